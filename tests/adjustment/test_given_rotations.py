"""How exact given rotations are, as far as the matches tell."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.covariance import estimate_covariances
from sfm_shapefit.adjustment.freedom import Freedom
from sfm_shapefit.adjustment.given_rotations import estimate_rotation_errors
from sfm_shapefit.adjustment.solve import adjust
from tests.adjustment.made import ring_problem

OPTIONS = AdjustmentOptions(loss_scale_px=2.0)


def turned_ring(sigma_deg, noise_px, num_points=400, seed=0):
    """Cameras on a ring whose rotations are off by sigma per axis, and their true rotations."""
    rng = np.random.default_rng(seed)
    truth = ring_problem(rng, 16, num_points, noise_px=noise_px, share=0.4)
    errors = Rotation.from_rotvec(np.radians(sigma_deg) * rng.standard_normal((16, 3))).as_matrix()
    return replace(truth, rotations=errors @ truth.rotations), truth.rotations


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("noise_px", [0.2, 1.0])
def test_exact_rotations_are_held_and_chance_is_told(noise_px, seed):
    problem, _ = turned_ring(0.0, noise_px, seed=seed)
    found = estimate_rotation_errors(problem, OPTIONS)
    assert found.decide(Freedom()).holds_rotations
    assert found.num_frames == 16
    covariances = estimate_covariances(adjust(problem, OPTIONS).problem, OPTIONS, noise_px=noise_px)
    sigmas = np.sqrt(np.trace(covariances.rotations, axis1=1, axis2=2) / 3.0)
    # The median of 16 estimates of a standard deviation, of three numbers each that hang together.
    assert found.chance_rad == pytest.approx(np.median(sigmas), rel=0.5)
    # The loss lets the better half of the errors count more, which makes its median a little smaller.
    assert found.noise_px == pytest.approx(noise_px, rel=0.15)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("sigma_deg", [0.05, 0.3])
def test_the_standard_deviation_of_wrong_rotations_is_found(sigma_deg, seed):
    found = estimate_rotation_errors(turned_ring(sigma_deg, 0.3, seed=seed)[0], OPTIONS)
    freedom = found.decide(Freedom())
    assert not freedom.holds_rotations
    # The root mean square of 16 x 3 normal numbers is within 4 / sqrt(96) = 41 % of sigma.
    assert np.degrees(freedom.least_pull_rad) == pytest.approx(sigma_deg, rel=0.41)


@pytest.mark.parametrize("sigma_deg", [0.0, 0.05])
def test_a_frame_whose_rotation_is_clearly_worse_has_a_sigma_of_its_own(sigma_deg):
    problem, _ = turned_ring(sigma_deg, 0.2)
    turned = problem.rotations.copy()
    turned[5] = Rotation.from_rotvec(np.radians([0.5, -0.4, 0.3])).as_matrix() @ turned[5]
    errors = estimate_rotation_errors(replace(problem, rotations=turned), OPTIONS)
    freedom = errors.decide(Freedom())
    own = np.degrees(freedom.pull_rad)
    assert not freedom.holds_rotations  # it would be held too
    assert freedom.singled_out()[5]
    assert own[5] == pytest.approx(np.sqrt(0.5 / 3.0), rel=0.2)
    assert sigma_deg > 0.0 or np.delete(own, 5).max() < 0.05
    assert np.delete(own, 5).max() < 0.25
    pull = freedom.apply(problem, problem.rotations).rotation_prior
    assert np.trace(pull.information[5]) < 0.5 * np.trace(pull.information[6])


def test_a_common_turn_of_all_is_no_error():
    problem, _ = turned_ring(0.0, 0.2)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix()
    poses = {"rotations": problem.rotations @ turn.T, "centers": problem.centers @ turn.T}
    turned = replace(problem, **poses, points=problem.points @ turn.T)
    assert estimate_rotation_errors(turned, OPTIONS).decide(Freedom()).holds_rotations


def test_few_frames_that_see_enough_say_nothing():
    problem, _ = turned_ring(0.5, 0.2)
    few = problem.of_points(np.arange(problem.num_points) < 12)
    found = estimate_rotation_errors(few, OPTIONS)
    assert found.num_frames < 3
    assert found.decide(Freedom()).holds_rotations


@pytest.mark.parametrize("seed", range(3))
def test_weighted_rotations_end_nearer_to_the_truth_than_held_and_free_ones(seed):
    """Few noisy points say less than rotations that are off by 0.05 degrees, and both together more."""
    problem, truth = turned_ring(0.05, 0.3, num_points=40, seed=seed)
    given = problem.rotations
    off = {}
    for name, freedom in {
        "held": Freedom(pull_rad=0.0),
        "free": Freedom(),
        "weighted": Freedom(pull_rad=np.radians(0.05), noise_px=0.3),
    }.items():
        options = AdjustmentOptions(
            loss_scale_px=None, hold_rotations=freedom.holds_rotations, noise_px=freedom.noise_px
        )
        ended = adjust(freedom.apply(problem, given), options).problem.rotations
        apart = Rotation.from_matrix(ended @ truth.transpose(0, 2, 1)).as_rotvec()
        apart -= np.einsum(
            "nab,nb->na", truth, np.tile(np.einsum("nba,nb->na", truth, apart).mean(0), (16, 1))
        )
        off[name] = np.sqrt(np.mean(apart**2))
    assert off["weighted"] < min(off["held"], off["free"])
