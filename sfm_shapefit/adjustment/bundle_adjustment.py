"""Bundle adjustment of reconstructions: from a seed by all points, on few tracks, or after a placement."""

from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial

import pycolmap

from sfm_shapefit.adjustment import AdjustmentOptions
from sfm_shapefit.adjustment.adjusted import Adjusted, AdjustedPlacement
from sfm_shapefit.adjustment.filter import filter_points
from sfm_shapefit.adjustment.free_sensors import NO_SENSORS
from sfm_shapefit.adjustment.given_rotations import RotationWeight, estimate_rotation_errors
from sfm_shapefit.adjustment.run import FIRST_FALL, LAST_FALL, MOST_FRAMES, AdjustmentRun, GivenPoses
from sfm_shapefit.adjustment.sources import TrackSource
from sfm_shapefit.adjustment.views import rotations_of_frames
from sfm_shapefit.tracks.options import StructureOptions


def bundle_adjust(
    seed: pycolmap.Reconstruction,
    tracks: TrackSource,
    structure_options: StructureOptions | None = None,
    *,
    fixed_frames: Collection[int] = (),
    given: GivenPoses | None = None,
) -> Adjusted:
    """Adjust poses and points together, starting from the poses of `seed`, which is not changed.

    Args:
        seed: the placed images; any points are ignored, for `tracks` are triangulated at its poses.
        tracks: as in `triangulate`.
        structure_options: filters; the defaults if None.
        fixed_frames: ids of frames whose poses stay what they are to the last bit.
        given: what is known of poses and lenses, and how it is treated; nothing if None.

    Returns:
        The adjusted model, with ids and colors of points as from `triangulate`. The gauge stays the seed's
        where fixed frames, rigs and known centers leave it open: the best similarity of the centers to the
        seed's is the identity. Sensors and intrinsics that are not free stay what they are to the bit.

    Raises:
        UnsolvableError: if no point can be triangulated.
    """
    structure_options, given = structure_options or StructureOptions(), given or GivenPoses()
    run = AdjustmentRun(seed, tracks, structure_options, fixed_frames, given)
    run.weight = given.weight_of(run.frames.frame_ids)
    if given.model is not None:
        run.given_rotations = rotations_of_frames(given.model, run.frames.frame_ids)
    unfiltered, initial_error_px, last = run.adjust_all(seed, tracks)
    uncertainty, sensors = run.uncertainty(last), run.judge_sensors(last)
    answer = filter_points(unfiltered, structure_options)
    return Adjusted(
        reconstruction=answer,
        initial_error_px=initial_error_px,
        final_error_px=answer.compute_mean_reprojection_error(),
        converged=run.converged,
        iterations=run.iterations,
        uncertainty=uncertainty,
        lenses=run.refined,
        sensors=sensors,
    )


def adjust_thinly(
    seed: pycolmap.Reconstruction,
    read_tracks: Callable[[], TrackSource],
    structure_options: StructureOptions | None = None,
    *,
    fixed_frames: Collection[int] = (),
    given: GivenPoses | None = None,
    thorough: bool = False,
) -> AdjustedPlacement:
    """Adjust the poses of `seed` on few tracks that hold every camera; for poses that may be coarse.

    Twice: the wide limit that coarse poses need lets wrong matches in, which bend what is held loosely, as
    long rings are. A ring of 300 images ends 0.0020 off after the first solve, 0.0012 after the second.

    Args:
        seed: the placed images, which is not changed; any points are ignored.
        read_tracks: returns what `triangulate` takes. Nobody else holds them, so that matches are given back
            before the last solve, which takes most memory.
        structure_options: filters; the defaults if None. Observations may miss by four times their limit.
        fixed_frames: ids of frames whose poses stay what they are to the last bit.
        given: lenses and rigs that change with the poses; nothing else of it counts. A lens whose focal
            length the points leave open gets what was given back, and the poses are adjusted again.
        thorough: whether all points follow where a lens or a rig has changed: a shape bends with a focal
            length that few points leave a thousandth off. Up to 2,000 frames.

    Returns:
        The adjusted poses, all rotations free; their gauge is as from `bundle_adjust`.

    Raises:
        UnsolvableError: if no point can be triangulated.
    """
    given = given or GivenPoses()
    freed = GivenPoses(lenses=given.lenses, free_rigs=given.free_rigs)
    run = AdjustmentRun(seed, read_tracks(), structure_options or StructureOptions(), fixed_frames, freed)
    adjusted = run.repeat_with_known_lenses(partial(run.adjust_twice_thinly, is_last=True))
    if thorough and run.frees_more_than_poses() and adjusted.num_frames <= MOST_FRAMES:
        _, _, adjusted = run.adjust_by_all_points()
    return AdjustedPlacement(
        reconstruction=run.posed(seed),
        weight=run.weight,
        frame_ids=run.frames.frame_ids,
        errors=None,
        uncertainty=run.uncertainty(adjusted),
        lenses=run.refined,
        sensors=run.judge_sensors(adjusted) if thorough else NO_SENSORS,
    )


def adjust_placement(
    seed: pycolmap.Reconstruction,
    tracks: TrackSource,
    structure_options: StructureOptions,
    weight: RotationWeight | None,
    *,
    fixed_frames: Collection[int] = (),
    given: GivenPoses | None = None,
) -> AdjustedPlacement:
    """Adjust placed cameras whose rotations were given, on all tracks at once.

    Args:
        seed: the placed images, which is not changed; any points are ignored.
        tracks: as in `triangulate`.
        structure_options: filters.
        weight: of the given rotations; None: the matches decide, see `adjustment.given_rotations`.
        fixed_frames: ids of frames whose poses stay what they are to the last bit.
        given: centers measured otherwise, which pull at the frames, and lenses that may change.

    Raises:
        UnsolvableError: if no point can be triangulated.
    """
    run, errors = AdjustmentRun(seed, tracks, structure_options, fixed_frames, given or GivenPoses()), None
    if run.frees_more_than_poses():  # points are found, and rotations judged, with what comes out
        run.repeat_with_known_lenses(run.adjust_twice_thinly)
        run.frames = replace(run.frames, rotations=run.start.rotations)
    _, _, problem = run.problem_of_all(checked=True)
    if weight is None:
        # The loss of the adjustment itself: a wider one lets wrong matches hide what the right ones say.
        loss_scale_px = run.choose_scale(problem) * structure_options.max_reprojection_error_px
        errors = estimate_rotation_errors(problem, AdjustmentOptions(loss_scale_px=loss_scale_px))
        weight = errors.weight()
    run.weight = weight
    is_repeated = bool(weight.singled_out(problem.num_frames).any())
    adjusted = run.adjust_placed(problem, FIRST_FALL if is_repeated else LAST_FALL)
    # A frame whose rotation was far off has had few of its tracks; where it stands now it has more, then all.
    for fall in (FIRST_FALL, LAST_FALL) if is_repeated else ():
        adjusted = run.adjust_placed(run.problem_of_all(checked=True)[2], fall)
    return AdjustedPlacement(
        reconstruction=run.posed(seed),
        weight=weight,
        frame_ids=run.frames.frame_ids,
        errors=errors,
        uncertainty=run.uncertainty(adjusted),
        lenses=run.refined,
        sensors=run.judge_sensors(adjusted),
    )
