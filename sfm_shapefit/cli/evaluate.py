"""`sfm-shapefit evaluate MODEL [REF]`."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sfm_shapefit.base.display import Row, row
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.wording import rounded
from sfm_shapefit.cli.console import print_json, print_lines, print_table, report_errors
from sfm_shapefit.cli.flags import (
    GroupedCommand,
    InputPath,
    Json,
    ModelArgument,
    ScaleBarsFile,
    one_path,
    split_values,
)
from sfm_shapefit.cli.root import app

if TYPE_CHECKING:
    from sfm_shapefit.scene.evaluation import Evaluation, PositionEvaluation, PositionFacts, Recall
    from sfm_shapefit.scene.pose_errors import ErrorSummary

_ROUNDING = 1e-9  # degrees, and share of the extent; smaller errors are rounding, and shown as 0
_WORST_SHOWN = 3  # cameras with the largest errors that the terminal names; --csv has all
_TABLES = {".csv", ".txt"}


class _OptionalReference(GroupedCommand):
    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        return [f"[{one}]" if one == "REF" else one for one in super().collect_usage_pieces(ctx)]


@app.command(
    "evaluate",
    cls=_OptionalReference,
    short_help="Compare a model's poses with a reference, or MODEL with control points or scale bars.",
    epilog="Example: sfm-shapefit evaluate out truth --csv errors.csv",
)
def evaluate_command(
    model: ModelArgument = None,
    reference: Annotated[
        Path | None,
        typer.Argument(
            metavar="REF",
            help="Model with the true poses, also transforms.json, or a table (.csv, .txt) of positions; "
            "without it: how well lengths of MODEL are known.",
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
    length: Annotated[
        list[str] | None,
        typer.Option(
            "--length",
            metavar="PLACE PLACE",
            help="The distance of two images, by name, or 3D points, by id; without REF; may be repeated.",
        ),
    ] = None,
    scale_bars: ScaleBarsFile = None,
    control_points: Annotated[
        Path | None,
        typer.Option("--control-points", metavar="FILE", help="Points of known position, as of `locate`."),
    ] = None,
    csv: Annotated[
        Path | None, typer.Option("--csv", metavar="FILE", help="Write one row per camera to FILE.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace FILE.")] = False,
    as_json: Json = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Also AUC of relative poses, and recall.")
    ] = False,
) -> None:
    """Compare the camera poses of MODEL with those of REF, after a robust similarity alignment.

    Without REF: how well lengths of MODEL are known, and how it compares with scale bars or control points.
    """
    source = one_path(model, input_path, "MODEL")
    if reference is None and not (threshold or trajectory or csv):
        known = {"scale_bars": scale_bars, "control_points": control_points}
        _tell_lengths(source, length or [], known, as_json=as_json)
        return
    truth = one_path(reference, None, "REF")
    if length or scale_bars or control_points:
        raise typer.BadParameter(
            "lengths, bars and points are of MODEL alone; leave REF out", param_hint="REF"
        )
    with report_errors():
        from sfm_shapefit.base.atomic_folder import atomic_file
        from sfm_shapefit.base.paths import refuse_absent
        from sfm_shapefit.commands.evaluate import evaluate, evaluate_against_table
        from sfm_shapefit.facts.tables import write_records
        from sfm_shapefit.files.output_paths import refuse_file

        if csv is not None:
            refuse_absent(source, truth)
            refuse_file(csv, overwrite=overwrite, protect=[source, truth])
        errors: Evaluation | PositionEvaluation
        if truth.is_file() and truth.suffix.lower() in _TABLES:
            if threshold or trajectory:
                raise InputError("a table of positions has no thresholds and no trajectory; leave these out")
            errors = evaluate_against_table(source, truth)
        else:
            errors = evaluate(source, truth, thresholds=threshold or (), trajectory=trajectory)
        if csv is not None:
            with atomic_file(csv) as partial:
                write_records(errors.rows(), partial)
        if as_json:
            print_json(errors.summary())
        else:
            title = f"{source} against {truth}"
            print_table(title, _told(errors, verbose=verbose or bool(threshold)), "see --json")
            if source.is_dir():
                print_lines([f"next: sfm-shapefit check {shlex.quote(str(source))}"])
            elif csv is None:
                both = f"{shlex.quote(str(source))} {shlex.quote(str(truth))}"
                print_lines([f"next: sfm-shapefit evaluate {both} --csv errors.csv"])


def _tell_lengths(source: Path, lengths: list[str], known: dict[str, Path | None], *, as_json: bool) -> None:
    with report_errors():
        from sfm_shapefit.base.paths import refuse_absent
        from sfm_shapefit.commands.lengths import evaluate_lengths

        refuse_absent(source, *filter(None, known.values()))
        ends = [split_values("length", one) for one in lengths]
        found = evaluate_lengths(source, ends, **known)
        if as_json:
            print_json(found.summary())
        else:
            print_table(str(source), found.told(), "see --json")
            model = shlex.quote(str(source))
            step = f"evaluate {model} --length PLACE PLACE" if not lengths else f"check {model}"
            if found.scale_sigma is None and not any(known.values()):
                step = f"locate {model} OUT --known-distance NAME NAME DISTANCE"
            print_lines([f"next: sfm-shapefit {step}"])


def _told(errors: "Evaluation | PositionEvaluation", *, verbose: bool) -> list[Row]:
    from sfm_shapefit.scene.evaluation import Evaluation

    common = f"{len(errors.names)} in common of {len(errors.names) + len(errors.missing)}"
    if isinstance(errors, Evaluation):
        rows = [*_evaluation_rows(errors), *(_recall_rows(errors) if verbose else ())]
    else:
        rows = _position_rows(errors.facts)
    return [row("cameras", common), *rows]


def _position_rows(facts: "PositionFacts") -> list[Row]:
    scale, aligned = facts.ref_from_model.scale, _describe(facts.aligned_position_error)
    return [
        row("compared", facts.statement),
        row("position error", _describe(facts.position_error) if facts.position_error else ""),
        row("median offset", ", ".join(map(rounded, facts.median_offset or ()))),
        row("after alignment", f"{aligned}; scale {scale:.6g}"),
    ]


def _evaluation_rows(errors: "Evaluation") -> list[Row]:
    """Return the errors in the reference's units."""
    smallest = _ROUNDING * errors.extent
    worst = [
        f"{one.name}: {rounded(one.position_error, smallest)}, {rounded(one.rotation_error_deg)} deg"
        for one in errors.worst(_WORST_SHOWN)
    ]
    return [
        Row("missing", errors.missing),
        row(
            "position error",
            f"{_describe(errors.position, smallest)} (REF's units; it spans {errors.extent:.4g})",
        ),
        row("rotation error", f"{_describe(errors.rotation_deg)} deg"),
        *_trajectory_rows(errors, smallest),
        Row("worst cameras", worst),
        *(row("warning", warning) for warning in errors.warnings),
    ]


def _recall_rows(errors: "Evaluation") -> list[Row]:
    aucs = [f"{100.0 * auc.auc:.1f} at {auc.threshold_deg:g} deg" for auc in errors.relative_pose_aucs]
    return [
        row("relative pose AUC", ", ".join(aucs)),
        row("within", "\n".join(map(_describe_recall, errors.recalls))),
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


def _trajectory_rows(errors: "Evaluation", smallest: float) -> list[Row]:
    found = errors.trajectory
    if found is None:
        return []
    turned = rounded(found.rpe_rotation_deg.rms)
    return [
        row("ATE", f"rms {rounded(found.ate.rms, smallest)}, {_describe(found.ate, smallest)}"),
        row("RPE", f"rms {rounded(found.rpe.rms, smallest)} and {turned} deg, per image"),
    ]
