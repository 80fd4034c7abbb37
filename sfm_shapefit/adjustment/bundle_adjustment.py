"""Bundle adjustment of images: from a seed by all points, on few tracks, or after a placement."""

from dataclasses import replace
from functools import partial

import numpy as np

from sfm_shapefit.adjustment import run as steps
from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.given_rotations import estimate_rotation_errors, without_unseen_turns
from sfm_shapefit.adjustment.run import FIRST_FALL, LAST_FALL, MOST_FRAMES, AdjustmentRun
from sfm_shapefit.scene.points import Points
from sfm_shapefit.tracks.links import ObservedTracks

_MANY_FRAMES = 1_000  # frames whose poses, if they are fine, need no coarse solve; it is half of the time


def adjust_seed(run: AdjustmentRun) -> tuple[Estimate, Points]:
    """Adjust poses, and points that are triangulated from links, from where all images are posed.

    Returns:
        The images where they stand now, and the points, not filtered yet. The gauge stays that of the start
        where fixed frames, rigs and known centers leave it open: the best similarity of the centers to the
        start's is the identity. Sensors and intrinsics that are not free stay what they are to the bit.

    Raises:
        UnsolvableError: if no point can be triangulated.
    """
    run, points, last, initial_error_px = steps.solve_from_seed(run)
    return run.estimate(last, initial_error_px=initial_error_px), points


def adjust_thinly(
    run: AdjustmentRun, *, lenses_wanted: bool = False, rotations_known: bool = False
) -> Estimate:
    """Adjust the poses of images on few tracks that hold every camera; for poses that may be coarse.

    Twice: the wide limit that coarse poses need lets wrong matches in, which bend what is held loosely, as
    long rings are. A ring of 300 images ends 0.0020 off after the first solve, 0.0012 after the second.

    Observations may miss by four times their limit. A lens whose focal length the points leave open gets what
    was given back, and the poses are adjusted again. Lenses that an adjustment has found before are held in
    the first solve. Where a lens or a rig has changed, all points follow, up to 2,000 frames: a shape bends
    with a focal length that few points leave a thousandth off.

    Args:
        run: at its begin. Nobody else holds its links, so that matches are given back before the last solve,
            which takes most memory.
        lenses_wanted: whether the images are measured anew through the lenses that come out. Few points
            suffice then, and how well centers are known stays open.
        rotations_known: whether rotations are known from elsewhere. All points follow the first solve at
            once; where lenses are wanted, only if their rays have not changed by a hundredth.

    Returns:
        The gauge is as from `adjust_seed`.

    Raises:
        UnsolvableError: if no point can be triangulated.
    """
    images = run.images
    only_lenses = lenses_wanted and not rotations_known
    if run.frees_more_than_poses:
        by_all = not only_lenses and len(images.frames.ids) <= MOST_FRAMES
        if by_all and rotations_known:
            run, last = steps.solve_coarsely(run)
            if lenses_wanted and run.images.differ_in_rays(images):
                return run.judge_lenses(last)[0].estimate(last, judged=False)
            run, _, last = steps.solve_by_all_points(run)
            return run.estimate(last)
        solve = partial(steps.solve_twice_thinly, lenses_known=run.has_found_lenses)
        again, follows = steps.solve_thinly_again, only_lenses or by_all
        run, last = steps.repeat_with_known_lenses(run, solve, again, more_follows=follows)
        if by_all and run.frees_more_than_poses:
            run, _, last = steps.solve_by_all_points(run, lenses_judged=True)
        return run.estimate(last, judged=not only_lenses)
    problem, coarse = steps.problem_of_poses(run) if len(images.frames.ids) >= _MANY_FRAMES else (None, None)
    if problem is None:
        run, last = steps.solve_coarsely(run, coarse)
        problem = steps.fine_problem(run)
    if problem is not None:
        run = replace(run, links=None)  # all matches, at the peak of the memory
        run, last = steps.solve_finely(run, problem)
    return run.estimate(last, judged=not only_lenses)


def adjust_placement(run: AdjustmentRun) -> Estimate:
    """Adjust images, all of them posed, whose rotations were given, on all tracks at once.

    Rotations move as the matches decide, if they are to. UnsolvableError if no point can be triangulated.
    """
    images, links, pull_rad, errors = run.images, run.links, run.freedom.pull_rad, None
    run = replace(run, freedom=replace(run.freedom, pull_rad=np.inf))
    if run.frees_more_than_poses:  # points are found, and rotations judged, with what comes out
        solve, again = steps.solve_twice_thinly, steps.solve_thinly_again
        run, _ = steps.repeat_with_known_lenses(run, solve, again)
        run = run.moved(run.images.posed(images.frames.rotations, run.images.frames.centers))
    tracks, found, problem = run.problem_of_all(checked=True)
    decided = replace(run.freedom, pull_rad=pull_rad)
    if pull_rad is None:
        # The loss of the adjustment itself: a wider one lets wrong matches hide what the right ones say.
        loss_scale_px = run.choose_scale(problem) * run.options.max_reprojection_error_px
        loss = AdjustmentOptions(loss_scale_px=loss_scale_px, threads=run.crew.threads)
        errors = estimate_rotation_errors(problem, loss)
        if isinstance(links, ObservedTracks):
            errors = without_unseen_turns(errors, problem, loss, run.share_of_frames(tracks, found))
        decided = errors.decide(run.freedom)
    run = replace(run, freedom=decided)
    is_repeated = bool(decided.singled_out().any())
    run, last = steps.solve_placed(run, problem, FIRST_FALL if is_repeated else LAST_FALL)
    # A frame whose rotation was far off has had few of its tracks; where it stands now it has more, then all.
    for fall in (FIRST_FALL, LAST_FALL) if is_repeated else ():
        run, last = steps.solve_placed(run, run.problem_of_all(checked=True)[2], fall)
    return run.estimate(last, errors=errors)
