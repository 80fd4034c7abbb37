"""Bundle adjustment by pycolmap's Ceres: robust rounds, with the structure triangulated afresh before each.

    round   triangulate and filter at   loss
    1       4 x the pixel threshold     Cauchy, 2 px
    2, 3    the pixel threshold         Cauchy, 1 px

A seed that is a few pixels off loses its long tracks to a tight filter at once, so the first round is loose.
Points made at the first poses carry their errors on, so every round triangulates anew instead of completing
what is there. From the incremental model's centers disturbed by 5 cm, the mean error against the laser truth
of Strecha's castle-P19 and P30 is 25 and 22 mm, with points kept, completed and filtered 26 and 25 mm.
Two-view tracks in the adjustment give 38 instead of 26 mm on P19.

One thread does all, because the sums of several are added in changing order: results then differ in
their last digits from run to run.
"""

from collections.abc import Collection
from dataclasses import replace
from typing import cast

import numpy as np
import pycolmap

from sfm_shapefit.adjustment.free_lenses import FreeLenses
from sfm_shapefit.adjustment.sources import TrackSource, with_rays_of
from sfm_shapefit.adjustment.structure import triangulate
from sfm_shapefit.adjustment.views import read_frames
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.files.colmap.model import sensors_of
from sfm_shapefit.files.colmap.quiet import is_heard, quiet_stderr
from sfm_shapefit.files.colmap.seed import transform_model
from sfm_shapefit.tracks.links import MatchedKeypoints
from sfm_shapefit.tracks.options import StructureOptions

# Of each round, how much looser than asked the filter is, and the scale of the Cauchy loss in px.
_ROUNDS = ((4.0, 2.0), (1.0, 1.0), (1.0, 1.0))
# Steps end at this relative fall of the cost; 0, pycolmap's default, doubles the time for equal errors.
_FUNCTION_TOLERANCE = 1e-6
# Of Levenberg-Marquardt steps in each round.
_MAX_STEPS = 100


def adjust_by_ceres(
    start: pycolmap.Reconstruction,
    tracks: TrackSource,
    structure_options: StructureOptions,
    fixed_frames: Collection[int],
    lenses: FreeLenses | None = None,
    *,
    free_rigs: bool = False,
) -> tuple[pycolmap.Reconstruction, int, bool]:
    """Return a new model, not yet filtered, the steps of all rounds, and whether the last one converged.

    Lenses that may change are free here: Ceres knows of no prior on them. So are rigs, but for the mean
    distance of sensors from the references, which is restored.

    Raises:
        UnsolvableError: if no point can be triangulated, or the adjustment diverges.
    """
    current, iterations, converged = start, 0, False
    for widening, loss_scale_px in _ROUNDS:
        limit_px = widening * structure_options.max_reprojection_error_px
        current = triangulate(current, tracks, replace(structure_options, max_reprojection_error_px=limit_px))
        refuse_without_points(current.num_points3D())
        steps, converged = _solve(current, loss_scale_px, fixed_frames, lenses, free_rigs=free_rigs)
        if lenses is not None and isinstance(tracks, MatchedKeypoints):
            tracks = with_rays_of(read_frames(current), tracks)
        if free_rigs and not fixed_frames:
            size = _mean_baseline(start) / _mean_baseline(current)
            motion = Similarity(scale=size, rotation=np.eye(3), translation=np.zeros(3))
            current = transform_model(current, motion)
        for image in map(current.image, sorted(current.reg_image_ids())):
            if not np.isfinite(image.cam_from_world().matrix()).all():  # such points are filtered later
                raise UnsolvableError(
                    f"the bundle adjustment drove image {image.name} to infinity; run without bundle "
                    "adjustment"
                )
        iterations += steps
    return current, iterations, converged


def refuse_without_points(num_points: int) -> None:
    """Raise UnsolvableError if there is no point to adjust."""
    if num_points == 0:
        raise UnsolvableError(
            "no 3D point can be triangulated at these camera positions, so there is nothing to adjust; "
            "run with --no-adjust and without --bundle-adjust"
        )


def _solve(
    reconstruction: pycolmap.Reconstruction,
    loss_scale_px: float,
    fixed_frames: Collection[int],
    lenses: FreeLenses | None,
    *,
    free_rigs: bool,
) -> tuple[int, bool]:
    """Adjust our own `reconstruction` in place; return the number of steps and whether they converged."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(reconstruction.reg_image_ids()):
        config.add_image(image_id)
    for frame_id in sorted(set(fixed_frames) & set(reconstruction.reg_frame_ids())):
        config.set_constant_rig_from_world_pose(frame_id)
    has_scale = any(_has_offsets(rig) for rig in reconstruction.rigs.values())
    if not has_scale or (free_rigs and not fixed_frames):
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    elif not fixed_frames:  # rigs know the scale, and one frame holds the rest
        config.set_constant_rig_from_world_pose(min(reconstruction.reg_frame_ids()))
    settings = pycolmap.BundleAdjustmentOptions()
    settings.print_summary = is_heard()
    settings.refine_focal_length = settings.refine_principal_point = settings.refine_extra_params = False
    settings.refine_sensor_from_rig = free_rigs
    if lenses is not None and lenses.doubts:
        settings.refine_focal_length, settings.refine_extra_params = True, lenses.distortion
        # Ceres, by pycolmap, frees the focal lengths of all cameras or of none.
        for camera_id in sorted(set(reconstruction.cameras) - set(lenses.with_free_focal())):
            config.set_constant_cam_intrinsics(camera_id)
    settings.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    settings.ceres.loss_function_scale = loss_scale_px
    settings.ceres.solver_options.function_tolerance = _FUNCTION_TOLERANCE
    settings.ceres.solver_options.max_num_iterations = _MAX_STEPS
    settings.ceres.solver_options.num_threads = 1
    with quiet_stderr():
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(settings, config, reconstruction)
        summary = cast("pycolmap.CeresBundleAdjustmentSummary", adjuster.solve())
    if not summary.is_solution_usable():
        raise UnsolvableError("the bundle adjustment failed; run without it and look at the seeded model")
    ceres = summary.ceres_summary
    converged = summary.termination_type == pycolmap.BundleAdjustmentTerminationType.CONVERGENCE
    steps = ceres.num_successful_steps + ceres.num_unsuccessful_steps - 1  # the start counts as one
    return steps, converged


def _mean_baseline(reconstruction: pycolmap.Reconstruction) -> float:
    """Return the mean distance of all sensors from the references of their rigs."""
    return float(np.mean([np.linalg.norm(pose.translation) for pose in sensors_of(reconstruction).values()]))


def _has_offsets(rig: pycolmap.Rig) -> bool:
    """Return whether a sensor stands off its rig's origin."""
    poses = [pose for pose in rig.non_ref_sensors.values() if pose is not None]
    return any(bool(np.any(pose.translation)) for pose in poses)
