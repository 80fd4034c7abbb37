"""Which scale, origin and axes the output gets: as asked, or by what is known.

The frame that is worked in is chosen for all cameras of a placement, and again for those that are trusted.
The output gets its gauge in one place, `stages.set_gauge`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.geometry import Similarity, mean_rotation_l1
from sfm_shapefit.base.wording import counted_are
from sfm_shapefit.facts.control_points import control_rows, control_warnings
from sfm_shapefit.files.colmap.control_points import look_at_marks, read_control_points
from sfm_shapefit.files.colmap.gravity import database_gravity, table_gravity
from sfm_shapefit.files.colmap.priors import database_priors, exif_priors, table_priors
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.pipeline.rigs import Rigid
from sfm_shapefit.pipeline.state import ModelState
from sfm_shapefit.placement.control_points import (
    control_gauge,
    fit_control_points,
    triangulate_control_points,
)
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
from sfm_shapefit.rotations.options import GRAVITY_OF_DATABASE
from sfm_shapefit.scene.given import ControlPoints, Gravity, Known, PositionPriors
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


PRIORS_OF_DATABASE = "database"
"""In place of a table or folder: the database's own pose priors."""
_NAMED = 3  # images; of more with a wrong gravity only the worst are named


def read_known(
    images: Images,
    file: DatabaseFile | None,
    priors: Path | str | None = None,
    control_points: str = "",
    gravity: str = "",
) -> Known:
    """Return what the user tells of images: position priors, control points, gravity, as far as asked for."""
    return Known(
        priors=None if priors is None else _read_priors(images, file, priors),
        control=_read_control(images, control_points) if control_points else None,
        gravity=_read_gravity(images, file, gravity) if gravity else None,
    )


def bring_to_known(state: ModelState) -> ModelState:
    """Return a model in scale and axes of control points, or with z up by gravity, where these are known.

    Points that cannot tell scale and axes leave the model as it is, and so do all where a camera is fixed;
    where the scale is known, they move and turn it only. They check its scale then.
    """
    known = state.inputs.known
    if known.control is not None:
        state = _bring_to_control_points(state, known.control)
    return state if known.gravity is None else _turn_upright(state, known.gravity)


def _read_priors(images: Images, file: DatabaseFile | None, asked: Path | str) -> PositionPriors:
    if str(asked) == PRIORS_OF_DATABASE:
        if file is None:
            raise InputError("there is no database whose priors could be taken; give one (database=FILE)")
        return database_priors(file, images)
    return exif_priors(Path(asked), images) if Path(asked).is_dir() else table_priors(Path(asked), images)


def _read_control(images: Images, file: str) -> ControlPoints:
    known = read_control_points(Path(file), images)
    if reason := known.why_too_few():
        raise InputError(f"{file}: {reason}")
    return known


def _read_gravity(images: Images, file: DatabaseFile | None, asked: str) -> Gravity:
    if asked != GRAVITY_OF_DATABASE:
        return table_gravity(Path(asked), images)
    if file is None:
        raise InputError("there is no database whose gravity could be taken; give a table")
    return database_gravity(file, images)


def _bring_to_control_points(state: ModelState, known: ControlPoints) -> ModelState:
    """Return a model in the world of control points, with a row for each point."""
    moves, resize = not state.inputs.fixed.any(), state.placement.unit is None
    images, options = state.images, state.inputs.options.structure
    found = triangulate_control_points(known, look_at_marks(images, known), options)
    fit = fit_control_points(known, found.positions, resize=resize or not moves)
    warnings = list(control_warnings(known, found, fit, images.names))
    rows = control_rows(known, found, fit)
    if not (isinstance(fit, str) or (moves and resize)):
        free = fit_control_points(known, found.positions)
        scale = 1.0 if isinstance(free, str) else free.motion.scale
        warnings.append(say_unused("control points were", state.gauge, lambda: scale))
    if not (isinstance(fit, str) or moves):
        rows = [replace(row, use="check") for row in rows]
    state = replace(state.warned(*warnings), control=tuple(rows))
    if isinstance(fit, str) or not moves:
        return state
    return state.moved(fit.motion, control_gauge(state.gauge, known, fit, resize=resize))


def _turn_upright(state: ModelState, gravity: Gravity) -> ModelState:
    """Return a model turned so that z points up, unless something else set its axes."""
    from sfm_shapefit.rotations.gravity import FEWEST_GRAVITIES, down_of, judge_gravity, turn_upright

    images, members = state.images, np.flatnonzero(state.images.is_posed)
    rotations, own = images.rotations[members], gravity.of(members)
    if len(own.indices) < FEWEST_GRAVITIES:
        few = f"{len(own.indices)} of the placed images have a gravity, and two are needed"
        return state.warned(f"{few} to turn the model upright")
    turn = turn_upright(down_of(rotations, own))
    off, wrong = judge_gravity(rotations @ turn.T, own)
    if wrong.any():
        worst = np.flatnonzero(wrong)[np.argsort(-off[wrong], kind="stable")]
        names = [images.names[members[own.indices[k]]] for k in worst[:_NAMED].tolist()]
        state = state.warned(
            f"gravities of {len(worst)} of {len(wrong)} images contradict their rotations and have no part: "
            f"{', '.join(names)}, by up to {np.degrees(off[worst[0]]):.0f} deg"
        )
    if state.gauge.axes is not None:
        return state
    statement = f"{state.gauge.statement}; z up by {int(np.sum(~wrong))} of {len(wrong)} gravities"
    return state.moved(turn_about_origin(turn), replace(state.gauge, axes=turn, statement=statement))
