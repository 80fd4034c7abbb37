"""What the user tells of images beside the matches: read before the work, and at its end what sets the axes.

A further kind is a type of `scene.given`, a reader in `files`, what it does to a model in `placement`, and a
line in each of the two functions here.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.facts.control_points import control_rows, control_warnings
from sfm_shapefit.files.colmap.control_points import look_at_marks, read_control_points
from sfm_shapefit.files.colmap.gravity import database_gravity, table_gravity
from sfm_shapefit.files.colmap.priors import database_priors, exif_priors, table_priors
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.pipeline.gauge_choice import say_unused, turn_about_origin
from sfm_shapefit.pipeline.state import ModelState
from sfm_shapefit.placement.control_points import (
    control_gauge,
    fit_control_points,
    triangulate_control_points,
)
from sfm_shapefit.rotations.options import GRAVITY_OF_DATABASE
from sfm_shapefit.scene.given import ControlPoints, Gravity, Known, PositionPriors
from sfm_shapefit.scene.images import Images

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
