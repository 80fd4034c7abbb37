"""`sfm-shapefit place GRAPH OUT`, or by its other name `solve`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sfm_shapefit.base.wording import counted
from sfm_shapefit.cli.console import shorten
from sfm_shapefit.cli.flags import GroupedCommand, OutArgument, OutputFlags, one_path, takes
from sfm_shapefit.cli.frame import Told, command_run
from sfm_shapefit.cli.lines import further_piece_rows, next_steps
from sfm_shapefit.cli.root import app
from sfm_shapefit.refinement.options import PlacementOptions

if TYPE_CHECKING:
    from sfm_shapefit.facts.result import GraphResult


@app.command("solve", cls=GroupedCommand, hidden=True, epilog="Example: sfm-shapefit place graph.txt out")
@app.command(
    "place",
    cls=GroupedCommand,
    short_help="Place the nodes of a bare view graph, or of relative poses.",
    epilog="Example: sfm-shapefit place graph.txt out",
)
@takes(PlacementOptions, OutputFlags, without=("images",))  # nodes have none
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
    with command_run(PlacementOptions, given, target, [source, rotations], "GRAPH OUT") as run:
        from sfm_shapefit.facts.exports import export_files
        from sfm_shapefit.pipeline.place import place_graph_file
        from sfm_shapefit.pipeline.write import write_result

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
        title = f"{counted(found.placement.graph.num_nodes, 'node')} of {source}"
        run.heed(found.verdict)
        run.show(title, found.summary(), lambda: _tell(found, target, run.flags))


def _tell(found: "GraphResult", out: Path, flags: OutputFlags) -> Told:
    """Say what was placed, what was not and why, and how certain it is."""
    from sfm_shapefit.facts.key_figures import figure_rows

    placement, facts = found.placement, found.summary()
    left_out = [f"{row.name}: {row.reason}" for row in found.cameras if not row.placed]
    rejected = counted(len(placement.rejected_pairs), "pair")
    return Told(
        figures=[
            *figure_rows(facts),
            *([("not placed", shorten(left_out))] if left_out else []),
            *further_piece_rows(facts),
            *[("warning", warning) for warning in facts["warnings"]],
        ],
        details=[
            ("directions", found.statement),
            ("dimension", str(placement.graph.dimension)),
            ("pairs", f"{placement.num_pairs:,}: {rejected} contradict the solution"),
            ("residuals", _describe_residuals(facts["residuals_deg"])),
            ("locations", placement.refined.statement()),
            ("certificate", found.departure.statement),
        ],
        verdict=found.verdict,
        steps=next_steps(facts, out, flags),
        timings_s=found.timings_s,
        written=f"{out}: locate.json, cameras.csv, pairs.csv{', report.html' * flags.report}",
    )


def _describe_residuals(found: dict[str, float]) -> str:
    """Say how far the placed pairs are off the solution."""
    quantiles = [f"{found[f'quantile_{q}']:.3g}" for q in (25, 50, 75, 90)]
    beyond = [f"{found[f'share_beyond_{angle}']:.1%} beyond {angle}" for angle in (1, 2, 5, 10, 30, 90)]
    return f"25/50/75/90 % of the pairs within {' / '.join(quantiles)} deg\n{', '.join(beyond)} deg"
