"""The paper's deterministic conditions, against brute force."""

import itertools

import numpy as np
import pytest

from paper.theory import graph_typicality, least_sines, recovery_conditions, well_distributed
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.solver.program import projected_length
from sfm_shapefit.solver.solve import solve
from sfm_shapefit.synthetic.graphs import random_graph_problem
from tests.problems import all_pairs, shape_error


def complete(n):
    return np.array(all_pairs(n))


def adjacency_of(problem):
    n = len(problem.locations)
    adjacency = np.zeros((n, n), dtype=bool)
    adjacency[problem.edges[:, 0], problem.edges[:, 1]] = True
    return adjacency | adjacency.T


def across(v, h):
    """The part of h orthogonal to v."""
    v = v / np.linalg.norm(v)
    return h - (h @ v) * v


def sine(a, b):
    return np.linalg.norm(across(a, b)) / np.linalg.norm(b)


def spread_along(t, adjacency, directions):
    """Well-distributedness by its definition, over the given directions h of space."""
    n, worst = len(t), np.inf
    for i, j in itertools.combinations(range(n), 2):
        common = np.flatnonzero(adjacency[i] & adjacency[j])
        for direction in directions:
            h = across(t[i] - t[j], direction)
            sums = 0.0
            for k in common:
                spanned = np.linalg.qr(np.stack([t[k] - t[i], t[k] - t[j]], axis=1))[0]
                sums += np.linalg.norm(h - spanned @ (spanned.T @ h))
            if len(common):
                worst = min(worst, sums / (len(common) * np.linalg.norm(h)))
    return worst


def test_complete_graphs_are_typical_and_those_apart_or_without_common_neighbors_are_not():
    t = graph_typicality(10, complete(10))
    assert (t.connected, t.degrees, t.codegrees, t.p_high) == (True, (9, 9), (8, 8), 1.0)
    assert t.p_low == pytest.approx(np.sqrt(8 / 20))
    assert t.holds
    ring = graph_typicality(8, np.array([[i, (i + 1) % 8] for i in range(8)]))
    assert (ring.connected, ring.codegrees, ring.holds) == (True, (0, 1), False)
    apart = graph_typicality(10, np.concatenate([complete(5), complete(5) + 5]))
    assert (apart.connected, apart.holds) == (False, False)


def test_beta_is_the_least_sine_over_all_triples():
    problem = random_graph_problem(9, 1.0, seed=3)
    t = problem.locations
    found = recovery_conditions(t, problem.edges)
    brute = min(sine(t[j] - t[i], t[k] - t[i]) for i, j, k in itertools.permutations(range(9), 3))
    assert found.beta == pytest.approx(brute, rel=1e-9)


def test_beta_with_exceptions_leaves_out_the_worst_cameras_of_each_pair():
    problem = random_graph_problem(8, 1.0, 3, seed=4)
    t = problem.locations
    most = min(np.sort(least_sines(t, i)[j])[2] for i, j in itertools.combinations(range(8), 2))
    brute = min(
        sorted(
            min(sine(t[j] - t[i], t[k] - t[i]), sine(t[j] - t[i], t[k] - t[j]))
            for k in range(8)
            if k not in (i, j)
        )[2]
        for i, j in itertools.combinations(range(8), 2)
    )
    assert most == pytest.approx(brute, rel=1e-9)


def test_collinear_cameras_grant_nothing_and_coincident_ones_are_refused():
    t = np.random.default_rng(0).standard_normal((8, 3))
    t[5] = 0.5 * (t[2] + t[7])
    found = recovery_conditions(t, complete(8))
    assert found.is_on_line
    assert found.beta < 1e-12
    assert found.granted_in_space == 0.0
    with pytest.raises(InputError, match="coincide"):
        recovery_conditions(t[[0, 1, 0]], complete(3))


def test_distance_constants_and_the_granted_share_are_those_of_the_theorems():
    t = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0.3, 0.4, 1]])
    lengths = [np.linalg.norm(t[i] - t[j]) for i, j in complete(4)]
    found = recovery_conditions(t, complete(4))
    assert found.distance_ratio == pytest.approx(min(lengths) / max(lengths))
    assert found.distance_bound == pytest.approx(max(lengths) / np.mean(lengths))
    granted = found.beta * found.distance_ratio * found.spread**2 / (3 * 256 * 64 * 32)
    assert found.granted == pytest.approx(granted)


def test_well_distributedness_in_space_is_the_minimum_of_its_definition():
    problem = random_graph_problem(7, 0.8, 3, seed=2)
    adjacency = adjacency_of(problem)
    exact = well_distributed(problem.locations, adjacency)
    rng = np.random.default_rng(0)
    sampled = spread_along(problem.locations, adjacency, rng.standard_normal((400, 3)))
    assert exact <= sampled + 1e-12
    # The sum is 1-Lipschitz in the angle of h, of which 400 draws miss the best by about pi / 400.
    assert sampled - exact < 0.02
    adjacency = ~np.eye(3, dtype=bool)
    adjacency[0, 1] = adjacency[1, 0] = False
    line = np.array([[0.0, 0, 0], [2, 0, 0], [1, 0, 0]])  # a collinear common neighbor counts in full
    assert well_distributed(line, adjacency) == 1.0


def test_all_constants_are_the_same_for_any_scale_and_place():
    problem = random_graph_problem(40, 0.7, 3, seed=7)
    one = recovery_conditions(problem.locations, problem.edges)
    other = recovery_conditions(3.0 * problem.locations + [1.0, -2.0, 5.0], problem.edges)
    for name in ("beta", "beta_most", "distance_ratio", "distance_bound", "spread"):
        assert getattr(other, name) == pytest.approx(getattr(one, name), rel=1e-9)


def test_space_grants_by_its_own_theorem_what_is_recovered_exactly_but_nothing_to_an_atypical_graph():
    problem = random_graph_problem(25, 1.0, 3, seed=9)
    found = recovery_conditions(problem.locations, problem.edges)
    constants = found.beta_most * found.spread**2 / found.distance_bound**2
    assert found.granted_in_space == pytest.approx(constants / (32 * 3 * 64 * 1024))
    assert min(found.granted, found.granted_in_space) > 0.0
    assert shape_error(solve(problem.view_graph).locations, problem.locations) < 1e-8
    sparse = random_graph_problem(30, 0.3, 3, seed=1)
    assert recovery_conditions(sparse.locations, sparse.edges).granted == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_the_truth_stays_feasible_below_the_share_of_the_lemma(seed):
    """L(T0) > 0 with every corrupted direction turned round, the worst case of the lemma."""
    n, rng = 40, np.random.default_rng(seed)
    t = normalized(rng.standard_normal((n, 3)))
    edges = complete(n)
    feasible = recovery_conditions(t, edges).feasible
    directions = normalized(t[edges[:, 0]] - t[edges[:, 1]])
    allowed = int(np.ceil(feasible * n)) - 1
    assert allowed >= 1
    degrees = np.zeros(n, dtype=int)
    for e in rng.permutation(len(edges)):
        if (degrees[edges[e]] < allowed).all():
            degrees[edges[e]] += 1
            directions[e] *= -1.0
    assert degrees.max() == allowed
    assert projected_length(ViewGraph(n, edges, directions), t) > 0.0
