"""`sfm-shapefit evaluate MODEL REF`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.wording import rounded
from sfm_shapefit.cli.console import SEE_JSON, Rows, print_json, print_table, report_errors, shorten
from sfm_shapefit.cli.flags import GroupedCommand, InputPath, Json, ModelArgument, one_path
from sfm_shapefit.cli.root import app

if TYPE_CHECKING:
    from sfm_shapefit.scene.evaluation import Evaluation, PositionEvaluation, Recall
    from sfm_shapefit.scene.pose_errors import ErrorSummary

_ROUNDING = 1e-9
"""Errors in degrees, and in the extent, that are no more than rounding."""
_WORST_SHOWN = 3
_TABLES = {".csv", ".txt"}


@app.command(
    "evaluate",
    cls=GroupedCommand,
    short_help="Compare a model's poses with those of a reference.",
    epilog="Example: sfm-shapefit evaluate out truth --csv errors.csv",
)
def evaluate_command(
    model: ModelArgument = None,
    reference: Annotated[
        Path | None,
        typer.Argument(
            metavar="REF",
            help="COLMAP model with the true poses, or a table (.csv, .txt) of known positions such as GPS.",
        ),
    ] = None,
    *,
    input_path: InputPath = None,
    threshold: Annotated[
        list[float] | None,
        typer.Option(
            "--threshold",
            metavar="DISTANCE",
            help="Recall and AUC at this position error in REF's units; may be repeated.",
        ),
    ] = None,
    trajectory: Annotated[
        bool,
        typer.Option(
            "--trajectory", help="Also ATE and RPE, as evo defines them, of the images in the order of names."
        ),
    ] = False,
    csv: Annotated[
        Path | None, typer.Option("--csv", metavar="FILE", help="Write one row per camera to FILE.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare the camera poses of MODEL with those of REF, after a robust similarity alignment."""
    source = one_path(model, input_path, "MODEL")
    truth = one_path(reference, None, "REF")
    with report_errors():
        from sfm_shapefit.facts.tables import write_records
        from sfm_shapefit.pipeline.evaluate import evaluate, evaluate_against_table

        errors: Evaluation | PositionEvaluation
        if truth.is_file() and truth.suffix.lower() in _TABLES:
            if threshold or trajectory:
                raise InputError("a table of positions has no thresholds and no trajectory; leave these out")
            errors = evaluate_against_table(source, truth)
        else:
            errors = evaluate(source, truth, thresholds=threshold or (), trajectory=trajectory)
        if csv is not None:
            if csv.exists() and csv.suffix.lower() != ".csv":
                raise InputError(f"{csv} exists and is no .csv file; choose another name")
            write_records(errors.rows(), csv)
        if as_json:
            print_json(errors.summary())
        else:
            title = f"{source} against {truth}"
            print_table(title, _rows_of(errors))


def _rows_of(errors: "Evaluation | PositionEvaluation") -> Rows:
    """Return the errors against a model or known positions."""
    from sfm_shapefit.scene.evaluation import Evaluation

    return _evaluation_table(errors) if isinstance(errors, Evaluation) else _position_table(errors)


def _position_table(errors: "PositionEvaluation") -> Rows:
    """Return the errors against known positions."""
    rows = [
        ("cameras", f"{len(errors.names)} in common of {len(errors.names) + len(errors.missing)}"),
        ("compared", errors.statement),
    ]
    if errors.position is not None:
        offset = ", ".join(rounded(value) for value in errors.summary()["median_offset"])
        rows += [("position error", _describe(errors.position)), ("median offset", offset)]
    scale = errors.ref_from_model.scale
    return [*rows, ("after alignment", f"{_describe(errors.aligned)}; scale {scale:.6g}")]


def _evaluation_table(errors: "Evaluation") -> Rows:
    """Return the errors in the reference's units."""
    smallest = _ROUNDING * errors.extent
    worst = [
        f"{row['name']}: {rounded(row['position_error'], smallest)}, {rounded(row['rotation_error_deg'])} deg"
        for row in errors.worst(_WORST_SHOWN)
    ]
    aucs = [f"{100.0 * auc.auc:.1f} at {auc.threshold_deg:g} deg" for auc in errors.relative_pose_aucs]
    return [
        ("cameras", f"{len(errors.names)} in common of {len(errors.names) + len(errors.missing)}"),
        *([("missing", shorten(errors.missing, SEE_JSON))] if errors.missing else []),
        (
            "position error",
            f"{_describe(errors.position, smallest)}\n"
            f"(the reference's cameras extend over {errors.extent:.4g})",
        ),
        ("rotation error", f"{_describe(errors.rotation_deg)} deg"),
        ("relative pose AUC", ", ".join(aucs)),
        *_trajectory_rows(errors, smallest),
        ("within", "\n".join(map(_describe_recall, errors.recalls))),
        ("worst cameras", "\n".join(worst)),
        *[("warning", warning) for warning in errors.warnings],
    ]


def _describe(error: "ErrorSummary", smallest: float = _ROUNDING) -> str:
    """Return an error in words; what is no larger than rounding is 0."""
    return ", ".join(
        f"{name} {rounded(getattr(error, name), smallest)}" for name in ("median", "mean", "max")
    )


def _describe_recall(recall: "Recall") -> str:
    """Say how many cameras are within a threshold, and what share of the extent it is."""
    fraction = recall.fraction_of_extent
    of_extent = "" if fraction is None else f" ({100.0 * fraction:g}% of the extent)"
    return (
        f"{recall.threshold:.4g}{of_extent}: {recall.recall:.1%} of the cameras, AUC {100.0 * recall.auc:.1f}"
    )


def _trajectory_rows(errors: "Evaluation", smallest: float) -> Rows:
    """Return ATE and RPE, if they were asked for."""
    found = errors.trajectory
    if found is None:
        return []
    turned = rounded(found.rpe_rotation_deg.rms)
    return [
        ("ATE", f"rms {rounded(found.ate.rms, smallest)}, {_describe(found.ate, smallest)}"),
        ("RPE", f"rms {rounded(found.rpe.rms, smallest)} and {turned} deg, per image"),
    ]
