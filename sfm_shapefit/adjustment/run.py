"""One bundle adjustment of our own: frames and tracks, and the solves that move the frames.

It triangulates at the pixel threshold and solves twice:

    start                                                           loss             to a relative fall of
    poses that are coarse: few tracks, triangulated at 16 px        Cauchy, 1 px     1e-4 (`adjust_thinly`)
    where nothing follows: some more, at the pixel threshold        0.25 to 1 px     1e-4
    all tracks, triangulated at the pixel threshold                 0.25 to 1 px     1e-3
    all tracks, triangulated there anew                             0.25 to 1 px     1e-5

The threshold is 4 px; with another one, all scales follow. Poses are coarse if the threshold loses a tenth
of the observations that four times as much finds. The scale is the one of 0.25, 0.5 and 1 px that the
errors themselves call for (`choose_loss_scale_px`): 0.25 px on photographs, whose best features are far
better than most; 1 px under normal errors of 0.5 px, where 0.25 px would cost a third. Where fine poses
stand, a first solve at 1 px leads away from what finer losses find: a street of photographs from 0.0115 off
to 0.0144, from where a relative fall of 1e-4 ends at 0.0114, and 1e-5 at 0.0113. Tracks are joined from the
matches that agree with the poses, anew for each solve.

Points of two images take part where the poses are fine, though no model gets them: a wrong match of these
goes unnoticed in a model, while here it is one of many that the loss weighs. On photographs a fifth to two
fifths of all observations are of no longer tracks, and each such match constrains the cameras once. Chosen
on castle-P19 (mean error 0.0254 without, 0.0238 with them), Herz-Jesus-P8 (0.0036, both) and a rendered
street (0.0116, 0.0114). From rotations that were given (`adjust_placement`) a first solve may be far off,
and takes checked points alone.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.covariance import estimate_covariances, focal_shares
from sfm_shapefit.adjustment.estimate import BundleAdjustment, Estimate
from sfm_shapefit.adjustment.free_sensors import judge_sensors
from sfm_shapefit.adjustment.freedom import Freedom, GivenPoses
from sfm_shapefit.adjustment.given_rotations import RotationErrors
from sfm_shapefit.adjustment.lens_doubts import covariances_of_open_lenses, errors_of_free_lenses
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.adjustment.shared_errors import CenterErrors, estimate_center_errors
from sfm_shapefit.adjustment.solve import (
    adjust,
    choose_loss_scale_px,
    frames_not_gained,
    reprojection_errors_px,
)
from sfm_shapefit.adjustment.sources import Links, with_rays_of
from sfm_shapefit.adjustment.views import views_of
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IndexArray, hand_back_memory
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.executors import HERE, Crew
from sfm_shapefit.base.threads import count_threads
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import FOCAL
from sfm_shapefit.scene.points import Points
from sfm_shapefit.tracks.links import MatchedKeypoints, ObservedTracks, SeenTracks
from sfm_shapefit.tracks.structure_options import StructureOptions
from sfm_shapefit.tracks.thin_tracks import choose_thin_tracks
from sfm_shapefit.tracks.triangulation import (
    PointLimits,
    TriangulatedPoints,
    triangulate_matches,
    triangulate_tracks,
)

# Scales of the Cauchy loss, in pixel thresholds; the errors choose among them (see the header).
_SCALES = (0.0625, 0.125, 0.25)
# Relative falls of the cost at which the two solves of all tracks end; a solve after a placement ends at the
# second.
FIRST_FALL, LAST_FALL = 1e-3, 1e-5
# Limit of the tracks of a thin solve and scale of its loss, in pixel thresholds, and the relative fall of its
# cost; coarse poses lose their observations to a narrower limit.
_THIN_LIMIT, _THIN_SCALE, _THIN_FALL = 4.0, 0.25, 1e-4
# Damping at first, relative to the curvature of single cameras. A row of n bends with about n^-4 of
# that: after the usual 1e-4, the fine solve of 2,500 cameras ends 5 % short of its minimum, and a made row of
# 100 keeps 0.4 of its bend; after 1e-8, neither. Only where a solve has gone before: from averaged rotations
# castle-P19 would end in another minimum, four cameras lost; and only if that has freed the same: of 457
# guessed lenses freed at once, the first five steps are refused.
_FIRST_DAMPING, _NEAR_DAMPING = AdjustmentOptions().first_damping, 1e-8
# Tracks that hold each image in a fine solve, in those of the thin one. With 1, the median errors of six real
# scenes are 1.0 to 1.3 times those with 3, and of a facade of 300 images 1.6 times; 6 is no better.
FINE_TIMES = 3
# Share of the observations of `_THIN_LIMIT` that the threshold finds too; with less, poses are coarse.
_FINE = 0.9
# Solves repeated with lenses held that were left open; each takes as long as the first.
_MOST_REPETITIONS = 2
_FEW = 0.1  # share of the images; the lenses of the others do not depend on so few
MOST_WHOLE = 20_000  # frames; the observations of more are divided, as one machine may not have the memory
MOST_FRAMES = 2_000  # frames; the standard deviations of more would take longer than all the rest


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AdjustmentRun:
    """An adjustment on its way: a solve gives the next one, and the problem that it solved."""

    images: Images
    """The images where they stand now."""
    links: Links | None
    """By the lenses of the images; None once they were given back, and nothing is triangulated any more."""
    options: StructureOptions
    freedom: Freedom
    """Lenses that the observations leave open are held from then on."""
    given: GivenPoses
    crew: Crew
    """Who works; many frames are divided among them."""
    checked_length: int
    """Fewest observations of a point that a model may have."""
    focal_sigmas: FloatArray
    """(l,) see `Estimate`."""
    undetermined: BoolArray
    """(l,) see `Estimate`."""
    loss_scale_px: float = 1.0
    """Scale of the loss in the last solve."""
    iterations: int = 0
    """Steps of all solves."""
    converged: bool = False

    @property
    def frees_more_than_poses(self) -> bool:
        """Whether lenses or sensors change."""
        return bool(self.freedom.lenses.any()) or bool(self.freedom.sensors(self.images).any())

    @property
    def has_found_lenses(self) -> bool:
        """Whether a lens that moves is no longer what was given."""
        of_lens = zip(self.images.lenses, self.freedom.lenses, strict=True)
        return any(is_free and lens.parameters != lens.given for lens, is_free in of_lens)

    def triangulate(self, widening: float, *, checked: bool = False) -> tuple[SeenTracks, TriangulatedPoints]:
        """Return the tracks and points at the poses of the images.

        Args:
            widening: largest error of an observation, in pixel thresholds.
            checked: whether only points that the model may have count; else points of two images too.
        """
        limits = PointLimits(
            max_error_px=widening * self.options.max_reprojection_error_px,
            min_angle_deg=self.options.min_triangulation_angle_deg,
            min_length=self.checked_length if checked else self.options.min_track_length,
        )
        poses, threads = views_of(self.images).poses(self.images), count_threads(self.crew.threads)
        assert self.links is not None
        if isinstance(self.links, ObservedTracks):
            found = triangulate_tracks(self.links, poses, limits, threads)
            return self.links, self._without_lone_frames(self.links, found, limits.min_length)
        error_px = self.options.max_reprojection_error_px
        joined, found = triangulate_matches(self.links, poses, limits, error_px, threads)
        return joined, self._without_lone_frames(joined, found, limits.min_length)

    def _without_lone_frames(
        self, joined: SeenTracks, found: TriangulatedPoints, least: int
    ) -> TriangulatedPoints:
        frames = self.images.frame_of[views_of(self.images).images].astype(np.int32)
        return without_lone_frames(found, frames[joined.cameras[:]], least)

    def problem(self, tracks: SeenTracks, found: TriangulatedPoints) -> AdjustmentProblem:
        """Return the problem of points that were triangulated from tracks, at the poses of the images."""
        sensors = self.freedom.sensors(self.images)
        return views_of(self.images).problem(self.images, sensors, self.given, tracks, found)

    def problem_of_all(
        self, *, checked: bool = False
    ) -> tuple[SeenTracks, TriangulatedPoints, AdjustmentProblem]:
        """Return tracks and points at the pixel threshold, as `triangulate` does, and the problem of all."""
        joined, found = self.triangulate(1.0, checked=checked)
        refuse_without_points(len(found.points))
        return joined, found, self.problem(joined, found)

    def share_of_frames(self, tracks: SeenTracks, found: TriangulatedPoints) -> FloatArray:
        """Return the share of each frame's observations of triangulated tracks that fit the points, (n,)."""
        frames = self.images.frame_of[views_of(self.images).images[tracks.cameras[:]]]
        track_of = tracks.list_of_rows()
        in_points, count = np.isin(track_of, found.tracks), len(self.images.frames.ids)
        fit, every = (np.bincount(frames[x], minlength=count) for x in (found.points_seen >= 0, in_points))
        return np.where(every > 0, fit / np.maximum(every, 1), 1.0)

    def thin_problem(
        self, tracks: SeenTracks, found: TriangulatedPoints, *, times: int = 1
    ) -> AdjustmentProblem:
        """Return the problem of few of the points found, or of some times as many."""
        refuse_without_points(len(found.points))
        hand_back_memory()  # what points were made of
        thin = tracks.of_points(found.points_seen)
        images = views_of(self.images).images.astype(np.int32)[thin.cameras[:]]
        chosen = choose_thin_tracks(thin.offsets, images, thin.pixels, self.images.num_images, times)
        del images
        place = np.full(len(found.points), -1, dtype=np.int32)
        place[chosen] = np.arange(len(chosen))
        points = found.points[chosen]
        seen = thin.spread(place)  # rather than a copy of the tracks that are chosen, which is large
        return self.problem(thin, TriangulatedPoints(points=points, tracks=chosen, points_seen=seen))

    def choose_scale(self, problem: AdjustmentProblem) -> float:
        """Return the scale of the loss that the errors of a problem call for, in pixel thresholds."""
        threshold_px = self.options.max_reprojection_error_px
        return choose_loss_scale_px(problem, [scale * threshold_px for scale in _SCALES]) / threshold_px

    def solve(
        self,
        problem: AdjustmentProblem,
        fall: float,
        scale: float | None = None,
        first_damping: float = _FIRST_DAMPING,
        settles_points: bool = False,
    ) -> "Solved":
        """Return the run at the optimum of a problem.

        Args:
            problem: of the run's images.
            fall: relative fall of the cost to end at.
            scale: of the loss, in pixel thresholds; None: the one that the errors call for.
            first_damping, settles_points: see `AdjustmentOptions`.
        """
        scale = self.choose_scale(problem) if scale is None else scale
        is_divided = self.crew.divides or problem.num_frames > MOST_WHOLE
        run = replace(self, loss_scale_px=scale * self.options.max_reprojection_error_px)
        done = adjust(
            self.freedom.apply(problem, self.given.rotations),
            run.options_at_optimum(),
            crew=self.crew if is_divided else None,
            cost_tolerance=fall,
            first_damping=first_damping,
            settles_points=settles_points,
            **self.freedom.overrides(),
        )
        run = replace(run, iterations=run.iterations + done.iterations, converged=done.converged)
        return run.moved(views_of(self.images).images_of(self.images, done.problem)), done.problem

    def options_at_optimum(self) -> AdjustmentOptions:
        """Return the options by which the optimum last solved for is one."""
        return AdjustmentOptions(
            loss_scale_px=self.loss_scale_px,
            hold_rotations=self.freedom.holds_rotations,
            noise_px=self.freedom.noise_px,
            threads=self.crew.threads,
        )

    def moved(self, images: Images) -> "AdjustmentRun":
        """Return the run with images that stand and look otherwise; links get the rays of their lenses."""
        pairs = zip(self.images.lenses, images.lenses, strict=True)
        changed = np.array([before.parameters != after.parameters for before, after in pairs], dtype=np.bool_)
        if self.links is None or not changed.any():
            return replace(self, images=images)
        return replace(self, images=images, links=with_rays_of(images, self.links, changed))

    def judge_lenses(self, last: AdjustmentProblem) -> "tuple[AdjustmentRun, BoolArray]":
        """Return the run with how well focal lengths are known, and the lenses (l,) left open."""
        free, lenses = self.freedom, self.images.lenses
        if not free.lenses.any():
            return self, free.lenses
        try:
            known = estimate_covariances(last, self.options_at_optimum(), **free.overrides())
            sigmas = focal_shares(last, known)
        except UnsolvableError:
            sigmas = np.full(len(lenses), np.inf)
        of_lens = zip(lenses, free.lenses.tolist(), sigmas.tolist(), strict=True)
        is_open = [is_free and not lens.is_credible(sigma) for lens, is_free, sigma in of_lens]
        return self._knowing(sigmas), np.array(is_open, dtype=np.bool_)

    def _knowing(self, sigmas: FloatArray) -> "AdjustmentRun":
        """Return the run with how well the focal lengths that move are known, by sigmas (l,) of all."""
        sigmas = np.where(np.isnan(sigmas), np.inf, sigmas)
        return replace(self, focal_sigmas=np.where(self.freedom.parts[:, FOCAL], sigmas, np.nan))

    def holding(self, held: BoolArray) -> "AdjustmentRun":
        """Return the run with some lenses (l,) as they were given, their focal lengths held from now on.

        A lens that is not to be believed even so is held as a whole.
        """
        old = self.images.lenses
        lenses = [lens.as_given() if held[k] else lens for k, lens in enumerate(old)]
        run = self.moved(self.images.with_lenses(lenses))
        return replace(
            run,
            freedom=run.freedom.holding(held, old),
            undetermined=run.undetermined | held,
            focal_sigmas=np.where(held, np.nan, run.focal_sigmas),
        )

    def estimate(
        self,
        last: AdjustmentProblem,
        *,
        errors: RotationErrors | None = None,
        initial_error_px: float = math.nan,
        judged: bool = True,
    ) -> Estimate:
        """Return where the images stand, and how well that is known at the optimum last solved for.

        Args:
            last: the problem there.
            errors, initial_error_px: see `Estimate` and `BundleAdjustment`.
            judged: whether it is asked how well centers and sensors are known, which takes as long as steps.
        """
        run, known = self._center_errors(last) if judged else (self, None)
        free = self.freedom.sensors(self.images) & judged
        covariances = None
        if known is not None:
            image_of = views_of(self.images).images[last.cameras_seeing]
            of_open = covariances_of_open_lenses(self.images, last, image_of, self.undetermined)
            covariances = known.covariances[self.images.frame_of] + of_open
        return Estimate(
            images=self.images,
            freedom=self.freedom,
            errors=errors,
            covariances=covariances,
            draws=None if known is None else known.draws,
            noise_px=math.nan if known is None else known.noise_px,
            lens_errors=None if known is None else known.lens_errors,
            scale_sigma=None if known is None else known.scale_sigma,
            focal_sigmas=run.focal_sigmas,
            undetermined=self.undetermined,
            sensor_sigmas=judge_sensors(self.images, free, last, self.options_at_optimum()),
            solves=BundleAdjustment(
                converged=self.converged,
                iterations=self.iterations,
                initial_error_px=initial_error_px,
                final_error_px=math.nan,
            ),
        )

    def _center_errors(self, problem: AdjustmentProblem) -> "tuple[AdjustmentRun, CenterErrors | None]":
        """Return the run with how well focal lengths are known, and the same of centers; None if it is not.

        Errors are estimated by points that the model may have, if there are any: of two images' a single
        residual is left, which says little of them. With all points, standard deviations on castle-P19 and
        Herz-Jesus-P8 are a quarter less than the checked points give, and the errors are not.
        """
        if problem.num_frames > MOST_FRAMES:
            return self.judge_lenses(problem)[0], None
        is_checked = np.bincount(problem.points_seen, minlength=problem.num_points) >= self.checked_length
        checked = problem.of_points(is_checked) if is_checked.any() else problem
        try:
            options = self.options_at_optimum()
            known = estimate_center_errors(checked, options, self.freedom.doubt_rad)
            if not self.freedom.lenses.any():
                return self, known
            of_lenses, sigmas = errors_of_free_lenses(checked, options, self.freedom)
            return self._knowing(sigmas), replace(known, covariances=known.covariances + of_lenses)
        except UnsolvableError:
            return self.judge_lenses(problem)[0], None


Solved = tuple[AdjustmentRun, AdjustmentProblem]


def without_lone_frames(found: TriangulatedPoints, frames: IndexArray, least: int) -> TriangulatedPoints:
    """Return points of at least so many observations (m,), of which no frame (m,) has a single one.

    Where it may move, such a frame and its point run into another camera of that point: nothing is missed
    there, and as near to the camera the point would say more than all others together.
    """
    while True:
        seen = found.points_seen >= 0
        alone = seen & (np.bincount(frames[seen], minlength=int(frames.max(initial=0)) + 1) == 1)[frames]
        if not alone.any():
            return found
        found = replace(found, points_seen=np.where(alone, -1, found.points_seen)).of_length(least)


def begin(
    images: Images,
    links: Links,
    options: StructureOptions,
    freedom: Freedom,
    given: GivenPoses | None = None,
    crew: Crew = HERE,
) -> AdjustmentRun:
    """Return the run of an adjustment that is to begin.

    Args:
        images: the start, all of them posed.
        links: of these images.
        options: filters of points.
        freedom: what moves.
        given: what is known of their poses; nothing if None.
        crew: who works.
    """
    given = given or GivenPoses()
    fewest = options.fewest_views(images.num_images) if isinstance(links, MatchedKeypoints) else 2
    num_lenses = len(images.lenses)
    return AdjustmentRun(
        images=images,
        links=links,
        options=options,
        freedom=freedom.over(num_lenses),
        given=given if given.rotations is not None else given._replace(rotations=images.frames.rotations),
        crew=crew,
        checked_length=max(options.min_track_length, fewest),
        focal_sigmas=np.full(num_lenses, np.nan),
        undetermined=np.zeros(num_lenses, dtype=np.bool_),
    )


def solve_coarsely(run: AdjustmentRun, coarse: AdjustmentProblem | None = None) -> Solved:
    """Return the run at the optimum of few points at the wide limit, which may be known; for coarse poses."""
    coarse = coarse or run.thin_problem(*run.triangulate(_THIN_LIMIT, checked=True))
    return run.solve(coarse, _THIN_FALL, _THIN_SCALE)


def fine_problem(run: AdjustmentRun) -> AdjustmentProblem | None:
    """Return the problem of some more points at the threshold; None if there are none."""
    joined, found = run.triangulate(1.0)
    return run.thin_problem(joined, found, times=FINE_TIMES) if len(found.points) else None


def solve_finely(run: AdjustmentRun, problem: AdjustmentProblem, *, near: bool = True) -> Solved:
    """Return the run at the optimum of a fine problem, after a coarse one, `near` if that freed the same."""
    return run.solve(problem, _THIN_FALL, first_damping=_NEAR_DAMPING if near else _FIRST_DAMPING)


def solve_twice_thinly(
    run: AdjustmentRun, coarse: AdjustmentProblem | None = None, *, lenses_known: bool = False
) -> Solved:
    """Return the run after coarse frames were moved at the wide limit, then finely at the threshold.

    Finely: by more points, with the loss that their errors call for. All tracks are given back before either
    is solved.

    Args:
        run, coarse: as of `solve_coarsely`.
        lenses_known: whether the first solve holds them; it then takes a tenth of the time if there are many.
    """
    free = run.freedom
    run, last = solve_coarsely(replace(run, freedom=free.without_lenses()) if lenses_known else run, coarse)
    run = replace(run, freedom=free)
    problem = fine_problem(run)
    if problem is None:
        return run, last
    del last
    return solve_finely(run, problem, near=not lenses_known)


def solve_thinly_again(run: AdjustmentRun) -> Solved:
    """Return the run after a fine solve, where poses are fine but for a few, else after two as at first."""
    fine, coarse = problem_of_poses(run)
    return solve_twice_thinly(run, coarse) if fine is None else solve_finely(run, fine)


def problem_of_poses(run: AdjustmentRun) -> tuple[AdjustmentProblem | None, AdjustmentProblem | None]:
    """Return the fine problem; None where the points found say that poses are coarse, and the coarse one."""
    joined, found = run.triangulate(1.0)
    num_fine = found.count_seen(run.checked_length)
    problem = run.thin_problem(joined, found, times=FINE_TIMES) if num_fine else None
    del joined, found  # whose arrays have all matches
    coarse = _coarse_points(run, num_fine)
    return (None, run.thin_problem(*coarse)) if coarse else (problem, None)


def _coarse_points(run: AdjustmentRun, num_fine: int) -> tuple[SeenTracks, TriangulatedPoints] | None:
    """Return the tracks and points at the wide limit; None if so many observations say that poses are fine.

    They are not looked for where nine tenths of all matched keypoints see those at the threshold.
    """
    assert run.links is not None
    if 0 < num_fine >= _FINE * len(run.links.cameras):
        return None
    joined, loose = run.triangulate(_THIN_LIMIT, checked=True)
    is_fine = 0 < num_fine >= _FINE * np.sum(loose.points_seen >= 0)
    return None if is_fine else (joined, loose)


def repeat_with_known_lenses(
    run: AdjustmentRun,
    solve: Callable[[AdjustmentRun], Solved],
    again: Callable[[AdjustmentRun], Solved],
    *,
    more_follows: bool = False,
) -> Solved:
    """Solve, and where focal lengths are left open, hold what was given of them and solve again.

    What is still open after a few times keeps what it has, with its standard deviation.

    Args:
        run: before the solve.
        solve, again: the first solve, and those after it.
        more_follows: whether images are measured anew, or adjusted by all points, while lenses move. Where
            those of few images are held, and others move, nothing is then solved again.
    """
    run, last = solve(run)
    for _ in range(_MOST_REPETITIONS):
        run, is_open = run.judge_lenses(last)
        if not is_open.any():
            return run, last
        run = run.holding(is_open)
        are_few = np.mean(is_open[run.images.lens_of]) <= _FEW
        if more_follows and are_few and run.frees_more_than_poses:
            return run, last
        run, last = again(run)
    return run.judge_lenses(last)[0], last


def solve_placed(run: AdjustmentRun, problem: AdjustmentProblem, fall: float) -> Solved:
    """Return the run at the optimum of a problem; frames that gained nothing by moving are put back."""
    after, last = run.solve(problem, fall, settles_points=True)
    if run.frees_more_than_poses:
        return after, last
    returned = frames_not_gained(problem, last, after.loss_scale_px)
    rotations = np.where(returned[:, None, None], problem.rotations, last.rotations)
    centers = np.where(returned[:, None], problem.centers, last.centers)
    return after.moved(after.images.posed(rotations, centers)), replace(
        last, rotations=rotations, centers=centers
    )


def _solve_all(run: AdjustmentRun) -> Solved:
    return run.solve(run.problem_of_all()[2], FIRST_FALL, settles_points=True)


def solve_by_all_points(
    run: AdjustmentRun, *, lenses_judged: bool = False
) -> tuple[AdjustmentRun, Points, AdjustmentProblem]:
    """Return the run after two solves by all points, those that a model may have, and the last problem.

    Where lenses were judged by fewer points, those left open are held already: all points tell no less.
    """
    run, _ = _solve_all(run) if lenses_judged else repeat_with_known_lenses(run, _solve_all, _solve_all)
    joined, found, problem = run.problem_of_all()
    run, last = run.solve(problem, LAST_FALL, first_damping=_NEAR_DAMPING, settles_points=True)
    found = replace(found, points=last.points).of_length(run.checked_length)
    return run, views_of(run.images).seen_points(joined, found), last


def solve_known_points(run: AdjustmentRun, points: FloatArray) -> Solved:
    """Return the run after two solves by points (k, 3) that are there, one for each track of its links.

    No other is triangulated, and none is left out. InputError if no image observes a point.
    """
    assert isinstance(run.links, ObservedTracks)
    problem = run.problem(run.links, TriangulatedPoints.of_tracks(run.links, points))
    run, problem = run.solve(problem, FIRST_FALL, settles_points=True)
    return run.solve(problem, LAST_FALL, first_damping=_NEAR_DAMPING, settles_points=True)


def solve_from_seed(run: AdjustmentRun) -> tuple[AdjustmentRun, Points, AdjustmentProblem, float]:
    """Return what `solve_by_all_points` does, after few where poses are coarse; and the first mean error."""
    joined, found = run.triangulate(1.0, checked=True)
    coarse = _coarse_points(run, found.count_seen())
    initial_error_px = mean_error_px(run.problem(joined, found))
    if coarse is not None:
        run, _ = run.solve(run.thin_problem(*coarse), _THIN_FALL, _THIN_SCALE)
    del joined, found, coarse
    return *solve_by_all_points(run), initial_error_px


def refuse_without_points(num_points: int) -> None:
    """Raise UnsolvableError if there is no point to adjust."""
    if num_points == 0:
        raise UnsolvableError(
            "no 3D point can be triangulated at these camera positions, so there is nothing to adjust; "
            "run with adjust=none"
        )


def mean_error_px(problem: AdjustmentProblem) -> float:
    """Return the mean over points of the mean error of a point's observations in front of their cameras."""
    if problem.num_points == 0:
        return float("nan")
    errors = reprojection_errors_px(problem)
    ahead = np.isfinite(errors)
    counts = np.bincount(problem.points_seen[ahead], minlength=problem.num_points)
    sums = np.bincount(problem.points_seen[ahead], errors[ahead], problem.num_points)
    return float(np.mean(sums[counts > 0] / counts[counts > 0]))
