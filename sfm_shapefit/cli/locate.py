"""`sfm-shapefit locate MODEL OUT`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from sfm_shapefit.cli.app import app
from sfm_shapefit.cli.console import Rows, shorten
from sfm_shapefit.cli.flags import (
    Database,
    GroupedCommand,
    InputPath,
    ModelArgument,
    OutArgument,
    OutputFlags,
    OutputPath,
    one_path,
    takes,
)
from sfm_shapefit.cli.frame import command_run
from sfm_shapefit.cli.lines import (
    describe_adjustment,
    describe_time,
    further_piece_rows,
    intrinsics_rows,
    name_pictures,
)
from sfm_shapefit.locate_options import LocateOptions

if TYPE_CHECKING:
    from sfm_shapefit.results.result import LocateResult


@app.command(
    "locate",
    cls=GroupedCommand,
    short_help="Place the cameras of a model from its rotations and matches.",
    epilog="Example: sfm-shapefit locate sparse/0 out",
)
@takes(LocateOptions, OutputFlags)
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
        typer.Option(
            "--executor",
            help="Who measures directions: this process, so many others as --threads says, or a cluster.",
        ),
    ] = "serial",
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="Of a dask scheduler that runs already."),
    ] = None,
    **given: Any,
) -> None:
    """Place the cameras of MODEL from its rotations and its matches; write a seeded model to OUT."""
    source = one_path(model, input_path, "MODEL")
    target = one_path(out, output_path, "OUT")
    with command_run(LocateOptions, given, target, [source, database, priors]) as run:
        from sfm_shapefit.commands.locate import locate
        from sfm_shapefit.commands.stages.execution import open_executor
        from sfm_shapefit.commands.write import write_result

        with open_executor(executor, run.options.num_threads(), scheduler) as workers:
            found = locate(
                source, database, options=run.options, progress=run.progress, priors=priors, executor=workers
            )
        write_result(found, target, **run.writing)
        title = f"{len(found.model.names)} images of {source}"
        run.heed(found.verdict)
        run.show(title, found.summary(), lambda: _locate_table(found, target, run.flags))


def _locate_table(found: "LocateResult", out: Path, flags: OutputFlags) -> Rows:
    """Return what was placed, what was not and why, how certain it is, and where it is."""
    facts = found.summary()
    left_out = [f"{row.name}: {row.reason}" for row in found.cameras if not row.placed]
    points = "none"
    if facts["num_points"]:
        points = f"{facts['num_points']}, mean error {facts['mean_reprojection_error_px']:.2f} px"
    return [
        ("verdict", found.verdict.statement),
        ("directions", found.inputs.statement),
        ("placed", f"{facts['num_placed']} of {facts['num_images']} images"),
        *([("not placed", shorten(left_out))] if left_out else []),
        *_group_rows(facts),
        *further_piece_rows(facts),
        ("pairs", _describe_pairs(facts)),
        ("points as nodes", f"{facts['num_points_as_nodes']} tracks helped to place the cameras"),
        ("centers", found.placement.refined.statement()),
        *([("adjustment", found.adjustment.statement)] if found.adjustment else []),
        *intrinsics_rows(facts),
        ("scale", found.gauge.statement),
        ("points", points),
        *([("bundle adjustment", describe_adjustment(found.adjusted))] if found.adjusted else []),
        *[("warning", warning) for warning in found.warnings],
        ("certificate", found.departure.statement),
        ("time", describe_time(found.timings_s, flags.verbose)),
        ("written to", f"{out}: seeded model, locate.json, cameras.csv, pairs.csv{name_pictures(flags)}"),
    ]


def _group_rows(facts: dict[str, Any]) -> Rows:
    groups = facts["rigid_groups"]
    if groups is None:
        return []
    fixed = f", {groups['num_fixed']} cameras fixed" if groups["num_fixed"] else ""
    inner = f"; {groups['num_inner_pairs']} pairs inside them give no constraint"
    return [("rigid groups", f"{groups['num_placed']} of {groups['num_groups']} placed{fixed}{inner}")]


def _describe_pairs(facts: dict[str, Any]) -> str:
    counts = dict(facts["pairs"])
    contradicting, usable = counts.pop("outlier"), counts.pop("usable")
    others = "".join(f", {count} {status.replace('_', ' ')}" for status, count in counts.items())
    filtered = (
        f", {facts['num_pairs_filtered']} left out by the filter" if facts["num_pairs_filtered"] else ""
    )
    return (
        f"{facts['num_pairs']}: {usable} usable ({contradicting} contradict the solution{filtered}){others}"
    )
