"""`sfm-shapefit check MODEL`."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm_shapefit.base.display import row
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.cli.console import (
    EXIT_UNSOLVABLE,
    catch_termination,
    print_ending,
    print_json,
    print_table,
    report_errors,
    show_progress,
)
from sfm_shapefit.cli.flags import (
    Database,
    GroupedCommand,
    ImageFolder,
    InputPath,
    Json,
    ModelArgument,
    Quiet,
    one_path,
)
from sfm_shapefit.cli.root import app

if TYPE_CHECKING:
    from sfm_shapefit.pipeline.checked import CheckResult


@app.command(
    "check",
    cls=GroupedCommand,
    short_help="Judge any COLMAP model: may it be used, which cameras are weak?",
    epilog="Example: sfm-shapefit check sparse/0 --report check.html",
)
def check_command(
    model: ModelArgument = None,
    *,
    input_path: InputPath = None,
    database: Database = None,
    report: Annotated[
        Path | None,
        typer.Option("--report", metavar="FILE", help="Write a page that explains the verdict to FILE."),
    ] = None,
    images: ImageFolder = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace FILE.")] = False,
    second_opinion: Annotated[
        bool,
        typer.Option(
            "--second-opinion/--no-second-opinion",
            help="Map the database anew, and judge by pairs what stands elsewhere there.",
        ),
    ] = True,
    as_json: Json = False,
    strict: Annotated[
        bool, typer.Option("--strict", help='End with exit code 4 where the verdict is "do not use".')
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Judge the poses of MODEL as they stand, whatever program made it; MODEL is not changed.

    Cameras are weak that see few points, have large errors or little of the picture covered, or that many
    pairs contradict. Pairs come from the database or, if there is none, from the model's tracks.
    """
    source = one_path(model, input_path, "MODEL")
    with report_errors():
        if images is not None and report is None:
            raise InputError("pictures of the images go into a page; name it with --report")
        if report is not None and not report.absolute().parent.is_dir():
            raise InputError(f"the folder of {report} does not exist; make it, or name another page")
        if report is not None and report.exists() and not overwrite:
            raise InputError(
                f"{report} exists already; choose another with --report, or replace it with --overwrite"
            )

        from sfm_shapefit.files.colmap.quiet import hear_pycolmap
        from sfm_shapefit.pipeline.check import check

        catch_termination()
        with show_progress(not (quiet or as_json)) as progress, hear_pycolmap(False):
            found = check(source, database, second_opinion=second_opinion, progress=progress)
        if report is not None:
            _write_page(found, report, images)
        if as_json:
            print_json(found.summary())
        elif not quiet:
            told = found.facts.told(found.cameras)
            rows = [*told.figures, row("written", str(report or ""))]
            opened = [f"open {shlex.quote(str(report))}"] if report is not None else []
            print_table(f"{told.counted} of {source}", rows, told.elsewhere)
            print_ending(found.verdict, [*opened, told.step.command])
        if strict and found.verdict.is_bad:
            raise typer.Exit(EXIT_UNSOLVABLE)


def _write_page(found: "CheckResult", page: Path, images: Path | None) -> None:
    """Write the page of a model, with small pictures of its images if they are at hand."""
    from sfm_shapefit.report.page import write_report
    from sfm_shapefit.report.sentences import shorten
    from sfm_shapefit.report.thumbnails import thumbnails_of

    pictures = thumbnails_of(found.drawing, images or "")
    if pictures is not None and not pictures:
        raise InputError(f"{images} has none of the images, such as {shorten(found.cameras[0].name)}")
    try:
        write_report(found.drawing, found.facts, page, pictures)
    except OSError as error:
        raise InputError(f"{page} cannot be written ({error.strerror}); choose another place") from error
