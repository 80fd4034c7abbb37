"""How well a length in a model is known, in the user's unit: for the whole model, and between two places."""

import math
from typing import Annotated, NamedTuple

import numpy as np

from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.place_errors import (
    Distances,
    PlaceErrors,
    ScaleErrors,
    draws_at,
    errors_of_points,
)
from sfm_shapefit.base.arrays import FloatArray, IntArray, distinct
from sfm_shapefit.base.display import Row, row
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import in_unit, rounded
from sfm_shapefit.facts.control_points import ControlComparison, describe_control_points
from sfm_shapefit.facts.scale_bars import ScaleBar
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points

WITHIN_95 = 1.96
"""Standard deviations; between them on either side lie 95 % of a normal distribution."""
_MOST_PLACES = 100  # points; all distances between as many are looked at
_NEAREST = 200  # distances, those nearest to the one that is told; their median is no matter of chance
_ALIGNED = 0.87  # cosine; a direction within 30 degrees of an axis is named by it
_STEPS = (1.0, 2.0, 5.0)  # factors of powers of ten; other numbers are not round


class Axes(NamedTuple):
    """What the units and axes of a model are."""

    unit: str
    """To follow a number."""
    has_scale: bool
    """Whether something known set the scale."""
    has_up: bool
    """Whether z points up."""


class LengthFacts(Record):
    """How well a length is known, errors of the scale included as far as these are known."""

    length: Annotated[float, "A length in the model's units, a round one if it stands for all."]
    half_width: Annotated[float, "Half the interval that holds the length with a probability of 95 %."]
    worst_direction: Annotated[list[float], "Unit vector along which places are known worst, output's axes."]
    worst_half_width: Annotated[float, "Half the interval of a length along that direction."]
    unit: Annotated[str, "Unit of the lengths, to follow a number."]
    has_up: Annotated[bool, "Whether z points up."]
    has_scale: Annotated[
        bool, "Whether something known set the scale, and not the input or an arbitrary unit."
    ]

    @property
    def statement(self) -> str:
        """All of it in words, of a length that stands for all."""
        along = name_direction(np.array(self.worst_direction), has_up=self.has_up)
        worst = f"worst direction {along} (± {self.said(self.worst_half_width)})"
        within = f"± {self.said(self.half_width)} (95 %)"
        return f"a length of {self.length:g} {self.unit} is known to {within}, {worst}"

    @property
    def relative(self) -> str:
        """All of it in words, as shares of a length, for a model whose scale nothing known set."""
        along = name_direction(np.array(self.worst_direction), has_up=self.has_up)
        usual, worst = (100.0 * half / self.length for half in (self.half_width, self.worst_half_width))
        return f"a length is known to ± {usual:.2g} % (95 %), worst direction {along} (± {worst:.2g} %)"

    @property
    def interval(self) -> str:
        """The length with its interval, and the worst direction, in words."""
        along = name_direction(np.array(self.worst_direction), has_up=self.has_up)
        within, digits = within_95(self.length, self.half_width, f" {self.unit}"), digits_of(self.half_width)
        return f"{within}, worst direction {along} (± {self.worst_half_width:.{digits}f})"

    def __str__(self) -> str:
        return self.interval + ("" if self.has_scale else "; the scale is open")

    def said(self, half_width: float) -> str:
        """Return half an interval in two digits, of meters in the unit that suits it."""
        is_metric = self.unit == "m"
        return in_unit(half_width, "m", digits=2) if is_metric else rounded(half_width, digits=2)


class LengthBetween(Record):
    """How well the distance between two places is known."""

    first: Annotated[str, "Name of an image, or id of a 3D point."]
    second: Annotated[str, "Name or id of the other place."]
    length: Annotated[LengthFacts, "The distance."]


class LengthsFacts(Record):
    """What `sfm-shapefit evaluate --json` prints of a model alone."""

    usual: Annotated[
        LengthFacts | None, "How well a length between its points is known; null where that is not known."
    ]
    lengths: Annotated[list[LengthBetween], "The distances that were asked for."]
    scale_bars: Annotated[tuple[ScaleBar, ...], "Known lengths between points, and those in the model."]
    control_points: Annotated[ControlComparison | None, "Points of known position; null if none are given."]
    scale_sigma: Annotated[
        float | None,
        "Relative standard deviation of the scale, which the lengths include; null if not known.",
    ]
    warnings: Annotated[list[str], "What the user should know, a sentence each."]

    def told(self) -> list[Row]:
        """Return what the terminal says."""
        control = (
            [describe_control_points(to.points, ""), to.statement] if (to := self.control_points) else []
        )
        scale = f"known to {100.0 * (self.scale_sigma or 0.0):.2g} %, included"
        unknown = f"its error is not known{', and not included' if self.usual else ''}"
        none = "their errors are not known; a model of at most 2,000 frames with 3D points tells them"
        return [
            row("lengths", self.usual.statement if self.usual else none),
            Row("between", [f"{one.first} and {one.second}: {one.length.interval}" for one in self.lengths]),
            row("scale", unknown if self.scale_sigma is None else scale),
            Row("scale bars", [one.line for one in self.scale_bars]),
            Row("control points", list(filter(None, control))),
            Row("warning", self.warnings),
        ]


def digits_of(half_width: float) -> int:
    """Return how many digits behind the point show two of half an interval."""
    return max(1 - math.floor(math.log10(half_width)), 0) if half_width > 0.0 else 6


def within_95(length: float, half_width: float, unit: str = "") -> str:
    """Return a length with the interval of 95 % in words; a unit begins with a blank."""
    digits = digits_of(half_width)
    return f"{length:.{digits}f} ± {half_width:.{digits}f}{unit} (95 %)"


def name_direction(direction: FloatArray, *, has_up: bool) -> str:
    """Return the axis along which a unit vector (3,) points nearly, or its coordinates."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) < _ALIGNED:
        return "({})".format(", ".join(f"{value:.2f}" for value in direction))
    return "up" if has_up and axis == 2 else "xyz"[axis]


def worst_of(covariances: FloatArray) -> tuple[FloatArray, float]:
    """Return the direction in which vectors are known worst, and the standard deviation along it.

    Covariances (m, 3, 3) count alike whatever their size, which is that of their median.
    """
    sizes = np.trace(covariances, axis1=1, axis2=2)
    shape = np.mean(covariances / np.maximum(sizes, 1e-300)[:, None, None], axis=0)
    values, axes = np.linalg.eigh(shape)
    axis = axes[:, -1] * np.sign(axes[np.argmax(np.abs(axes[:, -1])), -1])
    return axis, math.sqrt(float(np.median(sizes) * values[-1]))


def tell_length(found: Distances, length: float, axes: Axes) -> LengthFacts | None:
    """Return what is told of a length that some distances stand for; None if nothing is known of them."""
    known = np.isfinite(found.covariances).all(axis=(1, 2)) & (found.sigmas > 0.0)
    if not known.any():
        return None
    axis, sigma = worst_of(found.covariances[known])
    return LengthFacts(
        length=length,
        half_width=WITHIN_95 * float(np.median(found.sigmas[known])),
        worst_direction=axis.tolist(),
        worst_half_width=WITHIN_95 * sigma,
        unit=axes.unit,
        has_up=axes.has_up,
        has_scale=axes.has_scale,
    )


def tell_usual_length(places: PlaceErrors, scale: ScaleErrors, axes: Axes) -> LengthFacts | None:
    """Return how well a round length is known that is usual between places; None if it is not known."""
    rows = np.flatnonzero(np.isfinite(places.draws).all(axis=(1, 2)) & np.isfinite(places.own[:, 0, 0]))
    ends = rows[np.column_stack(np.triu_indices(len(rows), 1))]
    lengths = np.linalg.norm(places.places[ends[:, 1]] - places.places[ends[:, 0]], axis=1)
    if not (len(lengths) and places.draws.shape[2] and np.median(lengths) > 0.0):
        return None
    power = 10.0 ** math.floor(math.log10(np.median(lengths)))
    length = max(step * power for step in _STEPS if step * power <= np.median(lengths) or step == 1.0)
    near = np.argsort(np.abs(np.log(np.maximum(lengths, 1e-300) / length)), kind="stable")[:_NEAREST]
    return tell_length(places.apart(ends[near]).in_scale(scale), length, axes)


def spread_rows(lengths: IntArray) -> IntArray:
    """Return rows of points (k,), spread evenly over those that as many images see as the median, or more."""
    usual = np.flatnonzero(lengths >= np.median(lengths)) if len(lengths) else lengths
    return usual[distinct(np.linspace(0, len(usual) - 1, min(len(usual), _MOST_PLACES)).astype(np.int64))]


def length_between(
    images: Images, points: Points, estimate: Estimate | None, scale: ScaleErrors, axes: Axes
) -> LengthFacts | None:
    """Return how well a usual length between points of a model is known; None where it is not known."""
    if estimate is None or estimate.draws is None or not points.num_points:
        return None
    return tell_usual_length(errors_of(images, points, estimate, spread_rows(points.lengths())), scale, axes)


def errors_of(images: Images, points: Points, estimate: Estimate, chosen: IntArray) -> PlaceErrors:
    """Return the errors of some points of a model, by their rows."""
    rows = np.flatnonzero(images.is_posed)
    observed = points.rows_of(chosen)
    seen = observed.list_of_rows(), np.searchsorted(rows, points.images[observed.rows])
    posed = images.part(rows)
    return errors_of_points(posed, draws_at(estimate, posed), points.xyz[chosen], seen, estimate.noise_px)
