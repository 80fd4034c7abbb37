"""Verdicts, uncertainty and trust of a solved view graph."""

import numpy as np
import pytest

from sfm_shapefit.base.geometry import normalized, tangent_bases
from sfm_shapefit.graph.measured import Evidence, MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.verdicts import Verdict, assess
from sfm_shapefit.placement.conditioning import Looseness
from sfm_shapefit.refinement.agreement import find_agreement
from sfm_shapefit.solver.program import differences
from tests.problems import all_pairs, fit_angles

SIGMA = 0.01  # rad, per axis


def measured(seed, n=12, sigma=SIGMA):
    """All pairs of n cameras, directions with normal errors of `sigma` per axis."""
    rng = np.random.default_rng(seed)
    t = rng.standard_normal((n, 3))
    edges = np.array(all_pairs(n))
    v = normalized(differences(t, edges))
    errors = sigma * rng.standard_normal((len(edges), 2))
    return t, edges, normalized(v + np.einsum("edk,ek->ed", tangent_bases(v), errors))


def covariances(count, sigma=SIGMA):
    return np.tile(sigma**2 * np.eye(2), (count, 1, 1))


def test_wrong_and_reversed_directions_are_outliers_and_good_ones_are_not():
    t, edges, v = measured(0)
    v[3] = normalized(np.cross(v[3], v[4]))
    v[7] = -v[7]
    used = np.delete(np.arange(len(edges)), [3, 7])
    t = fit_angles(t, edges[used], v[used], 4)
    found = assess(MeasuredGraph(ViewGraph(12, edges, v), covariance=covariances(len(edges))), t)
    assert np.flatnonzero(~found.inliers).tolist() == [3, 7]
    assert found.residuals_deg[3] == pytest.approx(90.0, abs=5.0)
    assert found.residuals_deg[7] == pytest.approx(180.0, abs=5.0)
    assert found.level_deg == pytest.approx(np.degrees(SIGMA), rel=0.25)  # 66 residuals: 9 % at one sigma


def test_a_pair_that_knows_it_is_uncertain_is_not_blamed_unless_it_is_reversed():
    t, edges, v = measured(2)
    off, reverse = v.copy(), v.copy()
    off[3] = normalized(v[3] + 0.2 * tangent_bases(v[3:4])[0, :, 0])  # rad: 20 sigma of an ordinary pair
    reverse[3] = -v[3]
    for directions, sigma, agrees in ((off, SIGMA, False), (off, 0.1, True), (reverse, 2.0, False)):
        stated = covariances(len(edges))
        stated[3] = sigma**2 * np.eye(2)
        found = assess(MeasuredGraph(ViewGraph(12, edges, directions), covariance=stated), t)
        assert found.inliers[3] == agrees


@pytest.mark.parametrize("stated", [0.0, 0.5, 1.0])
def test_standard_deviations_cover_the_errors_of_least_squares(stated):
    """Whatever part of the noise the covariances state: the excess over the pairs is found."""
    within = []
    for seed in range(20):
        t, edges, v = measured(100 + seed, n=14)
        found = fit_angles(t, edges, v, 4)
        given = MeasuredGraph(ViewGraph(14, edges, v), covariance=covariances(len(edges), stated * SIGMA))
        judged = assess(given, found)
        centered, truth = found - found.mean(axis=0), t - t.mean(axis=0)
        errors = centered - truth * np.sum(centered**2) / np.sum(centered * truth)
        within.append(np.abs(errors) < judged.sigmas)
    # 840 errors: 1.6 % at one sigma, the noise's level is known to 5 % per seed; 68 % within 20 % is asked.
    assert np.mean(within) == pytest.approx(0.683, abs=0.07)


def test_the_excess_is_what_the_covariances_leave_unexplained():
    t, edges, v = measured(4, n=30)
    t = fit_angles(t, edges, v, 4)
    graph = ViewGraph(30, edges, v)
    less, more = (
        find_agreement(MeasuredGraph(graph, covariance=covariances(len(edges), share * SIGMA)), t)
        for share in (0.6, 1.2)
    )
    assert less.excess_rad == pytest.approx(0.8 * SIGMA, rel=0.15)
    assert more.excess_rad.max() < 1e-6


def test_a_pair_that_no_other_checks_is_undetermined():
    t, edges, v = measured(5, n=8)
    pendant = np.array([[0.5, 0.5, 3.0]])
    t = np.concatenate([t, pendant])
    own = np.array([(0, 8), (1, 8)])
    edges = np.concatenate([edges, own])
    v = np.concatenate([v, normalized(differences(t, own))])
    sure = covariances(len(edges))
    sure[-2] *= 1e4  # two directions hold a point; of an exact and a rough one nothing checks the exact one
    found = assess(MeasuredGraph(ViewGraph(9, edges, v), covariance=sure), t)
    assert found.verdict(len(edges) - 1) is Verdict.UNDETERMINED
    assert found.verdict(0) is Verdict.INLIER
    assert found.leverages[-1] > 0.99


def test_a_camera_that_no_agreeing_pair_holds_has_infinite_uncertainty():
    t, edges, v = measured(6)
    own = np.flatnonzero((edges == 4).any(axis=1))
    v[own] = -v[own]
    found = assess(MeasuredGraph(ViewGraph(12, edges, v), covariance=covariances(len(edges))), t)
    assert np.isinf(found.sigmas[4]).all()
    assert np.isfinite(np.delete(found.sigmas, 4, axis=0)).all()
    assert found.trust[4] == 0.0


def test_coincident_cameras_and_unknown_covariances_do_not_produce_nan():
    t, edges, v = measured(3)
    v[3] = normalized(np.cross(v[3], v[4]))
    found = assess(MeasuredGraph(ViewGraph(12, edges, v), covariance=np.full((len(edges), 2, 2), np.nan)), t)
    assert np.flatnonzero(~found.inliers).tolist() == [3]  # judged by the common level
    t[1] = t[0]
    found = assess(MeasuredGraph(ViewGraph(12, edges, v), covariance=covariances(len(edges))), t)
    assert np.isfinite(found.residuals_deg).all()
    assert not np.isnan(found.sigmas).any()
    assert not found.inliers[0]


@pytest.mark.parametrize("reach", [1e4, 1e7, 1e12])
def test_cameras_that_fly_far_outside_are_not_trusted_and_cost_the_others_nothing(reach):
    """Three of them fly together: their pairs agree with them as well as with the rest."""
    t, edges, _ = measured(8, n=20)
    t[17:] = reach * normalized(t[17:])
    v = normalized(differences(t, edges))
    noise = SIGMA * np.random.default_rng(8).standard_normal((len(edges), 2))
    v = normalized(v + np.einsum("edk,ek->ed", tangent_bases(v), noise))
    found = assess(MeasuredGraph(ViewGraph(20, edges, v)), t)
    assert found.trust[17:].max() < 1e-6
    assert (found.sigmas[17:].max(axis=1) > 1.0).all()
    without = edges.max(axis=1) < 17
    alone = assess(MeasuredGraph(ViewGraph(17, edges[without], v[without])), t[:17])
    assert found.trust[:17].min() > 0.9
    np.testing.assert_allclose(found.sigmas[:17], alone.sigmas, rtol=0.5)


def test_nodes_that_nothing_is_said_to_hold_hold_no_others():
    t, edges, v = measured(9)
    graph, own = ViewGraph(12, edges, v), (edges == 5).any(axis=1)
    found = assess(MeasuredGraph(graph), t, undetermined_nodes=np.array([5]))
    assert np.isinf(found.sigmas[5]).all()
    assert found.trust[5] == 0.0
    assert found.reasons[5] == Looseness.DISTANCE.value
    assert [(g.cameras.tolist(), g.cause) for g in found.loose_groups] == [([5], Looseness.DISTANCE)]
    assert found.inliers[own].all()  # they fit all the same
    assert np.isnan(found.leverages[own]).all()
    first = int(np.flatnonzero(own)[0])
    assert found.verdict(first) is Verdict.UNDETERMINED
    others, _ = graph.restricted_to(np.flatnonzero(~own))
    alone = assess(MeasuredGraph(others), np.delete(t, 5, axis=0))
    np.testing.assert_allclose(np.delete(found.sigmas, 5, axis=0), alone.sigmas, rtol=0.1)
    assert np.delete(found.trust, 5).min() > 0.9
    assert assess(MeasuredGraph(graph), t, undetermined_nodes=np.empty(0, dtype=np.int64)).trust[5] > 0.9


def test_errors_that_pairs_share_widen_the_standard_deviations():
    t, edges, v = measured(seed=3)
    graph = ViewGraph(len(t), edges, v)
    where = fit_angles(t, edges, v, 4)
    unit = np.random.default_rng(0).standard_normal((len(edges), 96, 2))

    def sigmas(size):
        evidence = Evidence(contradicting=np.zeros((0, 2), dtype=np.int64), errors=size * SIGMA * unit)
        measured = MeasuredGraph(graph, covariance=covariances(len(edges)), evidence=evidence)
        return assess(measured, where).sigmas

    np.testing.assert_allclose(sigmas(6.0), 3.0 * sigmas(2.0), rtol=0.25)  # 1 if only the excess counted
