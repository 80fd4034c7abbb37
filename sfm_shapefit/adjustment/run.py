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
fifths of all observations are of no longer tracks, and each such match tells the cameras one thing. Chosen
on castle-P19 (mean error 0.0254 without, 0.0238 with them), Herz-Jesus-P8 (0.0036, both) and a rendered
street (0.0116, 0.0114). From rotations that were given (`adjust_placement`) a first solve may be far off,
and takes checked points alone.

One thread does all, as the answer must not depend on their number.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.adjustment import (
    AdjustmentOptions,
    AdjustmentProblem,
    adjust,
    choose_loss_scale_px,
    frames_not_gained,
    reprojection_errors_px,
)
from sfm_shapefit.adjustment.estimate import Estimate, RefinedLenses
from sfm_shapefit.adjustment.free_lenses import ALL_HELD, FreeLenses, focal_sigmas
from sfm_shapefit.adjustment.free_sensors import NO_SENSORS, SensorSigma, judge_sensors
from sfm_shapefit.adjustment.given_rotations import RotationErrors, RotationWeight
from sfm_shapefit.adjustment.shared_errors import CenterErrors, estimate_center_errors
from sfm_shapefit.adjustment.sources import Links, with_rays_of
from sfm_shapefit.adjustment.views import Bounds, observations, views_of
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.known_positions import KnownPositions
from sfm_shapefit.scene.points import Points
from sfm_shapefit.tracks.links import MatchedKeypoints, ObservedTracks
from sfm_shapefit.tracks.options import StructureOptions
from sfm_shapefit.tracks.thin_tracks import choose_thin_tracks
from sfm_shapefit.tracks.triangulation import (
    PointLimits,
    TriangulatedPoints,
    triangulate_matches,
    triangulate_tracks,
)

# Of the Cauchy loss, in pixel thresholds, for the errors to choose from.
_SCALES = (0.0625, 0.125, 0.25)
# Of the two solves of all tracks, and of the one after a placement: the relative falls to end at.
FIRST_FALL, LAST_FALL = 1e-3, 1e-5
# Of the thin solve: the limit of its tracks, and the scale of its loss, in pixel thresholds.
_THIN_LIMIT, _THIN_SCALE, _THIN_FALL = 4.0, 0.25, 1e-4
# Damping at first, relative to the curvature of single cameras. A row of n bends with about n^-4 of
# that: after the usual 1e-4, the fine solve of 2,500 cameras ends 5 % short of its minimum, and a made row of
# 100 keeps 0.4 of its bend; after 1e-8, neither. Only where a solve has gone before: from averaged rotations
# castle-P19 would end in another minimum, four cameras lost.
_FIRST_DAMPING, _NEAR_DAMPING = AdjustmentOptions().first_damping, 1e-8
# Of the fine one after it: so many times as many tracks hold each image. With 1, the median errors of six
# real scenes are 1.0 to 1.3 times those with 3, and of a facade of 300 images 1.6 times; 6 is no better.
_FINE_TIMES = 3
# Poses at which the threshold finds less of the observations that `_THIN_LIMIT` finds are coarse.
_FINE = 0.9
# So often lenses are held that turn out to be left open, and all is solved for again.
_MOST_REPETITIONS = 2
# With more frames, the standard deviations would take longer than all the rest.
MOST_FRAMES = 2_000
_FREE = RotationWeight()


class GivenPoses(NamedTuple):
    """What is known of poses and lenses of images beside the pixels, and how an adjustment treats it."""

    weight: RotationWeight = _FREE
    """Of the given rotations."""
    rotations: FloatArray | None = None
    """(f, 3, 3) those that were given; None: those of the images."""
    fixed: BoolArray | None = None
    """(f,) frames whose poses stay what they are to the last bit; none if None."""
    centers: KnownPositions | None = None
    """Measured otherwise, of frames, which they pull at."""
    lenses: FreeLenses = ALL_HELD
    """Those that may change; all others stay what they are, to the bit."""
    free_rigs: bool = False
    """Whether the sensors of rigs may move in them."""

    def of(self, frames: IntArray) -> "GivenPoses":
        """Return what is known of some frames, ascending."""
        return self._replace(
            weight=self.weight.of(frames),
            rotations=None if self.rotations is None else self.rotations[frames],
            fixed=None if self.fixed is None else self.fixed[frames],
            centers=None if self.centers is None else self.centers.among(frames),
        )

    def bounds(self, images: Images) -> Bounds:
        """Return what holds and what moves in a problem of the images."""
        none = np.zeros(len(images.frames.ids), np.bool_)
        return Bounds(
            fixed=none if self.fixed is None else self.fixed,
            centers=self.centers,
            free_sensors=~images.sensors.is_reference if self.free_rigs else None,
        )


class AdjustmentRun:
    """The images and tracks of one adjustment; each solve moves the images on.

    A solve moves `images`, gives the tracks of `source` the rays of lenses that changed with them, and counts
    `iterations`. `loss_scale_px` is that of the last one. `lenses` are those still free, and `refined` says
    how well they are known. Whoever adjusts sets `weight`, and the `given_rotations` that it is of, before.
    """

    def __init__(self, images: Images, links: Links, options: StructureOptions, given: GivenPoses) -> None:
        self.lenses, self.refined = given.lenses, RefinedLenses({}, (), given.lenses)
        self.start = self.images = images
        self.views, self.bounds = views_of(images), given.bounds(images)
        self.weight, self.given_rotations = _FREE, images.frames.rotations
        self.source: Links | None = links
        fewest = options.fewest_views(images.num_images) if isinstance(links, MatchedKeypoints) else 2
        self.options = options
        self.iterations, self.converged, self.loss_scale_px = 0, False, 1.0
        self.checked_length = max(options.min_track_length, fewest)

    def has_free_sensors(self) -> bool:
        """Return whether any sensor may move in its rig."""
        return self.bounds.free_sensors is not None and bool(self.bounds.free_sensors.any())

    def frees_more_than_poses(self) -> bool:
        """Return whether lenses or rigs change."""
        return bool(self.lenses.doubts) or self.has_free_sensors()

    def _judge_sensors(self, adjusted: AdjustmentProblem) -> Mapping[int, SensorSigma]:
        """Return how well free sensors are known at the optimum last solved for, see `free_sensors`."""
        if not self.has_free_sensors():
            return NO_SENSORS
        assert self.bounds.free_sensors is not None
        camera_ids = [self.images.lenses[k].id for k in np.flatnonzero(self.bounds.free_sensors).tolist()]
        return judge_sensors(camera_ids, adjusted, self._options_at_optimum())

    def _problem(self, tracks: ObservedTracks, found: TriangulatedPoints) -> AdjustmentProblem:
        """Return the problem of points that were triangulated from tracks, at the poses of the images."""
        seen = observations(tracks, found.points_seen)
        return self.views.problem(self.images, self.bounds, found.points, seen)

    def _options_at_optimum(self) -> AdjustmentOptions:
        """Return the options by which the optimum last solved for is one."""
        return AdjustmentOptions(
            loss_scale_px=self.loss_scale_px, hold_rotations=self.weight.hold, noise_px=self.weight.noise_px
        )

    def _triangulate(
        self, widening: float, *, checked: bool = False
    ) -> tuple[ObservedTracks, TriangulatedPoints]:
        """Return the tracks and points at the frames' poses, at so many pixel thresholds.

        Checked: only points that the model may have; without, points of two images too.
        """
        limits = PointLimits(
            max_error_px=widening * self.options.max_reprojection_error_px,
            min_angle_deg=self.options.min_triangulation_angle_deg,
            min_length=self.checked_length if checked else self.options.min_track_length,
        )
        poses = self.views.poses(self.images)
        assert self.source is not None
        if isinstance(self.source, ObservedTracks):
            return self.source, triangulate_tracks(self.source, poses, limits)
        return triangulate_matches(self.source, poses, limits, self.options.max_reprojection_error_px)

    def problem_of_all(
        self, *, checked: bool = False
    ) -> tuple[ObservedTracks, TriangulatedPoints, AdjustmentProblem]:
        """Return tracks and points at the pixel threshold, as `triangulate` does, and the problem of all."""
        joined, found = self._triangulate(1.0, checked=checked)
        _refuse_without_points(len(found.points))
        return joined, found, self._problem(joined, found)

    def _of_checked_points(self, problem: AdjustmentProblem) -> AdjustmentProblem:
        """Return a problem without the points that the model may not have; as it is if it has no others.

        Errors are estimated by these: of two images' a single residual is left, which says little of them.
        With all points, standard deviations on castle-P19 and Herz-Jesus-P8 are a quarter less than the
        checked points give, and the errors are not.
        """
        is_checked = np.bincount(problem.points_seen, minlength=problem.num_points) >= self.checked_length
        return problem.of_points(is_checked) if is_checked.any() else problem

    def _thin_problem(
        self, tracks: ObservedTracks, found: TriangulatedPoints, *, times: int = 1
    ) -> AdjustmentProblem:
        """Return the problem of few of the points found, or of some times as many."""
        _refuse_without_points(len(found.points))
        thin = tracks.of_points(found.points_seen)
        images = self.views.images[thin.cameras]
        chosen = choose_thin_tracks(thin.offsets, images, thin.pixels, self.images.num_images, times)
        seen = np.repeat(np.arange(len(chosen)), thin.lengths()[chosen])
        points = TriangulatedPoints(points=found.points[chosen], tracks=chosen, points_seen=seen)
        return self._problem(thin.subset(chosen), points)

    def _adjust_by_few(self, problem: AdjustmentProblem) -> AdjustmentProblem:
        """Move coarse frames to the optimum of a thin problem, and return it."""
        return self._solve(problem, _THIN_SCALE, _THIN_FALL)

    def adjust_twice_thinly(self, *, is_last: bool = False) -> AdjustmentProblem:
        """Move coarse frames: at the wide limit, then finely at the threshold; return the last problem.

        Finely: by more points, with the loss that their errors call for. All tracks are given back before
        either is solved; and all matches before the second, if it `is_last`: if nothing follows but what
        lenses and rigs call for.
        """
        adjusted = self._adjust_by_few(self._thin_problem(*self._triangulate(_THIN_LIMIT, checked=True)))
        joined, found = self._triangulate(1.0)
        if len(found.points) == 0:
            return adjusted
        problem = self._thin_problem(joined, found, times=_FINE_TIMES)
        del joined, found, adjusted
        if is_last and not self.frees_more_than_poses():
            self.source = None  # all matches, at the peak of the memory; nothing is triangulated any more
        return self._solve(problem, self.choose_scale(problem), _THIN_FALL, _NEAR_DAMPING)

    def repeat_with_known_lenses(self, solve: Callable[[], AdjustmentProblem]) -> AdjustmentProblem:
        """Solve, and where focal lengths are left open, hold what was given of them and solve again.

        What is still open after a few times keeps what it has, with its standard deviation.
        """
        adjusted = solve()
        for _ in range(_MOST_REPETITIONS):
            unknown = self._judge_lenses(adjusted)
            if not unknown:
                break
            self._hold_lenses(unknown)
            adjusted = solve()
        else:
            self._judge_lenses(adjusted)
        return adjusted

    def _judge_lenses(self, adjusted: AdjustmentProblem) -> list[int]:
        """Note how well free focal lengths are known; return the cameras whose points leave them open."""
        if not self.lenses.doubts:
            return []
        options = replace(self._options_at_optimum(), **self.lenses.overrides())
        ids = self._camera_ids()
        try:
            found = dict(zip(ids, focal_sigmas(adjusted, options).tolist(), strict=True))
        except UnsolvableError:
            found = dict.fromkeys(ids, math.inf)
        told = self.lenses.with_free_focal()
        self.refined = self.refined._replace(sigmas={i: found[i] for i in ids if i in told})
        lenses, doubts = dict(zip(ids, self.images.lenses, strict=True)), self.lenses.doubts
        return [i for i in ids if i in doubts and not doubts[i].accepts(lenses[i], found[i])]

    def _hold_lenses(self, camera_ids: Sequence[int]) -> None:
        """Give lenses back what was given of them, and hold their focal lengths from now on.

        A lens that is not to be believed even so is held as a whole.
        """
        given = {camera: self.lenses.doubts[camera].given for camera in camera_ids}
        self._move(self.images.with_lenses([given.get(lens.id, lens) for lens in self.images.lenses]))
        self.lenses = self.lenses.holding(camera_ids)
        undetermined = tuple(dict.fromkeys((*self.refined.undetermined, *camera_ids)))
        self.refined = self.refined._replace(undetermined=undetermined, free=self.lenses)

    def _camera_ids(self) -> list[int]:
        """Return the ids of the lenses."""
        return [lens.id for lens in self.images.lenses]

    def _move(self, images: Images) -> None:
        """Let images stand and look as these; the tracks get the rays of lenses that changed."""
        pairs = zip(self.images.lenses, images.lenses, strict=True)
        changed = np.array([before.parameters != after.parameters for before, after in pairs], dtype=np.bool_)
        self.images = images
        if changed.any() and self.source is not None:
            self.source = with_rays_of(self.views, images, self.source, changed)

    def _solve(
        self, problem: AdjustmentProblem, scale: float, fall: float, first_damping: float = _FIRST_DAMPING
    ) -> AdjustmentProblem:
        """Move the frames to the optimum of a problem, and return it."""
        loss_scale_px = self.loss_scale_px = scale * self.options.max_reprojection_error_px
        problem = self.lenses.apply(problem, self._camera_ids())
        adjusted = adjust(
            self.weight.apply(problem, self.given_rotations),
            loss_scale_px=loss_scale_px,
            cost_tolerance=fall,
            first_damping=first_damping,
            hold_rotations=self.weight.hold,
            noise_px=self.weight.noise_px,
            **self.lenses.overrides(),
        )
        self._move(self.views.images_of(self.images, adjusted.problem))
        self.iterations += adjusted.iterations
        self.converged = adjusted.converged
        return adjusted.problem

    def adjust_placed(self, problem: AdjustmentProblem, fall: float) -> AdjustmentProblem:
        """Move the frames to the optimum of a problem, but those that would gain nothing by it."""
        adjusted = self._solve(problem, self.choose_scale(problem), fall)
        if not self.frees_more_than_poses():
            return self._return_frames(problem, adjusted)
        self._judge_lenses(adjusted)
        return adjusted

    def _return_frames(self, before: AdjustmentProblem, after: AdjustmentProblem) -> AdjustmentProblem:
        """Put the frames back that gained nothing by moving, and return the problem with them."""
        returned = frames_not_gained(before, after, self.loss_scale_px)
        rotations = np.where(returned[:, None, None], before.rotations, after.rotations)
        centers = np.where(returned[:, None], before.centers, after.centers)
        self.images = self.images.posed(rotations, centers)
        return replace(after, rotations=rotations, centers=centers)

    def estimate(
        self,
        last: AdjustmentProblem,
        *,
        errors: RotationErrors | None = None,
        initial_error_px: float = math.nan,
        with_sensors: bool = True,
    ) -> Estimate:
        """Return where the images stand, and how well that is known at the optimum last solved for."""
        known = self._center_errors(last)
        return Estimate(
            images=self.images,
            weight=self.weight,
            errors=errors,
            covariances=None if known is None else known.covariances[self.images.frame_of],
            scale_sigma=None if known is None else known.scale_sigma,
            lenses=self.refined,
            sensors=self._judge_sensors(last) if with_sensors else NO_SENSORS,
            initial_error_px=initial_error_px,
            converged=self.converged,
            iterations=self.iterations,
        )

    def _center_errors(self, problem: AdjustmentProblem) -> CenterErrors | None:
        """Return how well centers and scale are known; None if that is not known."""
        if problem.num_frames > MOST_FRAMES:
            return None
        try:
            return estimate_center_errors(
                self._of_checked_points(problem), self._options_at_optimum(), self.weight.open_rad()
            )
        except UnsolvableError:
            return None

    def choose_scale(self, problem: AdjustmentProblem) -> float:
        """Return the scale of the loss that the errors of a problem call for, in pixel thresholds."""
        threshold_px = self.options.max_reprojection_error_px
        return choose_loss_scale_px(problem, [scale * threshold_px for scale in _SCALES]) / threshold_px

    def _adjust_by_all_points_once(self) -> AdjustmentProblem:
        """Move the frames by all points, the first of two times; return the problem."""
        _, _, problem = self.problem_of_all()
        return self._solve(problem, self.choose_scale(problem), FIRST_FALL)

    def adjust_by_all_points(self) -> tuple[ObservedTracks, TriangulatedPoints, AdjustmentProblem]:
        """Move the frames by all points, twice; return what was solved for last, and the problem."""
        self.repeat_with_known_lenses(self._adjust_by_all_points_once)
        joined, found, problem = self.problem_of_all()
        adjusted = self._solve(problem, self.choose_scale(problem), LAST_FALL)
        self._judge_lenses(adjusted)
        return joined, found, adjusted

    def adjust_all(self) -> tuple[Points, float, AdjustmentProblem]:
        """Return the adjusted points, not filtered; the first mean error; and the problem solved last."""
        joined, found = self._triangulate(1.0, checked=True)
        loosely, loose = self._triangulate(_THIN_LIMIT, checked=True)
        _refuse_without_points(len(loose.points))
        initial_error_px = _mean_error_px(self._problem(joined, found))
        if np.sum(found.points_seen >= 0) < _FINE * np.sum(loose.points_seen >= 0):
            self._adjust_by_few(self._thin_problem(loosely, loose))
        joined, found, adjusted = self.adjust_by_all_points()
        found = replace(found, points=adjusted.points).of_length(self.checked_length)
        return self.views.seen_points(joined, found), initial_error_px, adjusted


def _refuse_without_points(num_points: int) -> None:
    """Raise UnsolvableError if there is no point to adjust."""
    if num_points == 0:
        raise UnsolvableError(
            "no 3D point can be triangulated at these camera positions, so there is nothing to adjust; "
            "run with --adjust none"
        )


def _mean_error_px(problem: AdjustmentProblem) -> float:
    """Return the mean over points of the mean error of a point's observations in front of their cameras."""
    if problem.num_points == 0:
        return float("nan")
    errors = reprojection_errors_px(problem)
    ahead = np.isfinite(errors)
    counts = np.bincount(problem.points_seen[ahead], minlength=problem.num_points)
    sums = np.bincount(problem.points_seen[ahead], errors[ahead], problem.num_points)
    return float(np.mean(sums[counts > 0] / counts[counts > 0]))
