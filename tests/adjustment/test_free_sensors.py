"""Sensors that are free in their rigs: found again after a disturbance, in the scale of their baselines."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.covariance import estimate_covariances
from sfm_shapefit.adjustment.layout import lay_out
from sfm_shapefit.adjustment.residuals import reprojection_residuals
from sfm_shapefit.adjustment.solve import adjust, values_of
from sfm_shapefit.base.quaternions import rotation_vectors
from tests.adjustment.made import disturb, ring_problem

SQUARES = AdjustmentOptions(loss_scale_px=None)
FRAMES, SENSORS = 10, 3


def rig_problem(rng, offset=0.3):
    """Frames of three sensors, the first of which is the reference, with the others free; with noise."""
    problem = ring_problem(rng, FRAMES, 120, sensors=SENSORS, noise_px=0.0, offset=offset)
    rotations, translations = problem.rig.rotations.copy(), problem.rig.translations.copy()
    rotations[::SENSORS], translations[::SENSORS] = np.eye(3), 0.0
    free = np.tile([-1, 0, 1], FRAMES)
    rig = replace(problem.rig, rotations=rotations, translations=translations, free_sensor_of_camera=free)
    problem = replace(problem, rig=rig)
    exact = reprojection_residuals(problem, values_of(problem)) + problem.pixels
    return replace(problem, pixels=exact + 0.5 * rng.standard_normal(exact.shape))


def disturb_sensors(problem, rng, angle_deg=1.0, share=0.02):
    """Turn each sensor by so much about a random axis, and make its offset longer or shorter by a share."""
    axes = rng.standard_normal((SENSORS, 3))
    axes *= np.radians(angle_deg) / np.linalg.norm(axes, axis=1, keepdims=True)
    turns = Rotation.from_rotvec(axes).as_matrix()
    sizes = 1.0 + share * rng.choice([-1.0, 1.0], SENSORS)
    turns[0], sizes[0] = np.eye(3), 1.0
    rig, of_sensor = problem.rig, np.tile(np.arange(SENSORS), FRAMES)
    rotations = turns[of_sensor] @ rig.rotations
    centers = sizes[of_sensor, None] * rig.sensor_centers()
    translations = -np.einsum("cab,cb->ca", rotations, centers)
    return replace(problem, rig=replace(rig, rotations=rotations, translations=translations))


def baselines(problem):
    return np.linalg.norm(problem.rig.translations[:SENSORS], axis=1)[1:]


@pytest.mark.parametrize("seed", range(3))
def test_disturbed_sensors_are_found_again_to_the_noise_and_their_mean_baseline_stays(seed):
    rng = np.random.default_rng(seed)
    truth = rig_problem(rng)
    start = disturb(disturb_sensors(truth, rng), rng, 0.02, 0.005, 0.02)
    found = adjust(start, SQUARES, cost_tolerance=1e-12)
    assert found.converged
    rig = found.problem.rig
    assert baselines(found.problem).mean() == pytest.approx(baselines(start).mean(), rel=1e-12)
    sigmas = estimate_covariances(found.problem, SQUARES).sensor_sigmas
    assert 1e-5 < sigmas[sigmas > 0.0].min() < sigmas.max() < 0.01
    size = baselines(truth).mean() / baselines(start).mean()
    turns = rotation_vectors(rig.rotations.transpose(0, 2, 1) @ truth.rig.rotations)[:SENSORS]
    shifts = size * rig.sensor_centers()[:SENSORS] - truth.rig.sensor_centers()[:SENSORS]
    assert np.abs(turns[0]).max() == np.abs(shifts[0]).max() == 0.0  # the reference stays
    # Of 12 errors in units of their standard deviations, the largest is beyond 4 once in 1,300 times.
    assert (np.abs(turns[1:]) < 4.0 * sigmas[:, 3:]).all()
    # The baseline that is held has no error along; in the scale of the mean it has some of the others'.
    assert (np.abs(shifts[1:]) < 4.0 * sigmas[:, :3].max()).all()
    for frame in range(1, FRAMES):  # one pose for all frames
        own = slice(frame * SENSORS, (frame + 1) * SENSORS)
        np.testing.assert_allclose(rig.rotations[own], rig.rotations[:SENSORS], atol=1e-12)
        np.testing.assert_allclose(rig.translations[own], rig.translations[:SENSORS], atol=1e-12)


def test_a_held_offset_or_two_fixed_frames_tell_the_scale_of_free_sensors():
    rng = np.random.default_rng(5)
    truth = rig_problem(rng)
    start = disturb_sensors(truth, rng)
    held = replace(start, rig=replace(start.rig, free_sensor_of_camera=np.tile([-1, -1, 0], FRAMES)))
    assert lay_out(held, SQUARES).scale_sensor == -1
    found = adjust(held, SQUARES)
    np.testing.assert_array_equal(
        found.problem.rig.translations[1::SENSORS], start.rig.translations[1::SENSORS]
    )
    fixed = replace(start, fixed=np.arange(FRAMES) < 2)
    assert lay_out(fixed, SQUARES).scale_sensor == -1
    found = adjust(fixed, SQUARES)
    # The fixed frames are 2.5 units apart, 0.5 px at 4 units are 0.004: all baselines are found, 2 % or not.
    np.testing.assert_allclose(baselines(found.problem), baselines(truth), rtol=0.005)
