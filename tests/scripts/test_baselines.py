"""The methods of the literature: exact on exact data, and optimal in their own objective."""

import numpy as np
import pytest

from harness.graphs import laplacian_matrix
from paper import baselines
from paper.baselines import onedsfm_scores
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.graph.triangle_scores import triangle_scores
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.solver.program import differences
from sfm_shapefit.solver.solve import solve
from sfm_shapefit.synthetic.graphs import box_graph_problem, random_graph_problem
from tests.problems import exact_graph, shape_error


@pytest.mark.parametrize("name", sorted(baselines.LOCATORS))
@pytest.mark.parametrize("d", [2, 3])
def test_every_locator_is_exact_on_exact_directions(name, d):
    problem = random_graph_problem(15, 0.7, d, seed=1)
    found = baselines.LOCATORS[name](problem.view_graph)
    # Interior points and splitting stop at 1e-8; positions are off by that times the conditioning.
    assert shape_error(found, problem.locations) < 1e-5
    assert np.linalg.norm(found) == pytest.approx(1.0)


def test_least_squares_minimises_the_sum_of_squared_distances_across():
    problem = random_graph_problem(12, 0.8, 3, sigma=0.1, seed=2)
    graph = problem.view_graph
    rng = np.random.default_rng(0)

    def value(t):
        t = (t - t.mean(axis=0)) / np.linalg.norm(t - t.mean(axis=0))
        d = differences(t, graph.edges)
        along = np.sum(d * graph.directions, axis=1, keepdims=True) * graph.directions
        return np.sum((d - along) ** 2)

    best = baselines.locate_least_squares(graph)
    for _ in range(50):
        assert value(best) < value(best + 1e-3 * rng.standard_normal(best.shape))


def test_the_eigenvector_of_many_cameras_is_that_of_a_dense_solve():
    graph = box_graph_problem(210, 12, sigma=0.02, seed=3).view_graph
    across = np.eye(3) - graph.directions[:, :, None] * graph.directions[:, None, :]
    matrix = laplacian_matrix(210, graph.edges, across).toarray()
    dense = np.linalg.eigh(matrix)[1][:, 3].reshape(210, 3)  # the first three are shifts
    found = baselines.locate_least_squares(graph)
    assert min(shape_error(found, sign * dense) for sign in (1.0, -1.0)) < 1e-6


def test_reweighting_by_length_lowers_the_error_of_noisy_directions():
    problem = random_graph_problem(40, 0.5, 3, sigma=0.05, seed=4)
    graph = problem.view_graph
    plain = shape_error(baselines.locate_least_squares(graph), problem.locations)
    assert shape_error(baselines.locate_least_squares(graph, 10), problem.locations) < plain


def test_linf_has_no_larger_worst_misfit_than_the_truth():
    problem = random_graph_problem(12, 0.8, 3, sigma=0.05, seed=5)
    graph = problem.view_graph

    def worst(t):
        d = differences(t, graph.edges)
        along = np.sum(d * graph.directions, axis=1)
        d, along = d / along.min(), along / along.min()  # the shortest pair has s_e = 1
        return np.linalg.norm(d - along[:, None] * graph.directions, axis=1).max()

    truth = problem.locations - problem.locations.mean(axis=0)
    assert worst(baselines.locate_linf(graph)) < worst(truth)


@pytest.mark.parametrize("name", sorted(baselines.FILTERS))
def test_every_filter_drops_most_wrong_pairs_and_few_right_ones(name):
    problem = random_graph_problem(60, 0.5, 3, sigma=0.01, q=0.2, seed=6)
    kept = baselines.FILTERS[name](problem.view_graph)
    assert kept[~problem.corrupted].mean() > 0.9
    assert kept[problem.corrupted].mean() < 0.45


@pytest.mark.parametrize("scores", [onedsfm_scores, triangle_scores])
def test_scores_do_not_depend_on_the_orientation_of_pairs(scores):
    problem = random_graph_problem(25, 0.5, 3, sigma=0.05, q=0.2, seed=7)
    graph = problem.view_graph
    turned = np.arange(len(problem.edges)) % 2 == 0
    edges = np.where(turned[:, None], problem.edges[:, ::-1], problem.edges)
    directions = np.where(turned[:, None], -problem.directions, problem.directions)
    other = ViewGraph(25, edges, directions)
    if scores is onedsfm_scores:  # whose axes are drawn among the directions: compare what both drop
        agree = (scores(graph) < 0.1) == (scores(other) < 0.1)
        assert agree.mean() > 0.85
    else:
        np.testing.assert_allclose(scores(other), scores(graph), atol=1e-12)


def test_a_filter_composes_with_shapefit():
    problem = random_graph_problem(50, 0.5, 3, sigma=0.02, q=0.4, seed=8)
    graph = problem.view_graph
    kept = baselines.filter_triangles(graph)
    filtered, cameras = graph.restricted_to(np.flatnonzero(kept))
    assert len(cameras) == 50
    assert shape_error(solve(filtered).locations, problem.locations) < 0.5 * shape_error(
        solve(graph).locations, problem.locations
    )


def test_a_triangle_states_the_angle_to_the_arc_of_its_other_sides_and_a_pair_in_none_is_kept():
    own_sides = exact_graph(np.random.default_rng(9).standard_normal((3, 3)), [[0, 1], [2, 1], [0, 2]])
    np.testing.assert_allclose(triangle_scores(own_sides, 0), 0.0, atol=1e-7)
    # Sides b = (1, 0, 0) and a = (0, 1, 0): the third must lie between them.
    tilted = normalized(np.array([[1.0, 1.0, 1.0]]))[0]
    outside = np.array([np.cos(-0.3), np.sin(-0.3), 0.0])
    for third, angle in ((tilted, np.arctan(1.0 / np.sqrt(2.0))), (outside, 0.3)):
        edges = np.array([[0, 1], [0, 2], [2, 1]])
        graph = ViewGraph(3, edges, np.stack([third, [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]))
        assert triangle_scores(graph, 0)[0] == pytest.approx(angle)
    path = ViewGraph(3, np.array([[0, 1], [1, 2]]), np.array([[1.0, 0, 0], [0, 1.0, 0]]))
    assert baselines.filter_triangles(path).all()


def test_on_exact_directions_no_axis_contradicts_the_order():
    problem = random_graph_problem(20, 1.0, 3, seed=10)
    assert onedsfm_scores(problem.view_graph).max() < 0.05
