"""scripts/benchmark.py trust: its statistics by hand, and its limits on one seed."""

import sys

import numpy as np
import pytest

from tests.scenes import ROOT

sys.path.insert(0, str(ROOT / "scripts"))  # as `python scripts/benchmark.py` does

from benchmarks import trust


def test_the_area_under_the_curve_counts_pairs_in_order_and_ties_half():
    bad = np.array([True, False, False, True])
    assert trust.area_under_curve(np.array([0.1, 0.5, 0.9, 0.5]), bad) == pytest.approx(3.5 / 4)
    assert trust.area_under_curve(np.array([0.9, 0.5, 0.1, 0.95]), bad) == 0.0


def test_errors_are_taken_after_shift_and_scale():
    rng = np.random.default_rng(0)
    truth, sigmas = rng.standard_normal((20, 3)), np.ones((20, 3))
    np.testing.assert_allclose(trust.error_ratios(3.0 * truth + 1.0, truth, sigmas), 0.0, atol=1e-12)
    sigmas[4] = np.inf
    moved = truth.copy()
    moved[4] += 100.0  # a camera that nothing holds neither counts nor disturbs the others
    np.testing.assert_allclose(trust.error_ratios(moved, truth, sigmas), 0.0, atol=1e-12)


@pytest.mark.parametrize("spoil", list(trust.SPOILED.values()))
def test_trust_ranks_the_errors_of_worse_cameras(spoil):
    area, num_bad = trust._ranked(spoil(0))
    assert num_bad > 0
    assert area > trust.LEAST_AUC


def test_standard_deviations_cover_errors_of_graphs_and_scenes():
    graphs = [trust._graph_ratios(trust.GRAPHS["box"](seed, 0.2)) for seed in range(2)]
    for ratios in (np.concatenate(graphs), trust._scene_ratios("facade", 0)):
        assert trust.COVERAGE[0] < np.mean(np.abs(ratios) < 1.0) < trust.COVERAGE[1]


def test_rotation_errors_are_taken_after_the_best_common_turn():
    from types import SimpleNamespace

    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    theirs = np.tile(np.eye(3), (5, 1, 1))
    ours = theirs @ turn
    ours[2] = np.diag([-1.0, -1.0, 1.0]) @ ours[2]
    model = SimpleNamespace(names=("a", "b", "c", "d", "e"), rotations=ours)
    truth = SimpleNamespace(names=("e", "d", "c", "b"), rotations=theirs[:4])
    errors = trust.rotation_errors_deg(model, truth)
    np.testing.assert_allclose(errors, [np.nan, 0.0, 180.0, 0.0, 0.0], atol=1e-5)
