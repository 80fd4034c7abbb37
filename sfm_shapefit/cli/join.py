"""`sfm-shapefit join MODEL MODEL... OUT`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from sfm_shapefit.cli.flags import Database, GroupedCommand, OutputFlags, flags_of, takes
from sfm_shapefit.cli.frame import command_run
from sfm_shapefit.cli.root import app
from sfm_shapefit.facts.command_options import JoinOptions


@app.command(
    "join",
    cls=GroupedCommand,
    short_help="Join models of one scene to one model, or say why not.",
    epilog="Example: sfm-shapefit join sparse/0 sparse/1 out --database database.db",
)
@takes(flags_of(JoinOptions, "adjust", "without"), flags_of(OutputFlags), settings=JoinOptions)
def join_command(
    paths: Annotated[
        list[Path] | None,
        typer.Argument(metavar="MODEL MODEL... OUT", help="Model folders, and the folder to be made."),
    ] = None,
    *,
    database: Database = None,
    **given: Any,
) -> None:
    """Join models of one scene, tied by matches between them or by images that they share; write one to OUT.

    The world is that of the first MODEL. Models that cannot be joined safely are left out, with the reason.
    """
    if paths is None or len(paths) < 3:
        raise typer.BadParameter("give two models or more, and then OUT")
    *models, target = paths
    with command_run(JoinOptions, given, target, [*models, database], "MODEL MODEL... OUT") as run:
        from sfm_shapefit.commands.join import join

        found = join(models, database, options=run.options, progress=run.progress)
        run.finish(found, models[0], target)
