"""Ground control points: points of known position that images show, which set scale, origin and axes.

Their positions in the model are triangulated; a similarity maps these onto the known ones. It starts from
the robust fit that position priors have. Then the noise of all that fit decides who fits: with n points of
three coordinates and 7 parameters,

    sigma^2 = sum |residual|^2 / (3 n - 7),

a point outside the fit is off by sigma sqrt(1 + h) per axis, with its leverage h = tr(J N^-1 J^T) / 3, and
fits up to 4 times that; a factor sqrt(1 + 7 / (3 n - 7)) allows for a sigma from few points. Measured:
`scripts/results/notes.md#control-points`. Three points check nothing.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.geometry import METRIC_SIGMA, Similarity, compose, fit_similarity, principal_lengths
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.placement.gauge import Free, Gauge, fit_to_priors
from sfm_shapefit.scene.given import (
    FEWEST_CONTROL_POINTS,
    ControlPoints,
    MarkedViews,
    Marks,
    PositionPriors,
    why_too_few,
)
from sfm_shapefit.scene.known_positions import KnownPositions
from sfm_shapefit.tracks.links import CameraPoses, ObservedTracks
from sfm_shapefit.tracks.structure_options import StructureOptions
from sfm_shapefit.tracks.triangulation import PointLimits, triangulate_tracks

_MARK_ERRORS = 4.0  # keypoint errors; marks are set by hand, in a model that may be bent
_FITTING_SIGMAS = 4.0  # standard deviations; chosen on scripts/results/notes.md#control-points
_MOST_ROUNDS = 20  # rounds, a bound; who fits settles in fewer
_FLAT = 5.0  # standard deviations; a smaller spread across a line leaves the turn about the line open


class TriangulatedMarks(NamedTuple):
    """Where a model has points that are marked in its images, and how well their marks agree."""

    positions: FloatArray
    """(k, 3), NaN for those that cannot be triangulated."""
    errors_px: FloatArray
    """(m,) distances of the marks from their points; NaN where there is no point or the image is not in the
    model."""
    agreeing: BoolArray
    """(m,) the marks that the point was triangulated from."""


class ControlFit(NamedTuple):
    """Control points after the similarity that maps the model onto them."""

    motion: Similarity
    """From the model to the control points."""
    fitting: BoolArray
    """(k,) points that set it."""
    sigma: float
    """Standard deviation of their coordinates; 0 if they are too few to have one."""
    residuals: FloatArray
    """(k, 3) the model's position minus the known one, in units of the known one; NaN where it has none."""
    scale_sigma: float
    """Relative standard deviation of the scale."""


def triangulate_marks(control: Marks, seen: MarkedViews, options: StructureOptions) -> TriangulatedMarks:
    """Return where the placed images have points; marks may be wrong, or off by 4 keypoint errors."""
    counts = np.bincount(control.points[seen.rows], minlength=len(control.names))
    tracks = ObservedTracks(
        offsets=offsets_of(counts),
        cameras=np.arange(len(seen.rows)),
        keypoints=seen.rows,
        pixels=control.pixels[seen.rows],
        on_plane=seen.on_plane,
        ids=np.arange(len(control.names)),
        may_split=False,
    )
    limits = PointLimits(
        max_error_px=_MARK_ERRORS * options.max_reprojection_error_px,
        min_angle_deg=options.min_triangulation_angle_deg,
        min_length=2,
    )
    stand = CameraPoses(
        rotations=seen.rotations,
        centers=seen.centers,
        focal_lengths_px=seen.focal_lengths_px,
        images=seen.images,
    )
    triangulated = triangulate_tracks(tracks, stand, limits)
    positions = np.full((len(control.names), 3), np.nan)
    positions[triangulated.tracks] = triangulated.points
    agreeing, errors = np.zeros(len(control.points), dtype=np.bool_), np.full(len(control.points), np.nan)
    agreeing[seen.rows] = triangulated.points_seen >= 0
    to_point = positions[control.points[seen.rows]] - seen.centers
    inside = np.einsum("kab,kb->ka", seen.rotations, to_point)
    with np.errstate(invalid="ignore", divide="ignore"):
        off = np.linalg.norm(inside[:, :2] / inside[:, 2:] - seen.on_plane, axis=1)
        errors[seen.rows] = seen.focal_lengths_px * off
    return TriangulatedMarks(positions, errors, agreeing)


def fit_control_points(
    control: ControlPoints, positions: FloatArray, *, resize: bool = True
) -> ControlFit | str:
    """Return the similarity that maps found positions (k, 3) onto the known ones, or why there is none.

    It keeps the scale if it may not `resize`.
    """
    known: BoolArray = np.asarray(np.isfinite(positions).all(axis=1))
    rows = np.flatnonzero(known & ~control.is_check)
    source, target = positions[rows], control.positions[rows]
    reason = why_too_few(target, "can be triangulated")
    if reason:
        return reason
    free = Free(resize=resize)
    fits: BoolArray = _start(source, target, free)
    for _ in range(_MOST_ROUNDS):
        motion = fit_similarity(source, target, fits.astype(np.float64), resize=resize)
        apart: FloatArray = np.asarray(np.linalg.norm(motion.apply(source) - target, axis=1))
        freedom = 3.0 * float(fits.sum()) - free.unknowns
        sigma = float(np.sqrt(np.sum(apart[fits] ** 2) / freedom))
        nearest = np.argsort(apart, kind="stable")[:FEWEST_CONTROL_POINTS]
        spread = np.sqrt(1.0 + np.where(fits, 0.0, _leverages(target, fits, free)))
        limit = _FITTING_SIGMAS * np.sqrt(1.0 + free.unknowns / freedom) * sigma
        again = np.array(apart <= limit * spread, dtype=np.bool_)
        again[nearest] = True
        if (again == fits).all():
            break
        fits = again
    if motion.scale <= 0.0:
        return "the control points contradict the model; check the order of their coordinates"
    if principal_lengths(target[fits])[1] <= _FLAT * sigma * np.sqrt(fits.sum()):
        return (
            f"the control points contradict one another: those that agree, {int(fits.sum())} of {len(rows)}, "
            "lie on a line but for their errors; check coordinates and marks"
        )
    fitting = np.zeros(len(known), dtype=np.bool_)
    fitting[rows[fits]] = True
    residuals = np.where(known[:, None], motion.apply(positions) - control.positions, np.nan)
    size = float(np.linalg.norm(target[fits] - target[fits].mean(axis=0)))
    return ControlFit(motion, fitting, sigma, residuals, sigma / size)


def control_gauge(before: Gauge, control: ControlPoints, fit: ControlFit, *, resize: bool) -> Gauge:
    """Return the gauge of control points, for a model that stands in another one, whose scale may `resize`.

    y = A (s x + b) becomes c R y + t = R A (c s x + c b + (R A)^T t).
    """
    motion = fit.motion
    axes = motion.rotation if before.axes is None else motion.rotation @ before.axes
    shift = axes.T @ motion.translation
    total = Similarity(scale=motion.scale, rotation=np.eye(3), translation=shift)
    used = int(np.sum(~control.is_check & np.isfinite(fit.residuals[:, 0])))
    sentence = f"the scale is known to {100.0 * fit.scale_sigma:.2g} %"
    agree = f"{control.statement}; {int(fit.fitting.sum())} of {used} agree, "
    agree += f"with a standard deviation of {fit.sigma:.3g} per axis"
    gauge = replace(
        before,
        similarity=compose(total, before.similarity),
        axes=axes,
        statement=f"{before.scale_statement}; control points: {agree}; origin and axes: theirs",
        datum=control.datum,
        has_priors=False,
    )
    if not resize:
        return gauge
    warning = ""
    if fit.scale_sigma > METRIC_SIGMA:
        warning = (
            f"{sentence} only, so it is not metric: the control points contradict one another, or the model"
        )
    return replace(
        gauge,
        scale="control points",
        statement=f"control points: {agree}; origin and axes: theirs; {sentence}",
        warning=warning,
        scale_sigma=fit.scale_sigma,
    )


def _start(source: FloatArray, target: FloatArray, free: Free) -> BoolArray:
    """Return which points fit at first: all of three, else those of the robust fit if they are enough."""
    everyone = np.ones(len(source), dtype=np.bool_)
    if len(source) <= FEWEST_CONTROL_POINTS:
        return everyone
    unknown = np.full((len(target), 3, 3), np.nan)
    priors = PositionPriors(
        known=KnownPositions.measured(np.arange(len(target)), target, unknown), statement=""
    )
    fits = fit_to_priors(source, priors, free, FEWEST_CONTROL_POINTS + 1).weights >= 0.5
    return fits if not why_too_few(target[fits], "") else everyone


def _leverages(points: FloatArray, fits: BoolArray, free: Free) -> FloatArray:
    """Return the variance per axis that a fit to some points (k, 3) predicts for all, in their variances.

    J of a shift, a turn and a scale about their mean is [I, -[x]_x, x].
    """
    x = points - points[fits].mean(axis=0)
    x /= np.linalg.norm(x[fits])
    jacobians = np.zeros((len(points), 3, free.unknowns))
    jacobians[:, :, :3] = np.eye(3)
    jacobians[:, :, 3:6] = np.cross(np.eye(3), x[:, None, :])
    if free.resize:
        jacobians[:, :, 6] = x
    normal = np.einsum("kab,kac->bc", jacobians[fits], jacobians[fits])
    return np.asarray(np.einsum("kab,kab->k", jacobians @ np.linalg.pinv(normal), jacobians)) / 3.0
