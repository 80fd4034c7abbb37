"""Lists of different lengths, whose rows stand in one table, one list after the other."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import AnyArray, IndexArray, IntArray, stable_order


def offsets_of(lengths: npt.ArrayLike) -> IntArray:
    """Return where lists of some lengths (k,) begin in their table, and the end of the last, (k + 1,)."""
    return np.append(0, np.cumsum(lengths, dtype=np.int64))


class Lists:
    """Lists of rows of a table, one after the other: list k has the rows offsets[k]:offsets[k + 1]."""

    __slots__ = ()
    offsets: IntArray
    """(k + 1,)"""

    def lengths(self) -> IntArray:
        """Return the number of rows of each list, (k,)."""
        return np.diff(self.offsets)

    def list_of_rows(self) -> IntArray:
        """Return the list that each row stands in."""
        return self.spread(np.arange(len(self.offsets) - 1))

    def spread(self, values: AnyArray) -> AnyArray:
        """Return the value of each row's list, of values (k, ...) of the lists."""
        return np.repeat(values, self.lengths(), axis=0)  # type: ignore[return-value]

    def ranks(self) -> IntArray:
        """Return which row of its list each row is, from 0 on."""
        return np.arange(self.offsets[-1]) - self.spread(self.offsets[:-1])

    def cuts(self, most: int) -> Iterator[IntArray]:
        """Yield the offsets of some lists after the other, (q + 1,), about so many rows at a time at most."""
        number, total = -(-int(self.offsets[-1]) // most) or 1, int(self.offsets[-1])
        cuts = np.searchsorted(self.offsets, np.arange(1, number) * total // number).tolist()
        for first, end in pairwise([0, *cuts, len(self.offsets) - 1]):
            yield self.offsets[first : end + 1]

    def slice_of(self, k: int) -> slice:
        """Return the rows of a list."""
        return slice(int(self.offsets[k]), int(self.offsets[k + 1]))

    def slices(self) -> list[slice]:
        """Return the rows of each list."""
        return [slice(*ends) for ends in pairwise(self.offsets.tolist())]

    def rows_of(self, chosen: IntArray) -> "RowLists":
        """Return the rows of some lists, in that order."""
        lengths = self.lengths()[chosen]
        offsets = offsets_of(lengths)
        rows = np.repeat(self.offsets[chosen] - offsets[:-1], lengths)
        rows += np.arange(offsets[-1])  # in place, for many rows
        return RowLists(offsets, rows)


@dataclass(frozen=True, slots=True, eq=False)
class RowLists(Lists):
    """Lists of rows of other arrays; the rows of list k are rows[offsets[k]:offsets[k + 1]]."""

    offsets: IntArray
    """(k + 1,)"""
    rows: IntArray
    """(m,) numbers, 32 bits each where there may be very many."""

    @classmethod
    def by_label(cls, labels: IndexArray, count: int = 0) -> "RowLists":
        """Return a list for each of `count` labels or more, of the rows (m,) that have it, ascending.

        Rows whose label is negative are in none.
        """
        is_in = labels >= 0
        rows = stable_order(labels)[len(labels) - np.count_nonzero(is_in) :]
        return cls(offsets_of(np.bincount(labels.compress(is_in), minlength=count)), rows)

    def __iter__(self) -> Iterator[IntArray]:
        """Return the rows of each list in turn."""
        return (self.rows[own] for own in self.slices())

    def subset(self, chosen: IntArray) -> "RowLists":
        """Return some of the lists, in that order."""
        return self.of(self.rows_of(chosen))

    def blocks(self, most: int) -> Iterator["RowLists"]:
        """Yield the lists in turn, as `cuts` has them."""
        for begins in self.cuts(most):
            yield RowLists(begins - begins[0], self.rows[begins[0] : begins[-1]])

    def of(self, lists: "RowLists") -> "RowLists":
        """Return lists of rows of this one's rows as lists of rows of the other arrays."""
        return RowLists(lists.offsets, self.rows[lists.rows])
