"""`sfm-shapefit inspect MODEL`."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.wording import counted
from sfm_shapefit.cli.console import (
    NAMES_SHOWN,
    SEE_JSON,
    Rows,
    catch_termination,
    print_json,
    print_steps,
    print_table,
    report_errors,
    shorten,
    show_progress,
)
from sfm_shapefit.cli.flags import Database, GroupedCommand, InputPath, Json, one_path, read_options, takes
from sfm_shapefit.cli.root import app
from sfm_shapefit.facts.options import LocateOptions

if TYPE_CHECKING:
    from sfm_shapefit.pipeline.inspect import Inspection

_INSPECTED = (
    "directions",
    "solver",
    "objective",
    "refine",
    "points",
    "min_inliers",
    "min_inlier_ratio",
    "inlier_threshold_px",
    "threads",
)
"""The options of `locate` that decide what the view graph is and what becomes of it."""


@app.command(
    "inspect",
    cls=GroupedCommand,
    short_help="Diagnose a model and say what locate would do; write nothing.",
    epilog="Example: sfm-shapefit inspect sparse/0",
)
@takes(LocateOptions, only=_INSPECTED)
def inspect_command(
    model: Annotated[
        Path | None,
        typer.Argument(metavar="MODEL", help="COLMAP model folder, or the text file of a bare graph."),
    ] = None,
    *,
    input_path: InputPath = None,
    database: Database = None,
    as_json: Json = False,
    **given: Any,
) -> None:
    """Diagnose the view graph of MODEL and say what `locate` would do; solve and write nothing."""
    source = one_path(model, input_path, "MODEL")
    with report_errors():
        options = read_options(LocateOptions, given)

        from sfm_shapefit.pipeline.inspect import inspect as inspect_model

        catch_termination()
        with show_progress(not as_json) as progress:
            found = inspect_model(source, database, options=options, progress=progress)
        if as_json:
            print_json(found.summary())
        else:
            what = "node" if source.is_file() else "image"
            print_table(f"{counted(found.num_images, what)} of {source}", _inspection_table(found))
            if not found.diagnosis.obstacle:
                command = "place" if what == "node" else "locate"
                print_steps([f"sfm-shapefit {command} {shlex.quote(str(source))} OUT"])
        if found.diagnosis.obstacle:
            raise UnsolvableError(found.diagnosis.obstacle)


def _inspection_table(found: "Inspection") -> Rows:
    """Return the diagnosis, label by label."""
    seen = found.diagnosis
    statuses = "\n".join(f"{count} {status}" for status, count in found.statuses.items())
    sizes = ", ".join(map(str, seen.components[:NAMES_SHOWN]))
    sizes += ", ..." if len(seen.components) > NAMES_SHOWN else ""
    pieces = [
        counted(piece.num_cameras, "camera")
        + (f", hinged at {', '.join(piece.hinges)}" if piece.hinges else "")
        for piece in seen.pieces
    ]
    left_out = [f"{name}: {reason}" for name, reason in seen.left_out.items()]
    weak = [f"{camera.name}: {'; '.join(camera.reasons)}" for camera in seen.weak]
    return [
        ("directions", found.directions),
        ("pairs", statuses),
        ("points as nodes", found.points),
        ("rigs", found.rigs),
        ("components", f"{len(seen.components)} (of {sizes} cameras)"),
        *([("rigid pieces", shorten(pieces, SEE_JSON))] if pieces else []),
        *([("not placed", shorten(left_out, SEE_JSON))] if left_out else []),
        *([("weak cameras", shorten(weak, SEE_JSON))] if weak else []),
        ("contradicting", seen.corruption.statement),
        *([("solver", f"{seen.plan.solver}: {seen.plan.solver_reason}")] if seen.plan else []),
        *([("finish", seen.plan.finish)] if seen.plan else []),
        *([("will take", found.expected.statement)] if found.expected else []),
    ]
