"""`sfm-shapefit map DATABASE OUT`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sfm_shapefit.cli.app import app
from sfm_shapefit.cli.console import (
    Rows,
    catch_termination,
    print_json,
    print_table,
    reported,
    shortened,
    shown_progress,
)
from sfm_shapefit.cli.flags import (
    Config,
    Json,
    OutArgument,
    OutputPath,
    Overwrite,
    Quiet,
    Report,
    Scene,
    Verbose,
    one_path,
    options_from,
    takes,
)
from sfm_shapefit.cli.lines import adjustment_line, time_line
from sfm_shapefit.options import MapOptions

if TYPE_CHECKING:
    from sfm_shapefit.results.map_result import MapResult


@app.command("map", short_help="From the matches of a database alone: rotations, then locate.")
@takes(MapOptions)
def map_command(
    database: Annotated[
        Path | None, typer.Argument(metavar="DATABASE", help="COLMAP database with verified matches.")
    ] = None,
    out: OutArgument = None,
    *,
    database_path: Annotated[Path | None, typer.Option("--database_path", hidden=True)] = None,
    output_path: OutputPath = None,
    overwrite: Overwrite = False,
    report: Report = True,
    scene: Scene = False,
    config: Config = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    **given: Any,
) -> None:
    """Average rotations from the matches of DATABASE, then locate; write the models to OUT/0, OUT/1, ..."""
    source = one_path(database, database_path, "DATABASE")
    target = one_path(out, output_path, "OUT")
    with reported(target):
        from sfm_shapefit.atomic_folder import claimed_output

        options = options_from(MapOptions, given, config)
        protect = [path for path in (source, config) if path is not None]
        with claimed_output(target, overwrite=overwrite, protect=protect):
            from sfm_shapefit.colmap.quiet import pycolmap_heard
            from sfm_shapefit.commands.map import map_database
            from sfm_shapefit.commands.write import write_map_result
            from sfm_shapefit.results.map_result import map_summary

            catch_termination()
            with shown_progress(not quiet, verbose) as progress, pycolmap_heard(verbose):
                found = map_database(source, options, progress)
                write_map_result(
                    found, target, overwrite=overwrite, protect=protect, report=report, scene=scene
                )
        if as_json:
            print_json(map_summary(found))
        elif not quiet:
            print_table(f"{found.num_images} images of {source}", _map_table(found, target, verbose=verbose))


def _map_table(found: "MapResult", out: Path, *, verbose: bool) -> Rows:
    """Return what each model has, what was left out, and where it is."""
    rows: Rows = [("pairs", f"{found.num_pairs} with a relative rotation")]
    for number, model in enumerate(found.models):
        located = model.located
        rows += [
            (f"model {number}", f"{int(located.kept.sum())} of {len(model.names)} images placed"),
            ("  rotations", model.averaging.statement),
            ("  points", str(located.reconstruction.num_points3D())),
            ("  scale", located.gauge.statement),
            *([("  bundle adjustment", adjustment_line(located.adjusted))] if located.adjusted else []),
            *[("  warning", warning) for warning in located.warnings],
        ]
    left_out = [f"{name}: {reason}" for name, reason in found.left_out.items()]
    return [
        *rows,
        *([("in no model", shortened(left_out, "see map.json"))] if left_out else []),
        *[("warning", warning) for warning in found.warnings],
        ("time", time_line(found.timings_s, verbose)),
        ("written to", f"{out}: models in {', '.join(str(k) for k in range(len(found.models)))}, map.json"),
    ]
