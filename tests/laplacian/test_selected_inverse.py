"""The entries of an inverse that belong to nodes and edges, against the whole inverse."""

import numpy as np
import pytest

from harness.graphs import laplacian_matrix
from sfm_shapefit.laplacian.factor import allocate_factor, analyze, factorize
from sfm_shapefit.synthetic import box_graph_problem, trajectory_graph_problem
from tests.graph_families import random_blocks


@pytest.mark.parametrize("problem", [box_graph_problem, trajectory_graph_problem])
@pytest.mark.parametrize("b", [2, 3])
def test_selected_entries_are_those_of_the_whole_inverse(problem, b):
    rng = np.random.default_rng(b)
    n, edges = 150, problem(150, 10.0, seed=b).edges
    edges = np.where(rng.random(len(edges))[:, None] < 0.5, edges, edges[:, ::-1])  # either way round
    weights = random_blocks(len(edges), b, seed=b)
    factor = factorize(analyze(n, edges), weights, ground=7.0)
    found = factor.selected_inverse()

    matrix = laplacian_matrix(n, edges, weights).toarray().reshape(n, b, n, b)
    last = factor.plan.permutation[-1]
    matrix[last, :, last, :] += 7.0 * np.eye(b)
    whole = np.linalg.inv(matrix.reshape(n * b, n * b)).reshape(n, b, n, b)
    nodes = np.arange(n)
    limit = 1e-10 * np.abs(whole).max()  # condition numbers here stay below 1e4
    np.testing.assert_allclose(found.nodes, whole[nodes, :, nodes, :], atol=limit)
    np.testing.assert_allclose(found.edges, whole[edges[:, 0], :, edges[:, 1], :], atol=limit)


def test_entries_are_right_where_the_factor_is_cut_into_tasks_and_single_precision_is_refused():
    edges = trajectory_graph_problem(6000, 60.0, seed=0).edges
    with pytest.raises(ValueError, match="float64"):
        factorize(analyze(6000, edges), np.ones(len(edges)), np.float32).selected_inverse()
    factor = factorize(analyze(6000, edges), np.ones(len(edges)), ground=7.0)
    assert len(factor.plan.tasks) > 1
    found = factor.selected_inverse()
    for node in range(0, 6000, 600):
        right = np.zeros((6000, 1))
        right[node] = 1.0
        column = factor.solve(right)[:, 0]
        tied = edges[edges[:, 0] == node]
        limit = 1e-9 * np.abs(column).max()
        np.testing.assert_allclose(found.nodes[node, 0, 0], column[node], atol=limit)
        np.testing.assert_allclose(found.edges[edges[:, 0] == node, 0, 0], column[tied[:, 1]], atol=limit)


@pytest.mark.parametrize("threads", [2, 3, 7])
def test_entries_are_the_same_to_the_bit_for_any_number_of_threads(threads):
    edges = trajectory_graph_problem(6000, 60.0, seed=0).edges
    plan, weights = analyze(6000, edges), random_blocks(len(edges), 2, seed=0)
    answers = []
    for count in (1, threads):
        factor = allocate_factor(plan, 2, threads=count)
        factor.refactor(weights)
        answers.append(factor.selected_inverse())
    np.testing.assert_array_equal(answers[0].nodes, answers[1].nodes)
    np.testing.assert_array_equal(answers[0].edges, answers[1].edges)
