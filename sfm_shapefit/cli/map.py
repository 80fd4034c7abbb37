"""`sfm-shapefit map DATABASE OUT`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sfm_shapefit.base.wording import counted
from sfm_shapefit.cli.console import Rows, shorten
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
from sfm_shapefit.cli.frame import Told, command_run
from sfm_shapefit.cli.lines import (
    control_point_rows,
    describe_adjustment,
    describe_points,
    intrinsics_rows,
    next_steps,
    picture_rows,
    rig_rows,
    scene_rows,
)
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
        run.heed(found.models[0].located.verdict)
        run.show(title, found.summary(), lambda: _tell(found, target, run.flags))


def _tell(found: "MapResult", out: Path, flags: OutputFlags) -> Told:
    """Say what each model has, what was left out, and where it is."""
    from sfm_shapefit.facts.key_figures import figure_rows

    several = len(found.models) > 1
    figures: Rows = []
    details: Rows = [("pairs", f"{counted(found.num_pairs, 'pair')} with a relative rotation")]
    for number, model in enumerate(found.models):
        located, facts = model.located, model.located.summary()
        title = [(f"model {number}", located.verdict.statement)] if several else []
        figures += [
            *title,
            *figure_rows(facts),
            ("points", describe_points(facts)),
            *intrinsics_rows(facts),
            *rig_rows(facts),
            *control_point_rows(facts),
            *scene_rows(facts),
            *[("warning", warning) for warning in located.warnings],
        ]
        details += [
            *title,
            ("rotations", model.averaging.statement),
            ("centers", located.placement.refined.statement()),
            ("scale", located.gauge.statement),
            *([("bundle adjustment", describe_adjustment(located.adjusted))] if located.adjusted else []),
            ("certificate", located.departure.statement),
        ]
    folders = [*map(str, range(len(found.models))), *(one.folder for one in found.joined)]
    left_out = [f"{name}: {reason}" for name, reason in found.left_out.items()]
    return Told(
        figures=[
            *figures,
            *[("joined" if join.join else "not joined", join.statement) for join in found.joins],
            *[(one.folder, one.facts["verdict"]["statement"]) for one in found.joined],
            *([("in no model", shorten(left_out, "see map.json"))] if left_out else []),
            *[("warning", warning) for warning in found.warnings],
            *picture_rows(flags, [name for model in found.models for name in model.located.model.names]),
        ],
        details=details,
        verdict=found.models[0].located.verdict,
        steps=next_steps(dict(found.models[0].located.summary()), out / "0", flags),
        timings_s=found.timings_s,
        written=f"{out}: {'models' if several else 'a model'} in {', '.join(folders)}, map.json",
    )
