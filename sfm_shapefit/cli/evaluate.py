"""`sfm-shapefit evaluate MODEL REF`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm_shapefit.cli.app import app
from sfm_shapefit.cli.console import Rows, print_json, print_table, report_errors, shorten
from sfm_shapefit.cli.flags import GroupedCommand, InputPath, Json, ModelArgument, one_path
from sfm_shapefit.errors import InputError

if TYPE_CHECKING:
    from sfm_shapefit.evaluation import Evaluation


@app.command(
    "evaluate",
    cls=GroupedCommand,
    short_help="Compare a model's poses with those of a reference.",
    epilog="Example: sfm-shapefit evaluate out truth --csv errors.csv",
)
def evaluate_command(
    model: ModelArgument = None,
    reference: Annotated[
        Path | None, typer.Argument(metavar="REF", help="COLMAP model with the true poses.")
    ] = None,
    *,
    input_path: InputPath = None,
    threshold: Annotated[
        list[float] | None,
        typer.Option("--threshold", help="Recall at this position error in REF's units; may be repeated."),
    ] = None,
    csv: Annotated[
        Path | None, typer.Option("--csv", metavar="FILE", help="Write one row per camera to FILE.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare the camera poses of MODEL with those of REF, after a robust similarity alignment."""
    source = one_path(model, input_path, "MODEL")
    truth = one_path(reference, None, "REF")
    with report_errors():
        from sfm_shapefit.commands.evaluate import evaluate
        from sfm_shapefit.results.tables import write_records

        errors = evaluate(source, truth, thresholds=threshold or ())
        if csv is not None:
            if csv.exists() and csv.suffix.lower() != ".csv":
                raise InputError(f"{csv} exists and is no .csv file; choose another name")
            write_records(errors.rows(), csv)
        if as_json:
            print_json(errors.summary())
        else:
            print_table(f"{source} against {truth}", _evaluation_table(errors))


def _evaluation_table(errors: "Evaluation") -> Rows:
    """Return the errors in the reference's units."""
    position, rotation = errors.position, errors.rotation_deg
    recall = "\n".join(f"{r.recall:.1%} within {r.threshold:.4g}" for r in errors.recalls)
    return [
        ("cameras", f"{len(errors.names)} in common of {len(errors.names) + len(errors.missing)}"),
        *([("missing", shorten(errors.missing))] if errors.missing else []),
        (
            "position error",
            f"median {position.median:.4g}, mean {position.mean:.4g}, max {position.max:.4g} "
            f"(the reference's cameras extend over {errors.extent:.4g})",
        ),
        (
            "rotation error",
            f"median {rotation.median:.4g}, mean {rotation.mean:.4g}, max {rotation.max:.4g} deg",
        ),
        ("recall", recall),
        *[("warning", warning) for warning in errors.warnings],
    ]
