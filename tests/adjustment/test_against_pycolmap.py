"""The optimum equals that of pycolmap's bundle adjustment, from the same start and under the same loss."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from sfm_shapefit.adjustment.options import AdjustmentOptions
from sfm_shapefit.adjustment.solve import adjust, reprojection_errors_px
from sfm_shapefit.base.geometry import fit_similarity
from tests.adjustment.made import adjust_by_pycolmap, disturb, problem_of, rig_problem_of, with_values
from tests.scenes import BUNDLED, real_scene

LOSS_PX = 1.0
TIGHT = AdjustmentOptions(
    loss_scale_px=LOSS_PX, cost_tolerance=0.0, gradient_tolerance=1e-13, max_iterations=500
)


def noisy_model(name, rng, noise_px=0.5):
    """A bundled scene's true model with noise on the observed pixels."""
    model = pycolmap.Reconstruction(BUNDLED / name / "truth")
    for image_id in sorted(model.reg_image_ids()):
        for point2d in model.image(image_id).points2D:
            point2d.xy = point2d.xy + noise_px * rng.standard_normal(2)
    return model


def both_answers(model, rng, options, *, free_lenses=False):
    """Our answer, pycolmap's centers aligned to it, pycolmap's cost, and the extent, from one start."""
    problem, images, points = problem_of(model)
    size = np.ptp(problem.centers, axis=0).max()
    start = disturb(problem, rng, center=1e-3 * size, rotation_rad=1e-3, point=1e-3 * size)
    copy = with_values(model, start, images, points)
    summary = adjust_by_pycolmap(copy, options.loss_scale_px, free_lenses=free_lenses)
    ours = adjust(start, options)
    centers = np.array([copy.image(image_id).projection_center() for image_id in images])
    theirs = fit_similarity(centers, ours.problem.centers).apply(centers)
    return ours, theirs, summary.final_cost, size


def test_both_measure_the_same_cost():
    model = noisy_model("photographed", np.random.default_rng(0))
    problem, images, points = problem_of(model)
    start = disturb(problem, np.random.default_rng(1), center=0.05, rotation_rad=1e-3, point=0.05)
    copy = with_values(model, start, images, points)
    copy.update_point_3d_errors()
    errors = reprojection_errors_px(start)
    sums = np.bincount(start.points_seen, np.nan_to_num(errors), minlength=len(points))
    means = sums / np.bincount(start.points_seen, minlength=len(points))
    clean = ~np.isin(np.arange(len(points)), start.points_seen[np.isnan(errors)])
    theirs = np.array([copy.point3D(point).error for point in points])
    np.testing.assert_allclose(means[clean], theirs[clean], rtol=1e-9)


@pytest.mark.parametrize("name", ["photographed", "courtyard"])
def test_the_optimum_is_that_of_pycolmap_on_bundled_scenes(name):
    rng = np.random.default_rng(0)
    ours, theirs, cost, size = both_answers(noisy_model(name, rng), rng, TIGHT)
    assert ours.gradient_norm < 1e-7
    assert ours.cost == pytest.approx(cost, rel=1e-9)
    np.testing.assert_allclose(theirs, ours.problem.centers, atol=1e-6 * size)


def test_the_optimum_with_free_lenses_is_that_of_pycolmap():
    rng = np.random.default_rng(1)
    model = noisy_model("photographed", rng)
    options = replace(TIGHT, free_focal_lengths=True, free_distortion=True)
    ours, theirs, cost, size = both_answers(model, rng, options, free_lenses=True)
    assert ours.cost == pytest.approx(cost, rel=1e-9)
    np.testing.assert_allclose(theirs, ours.problem.centers, atol=1e-6 * size)


def test_the_optimum_is_that_of_pycolmap_on_a_real_scene():
    model = pycolmap.Reconstruction(real_scene("Herz-Jesus-P8") / "sparse" / "0")
    for point in [point for point in model.point3D_ids() if point % 4]:
        model.delete_point3D(point)
    ours, theirs, cost, size = both_answers(model, np.random.default_rng(0), TIGHT)
    assert ours.cost == pytest.approx(cost, rel=1e-9)
    np.testing.assert_allclose(theirs, ours.problem.centers, atol=1e-6 * size)


def test_the_optimum_of_a_rig_is_that_of_pycolmap():
    pycolmap.set_random_seed(0)
    made = pycolmap.SyntheticDatasetOptions()
    made.num_rigs, made.num_cameras_per_rig, made.num_frames_per_rig, made.num_points3D = 1, 3, 8, 120
    made.sensor_from_rig_translation_stddev, made.sensor_from_rig_rotation_stddev = 0.2, 5.0
    model = pycolmap.synthesize_dataset(made)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev, noise.point3D_stddev, noise.rig_from_world_translation_stddev = 0.5, 0.01, 0.01
    pycolmap.synthesize_noise(noise, model)
    start, frames = rig_problem_of(model)
    start = replace(start, fixed=np.arange(len(frames)) == 0)  # the rig knows the scale

    adjust_by_pycolmap(model, LOSS_PX, fixed_frame=frames[0])
    ours = adjust(start, TIGHT).problem
    theirs = rig_problem_of(model)[0]
    size = np.ptp(theirs.centers, axis=0).max()
    assert np.abs(ours.centers - start.centers).max() > 1e-3 * size  # it had a way to go
    np.testing.assert_allclose(ours.centers, theirs.centers, atol=1e-6 * size)
    np.testing.assert_allclose(ours.rotations, theirs.rotations, atol=1e-6)
