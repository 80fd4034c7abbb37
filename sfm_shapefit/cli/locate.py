"""`sfm-shapefit locate MODEL OUT`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from sfm_shapefit.cli.app import app
from sfm_shapefit.cli.console import Rows, catch_termination, print_table, reported, shortened, shown_progress
from sfm_shapefit.cli.flags import (
    Config,
    Database,
    InputPath,
    Json,
    ModelArgument,
    OutArgument,
    OutputPath,
    Overwrite,
    Quiet,
    Report,
    Scene,
    one_path,
    options_from,
    takes,
)
from sfm_shapefit.cli.lines import objective_line, pictures_line, pieces_line
from sfm_shapefit.options import LocateOptions

if TYPE_CHECKING:
    from sfm_shapefit.results import LocateResult


@app.command("locate")
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
    executor: Annotated[
        Literal["serial", "processes", "dask"],
        typer.Option("--executor", help="Who measures the directions: this process, others, or a cluster."),
    ] = "serial",
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="Of a dask scheduler that runs already."),
    ] = None,
    overwrite: Overwrite = False,
    config: Config = None,
    report: Report = True,
    scene: Scene = False,
    as_json: Json = False,
    quiet: Quiet = False,
    **given: Any,
) -> None:
    """Place the cameras of MODEL from its rotations and its matches; write a seeded model to OUT."""
    source = one_path(model, input_path, "MODEL")
    target = one_path(out, output_path, "OUT")
    with reported():
        from sfm_shapefit.output import claimed_output

        options = options_from(LocateOptions, given, config)
        names = Path(options.fix) if options.fix else None
        protect = [path for path in (source, database, priors, names, config) if path is not None]
        with claimed_output(target, overwrite=overwrite, protect=protect):
            from sfm_shapefit.pipeline import locate
            from sfm_shapefit.pipeline.execution import open_executor
            from sfm_shapefit.report import dumps
            from sfm_shapefit.results import summary, write_result

            catch_termination()
            with (
                open_executor(executor, options.num_threads(), scheduler) as workers,
                shown_progress(not quiet) as progress,
            ):
                found = locate(source, database, options, progress, priors, workers)
                write_result(found, target, overwrite=overwrite, protect=protect, report=report, scene=scene)
    with reported("interrupted; the output is complete"):
        if as_json:
            print(dumps(summary(found)))  # noqa: T201
        elif not quiet:
            table = _locate_table(found, target, pictures_line(report, scene))
            print_table(f"{len(found.model.names)} images of {source}", table)


def _locate_table(found: "LocateResult", out: Path, pictures: str) -> Rows:
    """Return what was placed, what was not and why, how certain it is, and where it is."""
    from sfm_shapefit.results import summary

    facts = summary(found)
    left_out = [f"{row.name}: {row.reason}" for row in found.cameras if not row.placed]
    return [
        ("directions", found.inputs.statement),
        ("placed", f"{facts['num_placed']} of {facts['num_images']} images"),
        *([("not placed", shortened(left_out))] if left_out else []),
        *_bodies_line(facts),
        *pieces_line(facts),
        ("pairs", _pairs_line(facts)),
        ("objective", objective_line(found.solve)),
        ("points as nodes", f"{facts['num_points_as_nodes']} tracks helped to place the cameras"),
        ("centres", found.placement.finish.statement()),
        ("scale", found.gauge.statement),
        ("points", _points_line(facts)),
        *([("bundle adjustment", _adjustment_line(found))] if found.adjusted else []),
        *[("warning", warning) for warning in found.warnings],
        ("time", f"{sum(found.timings_s.values()):.1f} s"),
        ("written to", f"{out}: seeded model, locate.json, cameras.csv, pairs.csv{pictures}"),
    ]


def _bodies_line(facts: dict[str, Any]) -> Rows:
    bodies = facts["bodies"]
    if bodies is None:
        return []
    fixed = f", {bodies['num_fixed']} cameras fixed" if bodies["num_fixed"] else ""
    inner = f"; {bodies['num_inner_pairs']} pairs inside them give no constraint"
    return [("rigid bodies", f"{bodies['num_placed']} of {bodies['num_bodies']} placed{fixed}{inner}")]


def _pairs_line(facts: dict[str, Any]) -> str:
    counts = dict(facts["pairs"])
    contradicting, usable = counts.pop("outlier"), counts.pop("usable")
    others = "".join(f", {count} {status.replace('_', ' ')}" for status, count in counts.items())
    return f"{facts['num_pairs']}: {usable} usable ({contradicting} contradict the solution){others}"


def _points_line(facts: dict[str, Any]) -> str:
    if facts["num_points"] == 0:
        return "none"
    return f"{facts['num_points']}, mean error {facts['mean_reprojection_error_px']:.2f} px"


def _adjustment_line(found: "LocateResult") -> str:
    assert found.adjusted is not None
    state = "converged" if found.adjusted.converged else "stopped at its limit"
    before, after = found.adjusted.initial_error_px, found.adjusted.final_error_px
    return f"{state} after {found.adjusted.iterations} steps, mean error {before:.2f} -> {after:.2f} px"
