"""`sfm-shapefit check MODEL`."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.cli.console import (
    EXIT_UNSOLVABLE,
    print_answer,
    print_ending,
    print_json,
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


@app.command(
    "check",
    cls=GroupedCommand,
    short_help="Judge any COLMAP model: can it be used, and which cameras are weak?",
    epilog="Example: sfm-shapefit check sparse/0 --images images --report check.html",
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
    max_minutes: Annotated[
        float | None,
        typer.Option(
            "--max-minutes",
            min=0.0,
            metavar="NUMBER",
            help="Minutes after which no more images are matched, 0 for none; else all chosen ones are.",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace FILE.")] = False,
    second_opinion: Annotated[
        bool,
        typer.Option(
            "--second-opinion/--no-second-opinion",
            help="Also make a model of the database with `map`, and compare the two.",
        ),
    ] = True,
    as_json: Json = False,
    strict: Annotated[
        bool, typer.Option("--strict", help='End with exit code 4 where the verdict is "do not use".')
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Judge the poses of MODEL as they stand, whatever program made it; MODEL is not changed.

    A camera is weak if it sees few points, if its errors are large, if its points cover little of the
    picture, or if many pairs contradict it. Pairs come from the database, else from the images, else from
    the model's tracks.
    """
    source = one_path(model, input_path, "MODEL")
    with report_errors():
        from sfm_shapefit.files.model_folder import refuse_no_model

        refuse_no_model(source)
        from sfm_shapefit.files.colmap.listed_poses import read_source
        from sfm_shapefit.files.colmap.quiet import hear_pycolmap
        from sfm_shapefit.pipeline.check import check
        from sfm_shapefit.pipeline.inputs import choose_inputs
        from sfm_shapefit.pipeline.write import refuse_file

        known = choose_inputs(source, database).database
        if images is not None and report is None and known is not None:
            raise InputError(
                f"the images are not asked, since the matches are those of {known}; "
                "leave them out, or name a page for them with --report"
            )
        if max_minutes is not None and (images is None or known is not None):
            raise InputError(
                "--max-minutes is for images without a database; name their folder with --images"
            )
        if report is not None:  # now, not when all is computed
            if report.exists() and not overwrite and (images is None or known is not None):
                read_source(source, database)  # what is wrong with that is said first
            inputs = [path for path in (source, known, images) if path is not None]
            refuse_file(report, overwrite=overwrite, protect=inputs)
        with show_progress(not (quiet or as_json)) as progress, hear_pycolmap(False):
            found = check(
                source,
                database,
                images=images,
                max_minutes=max_minutes,
                second_opinion=second_opinion,
                progress=progress,
            )
        if report is not None:
            found.report(report, images=images or "", overwrite=overwrite)
        if as_json:
            print_json(found.summary())
        elif not quiet:
            told = found.facts.told(found.cameras, found.pairs)
            print_answer(told)
            written = "" if report is None else f"written to {report}; open {shlex.quote(str(report))}"
            print_ending(found.verdict.grade.value, found.verdict.statement, written, told.step.command)
        if strict and found.verdict.is_bad:
            raise typer.Exit(EXIT_UNSOLVABLE)
