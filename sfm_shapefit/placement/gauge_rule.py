"""What sets scale, origin and axes of the output, by precedence, and what checks them."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.geometry import Similarity, compose
from sfm_shapefit.base.wording import counted_are
from sfm_shapefit.placement.fixed_and_rigged import FixedAndRigged
from sfm_shapefit.placement.gauge import (
    FEWEST_CHECKED,
    Gauge,
    ScaleKind,
    coincide,
    distance_gauge,
    input_gauge,
    metric_gauge,
    moved_gauge,
    moved_to_priors,
    prior_gauge,
    unit_gauge,
)
from sfm_shapefit.placement.gauge_options import GaugeOptions, KnownDistance, Scale
from sfm_shapefit.scene.given import PositionPriors
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.same_images import names_among

SETS_SCALE: dict[ScaleKind, str] = {
    "fixed": "the fixed cameras",
    "rig": "the rigs",
    "control points": "the control points",
    "scale bars": "the scale bars",
    "distance": "the known distances",
    "prior": "the position priors",
    "input": "the input",
    "unit": "an arbitrary unit",
}
"""What a scale is that of, in words."""


class GaugeRule(NamedTuple):
    """What sets scale, origin and axes of the output, by precedence."""

    images: Images
    """As given."""
    rigid: FixedAndRigged
    scale: Scale
    """Where nothing else is known."""
    priors: PositionPriors | None = None
    distances: Sequence[KnownDistance] = ()

    def choose(self, cameras: IntArray, locations: FloatArray, unit: float | None) -> Gauge:
        """Return the gauge of cameras that were found, part by part.

        scale           rigid groups, else known distances, position priors, the input
        origin          fixed cameras, else position priors, the input
        axes            the input's; position priors turn them unless a camera is fixed

        Args:
            cameras: (k,) those in the output, ascending.
            locations: (k, 3) where they are, in axes of the input.
            unit: length of the unit of rigid groups in the locations' units; None without such groups.
        """
        images, rigid = self.images, self.rigid
        centers, fixed = images.centers[cameras], rigid.fixed[cameras]
        has_centers = not coincide(images.frames.centers)
        if not has_centers:
            # Where sensors are in their rig says nothing of positions.
            centers = np.where(np.isfinite(centers), 0.0, np.nan)
        priors = None if self.priors is None or rigid.fixed.any() else self.priors.of(cameras)
        if unit is not None:
            gauge = metric_gauge(locations, unit, centers, fixed, has_rigs=images.has_rigs)
        elif self.distances:
            names = [images.names[camera] for camera in cameras.tolist()]
            gauge = gauge_of_distances(names, locations, self.distances)
        elif priors is not None:
            return prior_gauge(locations, priors, axes_known=has_centers)
        else:
            gauge = unit_gauge(locations) if self.scale == "unit" else input_gauge(locations, centers)
        if priors is not None and len(priors):
            return moved_to_priors(gauge, locations, priors, axes_known=has_centers)
        if not rigid.fixed.any() or unit is not None:
            return gauge
        name = images.names[int(np.argmax(rigid.fixed))]
        if not fixed.any():
            raise UnsolvableError(
                f"{name} is to stay where it is, but the matches do not tie it to the others"
            )
        return moved_gauge(gauge, locations[fixed][0], centers[fixed][0], name)

    def check(self, chosen: Gauge, cameras: IntArray, centers: FloatArray) -> Iterator[str]:
        """Yield what is known and has no part in the gauge, and how well it checks that, a sentence each.

        Args:
            chosen: the gauge of the output.
            cameras: (k,) those in the output, ascending.
            centers: (k, 3) where they are in the output.
        """
        names = [self.images.names[camera] for camera in cameras.tolist()]
        if self.distances and chosen.scale != "distance":
            known = partial(gauge_of_distances, names, centers, self.distances)
            yield say_unused("known distances were", chosen, lambda: known().similarity.scale)
        if self.priors is None:
            return
        priors = self.priors.of(cameras)
        if chosen.scale != "prior":
            yield say_unused(
                "position priors were", chosen, lambda: prior_gauge(centers, priors).similarity.scale
            )
        if chosen.has_priors and len(priors) < FEWEST_CHECKED:
            yield (
                f"{counted_are(len(priors), 'position prior')} too few to check one another: a wrong one "
                f"would move the model and not show; give {FEWEST_CHECKED} or more"
            )
        elif self.rigid.fixed.any():
            yield "position priors have no part in origin and axes, which are those of the fixed cameras"


def gauge_of_distances(names: Sequence[str], locations: FloatArray, known: Sequence[KnownDistance]) -> Gauge:
    """Return the gauge of known distances of cameras, by name; those that are not there say nothing."""
    place_of = {name: place for place, name in enumerate(names)}
    distances = [one for one in known if {*one[:2]} <= place_of.keys()]
    if not distances:
        missing = next(name for name in known[0][:2] if name not in place_of)
        raise UnsolvableError(f"known distances: the image {missing} could not be placed; choose another")
    places = np.array([[place_of[first], place_of[second]] for first, second, _ in distances])
    clauses = [f"{first} and {second}" for first, second, _ in distances]
    return distance_gauge(
        locations, places, np.array([float(distance) for *_, distance in distances]), clauses
    )


def resized_gauge(
    before: Gauge, centers: FloatArray, scale: float, sigma: float, statement: str
) -> tuple[Similarity, Gauge]:
    """Return the motion that gives a model of centers (n, 3) another scale, and the gauge then.

    Their mean stays. The scale is that of scale bars, and known to `sigma` of itself. InputError if the
    centers are one point then, to rounding.
    """
    translation = (1.0 - scale) * centers.mean(axis=0)
    motion = Similarity(scale=scale, rotation=np.eye(3), translation=translation)
    if coincide(motion.apply(centers)):
        raise InputError(
            f"the scale bars make the model {scale:.2g} times as large, so small that its cameras coincide; "
            "give lengths and standard deviations in a smaller unit"
        )
    axes = np.eye(3) if before.axes is None else before.axes
    rest = f"origin and axes: those of {SETS_SCALE[before.scale]}"
    if before.scale in ("unit", "distance"):
        rest = "origin: the cameras' centroid, axes: the input's"
    return motion, replace(
        before,
        similarity=compose(replace(motion, translation=axes.T @ motion.translation), before.similarity),
        scale="scale bars",
        statement=f"{statement}; {rest}",
        scale_statement=statement,
        scale_sigma=sigma,
    )


def say_unused(what: str, chosen: Gauge, find: Callable[[], float]) -> str:
    """Say that something known did not set the scale, and by how much it differs from what did."""
    unused = f"{what} not used for the scale, which is that of {SETS_SCALE[chosen.scale]}"
    try:
        return f"{unused}; they differ by {100.0 * abs(find() - 1.0):.3g} %"
    except (InputError, UnsolvableError) as error:
        return f"{unused}, and do not check it: {error}"


def between_images(gauge: GaugeOptions, names: Sequence[str], missing: str) -> GaugeOptions:
    """Return options whose known distances are between images of some names.

    Raises:
        InputError: if one is of an image that there is not; `missing` says so, but for its name.
    """
    named, ambiguity = names_among((name for one in gauge.known_distance for name in one[:2]), names)
    for name in (name for one in gauge.known_distance for name in one[:2]):
        if name not in named:
            raise InputError(f"known distances: {missing} {name}{ambiguity and f'; {ambiguity}'}")
    known = tuple((named[first], named[second], length) for first, second, length in gauge.known_distance)
    return replace(gauge, known_distance=known)
