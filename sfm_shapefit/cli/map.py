"""`sfm-shapefit map DATABASE OUT`, and `map IMAGES OUT`, which makes the database first."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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

if TYPE_CHECKING:
    from sfm_shapefit.scene.given import Known

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
            metavar="DATABASE|IMAGES",
            help="COLMAP database with verified matches, or a folder of images to match.",
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

    From a folder IMAGES, OUT/database.db is made first, by COLMAP's features and matcher.
    """
    source = one_path(database, database_path, "DATABASE")
    target = one_path(out, output_path, "OUT")
    made = _database_to_make(source, target, given)
    with command_run(MapOptions, given, target, [source, priors], "DATABASE OUT", made) as run:
        from sfm_shapefit.commands.map import map_database
        from sfm_shapefit.pipeline.execution import open_client

        known, notes = _match(source, made, given, run, priors) if made is not None else (priors, [])
        if made is None and run.flags.images:
            _refuse_other_images(Path(run.flags.images), source)
        with open_client(scheduler) as client:
            found = map_database(
                made or source, run.options, progress=run.progress, priors=known, client=client
            )
        found = replace(found, images=made and source, warnings=(*notes, *found.warnings))
        run.finish(found, source, target)


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
) -> tuple["Known", list[str]]:
    """Make the database; return what files tell of its images, which is read first, and notes for the user.

    The report has the images then.
    """
    from sfm_shapefit.base.clock import Clock
    from sfm_shapefit.commands.match import begin_database, match_begun
    from sfm_shapefit.files.colmap.database_images import read_images
    from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
    from sfm_shapefit.pipeline.components import read_beside

    clock = Clock.of(run.progress, run.options.placement.solver.threads)
    begun, notes = begin_database(images, database, read_options(MatchingOptions, given), clock, priors)
    with closing(DatabaseFile(database)) as file:  # what cannot be used is refused before the long work
        _, _, known = read_beside(file, read_images(file).images, run.options, priors)
    notes += match_begun(begun, clock, priors)
    run.flags = replace(run.flags, images=run.flags.images or str(images))
    return known, notes


def _refuse_other_images(folder: Path, database: Path) -> None:
    """Refuse a folder without any image of the database now, not when all is computed."""
    from sfm_shapefit.base.errors import InputError
    from sfm_shapefit.base.paths import file_of
    from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile, database_in

    with closing(DatabaseFile(database_in(database))) as file:
        names = [str(name) for (name,) in file.rows("images", {("name",): "SELECT name FROM images"})]
    if names and not any(file_of(folder, name) for name in names):
        raise InputError(
            f"{folder} holds no image of {database}, such as {names[0]}; give the folder that their names "
            "start from"
        )
