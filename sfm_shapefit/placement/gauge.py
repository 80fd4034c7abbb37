"""Scale, origin and axes of the answer: left open by directions, chosen by the user and stated.

The program leaves scale and shift free (sum_i t_i = 0, L(T) = kappa); rotations are given, so the axes are
the input's. A gauge is a scale and a shift of the centers and, with position priors alone, a turn of the
whole model onto their axes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

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
from sfm_shapefit.scene.given import Datum, PositionPriors

_CAP_OF_SIZE = 0.5  # spreads of all input centers; one that is farther off is lost and must not set the scale
_ROUGH = 0.1  # spreads; the scale is rough if the input's centers are off by more, in the median
_DOUBTFUL = 0.01  # spreads; priors that are off by more are tried in other readings
_MEANINGLESS = 0.5  # spreads; random positions are .6 off
_COINCIDENT = 1e-9  # share of the distance from the origin; a smaller spread of centers is rounding
ScaleKind = Literal["fixed", "rig", "control points", "distance", "prior", "input", "unit"]
"""What can set a scale, by precedence."""
FEWEST_PRIORS = 2  # positions; with fewer there is no scale
_PRIORS_FOR_AXES = 3  # positions; two leave the turn about their line open
_FLAT = 5.0  # residuals; a smaller spread across a line leaves the turn about the line open
_KERNEL_WIDTH = 3.0  # standard deviations at which a prior has half of its weight; lost ones hardly count
_REWEIGHTINGS = 20  # steps, a bound; weights settle in fewer


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
    axes: FloatArray | None = None
    """(3, 3) rotation from the input's axes to the output's, about the origin, applied to the whole model
    after `similarity`; None where the axes are the input's."""
    warning: str = ""
    """Why the scale may be rough, if it may."""
    scale_sigma: float | None = None
    """Relative standard deviation of the scale, where that is measured and its error known."""
    datum: Datum | None = None
    """Where the output's origin is on Earth, if priors on Earth set it."""

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
    statement = "input: scale and origin of the input's centers, its axes"
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
    statement = f"fixed: scale and {origin}"
    if has_rigs:
        statement = f"rig: the unit of the sensors' offsets in their rigs; {origin}"
    name: Literal["rig", "fixed"] = "rig" if has_rigs else "fixed"
    return Gauge(similarity=_keep_axes(scale, shift), scale=name, statement=statement)


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
    statement = f"unit: {because}the median distance of the cameras from their centroid, the origin, is 1"
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
    said = f"{names[0]} are {distances[0]:g} apart"
    if len(distances) > 1:
        worst = int(np.argmax(np.abs(residuals)))
        said = (
            f"{int(np.sum(weights >= 0.5))} of {len(distances)} known distances agree, on a scale known to "
            f"{100.0 * sigma:.2g} %; {names[worst]} miss theirs most, by {residuals[worst]:.3g}"
        )
    similarity = _keep_axes(scale, -scale * locations.mean(axis=0))
    statement = f"distance: {said}; origin: the cameras' centroid, axes: the input's"
    return Gauge(
        similarity=similarity,
        scale="distance",
        statement=statement,
        scale_sigma=sigma if len(distances) > 1 else None,
        warning=f"the known distances contradict one another: {said}" if sigma > METRIC_SIGMA else "",
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
    has no part in it. UselessPriorsError if fewer than two cameras have one, or the priors coincide or
    contradict the answer.

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
    source, target = locations[priors.known.indices], priors.known.positions
    size = median_spread(target)
    if size <= _COINCIDENT * max(1.0, float(np.abs(target).max())):
        raise UselessPriorsError("the position priors coincide, so they set no scale; choose another scale")
    turns = len(source) >= _PRIORS_FOR_AXES
    similarity, weights, level = fit_to_priors(source, priors, size, rotate=turns)
    across = np.sqrt(np.linalg.svd(_center(target, weights), compute_uv=False)[1] ** 2 / weights.sum())
    if turns and across <= max(_FLAT * level, _COINCIDENT * size):  # exact priors have no level
        turns = False
        similarity, weights, level = fit_to_priors(source, priors, size, rotate=False)
    if not turns and not axes_known:
        similarity, weights, level = fit_to_priors(source, priors, size, rotate=True)
    if similarity.scale <= 0.0:
        raise UselessPriorsError(
            "the position priors contradict the cameras that were found; check that names and axes are right"
        )
    reading = better_reading(source, priors) if level > _DOUBTFUL * size else ""
    return Gauge(
        similarity=_keep_axes(similarity.scale, similarity.rotation.T @ similarity.translation),
        scale="prior",
        axes=similarity.rotation if turns or not axes_known else None,
        statement=_prior_statement(priors, similarity, weights, level, turns=turns or not axes_known),
        warning=_prior_warning(level / size, reading, turns=turns, axes_known=axes_known),
        datum=priors.datum if turns else None,
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


def fit_to_priors(
    source: FloatArray, priors: PositionPriors, size: float, *, rotate: bool
) -> tuple[Similarity, FloatArray, float]:
    """Return the similarity, the weight of each prior in [0, 1], and the level of their residuals.

    `source` (k, 3) are the locations of the cameras with priors, `size` is the priors' spread; with `rotate`
    the axes are fitted too.
    """
    target = priors.known.positions
    similarity = fit_similarity_l1(source, target, rotate=rotate, cap=_CAP_OF_SIZE * size)
    sigmas = np.nan_to_num(priors.known.sigmas(), nan=0.0)
    weights = np.ones(len(source))
    level = 0.0
    for _ in range(_REWEIGHTINGS):
        residuals = np.linalg.norm(similarity.apply(source) - target, axis=1)
        level = float(np.median(residuals)) / MEDIAN_NORMAL_LENGTH
        spread = np.maximum(np.maximum(sigmas, level), 1e-12 * size)
        weights = 1.0 / (1.0 + (residuals / (_KERNEL_WIDTH * spread)) ** 4)
        similarity = fit_similarity(source, target, weights / spread**2, rotate=rotate)
    return similarity, weights, level


def _center(points: FloatArray, weights: FloatArray) -> FloatArray:
    """Return sqrt(weight) times the points from their weighted mean, (n, 3)."""
    mean = weights @ points / weights.sum()
    return np.asarray(np.sqrt(weights)[:, None] * (points - mean))


def _prior_statement(
    priors: PositionPriors, similarity: Similarity, weights: FloatArray, level: float, *, turns: bool
) -> str:
    agreeing = int(np.sum(weights >= 0.5))
    axes = "axes: the input's"
    if turns:
        axes = f"turned by {float(rotation_angles_deg(similarity.rotation)):.1f} deg onto theirs"
    return (
        f"prior: {priors.statement}; {agreeing} of {len(weights)} agree, to {level:.3g} per axis; "
        f"origin: theirs, {axes}"
    )


def _prior_warning(level: float, reading: str, *, turns: bool, axes_known: bool) -> str:
    """Return why priors, which are off by `level` of their spread, may not be right; empty if they may."""
    off = f"the position priors are {level:.0%} of their spread off the answer"
    if reading:
        return f"{off}, and scale and axes taken from them no better; {reading}"
    if level > _ROUGH:
        rough = "are rough; check them" if level < _MEANINGLESS else "mean nothing: are they of this scene?"
        return f"{off}, so scale and axes taken from them {rough}"
    if not turns and not axes_known:
        return (
            "the position priors lie on a line or are fewer than three, so the model is turned onto that "
            "line, and about it by any angle"
        )
    if not turns:
        return (
            "the position priors lie on a line or are fewer than three, so the axes are kept as the input "
            "has them; they need not be those of the priors"
        )
    return ""
