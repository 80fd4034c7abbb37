"""Bundle adjustment of images: from a seed by all points, on few tracks, or after a placement."""

from collections.abc import Callable
from functools import partial

from sfm_shapefit.adjustment import AdjustmentOptions
from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.given_rotations import RotationWeight, estimate_rotation_errors
from sfm_shapefit.adjustment.run import FIRST_FALL, LAST_FALL, MOST_FRAMES, AdjustmentRun, GivenPoses
from sfm_shapefit.adjustment.sources import Links
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points
from sfm_shapefit.tracks.options import StructureOptions


def bundle_adjust(
    images: Images,
    links: Links,
    structure_options: StructureOptions | None = None,
    given: GivenPoses | None = None,
) -> tuple[Estimate, Points]:
    """Adjust poses and points together, starting from the poses of `images`, all of them posed.

    Args:
        images: the start.
        links: of these images; points are triangulated from them.
        structure_options: filters; the defaults if None.
        given: what is known of poses and lenses, and how it is treated; nothing if None.

    Returns:
        The images where they stand now, and the points, not filtered yet. The gauge stays that of the start
        where fixed frames, rigs and known centers leave it open: the best similarity of the centers to the
        start's is the identity. Sensors and intrinsics that are not free stay what they are to the bit.

    Raises:
        UnsolvableError: if no point can be triangulated.
    """
    given = given or GivenPoses()
    run = AdjustmentRun(images, links, structure_options or StructureOptions(), given)
    run.weight = given.weight
    if given.rotations is not None:
        run.given_rotations = given.rotations
    points, initial_error_px, last = run.adjust_all()
    return run.estimate(last, initial_error_px=initial_error_px), points


def adjust_thinly(
    images: Images,
    read_links: Callable[[], Links],
    structure_options: StructureOptions | None = None,
    given: GivenPoses | None = None,
    *,
    thorough: bool = False,
) -> Estimate:
    """Adjust the poses of images on few tracks that hold every camera; for poses that may be coarse.

    Twice: the wide limit that coarse poses need lets wrong matches in, which bend what is held loosely, as
    long rings are. A ring of 300 images ends 0.0020 off after the first solve, 0.0012 after the second.

    Args:
        images: the start, all of them posed.
        read_links: returns the links of these images. Nobody else holds them, so that matches are given back
            before the last solve, which takes most memory.
        structure_options: filters; the defaults if None. Observations may miss by four times their limit.
        given: fixed frames, lenses and rigs that change with the poses; nothing else of it counts. A lens
            whose focal length the points leave open gets what was given back, and the poses are adjusted
            again.
        thorough: whether all points follow where a lens or a rig has changed: a shape bends with a focal
            length that few points leave a thousandth off. Up to 2,000 frames.

    Returns:
        All rotations are free; the gauge is as from `bundle_adjust`.

    Raises:
        UnsolvableError: if no point can be triangulated.
    """
    given = given or GivenPoses()
    freed = GivenPoses(fixed=given.fixed, lenses=given.lenses, free_rigs=given.free_rigs)
    run = AdjustmentRun(images, read_links(), structure_options or StructureOptions(), freed)
    adjusted = run.repeat_with_known_lenses(partial(run.adjust_twice_thinly, is_last=True))
    if thorough and run.frees_more_than_poses() and adjusted.num_frames <= MOST_FRAMES:
        _, _, adjusted = run.adjust_by_all_points()
    return run.estimate(adjusted, with_sensors=thorough)


def adjust_placement(
    images: Images,
    links: Links,
    structure_options: StructureOptions,
    weight: RotationWeight | None,
    given: GivenPoses | None = None,
) -> Estimate:
    """Adjust placed images whose rotations were given, on all tracks at once.

    Args:
        images: the start, all of them posed.
        links: of these images.
        structure_options: filters.
        weight: of the given rotations; None: the matches decide, see `adjustment.given_rotations`.
        given: fixed frames, centers measured otherwise, which pull at the frames, and lenses and rigs that
            may change.

    Raises:
        UnsolvableError: if no point can be triangulated.
    """
    run, errors = AdjustmentRun(images, links, structure_options, given or GivenPoses()), None
    if run.frees_more_than_poses():  # points are found, and rotations judged, with what comes out
        run.repeat_with_known_lenses(run.adjust_twice_thinly)
        run.images = run.images.posed(images.frames.rotations, run.images.frames.centers)
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
    return run.estimate(adjusted, errors=errors)
