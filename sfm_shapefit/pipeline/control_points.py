"""Ground control points: read before the work, fitted at its end, when poses and intrinsics are final."""

from dataclasses import replace
from pathlib import Path

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.facts.control_points import ControlPoint, control_rows, control_warnings
from sfm_shapefit.files.colmap.control_points import look_at_marks, read_control_points
from sfm_shapefit.pipeline.gauge_choice import SETS_SCALE, off_by
from sfm_shapefit.pipeline.seed import Seeded
from sfm_shapefit.placement.control_points import (
    control_gauge,
    fit_control_points,
    triangulate_control_points,
)
from sfm_shapefit.scene.given import ControlPoints
from sfm_shapefit.scene.images import Images
from sfm_shapefit.tracks.options import StructureOptions


def read_control(images: Images, file: str) -> ControlPoints | None:
    """Return the control points of a file, if one is given.

    Raises:
        InputError: as `read_control_points`, or if too few of them have marks in two images of the model.
    """
    if not file:
        return None
    known = read_control_points(Path(file), images)
    if reason := known.why_too_few():
        raise InputError(f"{file}: {reason}")
    return known


def bring_to_control_points(
    seeded: Seeded, known: ControlPoints | None, options: StructureOptions, *, moves: bool
) -> tuple[Seeded, list[ControlPoint], tuple[str, ...]]:
    """Return a model in scale and axes of control points, a row for each point, and what to warn of.

    Points that cannot tell these leave the model as it is, and so do all where the model is not to move: they
    check its scale then.
    """
    if known is None:
        return seeded, [], ()
    found = triangulate_control_points(known, look_at_marks(seeded.images, known), options)
    fit = fit_control_points(known, found.positions)
    warnings = tuple(control_warnings(known, found, fit, seeded.images.names))
    rows = control_rows(known, found, fit)
    if isinstance(fit, str):
        return seeded, rows, warnings
    if not moves:
        unused = (
            f"control points were not used for the scale, which is that of {SETS_SCALE[seeded.gauge.scale]}"
        )
        checks: list[ControlPoint] = [replace(row, use="check") for row in rows]
        return seeded, checks, (*warnings, f"{unused}; {off_by(fit.motion.scale)}")
    return seeded.moved(fit.motion, control_gauge(seeded.gauge, known, fit)), rows, warnings
