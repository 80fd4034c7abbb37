"""The reported bound and objective hold in exact rational arithmetic, see `exact_certificate`."""

from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest

from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.solver.certificate import certify
from sfm_shapefit.solver.program import scale_functional
from sfm_shapefit.solver.solve import solve
from sfm_shapefit.solver.solver_options import SolverOptions, Status
from tests.exact_certificate import objective_bracket, proven_bound

ROUNDING = 1e-13  # 30 edges of terms of order 1 / 30 in doubles: 30 eps, and as much from the solver's scale


def problem(seed):
    """A small view graph in 2D or 3D, with noise, weights and a wrong pair or without."""
    rng = np.random.default_rng(seed)
    d, n = 2 + seed % 2, 4 + seed % 3
    t = rng.standard_normal((n, d))
    edges = list(combinations(range(n), 2))
    if seed % 5 == 4:
        edges = edges[1:]
    v = np.array([t[i] - t[j] for i, j in edges])
    v = normalized(normalized(v) + rng.choice([0.0, 0.02, 0.3]) * rng.standard_normal(v.shape))
    if seed % 4 == 1:
        v[rng.integers(len(v))] = normalized(rng.standard_normal((1, d)))[0]
    weights = rng.uniform(0.2, 3.0, len(edges)) if seed % 3 == 0 else None
    return ViewGraph(n, np.array(edges), v, weights)


def checked(graph, locations, dual, bound):
    """Return the proven bound, and the bracket of the objective, exactly."""
    edges = [tuple(edge) for edge in graph.edges.tolist()]
    return (
        proven_bound(edges, graph.directions, graph.weights, locations, dual, bound),
        *objective_bracket(edges, graph.directions, graph.weights, locations),
    )


@pytest.mark.parametrize("seed", range(50))
def test_the_certificate_of_a_small_problem_holds_exactly(seed):
    graph = problem(seed)
    found = solve(graph, SolverOptions(solver="admm" if seed % 7 == 6 else "newton"))
    proven, below, above = checked(graph, found.locations, found.dual, found.dual_bound)
    assert proven >= Fraction(found.dual_bound) - Fraction(ROUNDING)
    assert below - Fraction(ROUNDING) <= Fraction(found.objective) <= above + Fraction(ROUNDING)
    assert proven <= above  # weak duality, exactly
    assert above - proven <= Fraction(max(found.gap, 0.0)) + Fraction(2.0 * ROUNDING)


@pytest.mark.parametrize("seed", range(0, 50, 5))
def test_the_bound_of_any_dual_made_feasible_holds_exactly_and_one_that_claims_more_is_refuted(seed):
    graph = problem(seed)
    solved = solve(graph)
    claimed = solved.dual_bound + 1e-9
    proven, _, _ = checked(graph, solved.locations, solved.dual, claimed)
    assert proven < Fraction(claimed) - Fraction(ROUNDING)
    rng = np.random.default_rng(seed)
    dual = solved.dual + 0.05 * rng.standard_normal((graph.num_edges, graph.dimension))
    locations = rng.standard_normal((graph.num_nodes, graph.dimension))
    if np.sum(scale_functional(graph) * locations) < 0.0:
        locations = -locations
    found = certify(graph, locations, dual)
    proven, below, above = checked(graph, locations, found.dual, found.dual_bound)
    assert proven >= Fraction(found.dual_bound) - Fraction(ROUNDING)
    assert below - Fraction(ROUNDING) <= Fraction(found.objective) <= above + Fraction(ROUNDING)


def test_splitting_asked_for_on_a_tiny_graph_proves_its_answer_too():
    # Accelerated, the last four lead to locations of 1e10 and more.
    for seed in (*range(0, 200, 20), 54, 66, 162, 174):
        found = solve(problem(seed), SolverOptions(solver="admm"))
        assert found.status is Status.CONVERGED, seed
