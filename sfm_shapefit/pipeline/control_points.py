"""Ground control points: read before the work, fitted at its end, when poses and intrinsics are final."""

from pathlib import Path

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.facts.control_points import ControlPoint, control_rows, control_warnings
from sfm_shapefit.facts.options import LocateOptions
from sfm_shapefit.files.colmap.control_points import look_at_marks, read_control_points
from sfm_shapefit.files.colmap.model import PosedModel
from sfm_shapefit.files.colmap.seed import transform_model
from sfm_shapefit.pipeline.seed import Seeded
from sfm_shapefit.placement.control_points import (
    control_gauge,
    fit_control_points,
    triangulate_control_points,
)
from sfm_shapefit.scene.given import ControlPoints


def read_control(model: PosedModel, options: LocateOptions) -> ControlPoints | None:
    """Return the control points of a file, if they are wanted.

    Raises:
        InputError: as `read_control_points`, or if too few of them have marks in two images of the model.
    """
    if not options.control_points:
        return None
    known = read_control_points(Path(options.control_points), model)
    if reason := known.why_too_few():
        raise InputError(f"{options.control_points}: {reason}")
    return known


def bring_to_control_points(
    seeded: Seeded, model: PosedModel, known: ControlPoints | None, options: LocateOptions
) -> tuple[Seeded, list[ControlPoint], tuple[str, ...]]:
    """Return a model in scale and axes of control points, a row for each point, and what to warn of.

    Points that cannot tell these leave the model as it is.
    """
    if known is None:
        return seeded, [], ()
    found = triangulate_control_points(
        known, look_at_marks(seeded.reconstruction, model.names, known), options
    )
    fit = fit_control_points(known, found.positions)
    warnings = tuple(control_warnings(known, found, fit, model.names))
    rows = control_rows(known, found, fit)
    if isinstance(fit, str):
        return seeded, rows, warnings
    turned = transform_model(seeded.reconstruction, fit.motion)
    return seeded.moved(turned, control_gauge(seeded.gauge, known, fit)), rows, warnings
