"""Scale, origin and axes of the answer: left open by directions, chosen by the user and stated.

The program leaves scale and shift free (sum_i t_i = 0, L(T) = kappa); rotations are given, so the axes are
the input's. A gauge is a scale and a shift of the centers and, with position priors alone, a turn of the
whole model onto their axes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import (
    MEDIAN_NORMAL_LENGTH,
    METRIC_SIGMA,
    SIGMA_PER_MEDIAN,
    Similarity,
    fit_similarity,
    fit_similarity_l1,
    median_spread,
    rotation_angles_deg,
)
from sfm_shapefit.placement.prior_readings import better_reading
from sfm_shapefit.scene.given import EarthDatum, PositionPriors

ARBITRARY = ("input", "unit")
"""Kinds of scale that give way to known lengths."""
_CAP_OF_SIZE = 0.5  # spreads of all input centers; one that is farther off is lost and must not set the scale
_ROUGH = 0.1  # spreads; the scale is rough if the input's centers are off by more, in the median
_DOUBTFUL = 0.01  # spreads; priors that are off by more are tried in other readings
_MEANINGLESS = 0.5  # spreads; random positions are .6 off
_COINCIDENT = 1e-9  # share of the distance from the origin; a smaller spread of centers is rounding
ScaleKind = Literal["fixed", "rig", "control points", "scale bars", "distance", "prior", "input", "unit"]
"""What can set a scale, by precedence."""
FEWEST_PRIORS = 2  # positions; with fewer there is no scale
FEWEST_CHECKED = 5
"""Positions; fewer, less the seven unknowns of a similarity, do not tell which of them is wrong."""
_PRIORS_FOR_AXES = 3  # positions; two leave the turn about their line open
_FLAT = 5.0  # residuals; a smaller spread across a line leaves the turn about the line open
_KERNEL_WIDTH = 3.0  # standard deviations at which a prior has half of its weight; lost ones hardly count
_FEWEST_SPLIT = 2 * FEWEST_CHECKED  # positions; three of fewer fit half of them by chance
_FAR_BETTER = 0.1  # share of the level; it was 0.47 or more in 480 draws of wrong priors
_DRAWS = 300  # threes; where 45 % are wrong, 50 of them have right ones only
_REWEIGHTINGS = 20  # steps, a bound; weights settle in fewer


class Free(NamedTuple):
    """What of a similarity a fit may choose, beside the shift."""

    rotate: bool = True
    resize: bool = True

    @property
    def unknowns(self) -> int:
        """How many numbers that are."""
        return 3 + 3 * self.rotate + self.resize


ALL_FREE = Free()


class UselessPriorsError(InputError):
    """Position priors cannot set scale and origin of the cameras that were found."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gauge:
    """The map from the solver's locations to the output's units, and the sentence that states it."""

    similarity: Similarity
    """Scale and shift in the input's axes; its rotation is the identity."""
    scale: ScaleKind
    """What set the scale."""
    statement: str
    """What scale, origin and axes the output has, for the report."""
    scale_statement: str = ""
    """What the scale alone is, where it is known and origin and axes may still be those of something else."""
    axes: FloatArray | None = None
    """(3, 3) rotation from the input's axes to the output's, about the origin, applied to the whole model
    after `similarity`; None where the axes are the input's."""
    warning: str = ""
    """Why the scale may be rough, if it may."""
    scale_sigma: float | None = None
    """Relative standard deviation of the scale, where that is measured and its error known."""
    datum: EarthDatum | None = None
    """Where the output's origin is on Earth, if priors on Earth set it."""
    has_priors: bool = False
    """Whether position priors set the origin and, as far as they tell them, the axes."""

    def apply(self, locations: FloatArray) -> FloatArray:
        """Map the solver's locations (n, 3) to the output's units and axes."""
        moved = self.similarity.apply(locations)
        return moved if self.axes is None else np.asarray(moved @ self.axes.T)


def input_gauge(locations: FloatArray, input_centers: FloatArray) -> Gauge:
    """Return the gauge of the input's centers: a robust similarity (L1) that keeps the axes.

    It maps `locations` (n, 3) onto `input_centers` (n, 3) of the same cameras in the same axes; those of
    NaN are unknown. Without usable input centers it becomes "unit", and says so.
    """
    known = np.isfinite(input_centers).all(axis=1)
    if coincide(input_centers):
        why = "coincide" if known.any() else "are not known"
        return unit_gauge(locations, f"the input's centers {why}, so the scale is free; ")
    every, locations, input_centers = locations, locations[known], input_centers[known]
    size = median_spread(input_centers)
    similarity = fit_similarity_l1(locations, input_centers, rotate=False, cap=_CAP_OF_SIZE * size)
    if similarity.scale <= 0.0:
        return unit_gauge(every, "the input's centers contradict the answer; ")
    off = float(np.median(np.linalg.norm(similarity.apply(locations) - input_centers, axis=1))) / size
    warning = ""
    if off > _ROUGH:
        warning = (
            f"the input's centers are {off:.0%} of their spread off the answer, so the scale taken from them "
            "is rough; give scale=unit if they mean nothing"
        )
    statement = "input: scale, origin and axes are the input's"
    return Gauge(similarity=similarity, scale="input", statement=statement, warning=warning)


def metric_gauge(
    locations: FloatArray, unit: float, input_centers: FloatArray, fixed: BoolArray, *, has_rigs: bool
) -> Gauge:
    """Return the gauge of locations whose scale is known, with the origin of what is fixed, or of the input.

    Args:
        locations: (n, 3) the solver's answer.
        unit: length of the output's unit in theirs.
        input_centers: (n, 3) the input's centers of the same cameras, in the same axes; NaN if not known.
        fixed: (n,) the cameras that stay where the input has them.
        has_rigs: whether the scale is that of rigs; else it is that of the fixed cameras.
    """
    scale = 1.0 / unit
    shifts = input_centers - scale * locations
    if fixed.any():
        shift, origin = shifts[fixed].mean(axis=0), "origin of the fixed cameras"
    elif not coincide(input_centers):
        known = np.isfinite(shifts).all(axis=1)
        shift, origin = np.median(shifts[known], axis=0), "origin of the input's centers"
    else:
        shift, origin = -scale * locations.mean(axis=0), "centroid at the origin"
    similarity = _keep_axes(scale, shift)
    if not has_rigs:
        return Gauge(similarity=similarity, scale="fixed", statement=f"fixed: scale and {origin}")
    of_rigs = "rig: the unit of the sensors' offsets in their rigs"
    statement = f"{of_rigs}; {origin}"
    return Gauge(similarity=similarity, scale="rig", statement=statement, scale_statement=of_rigs)


def moved_gauge(gauge: Gauge, location: FloatArray, center: FloatArray, name: str) -> Gauge:
    """Return the gauge shifted so that one location (3,) comes to lie at `center`, where `name` stays."""
    scale = gauge.similarity.scale
    return replace(
        gauge,
        similarity=replace(gauge.similarity, translation=center - scale * location),
        statement=f"{gauge.statement}; shifted so that {name} stays where it is",
    )


def unit_gauge(locations: FloatArray, because: str = "") -> Gauge:
    """Return the gauge with the centroid (of locations (n, 3)) at 0 and the median distance from it 1."""
    centroid = locations.mean(axis=0)
    scale = 1.0 / float(np.median(np.linalg.norm(locations - centroid, axis=1)))
    where = "the origin is the centroid of the cameras, and their median distance from it is 1"
    statement = f"unit: {because}{where}"
    return Gauge(similarity=_keep_axes(scale, -scale * centroid), scale="unit", statement=statement)


def distance_gauge(
    locations: FloatArray, pairs: IntArray, distances: FloatArray, names: Sequence[str]
) -> Gauge:
    """Return the gauge in which cameras are so far apart; origin: the centroid.

    One distance becomes true. For several, the scale is the robust least-squares fit to all, weights
    1 / (1 + (residual / 3 levels)^4), from the median of the scales that single ones give. InputError if the
    cameras of a pair coincide in the answer.

    Args:
        locations: (n, 3) the solver's answer.
        pairs: (k, 2) cameras, k >= 1.
        distances: (k,) of each pair in the output's units, positive.
        names: (k,) the cameras of each pair, for the statement.
    """
    apart = np.linalg.norm(locations[pairs[:, 0]] - locations[pairs[:, 1]], axis=1)
    near = apart <= _COINCIDENT * median_spread(locations)
    if near.any():
        name = names[int(np.argmax(near))]
        raise InputError(f"the cameras {name} coincide, so their distance sets no scale; choose two others")
    scale, weights, sigma = _scale_of_distances(apart, distances)
    residuals = scale * apart - distances
    sentence, worst = f"{names[0]} are {distances[0]:g} apart", int(np.argmax(np.abs(residuals)))
    if len(distances) > 1:
        sentence = (
            f"{int(np.sum(weights >= 0.5))} of {len(distances)} known distances agree, on a scale known to "
            f"{100.0 * sigma:.2g} %; {names[worst]} miss theirs most, by {residuals[worst]:.3g}"
        )
    similarity = _keep_axes(scale, -scale * locations.mean(axis=0))
    statement = f"distance: {sentence}; origin: the cameras' centroid, axes: the input's"
    return Gauge(
        similarity=similarity,
        scale="distance",
        statement=statement,
        scale_statement=f"distance: {sentence}",
        scale_sigma=sigma if len(distances) > 1 else None,
        warning=(
            "the known distances contradict one another, so that the scale is known to "
            f"{100.0 * sigma:.2g} % only: {names[worst]} miss theirs most, by {residuals[worst]:.3g}"
            if sigma > METRIC_SIGMA
            else ""
        ),
    )


def _scale_of_distances(apart: FloatArray, distances: FloatArray) -> tuple[float, FloatArray, float]:
    """Return the scale, the weight of each distance in [0, 1], and the relative standard deviation."""
    scale, weights = float(np.median(distances / apart)), np.ones(len(apart))
    level = SIGMA_PER_MEDIAN * float(np.median(np.abs(scale * apart - distances)))
    spread = max(level, 1e-12 * float(distances.max()))
    for _ in range(_REWEIGHTINGS):
        weights = 1.0 / (1.0 + ((scale * apart - distances) / (_KERNEL_WIDTH * spread)) ** 4)
        scale = float(weights * apart @ distances / (weights * apart @ apart))
    left = max(float(weights.sum()) - 1.0, 1e-3)
    variance = float(weights @ (scale * apart - distances) ** 2) / left
    return scale, weights, float(np.sqrt(variance / (weights * apart @ apart))) / scale


def prior_gauge(locations: FloatArray, priors: PositionPriors, *, axes_known: bool = True) -> Gauge:
    """Return the gauge of position priors: a robust similarity, with a turn if they determine one.

    From the L1 fit, reweighted least squares with the priors' standard deviations (or one level for all,
    where these are too small or not known) and the weight 1 / (1 + (chi / 3)^4): a minority of wrong priors
    has no part in it. Fewer than five, which cannot tell who is wrong, weigh alike. UselessPriorsError if
    fewer than two cameras have one, or the priors coincide or contradict the answer.

    Args:
        locations: (n, 3) the solver's answer.
        priors: priors of these cameras.
        axes_known: whether the locations' axes mean anything. If not, and the priors lie on a line, the model
            is turned onto that line, and about it by any angle.
    """
    if len(priors) < FEWEST_PRIORS:
        raise UselessPriorsError(
            f"{len(priors)} of the placed cameras have a position prior, and a scale needs two; "
            "give priors of more cameras, or choose another scale"
        )
    target = priors.known.positions
    if median_spread(target) <= _COINCIDENT * max(1.0, float(np.abs(target).max())):
        raise UselessPriorsError("the position priors coincide, so they set no scale; choose another scale")
    fit = _fit_turning(locations[priors.known.indices], priors, Free(), axes_known=axes_known)
    if fit.motion.scale <= 0.0:
        raise UselessPriorsError(
            "the position priors contradict the cameras that were found; check that names and axes are right"
        )
    return Gauge(
        similarity=_keep_axes(fit.motion.scale, fit.motion.rotation.T @ fit.motion.translation),
        scale="prior",
        statement=f"prior: {priors.statement}; {fit.statement}",
        **_by_priors(fit, priors),
    )


def moved_to_priors(
    gauge: Gauge, locations: FloatArray, priors: PositionPriors, *, axes_known: bool = True
) -> Gauge:
    """Return a gauge of known scale, moved and turned onto position priors, of one camera at least.

    Arguments as of `prior_gauge`.
    """
    scaled = gauge.similarity.scale * locations[priors.known.indices]
    fit = _fit_turning(scaled, priors, Free(resize=False), axes_known=axes_known)
    return replace(
        gauge,
        similarity=_keep_axes(gauge.similarity.scale, fit.motion.rotation.T @ fit.motion.translation),
        statement=f"{gauge.scale_statement}; {priors.statement}: {fit.statement}",
        **_by_priors(fit, priors, gauge.warning),
    )


def _by_priors(fit: "_TurnedFit", priors: PositionPriors, warning: str = "") -> dict[str, Any]:
    """Return what a fit to position priors makes of a gauge beside its scale."""
    return {
        "axes": fit.motion.rotation if fit.turns else None,
        "warning": "; ".join(filter(None, [warning, fit.warning])),
        "datum": priors.datum if fit.tells_axes else None,
        "has_priors": True,
    }


class _TurnedFit(NamedTuple):
    """A fit to position priors whose axes are theirs, as far as they tell these."""

    motion: Similarity
    tells_axes: bool
    turns: bool
    """Whether it turns at all, if only onto a line."""
    statement: str
    warning: str


def _fit_turning(source: FloatArray, priors: PositionPriors, free: Free, *, axes_known: bool) -> _TurnedFit:
    """Return the fit of the cameras with priors, at `source` (k, 3), which turns if priors tell the axes."""
    target = priors.known.positions
    size = median_spread(target)
    is_point = size <= _COINCIDENT * max(1.0, float(np.abs(target).max()))
    tells = len(source) >= _PRIORS_FOR_AXES and not is_point
    fit = fit_to_priors(source, priors, free._replace(rotate=tells))
    values = np.linalg.svd(_center(target, fit.weights), compute_uv=False)
    across = 0.0 if len(values) < 2 else float(values[1]) / np.sqrt(fit.weights.sum())
    on_line = tells and across <= max(_FLAT * fit.level, _COINCIDENT * size)  # exact priors have no level
    tells = tells and not on_line
    turns = tells or not (axes_known or is_point)
    if on_line or turns != tells:
        fit = fit_to_priors(source, priors, free._replace(rotate=turns))
    reading = better_reading(source, priors) if fit.level > _DOUBTFUL * size > 0.0 else ""
    return _TurnedFit(
        fit.motion,
        tells,
        turns,
        _prior_statement(fit, turns=turns, axes_known=axes_known),
        _prior_warning(fit.level, size, reading, on_line=on_line, turns=turns, tells_axes=tells),
    )


def tell_scale(gauge: Gauge, sigma: float | None) -> Gauge:
    """Return the gauge with the relative standard deviation of a scale that was measured, and says it."""
    if sigma is None or gauge.scale not in ("rig", "prior"):
        return gauge
    statement = f"{gauge.statement}; the scale is known to {100.0 * sigma:.2g} %"
    warnings = [gauge.warning] if gauge.warning else []
    if sigma > METRIC_SIGMA:
        cause = {"rig": "offsets that tell it are too short", "prior": "priors that tell it are too vague"}
        warnings.append(
            f"the scale is known to {100.0 * sigma:.2g} % only, so it is not metric: the "
            f"{cause[gauge.scale]} for this scene"
        )
    return replace(gauge, statement=statement, warning="; ".join(warnings), scale_sigma=sigma)


def coincide(centers: FloatArray) -> bool:
    """Return whether the known centers, those of (n, 3) that are not NaN, are one point to rounding."""
    centers = centers[np.isfinite(centers).all(axis=1)]
    if not len(centers):
        return True
    return bool(np.ptp(centers, axis=0).max() <= _COINCIDENT * max(1.0, float(np.abs(centers).max())))


def _keep_axes(scale: float, shift: FloatArray) -> Similarity:
    """Return the map x -> scale x + shift."""
    return Similarity(scale=scale, rotation=np.eye(3), translation=shift)


class PriorMotion(NamedTuple):
    """A similarity that maps cameras onto their position priors."""

    motion: Similarity
    weights: FloatArray
    """(k,) weight of each prior in [0, 1]."""
    level: float
    """Standard deviation of their residuals per axis."""


def fit_to_priors(
    source: FloatArray, priors: PositionPriors, free: Free = ALL_FREE, fewest: int = FEWEST_CHECKED
) -> PriorMotion:
    """Return the robust fit of cameras at `source` (k, 3) to their priors; plain for less than `fewest`."""
    target, robust = priors.known.positions, len(source) >= fewest
    size = median_spread(target)
    if robust:
        cap = _CAP_OF_SIZE * size or np.inf
        motion = fit_similarity_l1(source, target, rotate=free.rotate, resize=free.resize, cap=cap)
    else:
        motion = fit_similarity(source, target, rotate=free.rotate, resize=free.resize)
    found = _reweighted(source, priors, free, motion, robust=robust)
    if robust and free.rotate and len(source) >= _FEWEST_SPLIT and found.level > _DOUBTFUL * size:
        start = _least_median(source, target, free)
        other = _reweighted(source, priors, free, start, robust=True)
        found = other if other.level < _FAR_BETTER * found.level else found
    return found


def _least_median(source: FloatArray, target: FloatArray, free: Free) -> Similarity:
    """Return the fit to three priors, of drawn threes, that leaves the least median residual of all priors.

    Nearly half of them may be off by one common shift, with which other fits are a compromise (Rousseeuw,
    "Least median of squares regression", 1984).
    """
    random, best, least = np.random.default_rng(0), None, np.inf
    for _ in range(_DRAWS):
        rows = random.choice(len(source), _PRIORS_FOR_AXES, replace=False)
        motion = fit_similarity(source[rows], target[rows], rotate=free.rotate, resize=free.resize)
        median = float(np.median(np.linalg.norm(motion.apply(source) - target, axis=1)))
        if best is None or median < least:
            best, least = motion, median
    assert best is not None
    return best


def _reweighted(
    source: FloatArray, priors: PositionPriors, free: Free, motion: Similarity, *, robust: bool
) -> PriorMotion:
    """Return the fit by reweighted least squares from a first motion."""
    target = priors.known.positions
    size = median_spread(target)
    sigmas = np.nan_to_num(priors.known.sigmas(), nan=0.0)
    weights = np.ones(len(source))
    level = 0.0
    for _ in range(_REWEIGHTINGS):
        residuals = np.linalg.norm(motion.apply(source) - target, axis=1)
        level = residual_level(residuals, free.unknowns, robust=robust)
        spread = np.maximum(np.maximum(sigmas, level), 1e-12 * size or 1.0)
        if robust:
            weights = 1.0 / (1.0 + (residuals / (_KERNEL_WIDTH * spread)) ** 4)
        motion = fit_similarity(source, target, weights / spread**2, rotate=free.rotate, resize=free.resize)
    return PriorMotion(motion, weights, level)


def residual_level(residuals: FloatArray, num_unknowns: int, *, robust: bool) -> float:
    """Return the standard deviation per axis of residuals (k,) in space that so many unknowns have shrunk.

    It comes from their median if it is to be robust, which a few residuals are too few for.
    """
    left = max(3 * len(residuals) - num_unknowns, 1)
    if robust:
        return float(np.median(residuals)) / MEDIAN_NORMAL_LENGTH * float(np.sqrt(3 * len(residuals) / left))
    return float(np.sqrt(np.sum(residuals**2) / left))


def _center(points: FloatArray, weights: FloatArray) -> FloatArray:
    """Return sqrt(weight) times the points from their weighted mean, (n, 3)."""
    mean = weights @ points / weights.sum()
    return np.asarray(np.sqrt(weights)[:, None] * (points - mean))


def _prior_statement(fit: PriorMotion, *, turns: bool, axes_known: bool) -> str:
    count, agreeing = len(fit.weights), int(np.sum(fit.weights >= 0.5))
    axes = "origin: theirs, axes: the input's"
    if turns:
        turn_deg = float(rotation_angles_deg(fit.motion.rotation))
        axes = "origin and axes: theirs"
        axes += f", the input was turned by {turn_deg:.1f} deg" if axes_known else ""
    agree = (
        f"{agreeing} of {count} agree"
        if count >= FEWEST_CHECKED
        else f"{count}, too few to check one another"
    )
    return f"{agree}, with a standard deviation of {fit.level:.3g} per axis; {axes}"


def _prior_warning(
    level: float, size: float, reading: str, *, on_line: bool, turns: bool, tells_axes: bool
) -> str:
    """Return why priors of a spread `size`, off by `level`, may not be right; empty if they may."""
    off = f"the position priors are {level / size if size else 0.0:.0%} of their spread off the answer"
    if reading:
        return f"{off}, and scale and axes taken from them no better; {reading}"
    if level > _ROUGH * size > 0.0:
        is_rough = level < _MEANINGLESS * size
        rough = "are rough; check them" if is_rough else "mean nothing: are they of this scene?"
        return f"{off}, so scale and axes taken from them {rough}"
    if tells_axes:
        return ""
    few = "the position priors lie on a line" if on_line else "the position priors are fewer than three"
    if turns:
        return f"{few}, so the model is turned onto their line, and about it by any angle"
    return f"{few}, so the axes are kept as the input has them; they need not be those of the priors"
