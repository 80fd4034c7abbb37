"""What was measured, and parts of it: everything is renumbered together."""

import numpy as np

from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.graph.measured import Evidence, MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph

# Five cameras and two points; the last two edges go to points.
EDGES = np.array([(0, 1), (1, 2), (2, 4), (3, 4), (1, 5), (4, 6)])
MEASURED = MeasuredGraph(
    ViewGraph(7, EDGES, np.tile([1.0, 0.0, 0.0], (6, 1)), 1.0 + np.arange(6), [f"n{k}" for k in range(7)]),
    covariance=np.arange(6.0)[:, None, None] * np.eye(2),
    evidence=Evidence(contradicting=np.array([(1, 4), (0, 3)])),
    num_points=2,
    groups=RigidGroups(group_of=[0, 1, 1, 0, 2, 3, 4], offsets=np.arange(21.0).reshape(7, 3)),
    fixed_group=2,
)


def test_pairs_are_the_edges_among_cameras_and_a_bare_graph_has_cameras_only():
    assert MEASURED.num_cameras == 5
    assert MEASURED.is_pair.tolist() == [True] * 4 + [False] * 2
    assert MEASURED.pairs.tolist() == [0, 1, 2, 3]
    assert MEASURED.classes.tolist() == [0, 0, 0, 0, 1, 1]
    assert MEASURED.cameras_per_group.tolist() == [2, 2, 1, 0, 0]
    bare = MeasuredGraph(MEASURED.graph)
    assert bare.num_cameras == 7
    assert not bare.classes.any()
    assert bare.part(np.array([0]))[0].covariance is None


def test_without_points_all_cameras_keep_their_numbers():
    bare = MEASURED.without_points()
    assert (bare.num_cameras, bare.num_points) == (5, 0)
    assert bare.graph.edges.tolist() == EDGES[:4].tolist()
    assert bare.graph.names == tuple(f"n{k}" for k in range(5))
    assert bare.covariance[:, 0, 0].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert bare.evidence.contradicting.tolist() == [[1, 4], [0, 3]]
    assert bare.groups.num_groups == 3
    assert bare.fixed_group == 2
    assert bare.without_points() is bare
