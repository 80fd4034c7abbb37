"""Which cameras are trusted by directions alone: against wrong rotations, and wrong pairs everywhere."""

import numpy as np

from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.bodies import find_bodies
from sfm_shapefit.judgement.trust import judge_cameras
from sfm_shapefit.judgement.verdicts import assess
from sfm_shapefit.placement.conditioning import condition
from sfm_shapefit.solver.program import differences


def clean(n, seed, density=0.6):
    """Locations, a random graph and its exact directions."""
    rng = np.random.default_rng(seed)
    t = rng.standard_normal((n, 3))
    edges = np.array([(i, j) for i in range(n) for j in range(i + 1, n) if rng.random() < density])
    return t, edges, normalized(differences(t, edges))


def test_in_a_clean_graph_or_where_pairs_are_wrong_everywhere_nobody_is_blamed():
    t, edges, v = clean(40, 3)
    found = assess(MeasuredGraph(ViewGraph(40, edges, v)), t)
    assert found.trust.min() > 0.99
    assert set(found.reasons) == {""}
    rng = np.random.default_rng(3)
    bad = rng.random(len(edges)) < 0.35
    v[bad] = normalized(rng.standard_normal((int(bad.sum()), 3)))
    assert assess(MeasuredGraph(ViewGraph(40, edges, v)), t).trust.min() > 0.7


def test_a_camera_most_of_whose_pairs_contradict_it_is_not_trusted():
    t, edges, v = clean(20, 7)
    own = np.flatnonzero((edges == 3).any(axis=1))[2:]
    v[own] = normalized(np.random.default_rng(7).standard_normal((len(own), 3)))
    found = assess(MeasuredGraph(ViewGraph(20, edges, v)), t)
    assert found.trust[3] < 0.4
    assert "rotation" in found.reasons[3]
    assert np.delete(found.trust, 3).min() > 0.9


def judged(t, edges, agrees, sigma=0.0, groups=None):
    """The trust of cameras of one standard deviation along each axis."""
    sigmas = np.full(t.shape, sigma)
    measured = MeasuredGraph(ViewGraph(len(t), edges, normalized(differences(t, edges))), groups=groups)
    return judge_cameras(measured, t, agrees, sigmas, condition(t, edges, agrees, sigmas, len(t)))


def test_the_cameras_of_a_group_are_judged_by_all_its_pairs_and_one_without_any_as_is_usual():
    t, edges, _ = clean(20, 5)
    edges = edges[(edges != 0).all(axis=1)]
    agrees = ~(edges == 3).any(axis=1)
    alone = judged(t, edges, agrees).trust
    assert (alone[3], alone[0]) == (0.0, 1.0)
    labels = np.arange(20)
    labels[4] = 3  # a frame
    together = judged(
        t,
        edges,
        agrees,
        groups=RigidGroups(group_of=np.unique(labels, return_inverse=True)[1], offsets=np.zeros((20, 3))),
    )
    assert together.trust[3] == together.trust[4]
    assert 0.7 < together.trust[3] < 0.9  # 11 of its 19 pairs with others, where 0.95 is usual


def test_trust_is_half_where_pairs_leave_a_fifth_of_the_scene_open():
    t, edges, _ = clean(20, 6)
    spread = float(np.median(np.linalg.norm(t - np.median(t, axis=0), axis=1)))
    found = judged(t, edges, np.ones(len(edges), dtype=bool), 0.1 * spread)
    np.testing.assert_allclose(found.trust, 0.5, atol=0.01)
    assert all(found.reasons)


def test_bodies_join_while_more_speaks_for_it_than_against():
    pairs = np.array([(0, 1), (1, 2), (3, 4), (2, 3), (0, 4)])
    for last, joined in ((-2.0, [0] * 5), (-4.0, [0] * 3 + [1] * 2)):
        assert find_bodies(5, pairs, np.array([9.0, 8.0, 7.0, 3.0, last])).tolist() == joined
