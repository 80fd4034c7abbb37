"""`sfm-shapefit locate MODEL OUT`."""

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
    Database,
    ExecutorName,
    InputPath,
    Json,
    ModelArgument,
    OutArgument,
    OutputPath,
    Overwrite,
    Quiet,
    Report,
    Scene,
    Scheduler,
    Verbose,
    one_path,
    options_from,
    takes,
)
from sfm_shapefit.cli.lines import adjustment_line, objective_line, pictures_line, pieces_line, time_line
from sfm_shapefit.options import LocateOptions

if TYPE_CHECKING:
    from sfm_shapefit.results import LocateResult


@app.command("locate", short_help="Place the cameras of a model from its rotations and matches.")
@takes(LocateOptions)
def locate_command(
    model: ModelArgument = None,
    out: OutArgument = None,
    *,
    input_path: InputPath = None,
    output_path: OutputPath = None,
    database: Database = None,
    priors: Annotated[
        Path | None,
        typer.Option(
            "--priors",
            metavar="FILE",
            help="Position priors, name x y z [sigma] per line, or name,lat,lon,alt with that header.",
        ),
    ] = None,
    executor: ExecutorName = "serial",
    scheduler: Scheduler = None,
    overwrite: Overwrite = False,
    config: Config = None,
    report: Report = True,
    scene: Scene = False,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    **given: Any,
) -> None:
    """Place the cameras of MODEL from its rotations and its matches; write a seeded model to OUT."""
    source = one_path(model, input_path, "MODEL")
    target = one_path(out, output_path, "OUT")
    with reported(target):
        from sfm_shapefit.atomic_folder import claimed_output

        options = options_from(LocateOptions, given, config)
        names = Path(options.fix) if options.fix else None
        protect = [path for path in (source, database, priors, names, config) if path is not None]
        with claimed_output(target, overwrite=overwrite, protect=protect):
            from sfm_shapefit.colmap.quiet import pycolmap_heard
            from sfm_shapefit.commands.locate import locate
            from sfm_shapefit.commands.stages.execution import open_executor
            from sfm_shapefit.commands.write import write_result
            from sfm_shapefit.results import summary

            catch_termination()
            with (
                open_executor(executor, options.num_threads(), scheduler) as workers,
                shown_progress(not quiet, verbose) as progress,
                pycolmap_heard(verbose),
            ):
                found = locate(source, database, options, progress, priors, workers)
                write_result(found, target, overwrite=overwrite, protect=protect, report=report, scene=scene)
        if as_json:
            print_json(summary(found))
        elif not quiet:
            table = _locate_table(found, target, pictures_line(report, scene), verbose=verbose)
            print_table(f"{len(found.model.names)} images of {source}", table)


def _locate_table(found: "LocateResult", out: Path, pictures: str, *, verbose: bool) -> Rows:
    """Return what was placed, what was not and why, how certain it is, and where it is."""
    from sfm_shapefit.results import summary

    facts = summary(found)
    left_out = [f"{row.name}: {row.reason}" for row in found.cameras if not row.placed]
    return [
        ("directions", found.inputs.statement),
        ("placed", f"{facts['num_placed']} of {facts['num_images']} images"),
        *([("not placed", shortened(left_out))] if left_out else []),
        *_groups_line(facts),
        *pieces_line(facts),
        ("pairs", _pairs_line(facts)),
        ("objective", objective_line(found.solve)),
        ("points as nodes", f"{facts['num_points_as_nodes']} tracks helped to place the cameras"),
        ("centres", found.placement.finish.statement()),
        ("scale", found.gauge.statement),
        ("points", _points_line(facts)),
        *([("bundle adjustment", adjustment_line(found.adjusted))] if found.adjusted else []),
        *[("warning", warning) for warning in found.warnings],
        ("time", time_line(found.timings_s, verbose)),
        ("written to", f"{out}: seeded model, locate.json, cameras.csv, pairs.csv{pictures}"),
    ]


def _groups_line(facts: dict[str, Any]) -> Rows:
    groups = facts["rigid_groups"]
    if groups is None:
        return []
    fixed = f", {groups['num_fixed']} cameras fixed" if groups["num_fixed"] else ""
    inner = f"; {groups['num_inner_pairs']} pairs inside them give no constraint"
    return [("rigid groups", f"{groups['num_placed']} of {groups['num_groups']} placed{fixed}{inner}")]


def _pairs_line(facts: dict[str, Any]) -> str:
    counts = dict(facts["pairs"])
    contradicting, usable = counts.pop("outlier"), counts.pop("usable")
    others = "".join(f", {count} {status.replace('_', ' ')}" for status, count in counts.items())
    filtered = (
        f", {facts['num_pairs_filtered']} left out by the filter" if facts["num_pairs_filtered"] else ""
    )
    return (
        f"{facts['num_pairs']}: {usable} usable ({contradicting} contradict the solution{filtered}){others}"
    )


def _points_line(facts: dict[str, Any]) -> str:
    if facts["num_points"] == 0:
        return "none"
    return f"{facts['num_points']}, mean error {facts['mean_reprojection_error_px']:.2f} px"
