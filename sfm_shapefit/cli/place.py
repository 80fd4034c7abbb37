"""`sfm-shapefit place GRAPH OUT`, or by its other name `solve`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from sfm_shapefit.cli.flags import GroupedCommand, OutArgument, OutputFlags, flags_of, one_path, takes
from sfm_shapefit.cli.frame import command_run
from sfm_shapefit.cli.root import app
from sfm_shapefit.refinement.placement_options import PlacementOptions


@app.command("solve", cls=GroupedCommand, hidden=True, epilog="Example: sfm-shapefit place graph.txt out")
@app.command(
    "place",
    cls=GroupedCommand,
    short_help="Place the nodes of a bare view graph, or of relative poses.",
    epilog="Example: sfm-shapefit place graph.txt out",
)
@takes(
    flags_of(PlacementOptions, "objective", "tol", "threads"),
    [flag for flag in flags_of(OutputFlags) if flag.name != "images"],  # nodes have none
    settings=PlacementOptions,
)
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
    **given: Any,
) -> None:
    """Place the nodes of a bare view GRAPH of directions, or of relative poses; write tables to OUT."""
    source = one_path(graph, None, "GRAPH")
    target = one_path(out, None, "OUT")
    if any((source / f"cameras{suffix}").exists() for suffix in (".bin", ".txt")):
        raise typer.BadParameter(f"{source} is a COLMAP model, which sfm-shapefit locate takes")
    with command_run(PlacementOptions, given, target, [source, rotations], "GRAPH OUT") as run:
        from sfm_shapefit.commands.place import place_graph_file

        found = place_graph_file(
            source,
            run.options,
            rotations=rotations,
            max_rotation_error_deg=max_rotation_error,
            reverse=reverse,
            progress=run.progress,
        )
        run.finish(found, source, target)
