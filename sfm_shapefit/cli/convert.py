"""`sfm-shapefit convert MODEL OUT`."""

from pathlib import Path
from typing import Annotated

import typer

from sfm_shapefit.base.display import NextStep
from sfm_shapefit.cli.console import print_lines, report_errors
from sfm_shapefit.cli.flags import GroupedCommand, InputPath, OutputPath, Quiet, one_path
from sfm_shapefit.cli.root import app
from sfm_shapefit.commands.convert import FORMATS, write_converted

_DESCRIBED = "; ".join(f"{name}: {one.help}" for name, one in FORMATS.items())


@app.command(
    "convert",
    cls=GroupedCommand,
    short_help="Write a model in another format.",
    epilog="Example: sfm-shapefit convert out transforms.json",
)
def convert_command(
    model: Annotated[
        Path | None,
        typer.Argument(
            metavar="MODEL",
            help="COLMAP model folder, OpenSfM's reconstruction.json, transforms.json or trajectory.",
        ),
    ] = None,
    out: Annotated[Path | None, typer.Argument(metavar="OUT", help="File or folder to be made.")] = None,
    *,
    input_path: InputPath = None,
    output_path: OutputPath = None,
    target_format: Annotated[
        str | None,
        typer.Option(
            "--format",
            help=f"{_DESCRIBED}. By default that of OUT's suffix; a folder if it has none.",
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an existing file; folders are never replaced.")
    ] = False,
    crs: Annotated[
        str,
        typer.Option(
            "--crs",
            help="Coordinates on Earth, of a model that knows its latitude and longitude: utm, EPSG:326ZZ or "
            "EPSG:327ZZ (zone ZZ of UTM), or EPSG:4978.",
        ),
    ] = "",
    offset: Annotated[
        str,
        typer.Option(
            "--offset",
            metavar="X,Y,Z|auto",
            help="Subtract this from all coordinates, and write it to *_offset.xyz.",
        ),
    ] = "",
    quiet: Quiet = False,
) -> None:
    """Write MODEL, COLMAP's or OpenSfM's, in another format."""
    source = one_path(model, input_path, "MODEL")
    target = one_path(out, output_path, "OUT")
    if target_format is not None and target_format not in FORMATS:
        raise typer.BadParameter(f"--format must be one of {', '.join(FORMATS)}, got {target_format!r}")
    with report_errors(target):
        written = write_converted(source, target, target_format, overwrite, (crs, offset))
        if not quiet:
            beside = f", {', '.join(map(str, written.files[1:]))}" if written.files[1:] else ""
            told = "; ".join(filter(None, [written.format, written.statement]))
            step = NextStep("", FORMATS[written.format].step).at(out=target).command
            print_lines([f"written to {target}{beside} ({told})", f"next: {step}"])
