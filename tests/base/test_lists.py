"""Lists of rows, one after the other in a table."""

import numpy as np
import pytest

from sfm_shapefit.base.lists import RowLists, offsets_of


@pytest.mark.parametrize("dtype", [np.int32, np.int64, np.uint32, np.uint64, np.bool_])
def test_offsets_of_lengths_of_any_type_are_whole_numbers_from_0_on(dtype):
    offsets = offsets_of(np.array([1, 0, 1], dtype=dtype))
    assert (offsets.tolist(), offsets.dtype) == ([0, 1, 1, 2], np.int64)


def test_lists_are_of_the_rows_with_a_label_ascending():
    lists = RowLists.by_label(np.array([2, -1, 0, 2, 0, 2]), 5)
    expected = [[2, 4], [], [0, 3, 5], [], []]
    assert [own.tolist() for own in lists] == expected
    assert lists.lengths().tolist() == [len(own) for own in expected]
    assert lists.list_of_rows().tolist() == [0, 0, 2, 2, 2]
    assert lists.ranks().tolist() == [0, 1, 0, 1, 2]
    assert lists.spread(np.array([[7, 1], [8, 2], [9, 3], [0, 0], [0, 0]]))[:, 0].tolist() == [7, 7, 9, 9, 9]
    assert lists.slice_of(2) == slice(2, 5)
    assert [own.tolist() for own in lists.subset(np.array([2, 1, 0]))] == [[0, 3, 5], [], [2, 4]]
    assert lists.rows_of(np.array([2, 0])).rows.tolist() == [2, 3, 4, 0, 1]
    assert [own.tolist() for own in RowLists.by_label(np.zeros(0, dtype=np.int64))] == []


def test_lists_of_rows_of_lists_are_lists_of_the_same_rows():
    outer, inner = RowLists.by_label(np.array([1, 0, 1, 0])), RowLists.by_label(np.array([1, -1, 0, 0]))
    assert [own.tolist() for own in outer.of(inner)] == [[0, 2], [1]]
