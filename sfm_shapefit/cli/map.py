"""`sfm-shapefit map DATABASE OUT`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sfm_shapefit.cli.app import app
from sfm_shapefit.cli.console import Rows, shorten
from sfm_shapefit.cli.flags import GroupedCommand, OutArgument, OutputFlags, OutputPath, one_path, takes
from sfm_shapefit.cli.frame import command_run
from sfm_shapefit.cli.lines import describe_adjustment, describe_time, intrinsics_rows
from sfm_shapefit.locate_options import MapOptions

if TYPE_CHECKING:
    from sfm_shapefit.results.map_result import MapResult


@app.command(
    "map",
    cls=GroupedCommand,
    short_help="From the matches of a database alone: rotations, then locate.",
    epilog="Example: sfm-shapefit map database.db out --bundle-adjust",
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
    **given: Any,
) -> None:
    """Average rotations from the matches of DATABASE, then locate; write the models to OUT/0, OUT/1, ..."""
    source = one_path(database, database_path, "DATABASE")
    target = one_path(out, output_path, "OUT")
    with command_run(MapOptions, given, target, [source]) as run:
        from sfm_shapefit.commands.map import map_database
        from sfm_shapefit.commands.write import write_result

        found = map_database(source, run.options, progress=run.progress)
        write_result(found, target, **run.writing)
        title = f"{found.num_images} images of {source}"
        run.heed(found.models[0].located.verdict)
        run.show(title, found.summary(), lambda: _map_table(found, target, run.flags))


def _map_table(found: "MapResult", out: Path, flags: OutputFlags) -> Rows:
    """Return what each model has, what was left out, and where it is."""
    rows: Rows = [("pairs", f"{found.num_pairs} with a relative rotation")]
    for number, model in enumerate(found.models):
        located = model.located
        rows += [
            (f"model {number}", located.verdict.statement),
            ("  placed", f"{int(located.kept.sum())} of {len(model.names)} images placed"),
            ("  rotations", model.averaging.statement),
            ("  points", str(located.reconstruction.num_points3D())),
            *intrinsics_rows(located.summary(), "  "),
            ("  scale", located.gauge.statement),
            *([("  bundle adjustment", describe_adjustment(located.adjusted))] if located.adjusted else []),
            *[("  warning", warning) for warning in located.warnings],
        ]
    left_out = [f"{name}: {reason}" for name, reason in found.left_out.items()]
    return [
        *rows,
        *([("in no model", shorten(left_out, "see map.json"))] if left_out else []),
        *[("warning", warning) for warning in found.warnings],
        ("time", describe_time(found.timings_s, flags.verbose)),
        ("written to", f"{out}: models in {', '.join(str(k) for k in range(len(found.models)))}, map.json"),
    ]
