"""The Newton solver: agreement with the conic reference, exactness, invariances, optimality, edge cases."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.solver.certificate import certify
from sfm_shapefit.solver.conic import solve_conic
from sfm_shapefit.solver.newton import steps
from sfm_shapefit.solver.newton.dense import solve_newton_dense
from sfm_shapefit.solver.newton.irls_start import approach
from sfm_shapefit.solver.newton.sparse import solve_newton_sparse
from sfm_shapefit.solver.program import (
    across,
    adjoint,
    differences,
    normalize_locations,
    objective,
    scale_functional,
)
from sfm_shapefit.solver.solver_options import IterationInfo
from tests.problems import draw_graph, shape

TOL = 1e-8
SOLVERS = pytest.mark.parametrize("solver", [solve_newton_dense, solve_newton_sparse])


def solved(graph, solver=solve_newton_dense, tol=TOL):
    """Locations and dual, after the public certificate has confirmed the gap."""
    t, y, _ = solver(graph, tol, 100)
    assert np.isfinite(t).all()
    assert np.isfinite(y).all()
    assert certify(graph, t, y).gap <= tol
    return t, y


@settings(max_examples=25)
@given(
    seed=st.integers(0, 10_000),
    d=st.sampled_from([2, 3]),
    sigma=st.sampled_from([1e-3, 0.01]),
    q=st.sampled_from([0.0, 0.2]),
    solver=st.sampled_from([solve_newton_dense, solve_newton_sparse]),
)
def test_it_agrees_with_the_conic_reference(seed, d, sigma, q, solver):
    graph, _ = draw_graph(seed, n=10, d=d, sigma=sigma, q=q, weighted=True)
    t, y, _ = solver(graph, 1e-11, 100)
    reference, _, _ = solve_conic(graph, 1e-10, 200)

    bound = certify(graph, t, y).dual_bound
    # Both objectives are within their gaps of the optimum; ours was asked for 1e-11.
    assert objective(graph, t) <= objective(graph, reference) + 1e-11
    assert bound <= objective(graph, reference) + 1e-14
    ours, theirs = normalize_locations(graph, t), normalize_locations(graph, reference)
    diameter = np.linalg.norm(np.ptp(theirs, axis=0))
    # Where noise makes the minimum flat, the reference's locations are off by about the root of what its
    # objective is above our bound, which is up to 1e-12; elsewhere 1e-7 is met.
    excess = max(objective(graph, reference) - bound, 0.0)
    assert np.abs(ours - theirs).max() <= max(1e-7, np.sqrt(excess)) * diameter


@pytest.mark.parametrize("sigma", [0.05, 0.3, 1.0])
def test_with_much_noise_the_objective_agrees_with_the_reference(sigma):
    graph, _ = draw_graph(61, n=10, sigma=sigma, weighted=True)
    t, _ = solved(graph, tol=1e-12)
    reference, _, _ = solve_conic(graph, 1e-10, 200)
    assert objective(graph, t) == pytest.approx(objective(graph, reference), abs=2e-11)


@pytest.mark.parametrize(
    ("d", "solver"),
    [
        *((d, solver) for d in (2, 3) for solver in (solve_newton_dense, solve_newton_sparse)),
        (5, solve_newton_sparse),  # whose kernels are compiled in half the time of the dense one's
    ],
)
def test_noiseless_graphs_are_recovered_to_rounding(d, solver):
    graph, truth = draw_graph(d, n=24, d=d, q=0.15)
    t, y = solved(graph, solver, 1e-13)  # the error is a small multiple of the gap
    assert objective(graph, t) > 0.05  # the corrupted pairs are really there
    assert np.linalg.norm(shape(t) - shape(truth)) < 1e-12
    assert certify(graph, t, y, uniqueness=True).unique


@SOLVERS
def test_a_plane_graph_is_solved_by_the_kernels_of_space(solver):
    kernels = approach, steps.take_step
    solved(draw_graph(7)[0], solver)
    known = [len(k.signatures) for k in kernels]
    t, y = solved(draw_graph(7, d=2)[0], solver)
    assert [len(k.signatures) for k in kernels] == known
    assert t.shape[1] == y.shape[1] == 2
    assert t.flags.c_contiguous
    assert y.flags.c_contiguous


@SOLVERS
def test_exact_directions_give_the_truth_and_a_zero_dual(solver):
    graph, truth = draw_graph(7, q=0.0)
    t, y = solved(graph, solver, 1e-12)
    assert np.linalg.norm(shape(t) - shape(truth)) < 1e-12
    assert not y.any()
    assert certify(graph, t, y, uniqueness=True).unique


@SOLVERS
@pytest.mark.parametrize("d", [2, 3])
def test_two_nodes_stand_along_their_direction_whatever_it_is(solver, d):
    """The first guess fits to rounding, and no step may follow that."""
    for direction in normalized(np.random.default_rng(d).standard_normal((100, d))):
        graph = ViewGraph(2, [[0, 1]], direction[None])
        t, _ = solved(graph, solver)
        np.testing.assert_allclose(t[0] - t[1], direction, atol=1e-12)


@SOLVERS
def test_the_optimality_conditions_hold(solver):
    graph, _ = draw_graph(11, sigma=0.05, weighted=True)
    t, y = solved(graph, solver)
    r = across(differences(t, graph.edges), graph.directions)
    norms, w = np.linalg.norm(r, axis=1), graph.weights
    kappa = w.sum()
    assert np.sum(scale_functional(graph) * t) == pytest.approx(kappa, rel=1e-12)
    assert (np.linalg.norm(y, axis=1) <= w * (1 + 1e-12)).all()
    assert np.abs(np.sum(y * graph.directions, axis=1)).max() < 1e-12
    multiplier = np.sum(y * r) / kappa
    # Refined until the violation is 1e-13 of the mean degree, or 1e-5 of the gap before the last step.
    violation = adjoint(y, graph.edges, graph.num_nodes) - multiplier * scale_functional(graph)
    assert np.abs(violation).max() < 1e-10
    # Complementarity: every pair's share of the gap is positive and at most the whole of it.
    shares = (w * norms - np.sum(y * r, axis=1)) / kappa
    assert shares.min() > -1e-15
    assert shares.sum() <= TOL


@SOLVERS
@pytest.mark.parametrize("n", [2, 3, 4])
@pytest.mark.parametrize("d", [2, 3])
def test_the_smallest_graphs_are_solved(n, d, solver):
    graph, truth = draw_graph(n, n=n, d=d, p=1.0, q=0.0)
    t, _ = solved(graph, solver)
    assert np.linalg.norm(shape(t) - shape(truth)) < 1e-10


@SOLVERS
def test_corrupted_graphs_of_all_kinds_are_solved(solver):
    solved(draw_graph(31, q=1.0)[0], solver)
    solved(draw_graph(37, q=0.5, sigma=0.3, d=2)[0], solver)
    graph, truth = draw_graph(41)
    coincident = truth.copy()
    coincident[1] = coincident[0]
    baselines = differences(coincident, graph.edges)
    baselines[np.linalg.norm(baselines, axis=1) == 0.0] = [0.0, 0.6, 0.8]
    t, _ = solved(ViewGraph(16, graph.edges, normalized(baselines)), solver)
    assert np.linalg.norm(shape(t) - shape(coincident)) < 1e-6
    flipped = np.where(np.arange(graph.num_edges)[:, None] % 4 == 0, -1.0, 1.0) * graph.directions
    t, _ = solved(ViewGraph(16, graph.edges, flipped), solver)
    assert np.linalg.norm(shape(t) - shape(truth)) < 1e-6


def test_bound_and_objective_before_the_first_step_are_those_of_the_formulas():
    graph, _ = draw_graph(7, sigma=0.1)
    problem, iterate, _, _ = steps.allocate(graph, graph.dimension)
    rng = np.random.default_rng(7)
    iterate.r[:], iterate.feasible[:] = rng.standard_normal((2, *iterate.r.shape))
    progress = steps.NewtonProgress(*steps.measure_gap(problem, iterate))
    kappa = graph.weights.sum()
    expected = graph.weights @ np.linalg.norm(iterate.r, axis=1) / kappa
    assert progress.objective == pytest.approx(expected, rel=1e-12)
    assert progress.multiplier == pytest.approx(np.sum(iterate.r * iterate.feasible) / kappa, rel=1e-12)
    assert progress.gap == pytest.approx(progress.objective - progress.multiplier, rel=1e-12)


@SOLVERS
def test_directions_that_cancel_or_do_not_determine_anything_are_refused_or_solved_without_nan(solver):
    circle = np.array([[0, 1], [1, 2], [2, 0]])
    v = np.array([[np.cos(a), np.sin(a)] for a in (0.0, 2 * np.pi / 3, 4 * np.pi / 3)])
    same = ViewGraph(3, circle, np.tile([[1.0, 0.0]], (3, 1)))
    with pytest.raises(UnsolvableError):
        solver(same, TOL, 50)  # c = 0
    rounded = np.array([[1.0, 0.0], [1.0, 1e-14], [1.0, -2e-14]])
    with pytest.raises(UnsolvableError, match="cancel at every camera"):
        solver(ViewGraph(3, circle, rounded), TOL, 50)  # c is rounding
    t, y, _ = solver(ViewGraph(3, circle, v), TOL, 50)
    assert np.isfinite(t).all()
    assert np.isfinite(y).all()


@SOLVERS
def test_the_callback_sees_bounds_that_hold_changes_no_bit_and_can_cancel(solver):
    graph, _ = draw_graph(43, sigma=0.05, n=30)
    seen: list[IterationInfo] = []
    t, y, count = solver(graph, TOL, 100, seen.append)  # a callback makes it return every cycle
    assert [info.iteration for info in seen] == list(range(1, count + 1))
    assert all(info.dual_bound <= objective(graph, t) + 1e-15 for info in seen)
    assert seen[-1].objective - seen[-1].dual_bound <= TOL
    again, dual, _ = solver(graph, TOL, 100)
    assert (t == again).all()
    assert (y == dual).all()
    assert solver(graph, TOL, 100, lambda _: False)[2] == 1
    told: list[int] = []
    t, y, count = solver(graph, 1e-10, 2, lambda info: told.append(info.iteration))
    assert (count, told) == (2, [1, 2])
    assert 0.0 < certify(graph, t, y).gap < 0.2  # a bound even where the limit ends it


def test_graphs_begun_in_single_precision_are_recovered_to_rounding():
    graph, truth = draw_graph(67, n=160, p=0.15, q=0.1)  # 480 unknowns: it begins in single precision
    t, _ = solved(graph, tol=1e-13)
    assert np.linalg.norm(shape(t) - shape(truth)) < 1e-12


def test_where_single_precision_stalls_double_precision_ends():
    """Cameras in a row, each with the next three: 480 unknowns, and the row bends at hardly any cost."""
    rng, n = np.random.default_rng(1), 160
    t = np.column_stack([np.arange(n), 0.3 * rng.standard_normal((n, 2))])
    edges = np.array([(i, j) for i in range(n) for j in range(i + 1, min(n, i + 4))])
    noise = 1e-3 * rng.standard_normal((len(edges), 3))
    graph = ViewGraph(n, edges, normalized(normalized(t[edges[:, 0]] - t[edges[:, 1]]) + noise))
    calls = []

    def watch(info):  # without double precision steps would go on for ever, each from where it began
        calls.append(info.iteration)
        return len(calls) < 60

    t, y, _ = solve_newton_dense(graph, 1e-10, 100, watch)
    assert certify(graph, t, y).gap < 1e-10


@pytest.mark.parametrize("sigma", [0.0, 0.05])
def test_a_factor_in_single_precision_leads_to_the_same_answer_as_one_in_double(sigma):
    graph, _ = draw_graph(71, n=151, p=0.15, sigma=sigma, weighted=True)  # 453 unknowns
    single, double = (solved(graph, solver, 1e-11) for solver in (solve_newton_dense, solve_newton_sparse))
    assert np.abs(shape(single[0]) - shape(double[0])).max() < 1e-7  # both within 1e-11 of a curved minimum
    assert np.sum(scale_functional(graph) * single[0]) == pytest.approx(graph.weights.sum(), rel=1e-12)
    assert certify(graph, *single).equality_residual < 1e-12


def lengths(x):
    """Norms of the rows."""
    return np.linalg.norm(x, axis=1)


@pytest.mark.parametrize("is_dense", [False, True])
def test_both_starts_take_their_dual_from_the_residuals_where_they_begin(is_dense):
    graph, _ = draw_graph(3, n=30, sigma=0.05, weighted=True)
    problem, iterate, _, step = steps.allocate(graph, graph.dimension)
    started = approach(problem, iterate, step) if is_dense else steps.start_from(problem, problem.c, iterate)
    assert started
    residuals = across(differences(iterate.t, graph.edges), graph.directions)
    assert lengths(iterate.r) == pytest.approx(lengths(residuals), rel=1e-9)
    shares, along = lengths(iterate.y) / graph.weights, np.sum(iterate.y * iterate.r, axis=1)
    assert along == pytest.approx(lengths(iterate.y) * lengths(iterate.r), rel=1e-12)  # y_e points along r_e
    if is_dense:  # smoothed: the longer the residual, the nearer to the surface of the ball
        assert np.all(np.diff(shares[np.argsort(lengths(residuals))]) >= -1e-12)
        assert 0.0 < shares.min() < shares.max() < 1.0
    else:  # one factor for all: the longest touches its ball
        assert shares == pytest.approx(lengths(residuals) / lengths(residuals).max(), rel=1e-9)


def test_what_is_within_a_bound_has_no_larger_entry_and_no_nan():
    x = np.array([[1.0, -2.0], [0.5, 0.0]])
    assert steps.is_within(x, 2.0)
    assert not steps.is_within(x, 1.9)
    assert not steps.is_within(x * [[1.0, np.nan]], 2.0)


def least_squares(graph):
    """Return the locations of least sum w_e |P_e (t_i - t_j)|^2 at the scale of the program, (n, d)."""
    n, d = graph.num_nodes, graph.dimension
    incidence = np.zeros((graph.num_edges, n))
    rows = np.arange(graph.num_edges)
    incidence[rows, graph.edges[:, 0]], incidence[rows, graph.edges[:, 1]] = 1.0, -1.0
    blocks = np.eye(d) - graph.directions[:, :, None] * graph.directions[:, None, :]
    matrix = np.einsum("e,ei,eab,ej->iajb", graph.weights, incidence, blocks, incidence).reshape(n * d, n * d)
    return np.linalg.lstsq(matrix, scale_functional(graph).ravel(), rcond=None)[0].reshape(n, d)


@pytest.mark.parametrize("weighted", [False, True])
def test_on_a_dense_graph_the_start_is_near_the_optimum(weighted):
    graph, _ = draw_graph(5, n=40, p=0.5, q=0.25, weighted=weighted)
    problem, iterate, _, step = steps.allocate(graph, graph.dimension)
    assert approach(problem, iterate, step)
    assert np.vdot(problem.c, iterate.t) == pytest.approx(problem.kappa, rel=1e-12)
    assert np.linalg.norm(iterate.y, axis=1).max() < problem.w.max()
    assert (np.linalg.norm(iterate.y, axis=1) <= problem.w).all()
    optimum = objective(graph, solved(graph)[0])
    above = objective(graph, iterate.t) - optimum
    # Without a tenth of what least squares leave, the seven rounds would not be worth a step.
    assert above < 0.1 * (objective(graph, least_squares(graph)) - optimum)


def test_where_gradients_do_not_converge_the_start_is_that_of_least_squares():
    n = 60  # a chain of triangles
    truth = np.cumsum(np.random.default_rng(2).uniform(0.5, 1.5, (n, 3)), axis=0)
    edges = np.array([(i, i + k) for i in range(n) for k in (1, 2) if i + k < n])
    graph = ViewGraph(n, edges, normalized(differences(truth, edges)))
    problem, iterate, _, step = steps.allocate(graph, graph.dimension)
    assert not approach(problem, iterate, step)
    np.testing.assert_allclose(shape(solved(graph)[0]), shape(truth), atol=1e-6)
