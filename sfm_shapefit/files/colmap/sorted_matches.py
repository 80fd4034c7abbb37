"""Matches that were read once and are kept sorted, so that no later stage reads and sorts them again.

They are kept as a database numbers keypoints, each match as one number of 64 bits, the keypoint of its first
image above that of the second: nothing of them depends on rotations or intrinsics, and numbers are sorted and
gathered faster than rows of two. All views of one database share them.
"""

from collections.abc import Callable

import numpy as np

from sfm_shapefit.base.arrays import IntArray, UInt32Array, UInt64Array

MATCH_BYTES = 8
"""Bytes of a match, kept or in a database; two keypoints of 32 bits."""

MOST_MATCHES = 64_000_000
"""Matches of a database, 0.5 GB; of more none is kept, and all are read from the file each time."""


class SortedMatches:
    """The matches of the pairs of a database as far as they were read."""

    def __init__(self, counts: IntArray) -> None:
        """Make room for the matches of all pairs, `counts` (k,) at most; memory is taken as they come."""
        ends = np.cumsum(counts)
        self._starts, self._size = ends - counts, int(ends[-1]) if len(ends) else 0
        self.clear()

    def clear(self) -> None:
        """Give back the memory of the matches until they are read again."""
        self._lengths = np.full(len(self._starts), -1)
        self._numbers = np.empty(self._size, dtype="<u8")

    def read(
        self, pairs: IntArray, read: Callable[[IntArray], tuple[IntArray, UInt64Array]]
    ) -> tuple[IntArray, UInt64Array]:
        """Return the matches of some pairs (m,): how many of each, (m,), and the numbers (M,) of all.

        Args:
            pairs: ascending.
            read: returns the same of pairs that are new.
        """
        new = pairs[self._lengths[pairs] < 0]
        if len(new):
            lengths, numbers = read(new)
            self._numbers[self._rows(new, lengths)] = numbers
            self._lengths[new] = lengths
        lengths = self._lengths[pairs]
        return lengths, self._numbers[self._rows(pairs, lengths)]

    def _rows(self, pairs: IntArray, lengths: IntArray) -> slice | IntArray:
        """Return where the matches of pairs (m,) stand, (M,), or from where to where if in one piece."""
        starts = self._starts[pairs]
        if len(pairs) and (starts[1:] == starts[:-1] + lengths[:-1]).all():
            return slice(starts[0], starts[-1] + lengths[-1])
        shifts = starts - (np.cumsum(lengths) - lengths)
        return np.asarray(np.repeat(shifts, lengths) + np.arange(lengths.sum()))


def keypoints_of(numbers: UInt64Array) -> UInt32Array:
    """Return the keypoints (M, 2) in the first and the second image of matches by their numbers (M,)."""
    return np.asarray(numbers, dtype="<u8").view("<u4").reshape(-1, 2)[:, ::-1]
