"""`sfm-shapefit convert MODEL OUT`."""

from pathlib import Path
from typing import Annotated

import typer

from sfm_shapefit.cli.console import print_table, report_errors
from sfm_shapefit.cli.flags import GroupedCommand, InputPath, OutputPath, Quiet, one_path
from sfm_shapefit.cli.root import app

_FORMATS = ("colmap", "colmap-txt", "nerf", "tum", "csv", "glb", "ply")


@app.command(
    "convert",
    cls=GroupedCommand,
    short_help="Write a model in another format.",
    epilog="Example: sfm-shapefit convert out transforms.json",
)
def convert_command(
    model: Annotated[
        Path | None,
        typer.Argument(metavar="MODEL", help="COLMAP model folder, or OpenSfM's reconstruction.json."),
    ] = None,
    out: Annotated[Path | None, typer.Argument(metavar="OUT", help="File or folder to be made.")] = None,
    *,
    input_path: InputPath = None,
    output_path: OutputPath = None,
    target_format: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="colmap or colmap-txt (a folder), nerf (transforms.json), tum (trajectory), csv, or glb or "
            "ply (a mesh); by default that of OUT's suffix: none, .json, .tum or .txt, .csv, .glb, .ply.",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
    quiet: Quiet = False,
) -> None:
    """Write MODEL, COLMAP's or OpenSfM's, in another format."""
    source = one_path(model, input_path, "MODEL")
    target = one_path(out, output_path, "OUT")
    if target_format is not None and target_format not in _FORMATS:
        raise typer.BadParameter(f"--format must be one of {', '.join(_FORMATS)}, got {target_format!r}")
    with report_errors(target):
        from sfm_shapefit.pipeline.convert import convert

        written = convert(source, target, target_format=target_format, overwrite=overwrite)  # type: ignore[arg-type]
        if not quiet:
            print_table(str(source), [("format", written), ("written to", str(target))])
