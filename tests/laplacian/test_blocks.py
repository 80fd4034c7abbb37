"""Graphs cut into blocks by their weights, and blocks grown by what is tied most to them."""

import numpy as np
import pytest

from sfm_shapefit.laplacian.blocks import cut_graph, grow_blocks
from sfm_shapefit.laplacian.operators import Workers

NOBODY = np.zeros((0, 2), dtype=np.int64)


def two_groups():
    """Even and odd nodes: all are tied, those of one kind a hundred times as much as others."""
    edges = np.array([(i, j) for i in range(24) for j in range(i + 1, 24)])
    return edges, np.where((edges[:, 0] - edges[:, 1]) % 2 == 0, 1.0, 0.01)


@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e12])
def test_ties_that_are_weak_are_cut_whatever_the_unit_of_weights(unit):
    edges, weights = two_groups()
    blocks = cut_graph(24, edges, unit * weights, size=12)
    np.testing.assert_array_equal(blocks, blocks[0] ^ (np.arange(24) % 2))


def test_what_is_no_larger_than_a_block_or_has_no_edge_is_one_block():
    edges, weights = two_groups()
    assert not cut_graph(24, edges, weights, size=24).any()
    assert not cut_graph(24, NOBODY, np.zeros(0), size=12).any()
    assert grow_blocks(np.zeros(0, dtype=np.int64), NOBODY, np.zeros(0), 0.5) == []


def test_a_block_grows_by_the_nodes_that_all_its_edges_together_tie_most():
    block_of = np.array([0, 0, 0, 0, 1, 1, 1, 1])
    # Node 5 has two ties of 2 to the first block, 4 has one of 3, and 6 one of 1; 7 has none.
    edges = np.array([(0, 5), (1, 5), (2, 4), (3, 6), (6, 7)])
    grown = grow_blocks(block_of, edges, np.array([2.0, 2.0, 3.0, 1.0, 9.0]), 0.5)
    assert [block.tolist() for block in grown] == [[0, 1, 2, 3, 4, 5], [0, 2, 4, 5, 6, 7]]
    alone = grow_blocks(block_of, edges, np.ones(5), 0.0)
    assert [block.tolist() for block in alone] == [[0, 1, 2, 3], [4, 5, 6, 7]]


def test_rows_are_shared_among_threads_where_they_are_worth_it_and_each_once():
    starts = np.arange(0, 202, 2)  # 100 rows of two items
    for least, several in ((200, True), (201, False)):
        ranges = []
        Workers(3).share(starts, lambda begin, end, to=ranges: to.append((begin, end)), least)
        assert (len(ranges) > 1) is several
        rows = [row for begin, end in sorted(ranges) for row in range(begin, end)]
        assert rows == list(range(100))
