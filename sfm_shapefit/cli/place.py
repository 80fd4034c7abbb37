"""`sfm-shapefit place GRAPH OUT`, or by its other name `solve`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sfm_shapefit.cli.app import app
from sfm_shapefit.cli.console import Rows, shorten
from sfm_shapefit.cli.flags import GroupedCommand, OutArgument, OutputFlags, one_path, takes
from sfm_shapefit.cli.frame import command_run
from sfm_shapefit.cli.lines import describe_time, further_piece_rows, name_pictures
from sfm_shapefit.refinement.options import PlacementOptions

if TYPE_CHECKING:
    from sfm_shapefit.results.result import GraphResult


@app.command("solve", cls=GroupedCommand, hidden=True, epilog="Example: sfm-shapefit place graph.txt out")
@app.command(
    "place",
    cls=GroupedCommand,
    short_help="Place the nodes of a bare view graph, or of relative poses.",
    epilog="Example: sfm-shapefit place graph.txt out",
)
@takes(PlacementOptions, OutputFlags)
def place_command(
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
    **given: Any,
) -> None:
    """Place the nodes of a bare view GRAPH of directions, or of relative poses; write tables to OUT."""
    source = one_path(graph, None, "GRAPH")
    target = one_path(out, None, "OUT")
    with command_run(PlacementOptions, given, target, [source, rotations]) as run:
        from sfm_shapefit.commands.place import place_graph_file
        from sfm_shapefit.commands.write import write_result
        from sfm_shapefit.results.exports import export_files

        found = place_graph_file(
            source,
            run.options,
            rotations=rotations,
            max_rotation_error_deg=max_rotation_error,
            reverse=reverse,
            progress=run.progress,
        )
        files = export_files(found, g2o=g2o, onedsfm=onedsfm)
        write_result(found, target, further_files=files, **run.writing)
        title = f"{found.placement.graph.num_nodes} nodes of {source}"
        run.heed(found.verdict)
        run.show(title, found.summary(), lambda: _place_table(found, target, run.flags))


def _place_table(found: "GraphResult", out: Path, flags: OutputFlags) -> Rows:
    """Return what was placed, what was not and why, and how certain it is."""
    placement, facts = found.placement, found.summary()
    left_out = [f"{row.name}: {row.reason}" for row in found.cameras if not row.placed]
    return [
        ("verdict", found.verdict.statement),
        ("directions", found.statement),
        ("dimension", str(placement.graph.dimension)),
        ("placed", f"{len(placement.cameras)} of {placement.graph.num_nodes} nodes"),
        *([("not placed", shorten(left_out))] if left_out else []),
        *further_piece_rows(facts),
        (
            "pairs",
            f"{placement.num_pairs}, of which {len(placement.rejected_pairs)} contradict the solution"
            + (
                f" and {len(placement.dropped)} were left out by the filter" if len(placement.dropped) else ""
            ),
        ),
        ("residuals", _describe_residuals(facts["residuals_deg"])),
        ("locations", placement.refined.statement()),
        *[("warning", warning) for warning in facts["warnings"]],
        ("certificate", found.departure.statement),
        ("time", describe_time(found.timings_s, flags.verbose)),
        ("written to", f"{out}: locate.json, cameras.csv, pairs.csv{name_pictures(flags)}"),
    ]


def _describe_residuals(found: dict[str, float]) -> str:
    """Say how far the placed pairs are off the solution."""
    quantiles = [f"{found[f'quantile_{q}']:.3g}" for q in (25, 50, 75, 90)]
    beyond = [f"{found[f'share_beyond_{angle}']:.1%} beyond {angle}" for angle in (1, 2, 5, 10, 30, 90)]
    return f"25/50/75/90 % of the pairs within {' / '.join(quantiles)} deg\n{', '.join(beyond)} deg"
