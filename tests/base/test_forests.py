"""Sets that unite."""

import numpy as np
import pytest
from scipy.sparse import coo_array, csgraph

from sfm_shapefit.base.forests import connected_components


@pytest.mark.parametrize(("n", "m"), [(1, 0), (50, 20), (1000, 600), (1000, 3000)])
def test_components_are_those_of_scipy_numbered_by_their_first_node(n, m):
    edges = np.random.default_rng(n + m).integers(0, n, (m, 2))
    links = coo_array((np.ones(m), tuple(edges.T)), shape=(n, n))
    expected = csgraph.connected_components(links, directed=False)[1]
    np.testing.assert_array_equal(connected_components(n, edges), expected)


def test_a_long_chain_in_any_order_is_one_component():
    order = np.random.default_rng(0).permutation(20_000)
    assert connected_components(20_000, np.column_stack([order[:-1], order[1:]])).max() == 0
    assert len(connected_components(0, np.zeros((0, 2), dtype=np.int64))) == 0
