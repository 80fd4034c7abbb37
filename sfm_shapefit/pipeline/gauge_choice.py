"""Which scale, origin and axes the output gets: as asked, or by what is known."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.pipeline.rigs import Rigid
from sfm_shapefit.placement.gauge import (
    Gauge,
    ScaleKind,
    coincide,
    distance_gauge,
    input_gauge,
    metric_gauge,
    moved_gauge,
    prior_gauge,
    unit_gauge,
)
from sfm_shapefit.placement.options import GaugeOptions, KnownDistance, Scale
from sfm_shapefit.scene.given import PositionPriors
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.same_images import names_among

SETS_SCALE: dict[ScaleKind, str] = {
    "fixed": "the fixed cameras",
    "rig": "the rigs",
    "control points": "the control points",
    "distance": "the known distances",
    "prior": "the position priors",
    "input": "the input",
    "unit": "an arbitrary unit",
}
"""What a scale is that of, in words."""


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


class GaugeRule(NamedTuple):
    """What sets scale, origin and axes of the output, by precedence."""

    images: Images
    """As given."""
    rigid: Rigid
    scale: Scale
    """Where nothing else is known."""
    priors: PositionPriors | None = None
    distances: Sequence[KnownDistance] = ()

    def choose(self, cameras: IntArray, locations: FloatArray, unit: float | None) -> Gauge:
        """Return the gauge of cameras that were found.

        Rigid groups know the scale; else known distances tell it, else priors, else the input. A single fixed
        camera moves the origin and keeps the axes, so that priors, which turn them, have no part.

        Args:
            cameras: (k,) those in the output, ascending.
            locations: (k, 3) where they are, in axes of the input.
            unit: length of the unit of rigid groups in the locations' units; None without such groups.
        """
        images, rigid = self.images, self.rigid
        centers, fixed = images.centers[cameras], rigid.fixed[cameras]
        has_centers = not coincide(images.frames.centers)
        if not has_centers:
            centers = np.where(
                np.isfinite(centers), 0.0, np.nan
            )  # where sensors are in their rig says nothing of positions
        if unit is not None:
            return metric_gauge(locations, unit, centers, fixed, has_rigs=images.has_rigs)
        if self.distances:
            names = [images.names[camera] for camera in cameras.tolist()]
            gauge = gauge_of_distances(names, locations, self.distances)
        elif self.priors is not None and not rigid.fixed.any():
            gauge = prior_gauge(locations, self.priors.of(cameras), axes_known=has_centers)
        else:
            gauge = unit_gauge(locations) if self.scale == "unit" else input_gauge(locations, centers)
        if not rigid.fixed.any():
            return gauge
        name = images.names[int(np.argmax(rigid.fixed))]
        if not fixed.any():
            raise UnsolvableError(
                f"{name} is to stay where it is, but the matches do not tie it to the others"
            )
        return moved_gauge(gauge, locations[fixed][0], centers[fixed][0], name)

    def check(self, chosen: Gauge, cameras: IntArray, centers: FloatArray) -> Iterator[str]:
        """Yield how far the scale is off what is known and did not set it, a sentence each.

        Args:
            chosen: the gauge of the output.
            cameras: (k,) those in the output, ascending.
            centers: (k, 3) where they are in the output.
        """
        names = [self.images.names[camera] for camera in cameras.tolist()]
        if self.distances and chosen.scale != "distance":
            known = partial(gauge_of_distances, names, centers, self.distances)
            yield say_unused("known distances were", chosen, lambda: known().similarity.scale)
        if self.priors is not None and chosen.scale != "prior":
            priors = self.priors.of(cameras)
            yield say_unused(
                "position priors were", chosen, lambda: prior_gauge(centers, priors).similarity.scale
            )


def say_unused(what: str, chosen: Gauge, find: Callable[[], float]) -> str:
    """Say that something known did not set the scale, and by how much it differs from what did."""
    unused = f"{what} not used for the scale, which is that of {SETS_SCALE[chosen.scale]}"
    try:
        return f"{unused}; they differ by {100.0 * abs(find() - 1.0):.3g} %"
    except (InputError, UnsolvableError) as error:
        return f"{unused}, and do not check it: {error}"


def gauge_of_distances(names: Sequence[str], locations: FloatArray, known: Sequence[KnownDistance]) -> Gauge:
    """Return the gauge of known distances of cameras, by name; those that are not there say nothing."""
    place_of = {name: place for place, name in enumerate(names)}
    there = [one for one in known if {*one[:2]} <= place_of.keys()]
    if not there:
        missing = next(name for name in known[0][:2] if name not in place_of)
        raise UnsolvableError(f"known distances: the image {missing} could not be placed; choose another")
    places = np.array([[place_of[first], place_of[second]] for first, second, _ in there])
    said = [f"{first} and {second}" for first, second, _ in there]
    return distance_gauge(locations, places, np.array([float(distance) for *_, distance in there]), said)
