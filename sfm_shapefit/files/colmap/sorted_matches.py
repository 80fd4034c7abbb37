"""Matches that were read once and are kept sorted, so that no later stage reads and sorts them again.

They are kept as a database numbers keypoints, eight bytes a match: nothing of them depends on rotations or
intrinsics. All views of one database share them.
"""

from collections.abc import Callable

import numpy as np

from sfm_shapefit.base.arrays import IntArray, UInt32Array

MATCH_BYTES = 8
"""Bytes of a match that is kept; two keypoints of 32 bits."""

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
        self._keypoints = np.empty((self._size, 2), dtype=np.uint32)

    def read(
        self, pairs: IntArray, read: Callable[[IntArray], tuple[IntArray, UInt32Array]]
    ) -> tuple[IntArray, UInt32Array]:
        """Return the matches of some pairs (m,): how many of each, (m,), and all of them, (M, 2).

        Args:
            pairs: ascending.
            read: returns the same of pairs that are new.
        """
        new = pairs[self._lengths[pairs] < 0]
        if len(new):
            lengths, matches = read(new)
            self._keypoints[self._rows(new, lengths)] = matches
            self._lengths[new] = lengths
        lengths = self._lengths[pairs]
        return lengths, self._keypoints[self._rows(pairs, lengths)]

    def _rows(self, pairs: IntArray, lengths: IntArray) -> slice | IntArray:
        """Return where the matches of pairs (m,) stand, (M,), or from where to where if in one piece."""
        starts = self._starts[pairs]
        if len(pairs) and (starts[1:] == starts[:-1] + lengths[:-1]).all():
            return slice(starts[0], starts[-1] + lengths[-1])
        shifts = starts - (np.cumsum(lengths) - lengths)
        return np.asarray(np.repeat(shifts, lengths) + np.arange(lengths.sum()))
