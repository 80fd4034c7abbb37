"""Matches that were read once and are kept sorted, so that no later stage reads and sorts them again.

They are kept as a database numbers keypoints, eight bytes a match: nothing of them depends on rotations or
intrinsics. All models of the images of one database share them.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import BoolArray, IntArray

UInt32Array = npt.NDArray[np.uint32]

MATCH_BYTES = 8
"""Of a match that is kept."""

MOST_MATCHES = 64_000_000
"""Of a database with more, in 0.5 GB, none is kept: all are read from the file each time."""

MOST_BESIDE_TRACKS = 16_000_000
"""Of a database with more, none is kept while points are made of them: to read 30 million again takes a
twentieth of the time of a run, and to keep them an eighth of its memory."""


class SortedMatches:
    """The matches of the pairs of a database as far as they were read, by the rows that hold them."""

    def __init__(self, rowids: IntArray, swapped: BoolArray, counts: IntArray) -> None:
        """Make room for the matches of all pairs; memory is taken as they come.

        Args:
            rowids: (k,) the row of each pair.
            swapped: (k,) whether it has the second image first.
            counts: (k,) the matches of each pair, at most.
        """
        order = np.argsort(rowids)
        self._rowids, self._swapped = rowids[order], swapped[order]
        ends = np.cumsum(counts)
        self._starts = (ends - counts)[order]
        self._size = int(ends[-1]) if len(ends) else 0
        self.clear()

    def clear(self) -> None:
        """Give back the memory of the matches until they are read again."""
        self._lengths = np.full(len(self._rowids), -1)
        self._keypoints = np.empty((self._size, 2), dtype=np.uint32)

    def places(self, rowids: IntArray, swapped: BoolArray) -> IntArray:
        """Return the places (m,) of pairs by their rows, -1 for a pair that is not here in that order."""
        if len(self._rowids) == 0:
            return np.full(len(rowids), -1)
        found = np.minimum(np.searchsorted(self._rowids, rowids), len(self._rowids) - 1)
        same = (self._rowids[found] == rowids) & (self._swapped[found] == swapped)
        return np.where(same, found, -1)

    def read(
        self, places: IntArray, read: Callable[[IntArray], tuple[IntArray, UInt32Array]]
    ) -> tuple[IntArray, UInt32Array]:
        """Return the matches of pairs by their places: how many of each, (m,), and all of them, (M, 2).

        Args:
            places: (m,) of the pairs, none of them -1.
            read: returns the same of the pairs at these positions in `places`, which are new.
        """
        new = np.flatnonzero(self._lengths[places] < 0)
        if len(new):
            lengths, matches = read(new)
            shifts = self._starts[places[new]] - (np.cumsum(lengths) - lengths)
            self._keypoints[np.repeat(shifts, lengths) + np.arange(len(matches))] = matches
            self._lengths[places[new]] = lengths
        lengths, starts = self._lengths[places], self._starts[places]
        if len(places) and (starts[1:] == starts[:-1] + lengths[:-1]).all():
            return lengths, self._keypoints[starts[0] : starts[-1] + lengths[-1]]
        shifts = starts - (np.cumsum(lengths) - lengths)
        return lengths, self._keypoints[np.repeat(shifts, lengths) + np.arange(lengths.sum())]
