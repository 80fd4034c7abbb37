"""`sfm-shapefit map DATABASE OUT`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sfm_shapefit.base.wording import counted
from sfm_shapefit.cli.flags import (
    ExecutorName,
    GroupedCommand,
    OutArgument,
    OutputFlags,
    OutputPath,
    PriorsFile,
    one_path,
    takes,
)
from sfm_shapefit.cli.frame import Shown, command_run
from sfm_shapefit.cli.root import app
from sfm_shapefit.facts.options import MapOptions

if TYPE_CHECKING:
    from sfm_shapefit.facts.map_result import MapResult


@app.command(
    "map",
    cls=GroupedCommand,
    short_help="From the matches of a database alone: rotations, then locate.",
    epilog="Example: sfm-shapefit map database.db out --adjust full",
)
@takes(MapOptions, OutputFlags)
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
    """Average rotations from the matches of DATABASE, then locate; write the models to OUT/0, OUT/1, ..."""
    source = one_path(database, database_path, "DATABASE")
    target = one_path(out, output_path, "OUT")
    with command_run(MapOptions, given, target, [source, priors], "DATABASE OUT") as run:
        from sfm_shapefit.pipeline.execution import open_executor
        from sfm_shapefit.pipeline.map import map_database
        from sfm_shapefit.pipeline.write import write_result

        with open_executor(executor, run.options.num_threads()) as workers:
            found = map_database(source, run.options, progress=run.progress, priors=priors, executor=workers)
        write_result(found, target, **run.writing)
        title = f"{counted(found.num_images, 'image')} of {source}"
        run.show(found, _shown(found, title, target))


def _shown(found: "MapResult", title: str, out: Path) -> Shown:
    """Return what is shown of models beside what they tell."""
    names = [name for model in found.models for name in model.located.model.names]
    folders = [*map(str, range(len(found.models))), *(one.folder for one in found.joined)]
    written = f"{'models' if len(found.models) > 1 else 'a model'} in {', '.join(folders)}, map.json"
    return Shown(title, names, out, found.models[0].located.facts.next_step, written, model="0")
