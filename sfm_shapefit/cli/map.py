"""`sfm-shapefit map DATABASE OUT`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from sfm_shapefit.cli.flags import (
    ExecutorName,
    GroupedCommand,
    OutArgument,
    OutputFlags,
    OutputPath,
    PriorsFile,
    flags_of,
    one_path,
    takes,
)
from sfm_shapefit.cli.frame import command_run
from sfm_shapefit.cli.root import app
from sfm_shapefit.facts.options import MapOptions

_FLAGS = (
    *("control_points", "known_distance", "gravity", "without", "intrinsics", "rigs", "adjust", "scale"),
    *("join", "min_trust", "min_points_per_image", "min_model_size", "points", "threads", "max_memory_mb"),
)
"""Options that are flags; the others are keys of --config."""


@app.command(
    "map",
    cls=GroupedCommand,
    short_help="Make models from the matches of a COLMAP database.",
    epilog="Example: sfm-shapefit map database.db out --images images",
)
@takes(flags_of(MapOptions, *_FLAGS), flags_of(OutputFlags), settings=MapOptions)
def map_command(
    database: Annotated[
        Path | None, typer.Argument(metavar="DATABASE", help="COLMAP database with verified matches.")
    ] = None,
    out: OutArgument = None,
    *,
    database_path: Annotated[Path | None, typer.Option("--database_path", hidden=True)] = None,
    output_path: OutputPath = None,
    priors: PriorsFile = None,
    executor: ExecutorName = "serial",
    **given: Any,
) -> None:
    """Make models from the matches of DATABASE; write them to OUT/0, OUT/1, ..., the largest first."""
    source = one_path(database, database_path, "DATABASE")
    target = one_path(out, output_path, "OUT")
    with command_run(MapOptions, given, target, [source, priors], "DATABASE OUT") as run:
        from sfm_shapefit.pipeline.execution import open_executor
        from sfm_shapefit.pipeline.map import map_database

        with open_executor(executor, run.options.placement.solver.num_threads()) as workers:
            found = map_database(source, run.options, progress=run.progress, priors=priors, executor=workers)
        run.finish(found, source, target)
