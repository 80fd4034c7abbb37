"""`sfm-shapefit workspace MODEL IMAGES OUT`."""

import shlex
import shutil
from pathlib import Path
from typing import Annotated, Any

import typer

from sfm_shapefit.cli.console import print_lines, report_errors
from sfm_shapefit.cli.flags import (
    GroupedCommand,
    InputPath,
    ModelArgument,
    OutArgument,
    OutputPath,
    Quiet,
    flags_of,
    one_path,
    read_options,
    takes,
)
from sfm_shapefit.cli.forecast import PLANS
from sfm_shapefit.cli.progress import show_progress
from sfm_shapefit.cli.root import app
from sfm_shapefit.files.undistortion_options import UndistortionOptions


@app.command(
    "workspace",
    cls=GroupedCommand,
    short_help="Write images and model without distortion, for splatting and dense programs.",
    epilog="Example: sfm-shapefit workspace mapped/0 images dense",
)
@takes(flags_of(UndistortionOptions), settings=UndistortionOptions)
def workspace_command(
    model: ModelArgument = None,
    images: Annotated[
        Path | None, typer.Argument(metavar="IMAGES", help="Folder of the images; they stay as they are.")
    ] = None,
    out: OutArgument = None,
    *,
    input_path: InputPath = None,
    image_path: Annotated[Path | None, typer.Option("--image_path", hidden=True)] = None,
    output_path: OutputPath = None,
    quiet: Quiet = False,
    **given: Any,
) -> None:
    """Write images and MODEL without distortion to OUT, as splatting and dense programs read them.

    3DGS, gsplat, brush, LichtFeld, nerfstudio, OpenMVS and COLMAP's dense commands take OUT as it is.
    Panoramas and wide fisheyes are cut to faces.
    """
    source = one_path(model, input_path, "MODEL")
    folder = one_path(images, image_path, "IMAGES")
    target = one_path(out, output_path, "OUT")
    with report_errors(target):
        options = read_options(UndistortionOptions, given)
        from sfm_shapefit.commands.workspace import workspace

        with show_progress(not quiet, plan=PLANS["MODEL IMAGES OUT"]) as progress:
            made = workspace(source, folder, target, options=options, progress=progress)
        if not quiet:
            print_lines([*made.told, f"next: {_next(shlex.quote(str(target)))}"])


def _next(folder: str) -> str:
    """Return what to do with a workspace: the command of a program that is there, or else in words."""
    for program, arguments in (
        ("ns-train", "splatfacto --data"),
        ("colmap", "patch_match_stereo --workspace_path"),
    ):
        if shutil.which(program):
            return f"{program} {arguments} {folder}"
    return f"train splats on {folder}, or give it to OpenMVS"
