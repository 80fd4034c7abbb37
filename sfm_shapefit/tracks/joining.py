"""Observations joined to tracks by the matches that agree with an epipolar geometry, compiled.

Who is joined with whom is a forest over compact arrays (union by the smaller number, paths halved as they are
walked: Tarjan and van Leeuwen 1984): eight bytes an observation, whatever the number of matches, which pass
by once and are not held. Every root is the smallest number of its tree, so that the answer does not depend
on the order of matches.
"""

from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import AnyArray
from sfm_shapefit.base.forests import root_of
from sfm_shapefit.base.jit import kernel


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


def number_trees(parents: AnyArray, order: AnyArray) -> AnyArray:
    """Return the number of the tree of each node (k,), trees numbered by their first node in `order`.

    Args:
        parents: (k,) the forest; paths in it become shorter.
        order: (m,) nodes; those of other trees get -1.
    """
    numbers: AnyArray = np.empty_like(parents)
    _number_trees(parents, order, numbers)
    return numbers
