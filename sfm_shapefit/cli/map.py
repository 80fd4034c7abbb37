"""`sfm-shapefit map DATABASE OUT`, and `map IMAGES OUT`, which makes the database first."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from sfm_shapefit.base.settings import homes_of
from sfm_shapefit.cli.flags import (
    GroupedCommand,
    OutArgument,
    OutputFlags,
    OutputPath,
    PriorsFile,
    Scheduler,
    flags_of,
    one_path,
    read_options,
    takes,
)
from sfm_shapefit.cli.frame import Run, command_run
from sfm_shapefit.cli.root import app
from sfm_shapefit.facts.command_options import MapOptions
from sfm_shapefit.files.matching_options import MatchingOptions

_FLAGS = (
    *("control_points", "scale_bars", "known_distance", "gravity", "without", "intrinsics", "rigs"),
    *(
        "adjust",
        "scale",
        "join",
        "min_trust",
        "min_points_per_image",
        "min_model_size",
        "points",
        "threads",
        "max_memory_mb",
    ),
)
"""Options that are flags; the others are keys of --config."""


@app.command(
    "map",
    cls=GroupedCommand,
    short_help="Make models from a COLMAP database, or from a folder of images.",
    epilog="Example: sfm-shapefit map images out",
)
@takes(flags_of(MapOptions, *_FLAGS), flags_of(MatchingOptions), flags_of(OutputFlags), settings=MapOptions)
def map_command(
    database: Annotated[
        Path | None,
        typer.Argument(
            metavar="DATABASE", help="COLMAP database with verified matches, or a folder of images to match."
        ),
    ] = None,
    out: OutArgument = None,
    *,
    database_path: Annotated[Path | None, typer.Option("--database_path", hidden=True)] = None,
    output_path: OutputPath = None,
    priors: PriorsFile = None,
    scheduler: Scheduler = "",
    **given: Any,
) -> None:
    """Make models from the matches of DATABASE; write them to OUT/0, OUT/1, ..., the largest first.

    Where DATABASE is a folder of images, OUT/database.db is made of them first, by COLMAP's features and
    matcher.
    """
    source = one_path(database, database_path, "DATABASE")
    target = one_path(out, output_path, "OUT")
    made = _database_to_make(source, target, given)
    with command_run(MapOptions, given, target, [source, priors], "DATABASE OUT", made) as run:
        from sfm_shapefit.commands.map import map_database
        from sfm_shapefit.pipeline.execution import open_client

        if made is not None:
            _match(source, made, given, run, priors)
        with open_client(scheduler) as client:
            found = map_database(
                made or source, run.options, progress=run.progress, priors=priors, client=client
            )
        run.finish(found if made is None else replace(found, images=source), source, target)


def _database_to_make(source: Path, target: Path, given: dict[str, Any]) -> Path | None:
    """Return the database to be made of a folder of images; None where the source is, or has, one."""
    from sfm_shapefit.files.colmap.sqlite_file import DATABASE_NAMES, database_beside

    if source.is_dir() and database_beside(source) is None:
        return target / DATABASE_NAMES[0]
    told = [name for name in homes_of(MatchingOptions) if given.get(name) is not None]
    if told and source.exists():  # a path that is not there is refused where the database is opened
        raise typer.BadParameter(
            f"--{told[0].replace('_', '-')} is for a folder of images, but {source} is a database already"
        )
    return None


def _match(
    images: Path, database: Path, given: dict[str, Any], run: Run[MapOptions], priors: Path | None
) -> None:
    """Make the database, unless the run could not use a file, and let the report have the images."""
    from sfm_shapefit.base.clock import Clock
    from sfm_shapefit.commands.map import refuse_useless_files
    from sfm_shapefit.commands.match import begin_database, match_begun

    clock = Clock.of(run.progress, run.options.placement.solver.threads)
    begun = begin_database(images, database, read_options(MatchingOptions, given), clock)
    refuse_useless_files(database, run.options, priors)
    match_begun(begun, clock)
    run.flags = replace(run.flags, images=run.flags.images or str(images))
