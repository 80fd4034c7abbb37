"""`sfm-shapefit inspect MODEL`."""

import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.wording import counted
from sfm_shapefit.cli.console import print_json, print_lines, print_table, report_errors
from sfm_shapefit.cli.flags import (
    Config,
    Database,
    GroupedCommand,
    InputPath,
    Json,
    flags_of,
    one_path,
    read_options,
    takes,
)
from sfm_shapefit.cli.progress import show_progress
from sfm_shapefit.cli.root import app
from sfm_shapefit.facts.command_options import InspectOptions


@app.command(
    "inspect",
    cls=GroupedCommand,
    short_help="Diagnose a model and say what locate would do; write nothing.",
    epilog="Example: sfm-shapefit inspect sparse/0",
)
@takes(flags_of(InspectOptions, "points", "without", "adjust", "threads"), settings=InspectOptions)
def inspect_command(
    model: Annotated[
        Path | None,
        typer.Argument(metavar="MODEL", help="COLMAP model folder, or the text file of a bare graph."),
    ] = None,
    *,
    input_path: InputPath = None,
    database: Database = None,
    as_json: Json = False,
    config: Config = None,
    **given: Any,
) -> None:
    """Diagnose the view graph of MODEL and say what `locate` would do; solve and write nothing."""
    source = one_path(model, input_path, "MODEL")
    with report_errors():
        from sfm_shapefit.base.atomic_folder import MARKER
        from sfm_shapefit.files.model_folder import refuse_no_model

        options = read_options(InspectOptions, given, config)
        refuse_no_model(source)

        from sfm_shapefit.commands.inspect import inspect as inspect_model

        with show_progress(not as_json) as progress:
            found = inspect_model(source, database, options=options, progress=progress)
        if as_json:
            print_json(found.summary())
        else:
            what, command = (
                ("node", "place") if source.is_file() and database is None else ("image", "locate")
            )
            told = found.told
            print_table(f"{counted(found.num_images, what)} of {source}", told.rows, told.elsewhere)
            if not found.diagnosis.obstacle:
                by = "" if database is None else f" --database {shlex.quote(str(database))}"
                if (source / MARKER).is_file():  # else the same comes out again
                    by += " --without FILE"
                print_lines([f"next: sfm-shapefit {command} {shlex.quote(str(source))} OUT{by}"])
        if found.diagnosis.obstacle:
            raise UnsolvableError(found.diagnosis.obstacle)
