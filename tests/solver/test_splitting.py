"""Splitting for ShapeFit and LUD: agreement with the conic reference, exactness, and how it ends."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from sfm_shapefit import synthetic
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.solver.certificate import certify
from sfm_shapefit.solver.conic import solve_conic
from sfm_shapefit.solver.program import adjoint, along, differences, objective, scale_functional
from sfm_shapefit.solver.splitting.anderson import Anderson
from sfm_shapefit.solver.splitting.edges import (
    ALONG,
    CHANGE,
    INTERIOR,
    OBJECTIVE,
    PAIRING,
    EdgePasses,
    edge_data,
)
from sfm_shapefit.solver.splitting.engine import Goal, Iteration, Stop, Tuning
from sfm_shapefit.solver.splitting.linear import (
    IterativeSolver,
    Resources,
    laplacian_factor,
    predict_factor,
)
from sfm_shapefit.solver.splitting.lud import solve_lud
from sfm_shapefit.solver.splitting.split_then_newton import solve_hybrid
from tests.graph_families import comm, er, geo, seq
from tests.problems import CountedFactor, draw_graph, measure_graph, shape, solve_admm

small_problem = partial(draw_graph, n=24, p=0.7, sigma=0.05, weighted=True)  # dense, and its true locations


@pytest.mark.parametrize("d", [3, 5])
def test_noisy_weighted_problems_have_the_optimum_of_the_conic_reference_and_a_dual_that_certifies_it(d):
    graph, _ = small_problem(d, d=d)
    result = solve_admm(graph, 1e-13, 3000)
    reference, _, _ = solve_conic(graph, 1e-10, 200)
    assert result.stop is Stop.ACCURATE
    assert objective(graph, result.locations) == pytest.approx(objective(graph, reference), rel=1e-8)
    # The conic answer is the looser one: a gap of 1e-10 allows sqrt(1e-10) where the optimum is smooth.
    np.testing.assert_allclose(shape(result.locations), shape(reference), atol=1e-5)
    certificate = certify(graph, result.locations, result.dual)
    # Repairing the equality costs the square root of the objective's accuracy: sqrt(1e-13) = 3e-7.
    assert certificate.gap <= 1e-6 * certificate.objective
    assert certificate.equality_residual < 1e-12


def test_in_the_plane_the_noisy_optimum_is_approached_and_the_limit_is_not_hidden():
    # With d = 2 the objective is polyhedral and splitting slows down near a vertex: 1e-4 after 300 steps.
    graph, _ = small_problem(2, d=2)
    reference = objective(graph, solve_conic(graph, 1e-10, 200)[0])
    rough, strict = solve_admm(graph, 1e-3, 1000), solve_admm(graph, 1e-10, 600)
    assert rough.stop is Stop.ACCURATE
    assert objective(graph, rough.locations) <= reference * (1.0 + 5e-3)
    assert strict.stop in (Stop.STALLED, Stop.MAX_ITERATIONS)
    assert reference * (1.0 - 1e-9) <= objective(graph, strict.locations) <= reference * (1.0 + 1e-3)


def test_dual_and_locations_are_feasible_however_early_the_iteration_ends():
    graph, _ = small_problem(1, d=3)
    for iterations in (1, 3, 12):
        result = solve_admm(graph, 1e-12, iterations)
        assert (np.linalg.norm(result.dual, axis=1) <= graph.weights * (1.0 + 1e-12)).all()
        np.testing.assert_allclose(along(result.dual, graph.directions), 0.0, atol=1e-13)
        length = float(np.sum(scale_functional(graph) * result.locations))
        assert length == pytest.approx(graph.weights.sum(), rel=1e-12)


NOISE_FREE = {
    **{f"{d} dimensions": lambda d=d: small_problem(60 + d, d=d, sigma=0.0, q=0.1) for d in (2, 3, 5)},
    "geo": lambda: corrupted(*geo(400, 40, 3)),
    "er": lambda: corrupted(*er(300, 60, 3)),
}


def corrupted(edges, t):
    """Exact directions, a fifth of them replaced, and the true locations."""
    return measure_graph(edges, t, sigma=0.0, q=0.2, seed=3), t


@pytest.mark.parametrize("name", NOISE_FREE)
def test_noise_free_problems_are_solved_to_the_last_digits_in_spite_of_corruption(name):
    graph, t = NOISE_FREE[name]()
    result = solve_admm(graph, 1e-14, 1000)
    assert np.linalg.norm(shape(result.locations) - shape(t)) < 1e-12


def objectives(graph, *, accelerate, tol=1e-8):
    """Return the objective after each iteration of the splitting, with acceleration allowed or not."""
    seen, renewals = [], tuple(10 * 2**k for k in range(8))
    tuning = Tuning(relaxation=1.7, renewals=renewals, penalty=0.5, accelerate=accelerate)
    passes, kappa = EdgePasses(edge_data(graph, -np.inf), 1), float(graph.weights.sum())
    run = Iteration(passes, laplacian_factor(graph), tuning, scale_functional(graph), kappa)
    run.run(Goal(tol, 0.0, 2000), lambda info: seen.append(info.objective))
    passes.close()
    return np.array(seen)


def test_acceleration_saves_more_than_half_of_the_iterations_without_noise_and_is_not_used_with_it():
    edges, t = geo(400, 40, 3)
    exact = measure_graph(edges, t, sigma=0.0, q=0.2, seed=3)
    assert len(objectives(exact, accelerate=True)) < 0.5 * len(objectives(exact, accelerate=False))
    noisy = measure_graph(edges, t, sigma=0.05, q=0.2, seed=3)
    np.testing.assert_array_equal(*(objectives(noisy, accelerate=how) for how in (True, False)))


def test_acceleration_that_leads_astray_is_given_up_and_the_answer_is_exact():
    graph, t = draw_graph(24, n=6, d=2, q=0.2)
    seen = objectives(graph, accelerate=True, tol=1e-14)
    assert seen.max() > 10.0 * seen[0]  # from there on it begins again
    assert np.linalg.norm(shape(solve_admm(graph, 1e-14, 2000).locations) - shape(t)) < 1e-9


def test_the_splitting_goes_on_where_many_small_steps_are_left():
    """On loose communities ten steps of the present length are not nearly all that is left."""
    graph = measure_graph(*comm(600, 12, 1), sigma=0.05, q=0.1, seed=1)
    best = objective(graph, solve_admm(graph, 1e-9, 3000).locations)
    # Measured: 0.09 of the tolerance; 0.47 if the step alone is looked at.
    assert objective(graph, solve_admm(graph, 1e-4, 2000).locations) < best * (1.0 + 0.3e-4)


def test_the_number_of_iterations_does_not_grow_with_the_number_of_cameras():
    counts = []
    for n in (1000, 4000):
        edges, t = geo(n, 40, 1)
        graph = measure_graph(edges, t, sigma=0.01, q=0.2, seed=1)
        result = solve_admm(graph, 1e-6, 500)
        assert result.stop is Stop.ACCURATE
        counts.append(result.iterations)
    assert max(counts) <= 1.3 * min(counts)


def test_a_factor_that_would_not_fit_is_replaced_by_conjugate_gradients_with_the_same_answer():
    edges, t = comm(600, 40, 1)
    graph = measure_graph(edges, t, sigma=0.01, q=0.2, seed=1)
    iterative = laplacian_factor(graph, Resources(memory_bytes=1000))
    assert isinstance(iterative, IterativeSolver)
    assert not isinstance(laplacian_factor(graph), IterativeSolver)
    direct, inexact = (
        solve_admm(graph, 1e-7, 1000),
        solve_admm(graph, 1e-7, 1000, Resources(factor=iterative)),
    )
    assert inexact.stop is Stop.ACCURATE
    assert objective(graph, inexact.locations) == pytest.approx(objective(graph, direct.locations), rel=1e-6)


class _Useless:
    """A Laplacian solver that does next to nothing."""

    def refactor(self, weights):
        self.scale = 1e-4 / weights.max()

    def solve(self, rhs):
        return self.scale * rhs


def test_solves_that_are_too_inexact_are_reported_as_a_stall():
    edges, t = seq(200, 12, 1)
    graph = measure_graph(edges, t, sigma=0.01, q=0.1, seed=1)
    result = solve_admm(graph, 1e-8, 2000, Resources(factor=_Useless()))
    assert result.stop is Stop.STALLED
    assert "allow more memory" in result.stop.value


def test_the_callback_sees_every_iteration_and_can_cancel():
    graph, _ = small_problem(6, d=3)
    seen = []

    def watch(info):
        seen.append(info)
        return info.iteration < 7

    result = solve_admm(graph, 1e-12, 100, on_iteration=watch)
    assert result.stop is Stop.CANCELLED
    assert [info.iteration for info in seen] == [1, 2, 3, 4, 5, 6, 7]
    assert result.iterations == 7
    assert seen[-1].objective == pytest.approx(objective(graph, result.locations), rel=1e-12)
    assert solve_lud(graph, 50, on_iteration=lambda info: info.iteration < 3).iterations == 3
    with pytest.raises(KeyError):  # what the callback raises reaches the caller
        solve_admm(graph, 1e-12, 100, on_iteration=lambda info: {}[info.iteration])


def lud_reference(graph):
    """LUD through cvxpy and Clarabel: optimal value and locations."""
    cp = pytest.importorskip("cvxpy")
    t, s = cp.Variable((graph.num_nodes, graph.dimension)), cp.Variable(graph.num_edges)
    i, j = graph.edges.T
    deviations = t[i] - t[j] - cp.multiply(cp.reshape(s, (graph.num_edges, 1), order="F"), graph.directions)
    program = cp.Problem(cp.Minimize(graph.weights @ cp.norm(deviations, 2, axis=1)), [s >= 1, t[0] == 0])
    program.solve(solver=cp.CLARABEL, tol_gap_abs=1e-9, tol_gap_rel=1e-9, tol_feas=1e-9)
    return program.value, t.value


@pytest.mark.parametrize("d", [2, 3])
def test_lud_has_the_optimum_of_a_conic_reference_and_its_bound_closes(d):
    graph, _ = small_problem(20 + d, d=d, n=16)
    value, locations = lud_reference(graph)
    result = solve_lud(graph, 3000, tol=1e-12)
    assert result.objective == pytest.approx(value, rel=1e-7)
    np.testing.assert_allclose(shape(result.locations), shape(locations), atol=1e-4)
    # The bound is below the optimum, and near it once the dual has converged.
    assert value * (1.0 - 1e-4) <= result.dual_bound <= value * (1.0 + 1e-7)
    assert result.equality_residual < 1e-12
    for iterations in (1, 2, 5, 20):  # from any early iterate the bound is below the optimum
        assert 0.0 <= solve_lud(graph, iterations).dual_bound <= value * (1.0 + 1e-7)


def test_the_bound_of_lud_is_found_in_few_steps_whatever_the_weights():
    """What restores the balance of the dual has no weights: nor has what conditions it, unlike the run."""
    graph, _ = small_problem(23, d=3, n=16)
    weights = 10.0 ** np.random.default_rng(23).uniform(-2.0, 2.0, graph.num_edges)
    graph = ViewGraph(16, graph.edges, graph.directions, weights)
    factor, iterations = CountedFactor(graph), []
    result = solve_lud(
        graph, 1000, tol=1e-12, resources=Resources(factor=factor), on_iteration=iterations.append
    )
    assert result.objective * (1.0 - 1e-6) <= result.dual_bound <= result.objective
    assert result.equality_residual < 1e-12
    assert factor.solved - len(iterations) <= 30


def test_lud_stands_on_a_chain_where_the_optimum_of_shapefit_collapses():
    edges, t = seq(300, 36, 1)
    graph = measure_graph(edges, t, sigma=0.01, q=0.1, seed=1)
    stretched = solve_lud(graph, 50, certified=False)
    collapsed, _, _ = solve_conic(graph, 1e-6, 200)
    assert solve_admm(graph, 1e-6, 500).stop in (Stop.STALLED, Stop.MAX_ITERATIONS)
    # Seeds 1 to 6: LUD 0.02 to 0.03, the optimum of ShapeFit 0.3 to 1.4 (sqrt(2) is no relation at all).
    assert np.linalg.norm(shape(stretched.locations) - shape(t)) < 0.06
    assert np.linalg.norm(shape(collapsed) - shape(t)) > 0.3


def plain_step(graph, least, x, t, rho, relaxation):
    """The proximal step of every edge as it is written in the module, without fusion."""
    v = graph.directions

    def residual(z):
        return z - np.maximum(along(z, v), least)[:, None] * v

    def clip(z):
        r = residual(z)
        norms = np.maximum(np.linalg.norm(r, axis=1), 1e-300)
        return np.minimum(1.0, graph.weights / rho / norms)[:, None] * r

    baselines = differences(t, graph.edges)
    x_next = relaxation * baselines + (1.0 - relaxation) * (x - clip(x)) + clip(x)
    u = clip(x_next)
    sums = {
        OBJECTIVE: graph.weights @ np.linalg.norm(residual(baselines), axis=1),
        PAIRING: np.sum(rho[:, None] * u * baselines),
        ALONG: rho @ along(u, v),
        CHANGE: np.sum(rho[:, None] * (x_next - x) ** 2),
        INTERIOR: np.sum(np.linalg.norm(rho[:, None] * u, axis=1) < graph.weights * (1.0 - 1e-9)),
    }
    y, y_next = x - clip(x), x_next - u
    residuals = np.sum(rho[:, None] * (baselines - y_next) ** 2), np.sum(rho[:, None] * (y_next - y) ** 2)
    pull = adjoint(rho[:, None] * (x_next - 2.0 * u - baselines), graph.edges, graph.num_nodes)
    return x_next, pull, [sums[k] for k in range(5)], residuals


@pytest.mark.parametrize("least", [-np.inf, 1.0])
@pytest.mark.parametrize("d", [2, 3, 5])
def test_the_fused_pass_is_the_proximal_step_written_plainly(d, least):
    graph, t = small_problem(40 + d, d=d)
    rng = np.random.default_rng(d)
    rho = rng.uniform(0.2, 5.0, size=graph.num_edges)
    x = rng.normal(size=graph.directions.shape)
    data = edge_data(graph, least)
    passes = EdgePasses(replace(data, bounds=(0, 50, 90, graph.num_edges)), 1)  # in three chunks
    order = passes.data.order
    ours = np.empty_like(x)
    pull, sums = passes.step(x[order], ours, t, rho[order], 1.7)
    x_next, expected_pull, expected_sums, residuals = plain_step(graph, least, x, t, rho, 1.7)
    np.testing.assert_allclose(ours, x_next[order], atol=1e-12)
    np.testing.assert_allclose(pull, expected_pull, atol=1e-11)
    np.testing.assert_allclose(sums, expected_sums, rtol=1e-12, atol=1e-11)
    np.testing.assert_allclose(passes.pull(ours, t, rho[order]), expected_pull, atol=1e-11)
    np.testing.assert_allclose(passes.imbalance(x[order], ours, t, rho[order]), residuals, rtol=1e-12)
    lengths = np.maximum(along(differences(t, graph.edges), graph.directions), least)
    errors = np.linalg.norm(differences(t, graph.edges) - lengths[:, None] * graph.directions, axis=1)
    np.testing.assert_allclose(passes.residuals(t), errors[order], atol=1e-12)


def test_new_penalties_keep_the_split_point_and_the_dual():
    graph, _ = small_problem(50, d=3)
    rng = np.random.default_rng(50)
    passes = EdgePasses(edge_data(graph, -np.inf), 1)
    x, rho = rng.normal(size=graph.directions.shape), rng.uniform(0.2, 5.0, size=graph.num_edges)
    dual = passes.dual(x, rho)
    point = x - dual / rho[:, None]
    other = rng.uniform(0.2, 5.0, size=graph.num_edges)
    passes.change_penalties(x, rho, other)
    np.testing.assert_allclose(passes.dual(x, other), dual, atol=1e-13)
    np.testing.assert_allclose(x - dual / other[:, None], point, atol=1e-13)


def test_edges_that_are_sorted_already_are_shared_with_the_graph_and_others_come_back_in_its_order():
    problem = synthetic.community_graph_problem(200, 12.0, sigma=0.01, q=0.1, seed=3)
    graph = problem.view_graph
    data = edge_data(graph, -np.inf)
    ascending = np.lexsort(graph.edges.T[::-1])
    assert (ascending == np.arange(graph.num_edges)).all()
    assert np.shares_memory(data.directions, graph.directions)
    shuffled = np.random.default_rng(3).permutation(graph.num_edges)
    other = ViewGraph(200, problem.edges[shuffled], problem.directions[shuffled])
    passes = EdgePasses(edge_data(other, -np.inf), 1)
    np.testing.assert_array_equal(passes.in_graph_order(passes.data.directions), other.directions)


@pytest.mark.parametrize(
    ("make", "degree", "is_ordered"),
    [
        (synthetic.expander_graph_problem, 20.0, False),
        (synthetic.box_graph_problem, 20.0, True),
        (synthetic.community_graph_problem, 30.0, True),
    ],
)
def test_expanders_are_not_ordered_and_others_are(make, degree, is_ordered):
    problem = make(6000, degree, sigma=0.0, q=0.0, seed=1)
    assert (predict_factor(problem.view_graph).tree is not None) == is_ordered


def test_slow_communities_are_freed_by_smaller_penalties_late():
    problem = synthetic.community_graph_problem(3000, 67.0, sigma=0.01, q=0.2, seed=1)
    graph = problem.view_graph
    factor, objectives = laplacian_factor(graph), []
    solve_admm(graph, 1e-9, 300, Resources(factor=factor), lambda info: objectives.append(info.objective))
    # 117 iterations to 1e-5 with the same balance at every renewal
    assert objectives[110] <= min(objectives) * (1.0 + 1e-5)


def test_acceleration_takes_the_best_combination_of_its_history():
    """Against least squares in the norm of rho; the history is kept in float32, to 1e-7."""
    m, d, memory = 700, 3, 3  # more edges than a block, in two chunks
    rng = np.random.default_rng(1)
    chunks = ((0, 0, 650), (1, 650, m))
    passes = SimpleNamespace(
        data=SimpleNamespace(bounds=(0, 650, m)), over_chunks=lambda run: [run(*chunk) for chunk in chunks]
    )
    acceleration, rho = Anderson(passes, (m, d), memory), rng.uniform(0.5, 2.0, m)
    points, images = rng.standard_normal((2, 6, m, d))
    for k in range(6):
        expected = images[k].copy()
        first = max(k - memory, 0)
        if k > 0:
            f = np.diff(images[first : k + 1], axis=0).reshape(k - first, -1)
            g = np.diff((images - points)[first : k + 1], axis=0).reshape(k - first, -1)
            root = np.repeat(np.sqrt(rho), d)
            gamma = np.linalg.lstsq((g * root).T, (images[k] - points[k]).ravel() * root, rcond=None)[0]
            expected -= (gamma @ f).reshape(m, d)
        found = acceleration.advance(points[k], images[k].copy(), rho)
        np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("family", [synthetic.box_graph_problem, synthetic.expander_graph_problem])
def test_a_whole_solve_is_the_same_to_the_bit_for_any_number_of_threads(family):
    problem = family(6000, 20.0, sigma=0.01, q=0.1, seed=1)
    graph = problem.view_graph
    one, two = (solve_hybrid(graph, 1e-4, 200, Resources(threads)) for threads in (1, 2))
    np.testing.assert_array_equal(one.locations, two.locations)
    np.testing.assert_array_equal(one.certificate.dual, two.certificate.dual)
    luds = (solve_lud(graph, 10, certified=False, resources=Resources(threads)) for threads in (1, 2))
    np.testing.assert_array_equal(*(found.locations for found in luds))
