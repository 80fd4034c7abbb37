"""`sfm-shapefit report OUT`: what an earlier run found, or any COLMAP model, to be looked at."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm_shapefit.base.display import row
from sfm_shapefit.cli.console import (
    catch_termination,
    print_steps,
    print_table,
    report_errors,
    show_progress,
)
from sfm_shapefit.cli.flags import Database, GroupedCommand, ImageFolder, one_path
from sfm_shapefit.cli.root import app

if TYPE_CHECKING:
    from sfm_shapefit.report.drawing import Drawing


@app.command(
    "report",
    cls=GroupedCommand,
    short_help="Explain a model in one page: what locate wrote, or any COLMAP model.",
    epilog="Example: sfm-shapefit report out",
)
def report_command(
    source: Annotated[
        Path | None,
        typer.Argument(metavar="OUT", help="A folder that locate or place wrote, or any COLMAP model."),
    ] = None,
    *,
    database: Database = None,
    write_to: Annotated[
        Path | None,
        typer.Option(
            "--write-to",
            metavar="FILE",
            help="The page of a COLMAP model, which is not touched itself. [default: report.html]",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace FILE.")] = False,
    images: ImageFolder = None,
) -> None:
    """Write OUT/report.html anew from the other files of OUT; of any other COLMAP model, write FILE.

    The page of a model says which cameras are weak (few points, large errors, little of the picture covered)
    and which pairs contradict it. Pairs come from the database or, if there is none, from the model's tracks.
    """
    folder = one_path(source, None, "OUT")
    with report_errors():
        from sfm_shapefit.base.atomic_folder import MAP_MARKER, MARKER

        if any((folder / marker).is_file() for marker in (MARKER, MAP_MARKER)):
            for name, value in (("--database", database), ("--write-to", write_to)):
                if value is not None:
                    raise typer.BadParameter(f"{name} is for COLMAP models; {folder} is an output of locate")
            _report_output(folder, images)
        else:
            _report_model(folder, database, write_to or Path("report.html"), overwrite, images)


def _report_output(folder: Path, images: Path | None) -> None:
    """Write the report of what `locate` or `place` wrote."""
    from sfm_shapefit.base.errors import InputError
    from sfm_shapefit.report.page import write_report
    from sfm_shapefit.report.read_back import read_output

    drawn, facts = read_output(folder)
    pictures = _pictures(drawn, images)
    try:
        write_report(drawn, facts, folder / "report.html", pictures)
        print_table(str(folder), [row("written", "report.html")])
        print_steps([f"open {shlex.quote(str(folder / 'report.html'))}"])
    except OSError as error:
        what = f"{folder} cannot be written ({error.strerror})"
        raise InputError(f"{what}; copy it elsewhere first") from error


def _report_model(
    folder: Path, database: Path | None, page: Path, overwrite: bool, images: Path | None
) -> None:
    """Write the report of any COLMAP model."""
    from sfm_shapefit.base.errors import InputError
    from sfm_shapefit.files.colmap.quiet import hear_pycolmap
    from sfm_shapefit.pipeline.examine import examine
    from sfm_shapefit.report.first_screen import banner
    from sfm_shapefit.report.page import write_report

    if page.exists() and not overwrite:
        raise InputError(
            f"{page} exists already; choose another with --write-to, or replace it with --overwrite"
        )
    catch_termination()
    with show_progress(True) as progress, hear_pycolmap(False):
        drawn, facts = examine(folder, database, progress=progress)
    try:
        write_report(drawn, facts, page, _pictures(drawn, images))
    except OSError as error:
        raise InputError(f"{page} cannot be written ({error.strerror}); choose another place") from error
    said = banner(drawn, facts)
    verdict = f"{said['headline']}. {said['sentence']}".strip()
    print_table(str(folder), [row("verdict", verdict), row("written", str(page))])
    print_steps([f"open {shlex.quote(str(page))}"])


def _pictures(drawn: "Drawing", images: Path | None) -> dict[int, str] | None:
    """Return small pictures of the images, if they are asked for."""
    from sfm_shapefit.base.errors import InputError
    from sfm_shapefit.report.sentences import shorten
    from sfm_shapefit.report.thumbnails import thumbnails_of

    pictures = thumbnails_of(drawn, images or "")
    if pictures is not None and not pictures:
        raise InputError(f"{images} has none of the images, such as {shorten(drawn.cameras.names[0])}")
    return pictures
