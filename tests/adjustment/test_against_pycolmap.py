"""The optimum equals that of pycolmap's bundle adjustment, from the same start and under the same loss."""

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.base.geometry import fit_similarity
from tests.adjustment.test_views import disturbed, scene
from tests.models import centers_of
from tests.scenes import BUNDLED

LOSS_PX = 1.0
TIGHT = AdjustmentOptions(
    loss_scale_px=LOSS_PX, cost_tolerance=0.0, gradient_tolerance=1e-13, max_iterations=500
)


def adjust_by_pycolmap(model, *, free_lenses, fixed_frames):
    """Adjust a model in place by pycolmap, in one thread; return the cost."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    if not fixed_frames:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    for frame_id in fixed_frames:
        config.set_constant_rig_from_world_pose(frame_id)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = free_lenses
    options.refine_principal_point = options.refine_sensor_from_rig = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_PX
    solver = options.ceres.solver_options
    solver.function_tolerance, solver.gradient_tolerance, solver.parameter_tolerance = 1e-15, 1e-18, 1e-18
    solver.max_num_iterations, solver.num_threads = TIGHT.max_iterations, 1
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    return adjuster.solve().ceres_summary.final_cost


def assert_same_optimum(model, size, *, free_lenses=False, fixed_frames=()):
    """Both adjust a model whose frames and points are moved, about 1e-3 of its size."""
    start = disturbed(model, 1e-3 * size)
    theirs, given = pycolmap.Reconstruction(start), centers_of(start)
    cost = adjust_by_pycolmap(theirs, free_lenses=free_lenses, fixed_frames=fixed_frames)
    free = {"free_focal_lengths": free_lenses, "free_distortion": free_lenses}
    ours = sfm_shapefit.bundle_adjust(start, TIGHT, fixed_frames=fixed_frames, **free)
    assert ours.adjusted.gradient_norm < 1e-7
    assert ours.adjusted.cost == pytest.approx(cost, rel=1e-9)
    found, expected = centers_of(ours.reconstruction), centers_of(theirs)
    assert np.abs(found - given).max() > 1e-4 * size  # it had a way to go
    fit = fit_similarity(expected, found)
    np.testing.assert_allclose(fit.apply(expected), found, atol=1e-6 * size)
    if fixed_frames:  # the rigs know the scale
        np.testing.assert_allclose(expected, found, atol=1e-6 * size)


@pytest.mark.parametrize(
    ("name", "free_lenses"), [("photographed", False), ("courtyard", False), ("photographed", True)]
)
def test_the_optimum_is_that_of_pycolmap_on_bundled_scenes(name, free_lenses):
    rng, model = np.random.default_rng(1), pycolmap.Reconstruction(BUNDLED / name / "truth")
    for image_id in sorted(model.reg_image_ids()):
        for point2d in model.image(image_id).points2D:
            point2d.xy = point2d.xy + 0.5 * rng.standard_normal(2)
    assert_same_optimum(model, np.ptp(centers_of(model), axis=0).max(), free_lenses=free_lenses)


def test_the_optimum_of_rigs_is_that_of_pycolmap():
    model = scene(rigs=True)
    first = min(model.reg_frame_ids())
    assert_same_optimum(model, np.ptp(centers_of(model), axis=0).max(), fixed_frames=[first])
