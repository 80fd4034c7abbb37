"""The certificate: what it makes of approximate duals, of spoilt ones, and of graphs it cannot serve."""

from types import SimpleNamespace

import numpy as np
import pytest

from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.approximate import approximate_cholesky, conjugate_gradients
from sfm_shapefit.laplacian.operators import adjacency
from sfm_shapefit.solver import certificate
from sfm_shapefit.solver.certificate import certify, certify_in_place
from sfm_shapefit.solver.newton.sparse import solve_newton_sparse
from sfm_shapefit.solver.program import across, adjoint, differences, objective, scale_functional
from sfm_shapefit.solver.splitting import split_then_newton as hybrid
from sfm_shapefit.solver.splitting.linear import IterativeSolver, Resources, laplacian_factor
from sfm_shapefit.solver.splitting.split_then_newton import HybridStop, solve_hybrid
from tests.graph_families import FAMILIES
from tests.problems import exact_graph, measure_graph, solve_admm


def draw_family(family, n, degree, *, sigma=0.01, q=0.2, seed=1):
    """A graph of a family with noisy and corrupted directions and uneven weights."""
    return measure_graph(*FAMILIES[family](n, degree, seed), sigma=sigma, q=q, seed=seed)


def complete(n, seed=0):
    """n cameras, all pairs, exact directions."""
    t = np.random.default_rng(seed).normal(size=(n, 3))
    return exact_graph(t), t


def assert_feasible(graph, certificate):
    """The dual is what it claims, recomputed here from the formulas."""
    y, v, w = certificate.dual, graph.directions, graph.weights
    assert np.all(np.linalg.norm(y, axis=1) <= w * (1.0 + 1e-14))
    assert np.abs(np.sum(y * v, axis=1)).max() <= 1e-14 * w.max()
    violation = adjoint(y, graph.edges, graph.num_nodes) - certificate.dual_bound * scale_functional(graph)
    degree = np.bincount(graph.edges.ravel(), weights=np.repeat(w, 2)).max()
    # What needs no repair: a 1e5th of the gap, from 1e-12 to 5e-10.
    allowed = min(max(1e-5 * certificate.gap, 1e-12), 5e-10)
    assert np.linalg.norm(violation, axis=1).max() <= 1.1 * allowed * degree


def unit_bound(graph, t, dual):
    """The bound after one repair in the metric of ones, as the certificate did before it had a better one."""
    edges, v, n = graph.edges, graph.directions, graph.num_nodes
    c, y = scale_functional(graph), across(dual, graph.directions)
    multiplier = np.sum(y * differences(t, edges)) / np.sum(c * t)
    h = conjugate_gradients(
        lambda x: adjoint(across(differences(x, edges), v), edges, n),
        approximate_cholesky(adjacency(n, edges), np.ones(len(edges)), 1),
        adjoint(y, edges, n) - multiplier * c,
        tol=1e-12,
        coupled_nodes=n,
    ).x
    y = y - across(differences(h, edges), v)
    return multiplier / max(1.0, np.max(np.linalg.norm(y, axis=1) / graph.weights))


@pytest.mark.parametrize(
    ("family", "n", "degree", "sigma", "iterations", "share"),
    [
        *(
            (family, 400, degree, sigma, iterations, 1.0)  # measured: closer by 1.4 to 1000 times
            for family, degree in (("geo", 24), ("comm", 40), ("er", 24))
            for sigma in (0.0, 0.01)
            for iterations in (25, 50)
        ),
        ("geo", 1000, 40, 0.01, 200, 0.01),
        ("seq", 400, 24, 0.01, 50, np.inf),  # a collapsing chain: little is proven
    ],
)
def test_the_repaired_dual_is_feasible_and_closer_than_by_the_unit_metric(
    family, n, degree, sigma, iterations, share
):
    graph = draw_family(family, n, degree, sigma=sigma)
    split = solve_admm(graph, 1e-5 if share < 1.0 else 1e-12, iterations)
    certificate = certify(graph, split.locations, split.dual)
    assert_feasible(graph, certificate)
    gap_by_unit = certificate.objective - unit_bound(graph, split.locations, split.dual)
    assert 0.0 <= certificate.gap <= share * gap_by_unit
    assert certificate.dual_bound > 0.0 or sigma == 0.0


def test_a_repair_stops_at_the_gap_asked_for_and_is_the_same_for_two_threads(monkeypatch):
    graph = draw_family("comm", 400, 40)
    split = solve_admm(graph, 1e-12, 100)
    steps = []

    def counted(*args, **kwargs):
        found = conjugate_gradients(*args, **kwargs)
        steps.append(found.iterations)
        return found

    monkeypatch.setattr(certificate, "conjugate_gradients", counted)
    monkeypatch.setattr(certificate, "_LARGE", 0)  # blocks of pairs, as for a large graph
    best = certify(graph, split.locations, split.dual)
    most, enough = len(steps), 10.0 * best.gap
    steps.clear()
    found = certify(graph, split.locations, split.dual, tol=enough)
    assert len(steps) < most
    assert_feasible(graph, found)
    assert best.gap < found.gap <= enough
    again = certify_in_place(graph, split.locations, split.dual.copy(), enough, np.inf, Resources(threads=2))
    assert np.array_equal(again.dual, found.dual)


@pytest.mark.parametrize(
    ("excess", "tol", "hopeless", "rounds"),
    [
        ((1e-3, 1e-4, 1e-5, 1e-6), 1e-4, np.inf, 3),  # after two the gap is small, but not what comes of it
        ((1e-3, 1e-4, 1e-5, 1e-6), 1e-3, np.inf, 2),
        ((1e-3, 1e-4, 1e-5, 1e-6), 0.0, np.inf, 4),  # the best bound: 1e-6 of excess is 2 % of the gap
        ((1e-3, 1e-4, 1e-5, 1e-6), 5e-6, np.inf, 3),  # missed anyway: 20 % will do
        ((1e-3, 1e-4, 1e-5, 1e-6), 5e-6, 5e-6, 1),  # given up at the second clipping
    ],
)
def test_clipping_goes_on_until_the_exact_repair_will_not_spoil_it(
    excess, tol, hopeless, rounds, monkeypatch
):
    restored = iter(excess)
    done = []
    monkeypatch.setattr(certificate, "_clip", lambda _: None)
    monkeypatch.setattr(certificate, "_violation", lambda *_: (0.2, None))
    monkeypatch.setattr(certificate, "_restore", lambda *_: done.append(1) or 1.0 + next(restored))
    gap = certificate._clip_in_rounds(SimpleNamespace(metric=None), None, None, 0.20001, tol, hopeless)
    assert len(done) == rounds
    assert gap == pytest.approx(1e-5 + (0.2 * excess[rounds - 1] if hopeless > 1.0 else 0.0), rel=1e-2)


def test_no_spoilt_dual_proves_more_than_the_optimum_and_wrong_locations_still_prove_a_bound():
    graph = draw_family("geo", 300, 24)
    t, y, _ = solve_newton_sparse(graph, 1e-10, 60)
    optimum = objective(graph, t)
    rng = np.random.default_rng(1)
    for size in (1e-6, 1e-3, 0.1, 10.0):
        certificate = certify(graph, t, y + size * rng.normal(size=y.shape))
        assert_feasible(graph, certificate)
        assert certificate.dual_bound <= optimum
    for spoilt in (np.roll(y, 1, axis=0), y + 0.3 * np.roll(y, 1, axis=0), -y, 0.0 * y):
        certificate = certify(graph, t, spoilt)
        assert_feasible(graph, certificate)
        assert certificate.dual_bound < optimum - 1e-3
    assert certify(graph, t, 5.0 * y).gap < 1e-8  # scaling is repaired
    assert certify(graph, t, -y).dual_bound == 0.0  # the zero dual is the floor
    one_wrong = y.copy()
    one_wrong[7] = 1e6
    elsewhere = t + 0.3 * rng.normal(size=t.shape)
    noisy = y + 1e-4 * rng.normal(size=y.shape)
    # Clipped, a single pair of 3600 that is wrong by its whole ball moves the bound little.
    for locations, dual, share in ((t, one_wrong, 0.9), (elsewhere, noisy, 0.5)):
        certificate = certify(graph, locations, dual)
        assert_feasible(graph, certificate)
        assert share * optimum <= certificate.dual_bound <= optimum


@pytest.mark.parametrize("size", [1e155, 1e300])
def test_a_dual_whose_sums_overflow_proves_nothing(size):
    graph, t = complete(12)
    spoilt = np.zeros((graph.num_edges, 3))
    spoilt[0] = size
    certificate = certify(graph, t, spoilt)
    assert_feasible(graph, certificate)
    assert np.isfinite(certificate.dual_bound)
    assert certificate.dual_bound <= objective(graph, t) + 1e-12


@pytest.mark.parametrize("row", [0, 1])
def test_a_violation_that_is_not_a_number_is_the_largest(row):
    total = np.ones((2, 3))
    total[row, 1] = np.nan
    assert certificate._unbalanced(total, np.zeros((2, 3)), 0.0) == np.inf


@pytest.mark.parametrize("n", [2, 3, 4, 12])
def test_exact_directions_need_no_more_than_the_zero_dual(n):
    graph, t = complete(n)
    noise = np.random.default_rng(n).normal(size=graph.directions.shape)
    for dual in (np.zeros_like(noise), 1e-3 * noise, noise):
        certificate = certify(graph, t, dual)
        assert certificate.gap <= 1e-12
        assert certificate.equality_residual <= 1e-12


def random_metric(d):
    """Return a metric of 9 cameras whose dual lies inside some balls, on some and outside of others."""
    rng = np.random.default_rng(d)
    edges = np.array([(i, j) for i in range(9) for j in range(i)])[rng.permutation(36)[:20]]
    v, y = rng.standard_normal((2, 20, d))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    y -= np.sum(y * v, axis=1, keepdims=True) * v
    w, stiffness = rng.uniform(0.5, 2.0, (2, 20))
    stiffness = (np.round(16.0 * stiffness) / 16.0).astype(np.float32)
    norms = np.repeat([0.3, 0.995, 1.7, 5.0], 5) * w
    y *= (norms / np.linalg.norm(y, axis=1))[:, None]
    # Few digits, so that the kernels' products of two numbers of single precision are exact.
    normal = np.where(np.arange(20) % 2, np.round(32.0 * np.sqrt(0.97) / norms) / 32.0, 0.0).astype(
        np.float32
    )
    for array in (edges, v, w):
        array.flags.writeable = False  # as those of a graph, for which the kernels are compiled
    metric = certificate._Metric(edges, v, w, stiffness, y, normal, tuple(range(d)))
    incidence = np.zeros((20, 9))
    incidence[np.arange(20), edges[:, 0]], incidence[np.arange(20), edges[:, 1]] = 1.0, -1.0
    return metric, incidence, rng


@pytest.mark.parametrize("d", [2, 3, 5])
def test_clipping_shortens_the_dual_to_its_balls_and_names_their_normals(d):
    metric, _, _ = random_metric(d)
    norms = np.linalg.norm(metric.y, axis=1)
    clipped = metric.y * np.minimum(1.0, metric.w / norms)[:, None]
    certificate._clip(metric)
    np.testing.assert_allclose(metric.y, clipped, rtol=1e-14)
    surface = np.sqrt(0.97) / np.linalg.norm(clipped, axis=1)
    np.testing.assert_allclose(metric.normal, np.where(norms > 0.99 * metric.w, surface, 0.0), rtol=1e-7)


@pytest.mark.parametrize("d", [2, 3, 5])
def test_a_step_moves_the_dual_by_the_metric_and_leaves_it_orthogonal(d):
    metric, incidence, rng = random_metric(d)
    h, y, v = rng.standard_normal((9, d)), metric.y.copy(), metric.v
    moved = incidence @ h
    flat = moved - np.sum(moved * v, axis=1, keepdims=True) * v
    u = metric.normal[:, None] * y
    step = metric.stiffness[:, None] * (flat - np.sum(flat * u, axis=1, keepdims=True) * u)
    total = np.empty((9, d))
    certificate._apply(metric, 0, 20, h, total)
    np.testing.assert_allclose(total, incidence.T @ step, atol=1e-13)

    metric.y[:] += 1e-3 * v  # what rounding might have left along v goes, too
    y += 1e-3 * v
    along_y = np.sum(moved * y, axis=1) * metric.normal.astype(float) ** 2
    expected = y - metric.stiffness[:, None] * (flat - along_y[:, None] * y)
    worst = certificate._move(metric, h)
    np.testing.assert_allclose(metric.y, expected - np.sum(expected * v, axis=1)[:, None] * v, atol=1e-13)
    assert np.abs(np.sum(metric.y * v, axis=1)).max() < 1e-14
    assert worst == pytest.approx(np.max(np.linalg.norm(metric.y, axis=1) / metric.w), rel=1e-14)


@pytest.mark.parametrize("size", [0.2, 1.0])
def test_projecting_a_dual_tells_its_sums_and_how_far_it_is_outside(size):
    metric, incidence, rng = random_metric(3)
    v, w = metric.v, metric.w
    y = size * w[:, None] * rng.uniform(-0.5, 0.5, (20, 3)) + rng.standard_normal((20, 1)) * v
    flat = y - np.sum(y * v, axis=1, keepdims=True) * v
    c, total, degrees = np.zeros((9, 3)), np.zeros((9, 3)), np.zeros(9)
    worst = certificate._project(metric.edges, v, w, y, c, total, degrees)
    np.testing.assert_allclose(y, flat, atol=1e-14)
    np.testing.assert_allclose(c, incidence.T @ (w[:, None] * v), atol=1e-14)
    np.testing.assert_allclose(total, incidence.T @ flat, atol=1e-14)
    np.testing.assert_allclose(degrees, np.abs(incidence).T @ w, rtol=1e-14)
    assert worst == pytest.approx(np.max(np.linalg.norm(flat, axis=1) / w), rel=1e-12)


def test_a_graph_in_two_pieces_is_refused():
    graph, t = complete(5)
    edges = np.concatenate([graph.edges, graph.edges + 5])
    twice = ViewGraph(10, edges, np.concatenate([graph.directions, graph.directions]))
    dual = np.random.default_rng(0).normal(size=twice.directions.shape)
    with pytest.raises(UnsolvableError, match="2 connected components"):
        certify(twice, np.concatenate([t, t]), dual)


def test_a_solver_without_fill_serves_as_well_and_takes_other_weights_as_if_it_were_new():
    graph = draw_family("geo", 600, 24)
    split = solve_admm(graph, 1e-5, 200)
    direct = certify(graph, split.locations, split.dual)
    neighbors = adjacency(graph.num_nodes, np.ascontiguousarray(graph.edges))
    used, new = IterativeSolver(neighbors), IterativeSolver(neighbors)
    certificate = certify_in_place(graph, split.locations, split.dual, 0.0, np.inf, Resources(factor=used))
    assert_feasible(graph, certificate)
    # The rounds stop at a tenth of the violation, not at the same point of it.
    assert certificate.gap <= 3.0 * direct.gap
    weights = np.random.default_rng(3).uniform(0.5, 2.0, graph.num_edges)
    for solver in (used, new):
        solver.refactor(weights)
    c = scale_functional(graph)
    assert np.array_equal(used.solve(c), new.solve(c))


def test_a_dual_may_be_made_feasible_in_place_and_is_otherwise_left_alone():
    graph = draw_family("geo", 300, 16)
    split = solve_admm(graph, 1e-4, 200)
    given = split.dual.copy()
    aside = certify(graph, split.locations, split.dual)
    assert np.array_equal(split.dual, given)
    in_place = certify_in_place(graph, split.locations, split.dual, 0.0, np.inf, Resources())
    assert np.shares_memory(in_place.dual, split.dual)
    assert np.array_equal(in_place.dual, aside.dual)
    assert in_place.dual_bound == aside.dual_bound


@pytest.mark.parametrize("sigma", [0.0, 0.01])
def test_newton_started_from_a_certified_point_needs_fewer_factorizations(sigma):
    graph = draw_family("geo", 400, 24, sigma=sigma)
    split = solve_admm(graph, 1e-7, 400)
    certificate = certify(graph, split.locations, split.dual)
    t, y, warm = solve_newton_sparse(graph, 1e-9, 60, start=(split.locations, certificate.dual))
    _, _, cold = solve_newton_sparse(graph, 1e-9, 60)
    assert certify(graph, t, y).gap <= 1e-9
    assert warm < cold


@pytest.mark.parametrize(("family", "degree"), [("geo", 24), ("comm", 40), ("er", 24)])
@pytest.mark.parametrize("sigma", [0.0, 0.01])
def test_the_hybrid_proves_the_gap_it_was_asked_for(family, degree, sigma):
    graph = draw_family(family, 400, degree, sigma=sigma)
    result = solve_hybrid(graph, 1e-8, 2000)
    assert result.stop in (HybridStop.CERTIFIED, HybridStop.NEWTON)
    assert certify(graph, result.locations, result.certificate.dual).gap <= 1e-8


def test_the_hybrid_leaves_a_collapsing_chain_to_newton_whose_steps_are_counted_on_and_can_be_cancelled():
    graph, seen = draw_family("seq", 300, 36, q=0.1), []
    result = solve_hybrid(graph, 1e-8, 2000, on_iteration=seen.append)
    assert result.stop is HybridStop.NEWTON
    assert result.factorizations > 0
    assert result.certificate.gap <= 1e-8
    assert solve_hybrid(graph, 1e-8, 2000, Resources(memory_bytes=300_000)).stop is HybridStop.TOO_LARGE
    assert len(seen) == result.iterations + result.factorizations
    assert [info.iteration for info in seen[: result.iterations + 1]] == list(range(1, result.iterations + 2))
    last = result.iterations + 2
    cancelled = solve_hybrid(graph, 1e-8, 2000, on_iteration=lambda info: info.iteration < last)
    assert (cancelled.stop, cancelled.factorizations) == (HybridStop.CANCELLED, 2)


def test_the_hybrid_ends_where_it_is_told_to():
    graph = draw_family("geo", 300, 24)
    limited = solve_hybrid(graph, 1e-8, 12)
    assert limited.stop is HybridStop.MAX_ITERATIONS
    assert limited.iterations == 12
    assert_feasible(graph, limited.certificate)
    cancelled = solve_hybrid(graph, 1e-8, 2000, on_iteration=lambda info: info.iteration < 20)
    assert cancelled.stop is HybridStop.CANCELLED
    assert cancelled.iterations == 20


def test_the_splitting_goes_on_for_what_the_certificate_missed(monkeypatch):
    graph = draw_family("geo", 400, 24)
    monkeypatch.setattr(hybrid, "_FIRST_TARGET_PER_TOL", 300.0)  # so that the first certificate misses
    again = solve_hybrid(graph, 1e-6, 2000)
    assert (again.stop, again.factorizations) == (HybridStop.CERTIFIED, 0)
    monkeypatch.setattr(hybrid, "_CERTIFICATES", 1)
    once = solve_hybrid(graph, 1e-6, 2000)
    assert (once.stop, once.iterations < again.iterations) == (HybridStop.NEWTON, True)


def test_a_certificate_within_reach_is_the_whole_one_and_one_out_of_reach_is_given_up(monkeypatch):
    graph = draw_family("comm", 1200, 30)
    split = solve_admm(graph, 1e-4, 200)
    whole = certify(graph, split.locations, split.dual)

    def certify_within(tol):
        return certify_in_place(graph, split.locations, split.dual.copy(), tol, tol, Resources())

    within = certify_within(2.0 * whole.gap)
    assert whole.gap <= within.gap <= 2.0 * whole.gap  # rounds may end earlier than for the best bound
    assert_feasible(graph, within)
    monkeypatch.setattr(certificate, "_restore_exactly", None)  # out of reach, it comes to no exact repair
    assert certify_within(0.3 * whole.gap) is None


@pytest.mark.parametrize("cheap", [True, False])
def test_newton_begins_at_the_split_point_and_then_anew_where_that_is_cheap(cheap, monkeypatch):
    graph = draw_family("seq", 300, 36, q=0.1)
    flops = 27.0 * laplacian_factor(graph).plan.flops
    monkeypatch.setattr(hybrid, "_CHEAP_FLOPS", flops if cheap else 0.99 * flops)
    monkeypatch.setattr(hybrid, "_NEWTON_STEPS", 1)  # too few from either point
    result = solve_hybrid(graph, 1e-8, 2000)
    assert (result.stop, result.factorizations) == (HybridStop.INACCURATE, 1 + cheap)
    monkeypatch.setattr(hybrid, "_NEWTON_FLOPS", 0.99 * flops)
    assert solve_hybrid(graph, 1e-8, 2000).stop is HybridStop.TOO_LARGE


@pytest.mark.parametrize("slides", [False, True])
@pytest.mark.parametrize("n", [12, 160])  # with 13 or 161 cameras: double precision alone, and single first
def test_uniqueness_is_judged_alike_by_a_dense_and_by_a_sparse_factor(n, slides, monkeypatch):
    graph, t = complete(n)
    if slides:  # the last camera hangs on the first by one pair, and fits wherever it stands along it
        edges = np.vstack([graph.edges, [[0, n]]])
        graph = ViewGraph(n + 1, edges, np.vstack([graph.directions, [[0.0, 0.0, 1.0]]]))
        t = np.vstack([t, t[0] - [0.0, 0.0, 1.0]])
    dual = np.zeros(graph.directions.shape)
    assert certify(graph, t, dual).unique is None
    by_dense = certify(graph, t, dual, uniqueness=True).unique
    monkeypatch.setattr(certificate, "prefers_dense_factor", lambda *_: False)
    assert certify(graph, t, dual, uniqueness=True).unique is by_dense
    assert by_dense is not slides
