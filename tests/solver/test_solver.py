"""ShapeFit solved and certified: exactness, optimality, and refusals."""

import importlib
import re
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.solver.certificate import certify
from sfm_shapefit.solver.factor_choice import prefers_dense_factor
from sfm_shapefit.solver.newton.sparse import solve_newton_sparse
from sfm_shapefit.solver.program import (
    adjoint,
    along,
    differences,
    objective,
    projected_length,
    scale_functional,
)
from sfm_shapefit.solver.solve import choose_method, solve
from sfm_shapefit.solver.solver_options import SolverOptions, Status
from sfm_shapefit.solver.splitting.split_then_newton import HybridStop
from sfm_shapefit.synthetic import box_graph_problem, expander_graph_problem, random_graph_problem
from tests.problems import all_pairs, exact_graph, shape

TOL = SolverOptions().tol
solving = importlib.import_module("sfm_shapefit.solver.solve")


def problem(seed, *, n=20, p=0.6, d=3, sigma=0.0, q=0.2, weighted=False):
    """A random problem of the paper's kind: the view graph and the true locations, centroid 0, norm 1."""
    drawn = random_graph_problem(n, p, d=d, sigma=sigma, q=q, seed=seed)
    weights = np.random.default_rng(seed).uniform(0.2, 3.0, len(drawn.edges)) if weighted else None
    return ViewGraph(n, drawn.edges, drawn.directions, weights), shape(drawn.locations)


def test_objective_and_lengths_are_those_of_the_formulas():
    graph, t = problem(3, n=9, p=0.8, sigma=0.1, weighted=True)
    v, weights, baselines = graph.directions, graph.weights, differences(t, graph.edges)
    lengths = np.sum(baselines * v, axis=1)
    np.testing.assert_allclose(along(baselines, v), lengths, rtol=1e-13)
    residuals = np.linalg.norm(baselines - lengths[:, None] * v, axis=1)
    assert projected_length(graph, t) == pytest.approx(weights @ lengths, rel=1e-13)
    expected = weights @ residuals / (weights @ lengths)
    assert objective(graph, t) == pytest.approx(expected, rel=1e-13)
    assert objective(graph, -t) == np.inf  # all pairs point the wrong way
    assert objective(graph, np.zeros_like(t)) == np.inf


@settings(max_examples=25)
@given(
    seed=st.integers(0, 10_000),
    d=st.sampled_from([2, 3]),
    sigma=st.sampled_from([0.0, 1e-6, 0.01, 0.3]),
    q=st.sampled_from([0.0, 0.3, 1.0]),
)
@example(seed=1816, d=2, sigma=1e-6, q=0.3)  # Newton steps end at a gap of 1.007e-8
@example(seed=196, d=2, sigma=1e-6, q=0.0)
@example(seed=4156, d=2, sigma=1e-6, q=0.3)  # and here at 3e-4
def test_every_result_proves_what_it_claims(seed, d, sigma, q):
    graph, _ = problem(seed, n=12, p=0.9, d=d, sigma=sigma, q=q, weighted=True)
    result = solve(graph)

    assert result.status is Status.CONVERGED
    assert result.gap <= TOL
    assert result.dual_bound <= result.objective + 1e-12
    assert result.objective == pytest.approx(objective(graph, result.locations), rel=1e-12)
    # Feasibility of the dual, recomputed here from the formulas.
    y, v = result.dual, graph.directions
    assert np.all(np.linalg.norm(y, axis=1) <= graph.weights * (1 + 1e-12))
    assert np.abs(np.sum(y * v, axis=1)).max() <= 1e-13
    imbalance = adjoint(y, graph.edges, 12) - result.dual_bound * scale_functional(graph)
    assert np.linalg.norm(imbalance, axis=1).max() <= 1e-9
    assert projected_length(graph, result.locations) == pytest.approx(graph.weights.sum(), rel=1e-12)
    assert np.abs(result.locations.mean(axis=0)).max() <= 1e-12 * np.abs(result.locations).max()


@pytest.mark.parametrize("seed", [88, 1264, 2225, 9254, 9886])
def test_the_conic_solver_loosens_its_tolerance_rather_than_giving_up(seed):
    # Clarabel ends without a point on these at 1e-11.
    graph, _ = problem(seed, n=12, p=0.9, d=5, q=1.0, weighted=True)
    conic = solve(graph, SolverOptions(solver="conic"))
    assert conic.gap < 1e-6
    t, _, _ = solve_newton_sparse(graph, 1e-8, 100)
    assert conic.objective == pytest.approx(objective(graph, t), abs=1e-6)


def test_certify_refuses_arrays_that_are_no_answer():
    graph, _ = problem(12)
    result = solve(graph)
    for locations, message in (
        (result.locations[1:], "shapes"),
        (result.locations * np.nan, "finite"),
        (-result.locations, "point against"),
    ):
        with pytest.raises(InputError, match=message):
            certify(graph, locations, result.dual)


@pytest.mark.parametrize("method", ["newton", "admm", "conic"])
def test_too_few_iterations_are_reported_not_hidden_in_the_line_that_a_result_is_either(method):
    graph, _ = problem(13, sigma=0.05)
    result = solve(graph, SolverOptions(solver=method, max_iterations=3))
    assert result.status is not Status.CONVERGED
    assert result.gap > TOL
    assert np.isfinite(result.locations).all()
    assert not result.converged
    assert result.status.name.lower() in repr(result)
    assert len(repr(result)) < 150


def test_graphs_that_determine_nothing_are_refused_with_the_reason():
    t = np.random.default_rng(0).standard_normal((8, 3))
    same = np.tile([1.0, 0.0, 0.0], (3, 1))  # t_0 - t_1, t_1 - t_2 and t_2 - t_0 all the same way
    for graph, reason in (
        (ViewGraph(3, np.empty((0, 2), dtype=int), np.empty((0, 3))), "no pair"),
        (exact_graph(t, [*all_pairs(4), *all_pairs(range(4, 8))]), "2 connected components"),
        (exact_graph(t[:5], [*all_pairs(4), (0, 4)]), "not parallel rigid"),
        (ViewGraph(3, [(0, 1), (1, 2), (2, 0)], same), "cancel"),
    ):
        for method in ("newton", "admm", "conic"):
            with pytest.raises(UnsolvableError, match=reason):
                solve(graph, solver=method)


def box(n):
    return box_graph_problem(n, 30, sigma=0.01, q=0.2, seed=n).view_graph


def test_where_newton_steps_stall_in_the_plane_splitting_follows_unless_newton_was_asked_for():
    graph, _ = problem(4156, n=12, p=0.9, d=2, sigma=1e-6, q=0.3, weighted=True)
    found, asked = solve(graph), solve(graph, solver="newton")
    assert (found.method, found.method_reason) == (
        "admm",
        "Newton steps stalled above the tolerance: splitting",
    )
    assert found.converged
    assert asked.status is Status.INACCURATE
    assert not solve(graph, certified=False).converged  # where nothing is proven, nothing is solved again
    few, many = solve(graph, max_iterations=3), solve(graph, max_iterations=100)
    assert (few.method, few.status) == ("newton", Status.MAX_ITERATIONS)
    assert many.converged  # the limit of Newton steps is none of splitting's


def test_splitting_after_newton_steps_counts_on_and_gives_nothing_away_where_it_is_cancelled():
    graph, _ = problem(4156, n=12, p=0.9, d=2, sigma=1e-6, q=0.3, weighted=True)
    newton, told = solve(graph, solver="newton"), []

    def hear(info):
        told.append(info.iteration)
        return info.iteration < newton.iterations + 3

    found = solve(graph, on_iteration=hear)
    assert told == [*range(1, newton.iterations + 4)]
    assert (found.status, found.method, found.iterations) == (Status.CANCELLED, "newton", len(told))
    assert found.gap == newton.gap


def test_auto_says_what_it_chose_and_why():
    small = solve(problem(15, sigma=0.05)[0])
    assert (small.method, small.method_reason) == ("newton", "60 unknowns: dense")
    sparse = solve(box(300))
    assert sparse.method == "newton"
    assert "Gflop for a sparse factor" in sparse.method_reason
    assert solve(box(60), SolverOptions(solver="admm", tol=1e-3)).method_reason == "asked for"


@pytest.mark.parametrize(
    ("n", "share", "flops", "dense"),
    [
        (100, 0.05, 1.0, True),
        (150, 0.05, 1.0, True),
        (151, 0.05, 453**3 / 12 - 1, False),
        (151, 0.29, 453**3 / 12 + 1, True),
        (151, 0.3, 1.0, True),
        (600, 0.3, 1.0, True),
        (601, 0.3, np.inf, False),
    ],
)
def test_small_and_dense_graphs_and_those_that_would_fill_in_have_a_dense_factor(n, share, flops, dense):
    graph = SimpleNamespace(num_nodes=n, dimension=3, num_edges=int(np.ceil(share * n * (n - 1) / 2)))
    assert prefers_dense_factor(graph, lambda: flops) is dense


@pytest.mark.parametrize(
    ("asked", "make", "chosen", "reason"),
    [
        ("auto", lambda: random_graph_problem(150, 0.1), "newton", "450 unknowns: dense"),
        ("auto", lambda: random_graph_problem(151, 0.4), "newton", "453 unknowns, dense graph"),
        ("auto", lambda: box_graph_problem(151, 8.0), "newton", "0.00.* Gflop for a sparse factor"),
        ("auto", lambda: expander_graph_problem(900, 20.0), "newton", "[23].* Gflop for a sparse factor"),
        ("auto", lambda: expander_graph_problem(1100, 24.0), "admm", "[56].* factor: splitting is faster"),
        (
            "auto",
            lambda: expander_graph_problem(5000, 20.0),
            "admm",
            "no order .*: splitting is faster",
        ),
        ("newton", lambda: expander_graph_problem(1100, 24.0), "newton", "asked for"),
        ("newton", lambda: random_graph_problem(100), "newton", "asked for"),
        ("admm", lambda: random_graph_problem(100), "admm", "asked for"),
        ("conic", lambda: random_graph_problem(100), "conic", "asked for"),
    ],
)
def test_the_table_of_choices(asked, make, chosen, reason):
    choice = choose_method(make().view_graph, SolverOptions(solver=asked))
    assert choice.method == chosen
    assert re.fullmatch(reason, choice.reason)


def test_a_factor_that_does_not_fit_is_replaced_and_the_answer_says_how_it_ended():
    graph = box(3000)  # its factor takes 1.6 MB
    within, beyond = (
        solve(graph, SolverOptions(solver="admm", tol=1e-4, factor_memory_mb=memory)) for memory in (2000, 1)
    )
    assert not np.array_equal(within.locations, beyond.locations)  # iterations in place of the factor
    assert within.objective == pytest.approx(beyond.objective, abs=2e-4)
    assert within.method_reason == "asked for"
    short = solve(graph, SolverOptions(solver="admm", max_iterations=2))
    assert short.method_reason == f"asked for; {HybridStop.MAX_ITERATIONS.value}"


def test_auto_leaves_newton_where_its_factor_would_explode():
    graph = expander_graph_problem(1100, 24, sigma=0.01, seed=1).view_graph
    result = solve(graph, SolverOptions(tol=1e-3))
    assert result.method == "admm"
    assert "splitting is faster" in result.method_reason
    assert result.status is Status.CONVERGED


@pytest.mark.parametrize("method", ["newton", "admm"])
def test_the_callback_sees_every_iteration_and_can_cancel(method):
    graph, seen = box(300), []

    def watch(info):
        seen.append(info)
        return len(seen) < 3

    result = solve(graph, SolverOptions(solver=method, tol=1e-12), on_iteration=watch)
    assert result.status is Status.CANCELLED
    assert [info.iteration for info in seen] == [1, 2, 3]
    assert np.isfinite(result.locations).all()
    assert result.dual_bound <= result.objective


@pytest.mark.parametrize("method", ["newton", "admm"])
def test_threads_and_repetitions_change_no_bit(method):
    graph = box(300)
    results = [solve(graph, SolverOptions(solver=method, tol=1e-6, threads=k)) for k in (1, 2, 1)]
    for other in results[1:]:
        np.testing.assert_array_equal(results[0].locations, other.locations)
        np.testing.assert_array_equal(results[0].dual, other.dual)


def test_uniqueness_is_certified_where_it_holds_and_not_where_it_does_not():
    assert solve(problem(16)[0]).unique is True
    assert solve(problem(16)[0], SolverOptions(uniqueness=False)).unique is None
    # Four fixed cameras in the plane; the fifth is seen on x = 0, x = 1, y = 0 and on y = 1, which costs
    # the same anywhere in the unit square, and its terms of the scale constraint cancel.
    fixed = np.array([[0.0, -3.0], [1.0, 4.0], [-3.0, 0.0], [4.0, 1.0]])
    edges = np.array([(i, j) for i in range(4) for j in range(i + 1, 4)] + [(4, k) for k in range(4)])
    exact = differences(fixed, edges[:6])
    tied = np.array([[0.0, 1.0], [0.0, -1.0], [1.0, 0.0], [-1.0, 0.0]])
    directions = np.vstack([exact / np.linalg.norm(exact, axis=1, keepdims=True), tied])
    result = solve(ViewGraph(5, edges, directions, [100.0] * 6 + [1.0] * 4))
    assert result.converged
    assert result.unique is False


def test_a_start_that_is_not_certified_has_the_same_locations_and_proves_nothing():
    graph, _ = problem(5, sigma=0.05)
    proved, start = solve(graph), solve(graph, certified=False)
    assert (start.locations == proved.locations).all()
    assert start.objective == pytest.approx(proved.objective, rel=1e-14)
    assert start.dual_bound == 0.0 < proved.dual_bound
    assert start.unique is None
    assert not start.dual.any()
    assert start.status is Status.INACCURATE
