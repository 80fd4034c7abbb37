"""The posterior of a pair from its triangles: a likelihood that is one, and what messages make of it."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_shapefit import synthetic
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.refinement import posterior as module
from sfm_shapefit.refinement.posterior import weigh_by_triangles


def corrupted(q=0.6, sigma=0.02, d=3, n=60):
    return synthetic.random_graph_problem(n, 0.5, d=d, sigma=sigma, q=q, seed=3)


def shapes_of(sides):
    a, b, c = sides / np.linalg.norm(sides, axis=2, keepdims=True)
    return module._shapes(np.stack([np.sum(x * y, axis=1) for x, y in ((a, b), (b, c), (c, a))], axis=1))


def right_triangles(tau, d, count=20_000):
    """Directions around triangles of random corners, each with a normal error of tau per axis."""
    rng = np.random.default_rng(5)
    corners = rng.standard_normal((3, count, d))
    sides = np.stack([corners[k] - corners[(k + 1) % 3] for k in range(3)])
    sides /= np.linalg.norm(sides, axis=2, keepdims=True)
    return sides + tau * rng.standard_normal(sides.shape)


@pytest.mark.parametrize("d", [2, 3, 4])
def test_the_ratio_is_a_density_over_random_triangles_and_its_level_is_the_likeliest_one(d):
    rng = np.random.default_rng(7)
    norms, levels = module._normalizers(d), module._RUNGS_RAD
    random = shapes_of(rng.standard_normal((3, 50_000, d)))
    for rung in (0, 3, 6):
        ratio = module._ratio(random, levels[rung], d) * norms[rung]
        assert ratio.mean() == pytest.approx(1.0, rel=0.15)
    if d == 2:  # every triangle is flat there; whether it closes is all there is, and says at most 4 to 1
        assert (module._ratio(random, 0.01, d) * module._normalizers(d)[9]).max() < 4.5
        return
    true = levels.index(0.055)
    shapes = shapes_of(right_triangles(0.055, d))
    likelihood = [
        np.mean(np.log(0.5 + 0.5 * module._ratio(shapes, tau, d) * norm))
        for tau, norm in zip(levels, norms, strict=True)
    ]
    assert abs(int(np.argmax(likelihood)) - true) <= 1


def test_the_histogram_gives_the_noise_and_the_share_of_right_triangles():
    rng = np.random.default_rng(1)
    right = right_triangles(0.024, 3)[:, :6000]
    shapes = shapes_of(np.concatenate([right, rng.standard_normal((3, 14_000, 3))], axis=1))
    shares = module._fit_shares(shapes, 3, module._normalizers(3))
    assert shares.sum() == pytest.approx(0.3, abs=0.05)
    level = module._LEVELS_RAD.index(0.024)
    assert shares[level - 1 : level + 2].sum() > 0.7 * shares.sum()


def test_a_triangle_tells_its_side_what_the_model_says_to_the_last_digit():
    directions = np.array([[1.0, 0.1, 0.0], [-0.4, 0.9, 0.02], [-0.5, -0.9, 0.01]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ratio, messages, log_odds = np.array([9.0]), np.zeros((1, 3)), np.zeros(3)
    for _ in range(200):
        module._sweep(np.array([[0, 1, 2]]), ratio, np.log(0.25 / 0.75), messages, log_odds, 1)
    # The cavity is the prior alone: a side in no other triangle hears nothing back of what it said itself.
    np.testing.assert_allclose(log_odds, np.log1p(0.25**2 * 8.0))


@pytest.mark.parametrize(("d", "least"), [(2, 0.6), (3, 0.9), (4, 0.9)])
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


def test_few_of_many_triangles_are_drawn_and_say_nearly_the_same(monkeypatch):
    graph = corrupted(0.4).view_graph
    everything = weigh_by_triangles(graph)
    monkeypatch.setattr(module, "_MOST_PER_PAIR", 8)
    few = weigh_by_triangles(graph)
    assert few.num_triangles < 0.9 * everything.num_triangles
    assert few.num_triangles <= 8 * graph.num_edges
    assert np.mean((few.posterior > 0.5) == (everything.posterior > 0.5)) > 0.9


def test_without_triangles_nothing_is_said():
    star = ViewGraph(4, [(0, 1), (0, 2), (0, 3)], np.eye(3))
    found = weigh_by_triangles(star)
    assert found.num_triangles == 0
    np.testing.assert_array_equal(found.posterior, 0.5)
    np.testing.assert_allclose(replace(found, prior=0.2).posterior, 0.2)
