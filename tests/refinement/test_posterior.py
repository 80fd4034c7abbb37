"""The posterior of a pair from its triangles: a likelihood that is one, and what messages make of it."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_shapefit import synthetic
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.refinement.posterior import weigh_by_triangles


def corrupted(q=0.6, sigma=0.02, d=3, n=60):
    return synthetic.random_graph_problem(n, 0.5, d=d, sigma=sigma, q=q, seed=3)


@pytest.mark.parametrize(("d", "least"), [(2, 0.6), (3, 0.9), (4, 0.9), (16, 0.9), (150, 0.8)])
def test_right_pairs_are_told_from_wrong_ones_in_any_dimension(d, least):
    problem = corrupted(q=0.3 if d == 2 else 0.6, d=d)
    wrong, posterior = problem.corrupted, weigh_by_triangles(problem.view_graph).posterior
    above = np.mean(posterior[~wrong][:, None] > posterior[wrong])
    assert above > least


def test_the_posterior_does_not_depend_on_names_or_on_the_sense_of_pairs():
    problem = corrupted()
    graph, rng = problem.view_graph, np.random.default_rng(0)
    names, order = rng.permutation(graph.num_nodes), rng.permutation(graph.num_edges)
    edges, directions = names[graph.edges][order], graph.directions[order]
    turned = rng.random(len(order)) < 0.5
    edges[turned], directions = edges[turned, ::-1], np.where(turned[:, None], -directions, directions)
    there = weigh_by_triangles(ViewGraph(graph.num_nodes, edges, directions))
    np.testing.assert_allclose(there.posterior, weigh_by_triangles(graph).posterior[order], atol=1e-9)


def drawn_triangles(sigma, wrong, seed):
    """A graph of triangles that share no pair, some with a wrong side, and which of its pairs are wrong."""
    rng = np.random.default_rng(seed)
    corners = rng.standard_normal((len(wrong), 3, 3))
    sides = np.stack([corners[:, k] - corners[:, (k + 1) % 3] for k in range(3)], axis=1)
    v = normalized(normalized(sides) + sigma * rng.standard_normal(sides.shape))
    is_wrong = np.zeros((len(wrong), 3), dtype=bool)
    is_wrong[wrong, 0] = True
    v[is_wrong] = normalized(rng.standard_normal(v.shape))[is_wrong]
    edges = 3 * np.arange(len(wrong))[:, None, None] + np.array([(0, 1), (1, 2), (2, 0)])
    return ViewGraph(3 * len(wrong), edges.reshape(-1, 2), v.reshape(-1, 3)), is_wrong.ravel()


@pytest.mark.parametrize("sigma", [0.01, 0.05])
def test_posteriors_are_the_shares_of_right_pairs_where_triangles_share_none(sigma):
    """There the messages are exact: of the pairs of any posterior, as large a share is right."""
    graph, wrong = drawn_triangles(sigma, np.arange(4000) % 2 == 0, seed=1)
    found = weigh_by_triangles(graph)
    assert found.num_triangles == 4000
    sides = found.posterior.reshape(-1, 3)
    assert np.ptp(sides, axis=1).max() < 1e-9  # none of the three is more suspect than the others
    # A side is wrong in half of the triangles: of all sides 5/6 are right, of those that do not close 2/3.
    closing = sides[:, 0] > np.median(sides[:, 0])
    assert found.prior == pytest.approx(5.0 / 6.0, abs=0.05)
    assert np.mean(~wrong.reshape(-1, 3)[closing]) > 0.95  # some close by chance
    assert sides[closing].mean() == pytest.approx(np.mean(~wrong.reshape(-1, 3)[closing]), abs=0.03)
    assert sides[~closing].mean() == pytest.approx(np.mean(~wrong.reshape(-1, 3)[~closing]), abs=0.1)


@pytest.mark.parametrize("d", [2, 3, 4])
@pytest.mark.parametrize("q", [0.0, 0.3, 0.6])
def test_the_mean_posterior_is_about_the_share_of_right_pairs(d, q):
    problem = corrupted(q, d=d)
    found = weigh_by_triangles(problem.view_graph)
    # Beside many right pairs some wrong ones close triangles by chance; in the plane more do.
    assert -0.05 < found.posterior.mean() - np.mean(~problem.corrupted) < (0.2 if d == 2 else 0.15)
    assert found.prior == pytest.approx(np.clip(found.posterior.mean(), 0.05, 0.95), abs=0.02)


def test_few_of_many_triangles_are_drawn_and_say_what_all_would():
    problem = synthetic.random_graph_problem(120, 1.0, sigma=0.02, q=0.4, seed=3)
    found = weigh_by_triangles(problem.view_graph)  # 118 triangles at each pair, of which it draws 64
    assert 0.5 < found.num_triangles / (120 * 119 * 118 / 6) < 0.6
    assert np.mean((found.posterior > 0.5) == ~problem.corrupted) > 0.9


def test_without_triangles_nothing_is_said():
    star = ViewGraph(4, [(0, 1), (0, 2), (0, 3)], np.eye(3))
    found = weigh_by_triangles(star)
    assert found.num_triangles == 0
    np.testing.assert_array_equal(found.posterior, 0.5)
    np.testing.assert_allclose(replace(found, prior=0.2).posterior, 0.2)
