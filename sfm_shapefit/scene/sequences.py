"""Sequences of images that one device took, as their names say: frames of a video, or numbered photographs.

Images of one sequence lie in one folder and have names that differ in their digits only. Numbers of a device
are dense, as frames of a video are, or differ by little, as times of day do; those of photographs that were
collected are spread over all there are.
"""

import re
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from sfm_shapefit.base.arrays import IntArray

_DIGITS = re.compile(r"\d+")
_FOLDER = re.compile(r"[^/\\]*$")  # what follows it
_SPARSEST = 50  # numbers for each image; a video of which every fiftieth frame was taken is as sparse
_NARROW = 0.01  # share of the largest number; that of the seconds of an hour in a time stamp is less
_MOST_DIGITS = 18  # which a 64-bit integer holds; the last ones tell images apart


def find_sequences(names: Sequence[str]) -> list[tuple[IntArray, IntArray]]:
    """Return the images of each sequence, as rows by ascending number, and these numbers."""
    alike = defaultdict[tuple[str, str], list[tuple[int, int]]](list)
    for row, name in enumerate(names):
        folder, stem = _FOLDER.sub("", name), name[_FOLDER.search(name).start() :]  # type: ignore[union-attr]
        stem, dot, _ = stem.rpartition(".")
        digits = "".join(_DIGITS.findall(stem))
        if dot and digits:
            alike[folder, _DIGITS.sub("#", stem)].append((int(digits[-_MOST_DIGITS:]), row))
    sequences = []
    for members in alike.values():
        numbers, rows = np.array(sorted(members), dtype=np.int64).T
        if np.ptp(numbers) <= max(_SPARSEST * len(rows), _NARROW * numbers[-1]):
            sequences.append((rows, numbers))
    return sequences
