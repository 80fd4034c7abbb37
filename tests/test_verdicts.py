"""Verdicts, uncertainty, trust and gauge of a solved view graph."""

import numpy as np
import pytest

from sfm_shapefit.gauge import choose_gauge
from sfm_shapefit.geometry import normalized, tangent_bases
from sfm_shapefit.robust import verdicts
from sfm_shapefit.robust.verdicts import assess
from sfm_shapefit.solver.program import differences
from sfm_shapefit.viewgraph import ViewGraph

SIGMA = 0.01  # rad, per axis


def measured(seed, n=12, sigma=SIGMA):
    """All pairs of n cameras, directions with normal errors of `sigma` per axis."""
    rng = np.random.default_rng(seed)
    t = rng.standard_normal((n, 3))
    edges = np.array([(i, j) for i in range(n) for j in range(i + 1, n)])
    v = normalized(differences(t, edges))
    errors = sigma * rng.standard_normal((len(edges), 2))
    return t, edges, normalized(v + np.einsum("edk,ek->ed", tangent_bases(v), errors))


def covariances(count, sigma=SIGMA):
    return np.tile(sigma**2 * np.eye(2), (count, 1, 1))


def test_wrong_and_reversed_directions_are_outliers_and_good_ones_are_not():
    t, edges, v = measured(0)
    v[3] = normalized(np.cross(v[3], v[4]))
    v[7] = -v[7]
    found = assess(ViewGraph(12, edges, v), t, covariances(len(edges)))
    assert np.flatnonzero(~found.inliers).tolist() == [3, 7]
    assert found.residuals_deg[3] == pytest.approx(90.0, abs=5.0)
    assert found.residuals_deg[7] == pytest.approx(180.0, abs=5.0)
    assert found.level_deg == pytest.approx(np.degrees(SIGMA), rel=0.25)  # 66 residuals: 9 % at one sigma


def test_trust_is_the_share_of_agreeing_pairs():
    t, edges, v = measured(1)
    wrong = np.flatnonzero((edges == 5).any(axis=1))[:4]
    v[wrong] = normalized(np.roll(v[wrong], 1, axis=1))
    found = assess(ViewGraph(12, edges, v), t, covariances(len(edges)))
    assert found.trust[5] == pytest.approx(7 / 11)
    assert found.trust.max() == 1.0


def test_a_pair_that_knows_it_is_uncertain_is_not_blamed():
    t, edges, v = measured(2)
    off = 0.2  # rad: 20 sigma of an ordinary pair
    v[3] = normalized(v[3] + off * tangent_bases(v[3:4])[0, :, 0])
    sure, unsure = covariances(len(edges)), covariances(len(edges))
    unsure[3] = 0.1**2 * np.eye(2)
    graph = ViewGraph(12, edges, v)
    assert not assess(graph, t, sure).inliers[3]
    assert assess(graph, t, unsure).inliers[3]


def test_unknown_covariances_are_judged_by_the_common_level():
    t, edges, v = measured(3)
    v[3] = normalized(np.cross(v[3], v[4]))
    found = assess(ViewGraph(12, edges, v), t, np.full((len(edges), 2, 2), np.nan))
    assert np.flatnonzero(~found.inliers).tolist() == [3]


def test_standard_deviations_predict_the_scatter_of_least_squares():
    t, edges, _ = measured(4)
    v = normalized(differences(t, edges))
    gauge = verdicts._gauge_directions(t)
    bases = tangent_bases(v)
    lengths = np.linalg.norm(differences(t, edges), axis=1)
    rows = np.zeros((2 * len(edges), 36))  # tangential change of each direction per change of the locations
    for e, (i, j) in enumerate(edges):
        rows[2 * e : 2 * e + 2, 3 * i : 3 * i + 3] = bases[e].T / lengths[e]
        rows[2 * e : 2 * e + 2, 3 * j : 3 * j + 3] = -bases[e].T / lengths[e]
    rng = np.random.default_rng(4)
    samples = np.linalg.pinv(rows) @ (SIGMA * rng.standard_normal((len(rows), 4000)))
    samples -= gauge @ (gauge.T @ samples)
    found = assess(ViewGraph(12, edges, v), t, covariances(len(edges)))
    # 4000 samples give a standard deviation to 1.1 %; four of those.
    np.testing.assert_allclose(found.sigmas.ravel(), samples.std(axis=1), rtol=0.045)


def test_sampled_standard_deviations_agree_with_the_exact_ones(monkeypatch):
    t, edges, v = measured(5, n=20)
    graph = ViewGraph(20, edges, v)
    exact = assess(graph, t, covariances(len(edges))).sigmas
    monkeypatch.setattr(verdicts, "_DENSE_UNKNOWNS", 0)
    sampled = assess(graph, t, covariances(len(edges))).sigmas
    # 200 samples: 5 % at one sigma, and the largest of 60 values is at 2.6 sigma or so.
    np.testing.assert_allclose(sampled, exact, rtol=0.2)
    np.testing.assert_array_equal(sampled, assess(graph, t, covariances(len(edges))).sigmas)


def test_a_camera_that_no_agreeing_pair_holds_has_infinite_uncertainty():
    t, edges, v = measured(6)
    own = np.flatnonzero((edges == 4).any(axis=1))
    v[own] = -v[own]
    found = assess(ViewGraph(12, edges, v), t, covariances(len(edges)))
    assert np.isinf(found.sigmas[4]).all()
    assert np.isfinite(np.delete(found.sigmas, 4, axis=0)).all()
    assert found.trust[4] == 0.0


def test_coincident_cameras_do_not_produce_nan():
    t, edges, v = measured(7)
    t[1] = t[0]
    found = assess(ViewGraph(12, edges, v), t, covariances(len(edges)))
    assert np.isfinite(found.residuals_deg).all()
    assert not np.isnan(found.sigmas).any()
    assert not found.inliers[0]


def test_the_input_gauge_is_recovered_without_turning_the_axes():
    t = measured(8)[0]
    gauge = choose_gauge(t, 7.0 * t + [1.0, -2.0, 3.0], "input")
    assert gauge.scale == "input"
    assert gauge.similarity.scale == pytest.approx(7.0, rel=1e-9)
    np.testing.assert_allclose(gauge.similarity.apply(t), 7.0 * t + [1.0, -2.0, 3.0], atol=1e-8)
    np.testing.assert_array_equal(gauge.similarity.rotation, np.eye(3))


def test_a_few_wild_cameras_do_not_set_the_scale():
    t = measured(9)[0]
    wild_input, wild_answer = 7.0 * t, t.copy()
    wild_input[3] += 1e4
    wild_answer[5] += 1e4
    assert choose_gauge(wild_answer, wild_input, "input").similarity.scale == pytest.approx(7.0, rel=1e-6)


@pytest.mark.parametrize("centers", [np.zeros((12, 3)), np.full((12, 3), 1e6)])
def test_without_input_centres_the_scale_is_unit_and_said_so(centers):
    t = measured(10)[0]
    gauge = choose_gauge(t, centers, "input")
    placed = gauge.similarity.apply(t)
    assert gauge.scale == "unit"
    assert "coincide" in gauge.statement
    np.testing.assert_allclose(placed.mean(axis=0), 0.0, atol=1e-12)
    assert np.median(np.linalg.norm(placed, axis=1)) == pytest.approx(1.0, rel=1e-12)


def test_centres_that_contradict_the_answer_do_not_turn_it_inside_out():
    t = measured(11)[0]
    gauge = choose_gauge(t, -t, "input")
    assert gauge.scale == "unit"
    assert gauge.similarity.scale > 0.0


def test_unit_can_be_asked_for():
    t = measured(12)[0]
    assert choose_gauge(t, 7.0 * t, "unit").scale == "unit"
