"""Observations joined to tracks by the matches that agree with an epipolar geometry, compiled.

Who is joined with whom is a forest over compact arrays (union by the smaller number, paths halved as they are
walked: Tarjan and van Leeuwen 1984): eight bytes an observation, whatever the number of matches, which pass
by once and are not held. Every root is the smallest number of its tree, so that the answer does not depend
on the order of matches.
"""

from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import AnyArray, Int32Array
from sfm_shapefit.base.forests import root_of
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.base.lists import RowLists


@kernel
def _number_trees(parents: Any, order: Any, numbers: Any) -> int:
    """Write the number of the tree of each node by the first node of it in `order`; return how many."""
    count = 0
    for k in range(len(numbers)):
        numbers[k] = -1
    for position in range(len(order)):
        root = root_of(parents, order[position])
        if numbers[root] < 0:
            numbers[root] = count
            count += 1
        numbers[order[position]] = numbers[root]
    return count


@kernel
def _list_trees(parents: Any, begins: Any, offsets: Any, rows: Any) -> int:
    """Write the trees of several nodes, by their first node, and where each begins; return how many."""
    for k in range(len(parents)):
        parents[k] = root_of(parents, k)  # no larger than k, so that it is one already
        begins[parents[k]] += 1
    count, end = 0, 0
    for k in range(len(parents)):
        size, begins[k] = begins[k], -1
        if size > 1:
            begins[k] = end
            end += size
            count += 1
            offsets[count] = end
    for k in range(len(parents)):
        at = begins[parents[k]]
        if at >= 0:
            rows[at] = k
            begins[parents[k]] += 1
    return count


def list_trees(parents: Int32Array) -> RowLists:
    """Return the trees of two nodes or more, by their first node; the nodes of each ascend.

    The forest (k,) has the smallest node of each tree as its root, and is used up.
    """
    offsets = np.zeros(len(parents) // 2 + 1, dtype=np.int64)
    rows: Any = np.empty_like(parents)
    count = _list_trees(parents, np.zeros_like(parents), offsets, rows)
    return RowLists(offsets[: count + 1].copy(), rows[: offsets[count]])


def number_trees(parents: AnyArray, order: AnyArray) -> AnyArray:
    """Return the number of the tree of each node (k,), trees numbered by their first node in `order`.

    Args:
        parents: (k,) the forest; paths in it become shorter.
        order: (m,) nodes; those of other trees get -1.
    """
    numbers: AnyArray = np.empty_like(parents)
    _number_trees(parents, order, numbers)
    return numbers
