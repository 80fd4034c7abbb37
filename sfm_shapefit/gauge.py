"""Scale and origin of the answer: what directions cannot tell, chosen by the user and stated.

Rotations are given, so the axes are the input's; a gauge is one scale and one shift. The program
leaves both free (sum_i t_i = 0, L(T) = kappa).
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sfm_shapefit.arrays import BoolArray, FloatArray
from sfm_shapefit.geometry import Similarity, fit_similarity_l1, median_spread

Scale = Literal["input", "unit", "rig"]


_CAP_OF_SIZE = 0.5  # an input centre that is farther off is lost, and must not set the scale
_ROUGH = 0.1  # median distance of the input's centres from the answer, of their spread
_COINCIDENT = 1e-9  # spread of centres, relative to their distance from the origin, that counts as none


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gauge:
    """The map from the solver's locations to the output's units, and the sentence that states it."""

    similarity: Similarity
    """Its rotation is the identity."""
    scale: Scale | Literal["fixed"]
    """The choice that was carried out."""
    statement: str
    """What scale and origin the output has, for the report."""
    warning: str = ""
    """Why the scale may be rough, if it may."""


def choose_gauge(locations: FloatArray, input_centers: FloatArray, scale: Scale) -> Gauge:
    """Return the gauge asked for; without usable input centres "input" becomes "unit", and says so.

    Args:
        locations: (n, 3) the solver's answer.
        input_centers: (n, 3) the input's centres of the same cameras, in the same axes.
        scale: "input" maps robustly (L1, no rotation) onto the input's centres; "unit" puts the centroid
            at the origin and the median distance from it to 1. "rig" is not for these locations, see
            `metric_gauge`.
    """
    if scale == "unit":
        return _unit(locations, "unit: median distance of the cameras from their centroid is 1")
    spread = np.ptp(input_centers, axis=0).max()
    if spread <= _COINCIDENT * max(1.0, float(np.abs(input_centers).max())):
        return _unit(
            locations, "unit: the input's centres coincide, so the scale is free; median distance is 1"
        )
    size = median_spread(input_centers) or spread
    similarity = fit_similarity_l1(locations, input_centers, rotate=False, cap=_CAP_OF_SIZE * size)
    if similarity.scale <= 0.0:
        return _unit(locations, "unit: the input's centres contradict the answer; median distance is 1")
    off = float(np.median(np.linalg.norm(similarity.apply(locations) - input_centers, axis=1))) / size
    warning = ""
    if off > _ROUGH:
        warning = (
            f"the input's centres are {off:.0%} of their spread off the answer, so the scale taken from them "
            "is rough; use the scale unit if they mean nothing"
        )
    statement = "input: scale and origin of the input's centres"
    return Gauge(similarity=similarity, scale="input", statement=statement, warning=warning)


def metric_gauge(
    locations: FloatArray, unit: float, input_centers: FloatArray, fixed: BoolArray, *, has_rigs: bool
) -> Gauge:
    """Return the gauge of locations whose scale is known, with the origin of what is fixed, or of the input.

    Args:
        locations: (n, 3) the solver's answer.
        unit: length of the output's unit in theirs.
        input_centers: (n, 3) the input's centres of the same cameras, in the same axes.
        fixed: (n,) the cameras that stay where the input has them.
        has_rigs: whether the scale is that of rigs; else it is that of the fixed cameras.
    """
    scale = 1.0 / unit
    shifts = input_centers - scale * locations
    if fixed.any():
        shift, origin = shifts[fixed].mean(axis=0), "origin of the fixed cameras"
    elif np.ptp(input_centers, axis=0).max() > _COINCIDENT * max(1.0, float(np.abs(input_centers).max())):
        shift, origin = np.median(shifts, axis=0), "origin of the input's centres"
    else:
        shift, origin = -scale * locations.mean(axis=0), "centroid at the origin"
    similarity = Similarity(scale=scale, rotation=np.eye(3), translation=shift)
    if has_rigs:
        return Gauge(
            similarity=similarity,
            scale="rig",
            statement=f"rig: the unit of the sensors' offsets in their rigs; {origin}",
        )
    return Gauge(similarity=similarity, scale="fixed", statement=f"fixed: scale and {origin}")


def moved_gauge(gauge: Gauge, location: FloatArray, center: FloatArray, name: str) -> Gauge:
    """Return the gauge shifted so that one location (3,) comes to lie at `center`, where `name` stays."""
    scale = gauge.similarity.scale
    return replace(
        gauge,
        similarity=replace(gauge.similarity, translation=center - scale * location),
        statement=f"{gauge.statement}; shifted so that {name} stays where it is",
    )


def _unit(locations: FloatArray, statement: str) -> Gauge:
    centroid = locations.mean(axis=0)
    scale = 1.0 / float(np.median(np.linalg.norm(locations - centroid, axis=1)))
    similarity = Similarity(scale=scale, rotation=np.eye(3), translation=-scale * centroid)
    return Gauge(similarity=similarity, scale="unit", statement=statement)
