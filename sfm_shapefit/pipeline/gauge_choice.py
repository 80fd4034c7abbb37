"""Which scale, origin and axes the output gets: as asked, or by what is known.

The frame that is worked in is chosen for all cameras of a placement, and again for those that are trusted.
The output gets its gauge in one place, `stages.set_gauge`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.geometry import Similarity, mean_rotation_l1
from sfm_shapefit.base.wording import counted_are
from sfm_shapefit.pipeline.rigs import Rigid
from sfm_shapefit.pipeline.state import ModelState
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
from sfm_shapefit.placement.options import GaugeOptions, KnownDistance, Scale
from sfm_shapefit.placement.prior_refinement import PULLED
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


def gauge_rule(state: ModelState) -> GaugeRule:
    """Return what sets scale, origin and axes of a model."""
    inputs = state.inputs
    return GaugeRule(inputs.images, state.rigid, inputs.scale, inputs.known.priors, inputs.distances)


def choose_frame(state: ModelState) -> ModelState:
    """Return a state in the frame of the placed cameras that are kept, or of all; what priors hold stays."""
    if state.held is not None:
        return state
    placed, kept = state.placement, slice(None) if state.kept is None else state.kept
    frame = gauge_rule(state).choose(placed.cameras[kept], placed.locations[kept], placed.unit)
    return replace(state, frame=frame)


def bring_to_gauge(state: ModelState) -> ModelState:
    """Return a model with points in its gauge, chosen anew where it was bundle adjusted or lost cameras.

    The axes of the input are those in which the rotations agree best with the input's. What fixed cameras
    hold of the gauge is held already.
    """
    state, frame = replace(state, gauge=state.frame), state.frame
    lost = state.bundle is not None or (state.support.num_seen >= 0).any()
    if not lost or state.held is not None:
        return state if frame.axes is None else state.moved(turn_about_origin(frame.axes), frame)
    cameras, images = state.placement.cameras[state.kept], state.images
    unit, is_fixed = None if state.placement.unit is None else 1.0, bool(state.inputs.fixed.any())
    if is_fixed and unit is not None:
        return state
    given, own = state.source.images.rotations[cameras], images.rotations[cameras]
    turn = np.eye(3) if is_fixed else mean_rotation_l1(given.transpose(0, 2, 1) @ own)
    found = gauge_rule(state).choose(cameras, images.centers[cameras] @ turn.T, unit)
    axes = np.eye(3) if found.axes is None else found.axes
    scale, shift, before = found.similarity.scale, found.similarity.translation, frame.similarity
    motion = Similarity(scale=scale, rotation=axes @ turn, translation=axes @ shift)
    moved = scale * turn @ before.translation + shift
    similarity = replace(before, scale=scale * before.scale, translation=moved)
    _, mark, pulled = frame.statement.partition(PULLED)  # what pulled the cameras before
    statement = f"{found.statement}{mark}{pulled}"
    return state.moved(motion, replace(found, similarity=similarity, statement=statement))


def turn_about_origin(rotation: FloatArray) -> Similarity:
    """Return the motion that only turns the world."""
    return Similarity(scale=1.0, rotation=rotation, translation=np.zeros(3))


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
