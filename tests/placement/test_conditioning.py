"""What is rigid by its graph and loose by its geometry, and what is said of it."""

import numpy as np
import pytest

from sfm_shapefit.base.geometry import normalized, tangent_bases
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.verdicts import assess
from sfm_shapefit.placement.conditioning import Looseness
from sfm_shapefit.solver.program import differences
from tests.problems import all_pairs

SIGMA = 0.003  # rad


def judged(t, edges):
    """The assessment of the truth by directions with errors of SIGMA."""
    v = normalized(differences(t, edges))
    errors = SIGMA * np.random.default_rng(0).standard_normal((len(edges), t.shape[1] - 1))
    v = normalized(v + np.einsum("edk,ek->ed", tangent_bases(v), errors))
    return assess(
        MeasuredGraph(
            ViewGraph(len(t), edges, v),
            covariance=np.tile(SIGMA**2 * np.eye(t.shape[1] - 1), (len(edges), 1, 1)),
        ),
        t,
    )


def test_a_far_camera_seen_in_one_direction_is_loose_and_named_so_and_a_well_tied_one_is_not():
    t = np.random.default_rng(3).standard_normal((13, 3))
    assert judged(t, np.array(all_pairs(13))).loose_groups == ()
    t[12] = [0.0, 0.0, 60.0]
    found = judged(t, np.array(all_pairs(13)))
    assert [group.cameras.tolist() for group in found.loose_groups] == [[12]]
    assert found.loose_groups[0].cause is Looseness.PARALLEL
    assert Looseness.PARALLEL.value in found.reasons[12]
    t[12] /= 2.0
    few = judged(t, np.array([*all_pairs(12), (0, 12), (1, 12)]))
    assert few.loose_groups[0].cause is Looseness.FEW_PAIRS


@pytest.mark.parametrize("bend", [0.0, 1e-4])
def test_a_straight_run_is_loose_though_its_graph_is_rigid(bend):
    rng = np.random.default_rng(2)
    block = rng.standard_normal((10, 3))
    run = np.column_stack([np.arange(2.0, 8.0), bend * rng.standard_normal((6, 2))])
    t = np.concatenate([block, run])
    edges = all_pairs(10) + [(10 + i, 10 + j) for i, j in all_pairs(6)]
    # The first of the run is tied to the block well, and so is nothing else of it.
    edges += [(k, 10) for k in range(10)] + [(0, 15)]
    found = judged(t, np.array(edges))
    causes = {group.cause for group in found.loose_groups}
    members = np.concatenate([group.cameras for group in found.loose_groups])
    assert Looseness.ON_A_LINE in causes
    assert set(members.tolist()) <= set(range(10, 16))
    assert len(members) >= 3


def test_a_group_on_a_narrow_bridge_moves_together():
    rng = np.random.default_rng(5)
    block = rng.standard_normal((12, 3))
    group = rng.standard_normal((8, 3)) + np.array([40.0, 0.0, 0.0])
    edges = all_pairs(12) + [(12 + i, 12 + j) for i, j in all_pairs(8)]
    edges += [(0, 12), (1, 13), (2, 14)]
    found = judged(np.concatenate([block, group]), np.array(edges))
    assert any({12, 13, 14, 15} <= set(g.cameras.tolist()) for g in found.loose_groups)
    assert found.loose_groups[0].cause is Looseness.TOGETHER
