"""Corruption with a structure: wrong pairs that agree with one another, or gather on weakly tied cameras."""

import numpy as np
import pytest

from harness.graphs import relative_error
from sfm_shapefit.base.geometry import angle_between_deg, normalized
from sfm_shapefit.commands.place import place
from sfm_shapefit.facts.warnings import quality_warnings
from sfm_shapefit.solver.program import differences
from sfm_shapefit.synthetic import box_graph_problem, community_graph_problem, random_graph_problem


def test_wrong_pairs_agree_on_the_second_configuration_and_right_ones_on_the_truth():
    problem = box_graph_problem(80, 12.0, q=0.3, seed=1, corruption="self-consistent")
    wrong = problem.corrupted
    assert 0.2 < wrong.mean() < 0.4  # 3 sigma of 500 draws is 0.06
    for locations, rows in ((problem.locations, ~wrong), (problem.false_locations, wrong)):
        baselines = normalized(differences(locations, problem.edges))
        np.testing.assert_allclose(problem.directions[rows], baselines[rows], atol=1e-14)
    assert relative_error(problem.false_locations, problem.locations) > 1.0


def test_the_models_of_corruption_differ_in_the_wrong_directions_only_and_others_are_refused():
    uniform, consistent = (
        random_graph_problem(30, sigma=0.05, q=0.3, seed=2, corruption=corruption)
        for corruption in ("uniform", "self-consistent")
    )
    assert uniform.false_locations is None
    np.testing.assert_array_equal(uniform.corrupted, consistent.corrupted)
    right = ~uniform.corrupted
    np.testing.assert_array_equal(uniform.directions[right], consistent.directions[right])
    assert (uniform.directions != consistent.directions)[~right].all()
    with pytest.raises(ValueError, match="corruption must be one of uniform, self-consistent"):
        random_graph_problem(5, corruption="sly")


def test_concentrated_corruption_sits_on_cameras_with_few_pairs():
    problem = community_graph_problem(400, 30.0, q=0.3, seed=3, corruption="concentrated")
    degrees = np.bincount(problem.edges.ravel())
    smaller = degrees[problem.edges].min(axis=1)
    few = smaller <= np.median(smaller)
    assert problem.corrupted.mean() == pytest.approx(0.3, abs=0.03)  # 3 sigma of 4,000 draws is 0.022
    assert problem.corrupted[few].mean() > 1.4 * problem.corrupted[~few].mean()


@pytest.mark.parametrize("seed", range(3))
def test_a_fifth_of_wrong_pairs_that_agree_does_no_harm(seed):
    problem = random_graph_problem(60, q=0.2, seed=seed, corruption="self-consistent")
    found = place(problem.view_graph).certified
    assert relative_error(found.locations, problem.locations) < 1e-6  # exact recovery


@pytest.mark.parametrize("seed", range(3))
def test_wrong_pairs_that_agree_are_found_and_nothing_but_their_agreement_is_warned_of(seed):
    problem = random_graph_problem(60, sigma=0.01, q=0.2, seed=seed, corruption="self-consistent")
    placement = place(problem.view_graph)
    rejected = np.isin(np.arange(len(problem.edges)), placement.edges[~placement.assessment.inliers])
    true = normalized(differences(problem.locations, problem.edges))
    off_deg = angle_between_deg(problem.directions, true)
    assert rejected[problem.corrupted & (off_deg > 5.0)].all()  # noise is 0.6 deg
    assert rejected[~problem.corrupted].mean() < 0.02
    (warning,) = quality_warnings(placement)
    assert "agree with one another on another placement" in warning


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("q", [0.45, 0.5])
def test_at_the_limit_the_optimum_is_wrong_and_an_answer_that_is_wrong_is_warned_of(seed, q):
    problem = random_graph_problem(60, sigma=0.01, q=q, seed=seed, corruption="self-consistent")
    placement = place(problem.view_graph)
    assert relative_error(placement.certified.locations, problem.locations) > 0.1  # without corruption 0.005
    if relative_error(placement.locations, problem.locations) > 0.1:  # the refinement may still find it
        assert any(quality_warnings(placement))
