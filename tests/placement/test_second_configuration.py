"""A second placement that the rejected pairs agree on: found where there is one, and only there."""

import numpy as np
import pytest

from sfm_shapefit.commands.place import place
from sfm_shapefit.facts.warnings import quality_warnings
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.placement.second_configuration import find_second_configuration
from sfm_shapefit.synthetic import box_graph_problem, random_graph_problem


def judged(problem, inliers=None, level_deg=0.5):
    graph = problem.view_graph
    inliers = ~problem.corrupted if inliers is None else inliers
    return find_second_configuration(graph, np.arange(graph.num_edges), inliers, level_deg)


@pytest.mark.parametrize("q", [0.25, 0.4])
def test_pairs_that_agree_on_a_second_configuration_are_a_rival(q):
    problem = random_graph_problem(60, 0.5, sigma=0.01, q=q, seed=1, corruption="self-consistent")
    found = judged(problem)
    assert len(found.cameras) == 60
    # Noise of 0.6 deg against 3, short baselines of LUD unrefined.
    assert found.num_pairs > 0.9 * problem.corrupted.sum()
    assert found.num_against == np.sum(~problem.corrupted)


@pytest.mark.parametrize("sigma", [0.01, 0.1])
@pytest.mark.parametrize("q", [0.2, 0.5])
def test_random_wrong_pairs_are_no_rival(q, sigma):
    for problem in (
        random_graph_problem(60, 0.5, sigma=sigma, q=q, seed=2),
        box_graph_problem(200, 16.0, sigma=sigma, q=q, seed=2),
        box_graph_problem(200, 10.0, sigma=sigma, q=q, seed=2),  # here unknowns fit a third of them
    ):
        assert judged(problem, level_deg=np.degrees(sigma)) is None


def test_pairs_that_just_suffice_to_place_their_cameras_are_no_rival():
    problem = random_graph_problem(60, 1.0, sigma=0.0, seed=3)
    few = np.random.default_rng(0).permutation(len(problem.edges))[:106]  # 88 fit whatever was measured
    inliers = np.ones(len(problem.edges), dtype=bool)
    inliers[few] = False
    kept = np.concatenate([few, np.flatnonzero(inliers)[:300]])  # so that they are many enough to matter
    graph = ViewGraph(60, problem.edges[kept], problem.directions[kept])
    assert find_second_configuration(graph, np.arange(len(kept)), inliers[kept], 0.5) is None


def test_a_few_pairs_that_agree_are_no_rival_and_directions_to_points_are_not_heard():
    few = random_graph_problem(60, 1.0, sigma=0.01, q=0.12, seed=4, corruption="self-consistent")
    assert judged(few) is None
    problem = random_graph_problem(60, 0.5, sigma=0.01, q=0.4, seed=5, corruption="self-consistent")
    right, pairs = ~problem.corrupted, np.flatnonzero(~problem.corrupted)
    assert find_second_configuration(problem.view_graph, pairs, right, 0.5) is None


def test_a_placement_with_a_rival_warns_and_names_its_cameras():
    problem = random_graph_problem(60, 0.5, sigma=0.01, q=0.35, seed=6, corruption="self-consistent")
    edges = np.concatenate([[[0, 61]], problem.edges + 1])  # camera 0 stays out, the others keep numbers
    graph = ViewGraph(62, edges, np.concatenate([[[1.0, 0.0, 0.0]], problem.directions]))
    placement = place(graph)
    assert placement.second_configuration is not None
    assert set(placement.second_configuration.cameras.tolist()) <= set(range(1, 61))
    assert len(placement.second_configuration.cameras) > 55
    assert any("agree with one another" in sentence for sentence in quality_warnings(placement))
