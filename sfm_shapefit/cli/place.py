"""`sfm-shapefit solve GRAPH OUT`."""

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
    Json,
    OutArgument,
    Overwrite,
    Quiet,
    Report,
    Scene,
    one_path,
    options_from,
    takes,
)
from sfm_shapefit.cli.lines import objective_line, pictures_line, pieces_line, time_line
from sfm_shapefit.refinement.options import PlacementOptions

if TYPE_CHECKING:
    from sfm_shapefit.results import GraphResult


@app.command("solve", short_help="Place the nodes of a bare view graph, or of relative poses.")
@takes(PlacementOptions)
def solve_command(
    graph: Annotated[
        Path | None,
        typer.Argument(
            metavar="GRAPH",
            help="Text file, i j vx vy vz [weight] per line; or relative poses: 1DSfM's EGs.txt or its "
            "folder, GLOMAP's text, or a g2o file.",
        ),
    ] = None,
    out: OutArgument = None,
    *,
    rotations: Annotated[
        Path | None,
        typer.Option(
            "--rotations",
            metavar="FILE",
            help="Rotations for relative poses: 1DSfM's rots.txt, i R11 R12 ... R33 per line, or the "
            "vertices of a g2o file; averaged if not given.",
        ),
    ] = None,
    max_rotation_error: Annotated[
        float,
        typer.Option(
            "--max-rotation-error",
            metavar="DEG",
            min=0.0,
            help="Leave out relative poses whose rotation contradicts the cameras' by more.",
        ),
    ] = 10.0,
    reverse: Annotated[
        bool, typer.Option("--reverse", help="Directions point from i to j, as in 1DSfM's prob.txt.")
    ] = False,
    g2o: Annotated[bool, typer.Option("--g2o", help="Also write the placed nodes to positions.g2o.")] = False,
    onedsfm: Annotated[
        bool,
        typer.Option("--1dsfm", help="Also write 1dsfm/: the pairs that agree, rotations and locations."),
    ] = False,
    overwrite: Overwrite = False,
    report: Report = True,
    scene: Scene = False,
    as_json: Json = False,
    quiet: Quiet = False,
    **given: Any,
) -> None:
    """Place the nodes of a bare view GRAPH of directions, or of relative poses; write tables to OUT."""
    source = one_path(graph, None, "GRAPH")
    target = one_path(out, None, "OUT")
    with reported(target):
        from sfm_shapefit.atomic_folder import claimed_output

        options = options_from(PlacementOptions, given)
        inputs = [path for path in (source, rotations) if path is not None]
        with claimed_output(target, overwrite=overwrite, protect=inputs):
            from sfm_shapefit.commands.place import solve_graph_file
            from sfm_shapefit.commands.write import write_graph_result
            from sfm_shapefit.results import graph_summary

            catch_termination()
            with shown_progress(not quiet) as progress:
                found = solve_graph_file(
                    source,
                    options,
                    rotations=rotations,
                    max_rotation_error_deg=max_rotation_error,
                    reverse=reverse,
                    progress=progress,
                )
            write_graph_result(
                found,
                target,
                overwrite=overwrite,
                g2o=g2o,
                onedsfm=onedsfm,
                protect=inputs,
                report=report,
                scene=scene,
            )
        if as_json:
            print_json(graph_summary(found))
        elif not quiet:
            print_table(
                f"{found.placement.graph.num_nodes} nodes of {source}",
                _solve_table(found, target, pictures_line(report, scene)),
            )


def _solve_table(found: "GraphResult", out: Path, pictures: str) -> Rows:
    """Return what was placed, what was not and why, and how certain it is."""
    from sfm_shapefit.results import graph_summary, graph_warnings

    placement, facts = found.placement, graph_summary(found)
    left_out = [f"{row.name}: {row.reason}" for row in found.cameras if not row.placed]
    return [
        ("directions", found.statement),
        ("dimension", str(placement.graph.dimension)),
        ("placed", f"{len(placement.cameras)} of {placement.graph.num_nodes} nodes"),
        *([("not placed", shortened(left_out))] if left_out else []),
        *pieces_line(facts),
        (
            "pairs",
            f"{placement.num_pairs}, of which {len(placement.rejected_pairs)} contradict the solution"
            + (
                f" and {len(placement.dropped)} were left out by the filter" if len(placement.dropped) else ""
            ),
        ),
        ("residuals", _residuals_line(facts["residuals_deg"])),
        ("objective", objective_line(placement.solve)),
        ("locations", placement.finish.statement()),
        *[("warning", warning) for warning in graph_warnings(placement)],
        ("time", time_line(found.timings_s)),
        ("written to", f"{out}: locate.json, cameras.csv, pairs.csv{pictures}"),
    ]


def _residuals_line(found: dict[str, float]) -> str:
    """Say how far the placed pairs are off the solution."""
    quantiles = [f"{found[f'quantile_{q}']:.3g}" for q in (25, 50, 75, 90)]
    beyond = [f"{found[f'share_beyond_{angle}']:.1%} beyond {angle}" for angle in (1, 2, 5, 10, 30, 90)]
    return f"25/50/75/90 % of the pairs within {' / '.join(quantiles)} deg\n{', '.join(beyond)} deg"
