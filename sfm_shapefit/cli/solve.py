"""`sfm-shapefit solve GRAPH OUT`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sfm_shapefit.cli.app import app
from sfm_shapefit.cli.console import Rows, catch_termination, print_table, reported, shortened
from sfm_shapefit.cli.flags import Json, OutArgument, Overwrite, Quiet, one_path, options_from, takes
from sfm_shapefit.cli.lines import objective_line, pieces_line
from sfm_shapefit.robust.options import PlacementOptions

if TYPE_CHECKING:
    from sfm_shapefit.results import GraphResult


@app.command("solve")
@takes(PlacementOptions)
def solve_command(
    graph: Annotated[
        Path | None, typer.Argument(metavar="GRAPH", help="Text file: i j vx vy vz [weight] per line.")
    ] = None,
    out: OutArgument = None,
    *,
    overwrite: Overwrite = False,
    as_json: Json = False,
    quiet: Quiet = False,
    **given: Any,
) -> None:
    """Place the nodes of a bare view GRAPH of directions, in any dimension; write tables to OUT."""
    source = one_path(graph, None, "GRAPH")
    target = one_path(out, None, "OUT")
    with reported():
        from sfm_shapefit.output import check_output

        options = options_from(PlacementOptions, given)
        check_output(target, overwrite=overwrite, protect=[source])

        from sfm_shapefit.pipeline import solve_graph_file
        from sfm_shapefit.report import dumps
        from sfm_shapefit.results import graph_summary, write_graph_result

        catch_termination()
        found = solve_graph_file(source, options)
        write_graph_result(found, target, overwrite=overwrite)
        if as_json:
            print(dumps(graph_summary(found)))  # noqa: T201
        elif not quiet:
            print_table(f"{found.placement.graph.num_cameras} nodes of {source}", _solve_table(found, target))


def _solve_table(found: "GraphResult", out: Path) -> Rows:
    """Return what was placed, what was not and why, and how certain it is."""
    from sfm_shapefit.results import graph_summary, quality_warnings

    placement = found.placement
    left_out = [f"{row.name}: {row.reason}" for row in found.cameras if not row.placed]
    return [
        ("dimension", str(placement.graph.dimension)),
        ("placed", f"{len(placement.cameras)} of {placement.graph.num_cameras} nodes"),
        *([("not placed", shortened(left_out))] if left_out else []),
        *pieces_line(graph_summary(found)),
        (
            "pairs",
            f"{placement.num_pairs}, of which {len(placement.rejected_pairs)} contradict the solution",
        ),
        ("objective", objective_line(placement.solve)),
        ("locations", placement.finish.statement()),
        *[("warning", warning) for warning in quality_warnings(placement)],
        ("time", f"{sum(found.timings_s.values()):.1f} s"),
        ("written to", f"{out}: locate.json, cameras.csv, pairs.csv"),
    ]
