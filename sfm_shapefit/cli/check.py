"""`sfm-shapefit check MODEL`."""

import shlex
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.libraries import import_packages
from sfm_shapefit.cli.console import (
    EXIT_UNSOLVABLE,
    print_answer,
    print_ending,
    print_json,
    print_lines,
    report_errors,
)
from sfm_shapefit.cli.flags import (
    STRICT_HELP,
    Database,
    GroupedCommand,
    ImageFolder,
    InputPath,
    Json,
    ModelArgument,
    Quiet,
    ScaleBarsFile,
    one_path,
)
from sfm_shapefit.cli.forecast import PLANS
from sfm_shapefit.cli.progress import show_progress
from sfm_shapefit.cli.root import app

if TYPE_CHECKING:
    from sfm_shapefit.facts.check_result import CheckResult
    from sfm_shapefit.facts.checked_pieces import CheckedPieces


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
    scale_bars: ScaleBarsFile = None,
    max_minutes: Annotated[
        float | None,
        typer.Option(
            "--max-minutes",
            min=0.0,
            metavar="NUMBER",
            help="Minutes after which no more images are matched, 0 for none; else all chosen ones are.",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace FILE, and OUT.")] = False,
    second_opinion: Annotated[
        Path | None,
        typer.Option(
            "--second-opinion",
            metavar="OUT",
            help="Keep the models that `map` makes of the database, which MODEL is compared with, in OUT.",
        ),
    ] = None,
    no_second_opinion: Annotated[
        bool, typer.Option("--no-second-opinion", help="Make none of the database, and compare with none.")
    ] = False,
    as_json: Json = False,
    strict: Annotated[
        bool, typer.Option("--strict", help=f"{STRICT_HELP}, or without matches to check by.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Judge the poses of MODEL as they stand, whatever program made it; MODEL is not changed.

    A camera is weak if it sees few points, if its errors are large, or if many pairs
    contradict it. Pairs come from the database, else from the images, else from the model's tracks.
    A folder of several models, as sparse with 0 and 1, gets one table, and which of them to keep.
    """
    source = one_path(model, input_path, "MODEL")
    with report_errors():
        from sfm_shapefit.files.model_folder import model_folders, refuse_no_model

        if len(model_folders(source)) > 1:
            _refuse_of_many(
                {"--report": report, "--second-opinion": second_opinion, "--images": images}
                | {"--scale-bars": scale_bars}
            )
            pieces = _check_pieces(source, database, not no_second_opinion, as_json=as_json, quiet=quiet)
            if strict:
                _be_strict(is_usable=bool(pieces.kept), has_matches=pieces.has_matches)
            return
        refuse_no_model(source)
        import_packages()
        from sfm_shapefit.base.atomic_folder import claimed_output
        from sfm_shapefit.commands.check import check
        from sfm_shapefit.files.colmap.listed_poses import read_source
        from sfm_shapefit.files.colmap.quiet import hear_pycolmap
        from sfm_shapefit.files.output_paths import refuse_file
        from sfm_shapefit.pipeline.inputs import inputs_to_check

        known = inputs_to_check(source, database).database
        if second_opinion is not None and no_second_opinion:
            raise InputError("--second-opinion and --no-second-opinion contradict each other; give one")
        _refuse_without_use(known, images, report, second_opinion, max_minutes)
        inputs = [path for path in (source, known, images, scale_bars) if path is not None]
        if report is not None:  # now, not when all is computed
            if report.exists() and not overwrite and (images is None or known is not None):
                read_source(source, database)  # what is wrong with that is said first
            refuse_file(report, overwrite=overwrite, protect=inputs)
        plan = () if known is None or no_second_opinion else PLANS["MODEL with a database"]
        bars = None
        if scale_bars is not None:
            from sfm_shapefit.commands.lengths import judge_bars

            bars = judge_bars(source, scale_bars)
        with (
            claimed_output(second_opinion, overwrite=overwrite, protect=inputs)
            if second_opinion
            else nullcontext(),
            show_progress(not (quiet or as_json), plan=plan) as progress,
            hear_pycolmap(False),
        ):
            found = check(
                source,
                database,
                images=images,
                max_minutes=max_minutes,
                second_opinion=not no_second_opinion,
                progress=progress,
            )
            found = _keep_second(found.with_bars(bars), second_opinion, overwrite=overwrite)
        if report is not None:
            found.report(report, images=images or "", overwrite=overwrite)
        if as_json:
            print_json(found.summary())
        elif not quiet:
            told = found.facts.told(found.cameras, found.pairs)
            print_answer(told)
            written = "" if report is None else f"written to {report}; open {shlex.quote(str(report))}"
            print_ending(found.verdict.grade.value, found.facts.told_verdict, written, told.step)
        if strict:
            _be_strict(is_usable=found.verdict.is_usable, has_matches=found.facts.has_matches)


def _be_strict(*, is_usable: bool, has_matches: bool) -> None:
    """End with exit code 4 unless a model can be used, and was compared with matches."""
    if is_usable and not has_matches:
        raise UnsolvableError(
            "--strict: the model was checked by its own tracks alone, which cannot show a fold; give its "
            "database (--database) or its photographs (--images)"
        )
    if not is_usable:
        raise typer.Exit(EXIT_UNSOLVABLE)


def _refuse_of_many(given: dict[str, Path | None]) -> None:
    """Raise InputError for flags that are of one model, where a folder of several is judged."""
    for flag, path in given.items():
        if path is not None:
            raise InputError(f"{flag} needs a single model; give one of those in the folder, or leave it out")


def _refuse_without_use(
    known: Path | None,
    images: Path | None,
    report: Path | None,
    second_opinion: Path | None,
    max_minutes: float | None,
) -> None:
    """Raise InputError for a flag that the matches of a `known` database, or their lack, make useless."""
    if second_opinion is not None and known is None:
        raise InputError("a second opinion needs the database of MODEL; name it with --database")
    if images is not None and report is None and known is not None:
        raise InputError(
            f"with a database ({known}), its matches are used and the images are not matched anew; "
            "leave --images out, or show the images on a page with --report"
        )
    if max_minutes is not None and (images is None or known is not None):
        raise InputError("--max-minutes is for images without a database; name their folder with --images")


def _keep_second(found: "CheckResult", out: Path | None, *, overwrite: bool) -> "CheckResult":
    """Write the models of the second opinion into a folder, if one is wanted, and return what tells of it."""
    if out is None:
        return found
    if found.second_opinion is None:
        note = f"{out} was not written: no model could be made of the database"
        return replace(found, facts=replace(found.facts, warnings=[*found.facts.warnings, note]))
    found.second_opinion.write(out, overwrite=overwrite)
    return replace(found, facts=replace(found.facts, second_opinion=str(out)))


def _check_pieces(
    folder: Path, database: Path | None, second_opinion: bool, *, as_json: bool, quiet: bool
) -> "CheckedPieces":
    """Judge the models in a folder, print one table, and return what was found."""
    from sfm_shapefit.commands.check import check_pieces
    from sfm_shapefit.files.colmap.quiet import hear_pycolmap

    with show_progress(not (quiet or as_json)) as progress, hear_pycolmap(False):
        found = check_pieces(folder, database, second_opinion=second_opinion, progress=progress)
    if as_json:
        print_json(found.summary())
    elif not quiet:
        told = found.told
        print_answer(told)
        if told.step.command:
            print_lines([told.step.line])
    return found
