"""Errors of camera poses against a reference, after a robust alignment of positions and one of rotations.

A reconstruction is known up to a similarity. The centers are aligned by the similarity with the least sum of
min(distance, cap), cap = half of the reference's median spread: an L1 fit for which a camera that has flown
away is lost and pulls no more, so that half of the cameras may be anywhere (`geometry.fit_similarity_l1`).
The rotations are compared independently of that: with ref_from_model = Q, a perfect camera has
R_ref = R_model Q^T, so Q is the L1 mean of the R_ref^T R_model, and the error is the angle of what remains.

Recall at a threshold is the share of *all* reference cameras whose position error is at most the threshold;
a camera that the model misses counts as a failure. AUC of relative poses, ATE and RPE are those of
`pose_errors`, on which the alignment has no influence, or one of their own.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, frozen
from sfm_shapefit.base.display import Displayed
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import (
    Alignment,
    Similarity,
    fit_similarity,
    fit_similarity_l1,
    mean_rotation_l1,
    median_spread,
    rotation_angles_deg,
)
from sfm_shapefit.base.record import Record
from sfm_shapefit.scene.pose_errors import (
    ErrorSummary,
    NamedPoses,
    TrajectoryErrors,
    area_under_recall,
    relative_pose_errors,
    summarize_errors,
    trajectory_errors,
)
from sfm_shapefit.scene.same_images import same_images

_ON_A_LINE = (
    "the camera centers lie on a line, so the alignment's rotation about it is arbitrary; position errors "
    "across the line are a lower bound"
)

# Errors of relative poses in degrees up to which the area under the recall is given; from fine to coarse.
AUC_THRESHOLDS_DEG = (0.5, 1.0, 5.0, 10.0)
# Position errors at which recall is always given, as shares of the reference's extent; three to a decade.
RELATIVE_THRESHOLDS = (0.001, 0.003, 0.01, 0.03, 0.1)
_WORST = 10  # worst cameras that are named; more would hide the figures above them
_MIN_COMMON = 3  # centers in common; fewer never determine a similarity
_FEWEST_CHECKED = 5  # centers; fewer, less the seven unknowns of a similarity, do not tell who is wrong
# Caps of 0.3 and 0.5 survived every corruption of half of the cameras minus one that was tried; a cap of 1
# failed on some sets of 7 and 11 cameras.
_CAP_OF_SPREAD = 0.5
_OTHER_SCENE_DEG = 20.0  # degrees; poses that are only rough are nearer, unlike scenes 30 and more apart
_COLLINEAR_RATIO = 1e-3  # second over first singular value of the centers; with less they are a line


class Recall(Record):
    """The share of the reference's cameras that are placed to within a threshold."""

    threshold: Annotated[float, "Position error, in the reference's units."]
    fraction_of_extent: Annotated[
        float | None,
        "The threshold as a fraction of the reference's extent; null for one given in the reference's units.",
    ]
    recall: Annotated[float, "In [0, 1]; cameras that the model misses count as failures."]
    auc: Annotated[float, "Area under the recall up to the threshold, divided by it, in [0, 1]."]


class RelativePoseAuc(Record):
    """How well the relative poses of all pairs of the reference's cameras are known."""

    threshold_deg: Annotated[float, "The larger of the angles of rotation and of translation direction."]
    auc: Annotated[
        float, "Area under the recall up to the threshold, divided by it; pairs that the model misses fail."
    ]


class WorstCamera(Record):
    """A camera that is farthest off."""

    name: Annotated[str, "Of its image."]
    position_error: Annotated[float, "In the reference's units."]
    rotation_error_deg: Annotated[float, "What remains after the best global rotation."]


class EvaluationFacts(Record):
    """What `sfm-shapefit evaluate --json` prints."""

    num_reference: Annotated[int, "Cameras of the reference."]
    num_model: Annotated[int, "Cameras of the model."]
    num_common: Annotated[int, "Cameras of both, by name."]
    num_missing: Annotated[int, "Cameras that the model lacks."]
    num_extra: Annotated[int, "Cameras that the reference lacks."]
    missing: Annotated[tuple[str, ...], "Names of the cameras that the model lacks."]
    extra: Annotated[tuple[str, ...], "Names of the cameras that the reference lacks."]
    extent: Annotated[float, "Diagonal of the reference's cameras."]
    position_error: Annotated[ErrorSummary, "In the reference's units."]
    rotation_error_deg: Annotated[ErrorSummary, "What remains after the best global rotation."]
    recall: Annotated[
        tuple[Recall, ...], "At shares of the extent, then at the thresholds that were asked for."
    ]
    relative_pose_auc: Annotated[
        tuple[RelativePoseAuc, ...],
        "Over all pairs of the reference's cameras, at 0.5, 1, 5 and 10 degrees.",
    ]
    trajectory: Annotated[
        TrajectoryErrors | None,
        "ATE and RPE in the order of the names; null unless --trajectory asks for them.",
    ]
    worst: Annotated[list[WorstCamera], "The ten cameras with the largest position errors, the worst first."]
    ref_from_model: Annotated[Alignment, "From the model's world to the reference's."]
    rotation_ref_from_model: Annotated[list[list[float]], "The rotations' own alignment, 3 rows."]
    degenerate: Annotated[bool, "Whether the centers lie on a line."]
    warnings: Annotated[tuple[str, ...], "What the user should know, a sentence each."]


class PositionFacts(Record):
    """What `sfm-shapefit evaluate --json` prints against a table of known positions."""

    statement: Annotated[str, "What is compared with what, in words."]
    num_reference: Annotated[int, "Cameras of the table."]
    num_common: Annotated[int, "Cameras of both, by name."]
    missing: Annotated[tuple[str, ...], "Names of the cameras that the model lacks."]
    position_error: Annotated[
        ErrorSummary | None, "As they stand, in the table's units; null if the model has no datum."
    ]
    median_offset: Annotated[
        list[float] | None, "Model minus table as they stand, the median of each axis; else null."
    ]
    aligned_position_error: Annotated[ErrorSummary, "After the robust similarity that fits best."]
    ref_from_model: Annotated[Alignment, "From the model's world to the table's."]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Evaluation(Displayed):
    """Errors of a model's camera poses against a reference. Arrays are read-only."""

    names: tuple[str, ...]
    """The k common cameras, in the reference's order."""
    missing: tuple[str, ...]
    """Cameras of the reference that the model does not have."""
    extra: tuple[str, ...]
    """Cameras of the model that the reference does not have."""
    position_errors: FloatArray
    """(k,) distances between aligned and reference centers, in the reference's units."""
    rotation_errors_deg: FloatArray
    """(k,) angles that remain after the best global rotation."""
    aligned_centers: FloatArray
    """(k, 3) the model's centers in the reference's frame."""
    ref_from_model: Similarity
    """The alignment of the centers."""
    rotation_ref_from_model: FloatArray
    """(3, 3) the alignment of the rotations, found without the centers."""
    extent: float
    """Diagonal of the bounding box of all reference centers, in the reference's units."""
    recalls: tuple[Recall, ...]
    """Recall at the relative thresholds, then at the absolute ones that were asked for."""
    relative_pose_aucs: tuple[RelativePoseAuc, ...]
    """The area under the recall of the errors of pairs at 0.5, 1, 5 and 10 degrees."""
    trajectory: TrajectoryErrors | None
    """ATE and RPE of the common cameras in the order of their names; None if not asked for."""
    warnings: tuple[str, ...]
    """What a reader of the numbers must know; one sentence each."""

    @property
    def degenerate(self) -> bool:
        """Whether the centers lie on a line: the rotation of `ref_from_model` about it is arbitrary."""
        return _ON_A_LINE in self.warnings

    @property
    def position(self) -> ErrorSummary:
        """Statistics of the position errors, in the reference's units."""
        return summarize_errors(self.position_errors)

    @property
    def rotation_deg(self) -> ErrorSummary:
        """Statistics of the rotation errors, in degrees."""
        return summarize_errors(self.rotation_errors_deg)

    @property
    def facts(self) -> EvaluationFacts:
        """The figures, as they stand in JSON."""
        return EvaluationFacts.taken_from(
            self,
            num_reference=len(self.names) + len(self.missing),
            num_model=len(self.names) + len(self.extra),
            num_common=len(self.names),
            num_missing=len(self.missing),
            num_extra=len(self.extra),
            position_error=self.position,
            rotation_error_deg=self.rotation_deg,
            recall=self.recalls,
            relative_pose_auc=self.relative_pose_aucs,
            worst=self.worst(),
            ref_from_model=self.ref_from_model.facts,
            rotation_ref_from_model=self.rotation_ref_from_model.tolist(),
        )

    def _headline(self) -> str:
        median, worst = self.position.median, self.position.max
        return f"{len(self.names)} cameras in common, position error {median:.3g} (median), {worst:.3g} (max)"

    def worst(self, count: int = _WORST) -> list[WorstCamera]:
        """Return the cameras that are farthest off."""
        return [
            WorstCamera(
                name=self.names[k],
                position_error=float(self.position_errors[k]),
                rotation_error_deg=float(self.rotation_errors_deg[k]),
            )
            for k in np.argsort(-self.position_errors, kind="stable")[:count].tolist()
        ]

    def rows(self) -> list[dict[str, str | float]]:
        """Return one row per common camera, for a table: errors and the aligned center."""
        keys = ("name", "position_error", "rotation_error_deg", "x", "y", "z")
        errors = np.column_stack([self.position_errors, self.rotation_errors_deg, self.aligned_centers])
        return [
            dict(zip(keys, (name, *row), strict=True))
            for name, row in zip(self.names, errors.tolist(), strict=True)
        ]


def evaluate_poses(
    model: NamedPoses,
    reference: NamedPoses,
    thresholds: Sequence[float] = (),
    *,
    trajectory: bool = False,
) -> Evaluation:
    """Compare a model's camera poses with a reference's; cameras correspond by name.

    Args:
        model, reference: the two.
        thresholds: position errors in the reference's units at which recall and its AUC are given too.
        trajectory: also compute ATE and RPE of the common cameras in the order of their names.

    Raises:
        InputError: if a threshold is not positive, fewer than 3 cameras are common, or all common centers of
            either side coincide.
    """
    for threshold in thresholds:
        if not (np.isfinite(threshold) and threshold > 0.0):
            raise InputError(f"a recall threshold must be a positive number, got {threshold}")
    in_model, in_ref, ambiguity = _common_cameras(model.names, reference.names)
    ours, theirs = model.taken(in_model), reference.taken(in_ref)
    x, y = ours.centers, theirs.centers
    _refuse_coincident("the model", x)
    _refuse_coincident("the reference", y)

    cap = _CAP_OF_SPREAD * median_spread(y)
    ref_from_model = _align(x, y)
    aligned = ref_from_model.apply(x)
    errors = np.linalg.norm(aligned - y, axis=1)
    turns = np.swapaxes(theirs.rotations, 1, 2) @ ours.rotations
    global_rotation = mean_rotation_l1(turns)

    turned_deg = rotation_angles_deg(turns @ global_rotation.T)
    close = errors < cap
    degenerate = _on_a_line(x, close) or _on_a_line(y, close)
    extent = float(np.linalg.norm(np.ptp(reference.centers, axis=0)))
    pair_errors = relative_pose_errors(ours, theirs, extent)
    in_time = np.argsort(np.array(theirs.names), kind="stable")
    return Evaluation(
        names=theirs.names,
        missing=_without(reference.names, in_ref),
        extra=_without(model.names, in_model),
        position_errors=frozen(errors),
        rotation_errors_deg=frozen(turned_deg),
        aligned_centers=frozen(aligned),
        ref_from_model=ref_from_model,
        rotation_ref_from_model=frozen(global_rotation),
        extent=extent,
        recalls=_recalls(errors, len(reference.names), extent, thresholds),
        relative_pose_aucs=_relative_pose_aucs(pair_errors, len(in_ref), len(reference.names)),
        trajectory=trajectory_errors(ours.taken(in_time), theirs.taken(in_time)) if trajectory else None,
        warnings=(*_warnings(degenerate, close, cap, turned_deg), *filter(None, [ambiguity])),
    )


def _without(names: Sequence[str], places: IntArray) -> tuple[str, ...]:
    known = set(places.tolist())
    return tuple(name for place, name in enumerate(names) if place not in known)


def _common_cameras(names: Sequence[str], ref_names: Sequence[str]) -> tuple[IntArray, IntArray, str]:
    """Return the indices of the common cameras in both lists, in the reference's order, and `ambiguity`."""
    places, ambiguity = same_images(ref_names, names)
    in_ref = np.flatnonzero(places >= 0)
    if len(in_ref) < _MIN_COMMON:
        only = {"model": _without(names, places[in_ref]), "reference": _without(ref_names, in_ref)}
        examples = [f"only the {owner} has '{missed[0]}'" for owner, missed in only.items() if missed]
        shown = f": {'; '.join(filter(None, [', '.join(examples), ambiguity]))}" if examples else ""
        raise InputError(
            f"the model ({len(names)} cameras) and the reference ({len(ref_names)}) share {len(in_ref)} image"
            f" names{shown}; at least {_MIN_COMMON} must be equal, as an alignment leaves two without errors"
        )
    return places[in_ref], in_ref, ambiguity


def _align(x: FloatArray, y: FloatArray) -> Similarity:
    """Return the robust similarity from x to y (k, 3); of few, which cannot outvote one, the plain one."""
    if len(x) < _FEWEST_CHECKED:
        return fit_similarity(x, y)
    return fit_similarity_l1(x, y, cap=_CAP_OF_SPREAD * median_spread(y))


def _say_few(count: int) -> str:
    """Say how much of the errors of so few cameras an alignment takes up; empty for more."""
    if count >= _FEWEST_CHECKED:
        return ""
    return (
        f"the alignment of {count} cameras takes up 7 of their {3 * count} coordinates, and with them most "
        "of the errors: compare more"
    )


def _refuse_coincident(owner: str, centers: FloatArray) -> None:
    """Raise InputError if all centers are the same to rounding."""
    rounding = 1e-12 * float(np.abs(centers).max())
    if float(np.ptp(centers, axis=0).max()) <= rounding:
        raise InputError(
            f"all common cameras of {owner} are at one point, so nothing can be aligned; place them first"
        )


def _on_a_line(centers: FloatArray, close: BoolArray) -> bool:
    """Whether the centers that the alignment rests on lie on a line; of all, if too few are close."""
    used = centers[close] if close.sum() >= _MIN_COMMON else centers
    spreads = np.linalg.svd(used - used.mean(axis=0), compute_uv=False)
    return bool(spreads[1] <= _COLLINEAR_RATIO * spreads[0])


def _recalls(
    errors: FloatArray, num_reference: int, extent: float, thresholds: Sequence[float]
) -> tuple[Recall, ...]:
    """Return the recall at the relative thresholds and at the given absolute ones."""
    relative = [(fraction * extent, fraction) for fraction in RELATIVE_THRESHOLDS]
    absolute = [(float(threshold), None) for threshold in thresholds]
    both = [*relative, *absolute]
    num_missing = num_reference - len(errors)
    aucs = area_under_recall(errors, num_missing, [threshold for threshold, _ in both])
    return tuple(
        Recall(
            threshold=threshold,
            fraction_of_extent=fraction,
            recall=float(np.count_nonzero(errors <= threshold)) / num_reference,
            auc=auc,
        )
        for (threshold, fraction), auc in zip(both, aucs, strict=True)
    )


def _relative_pose_aucs(
    errors: FloatArray, num_common: int, num_reference: int
) -> tuple[RelativePoseAuc, ...]:
    """Return the areas of all pairs of the reference's cameras, of which the model has those of `errors`."""
    of_common = num_common * (num_common - 1) / (num_reference * (num_reference - 1))
    num_missing = round(len(errors) * (1.0 / of_common - 1.0))
    areas = area_under_recall(errors, num_missing, AUC_THRESHOLDS_DEG)
    return tuple(
        RelativePoseAuc(threshold_deg=threshold, auc=area)
        for threshold, area in zip(AUC_THRESHOLDS_DEG, areas, strict=True)
    )


def _warnings(degenerate: bool, close: BoolArray, cap: float, turned_deg: FloatArray) -> tuple[str, ...]:
    sentences = [few] if (few := _say_few(len(close))) else []
    if (turn := float(np.median(turned_deg))) > _OTHER_SCENE_DEG:
        sentences.append(
            f"rotations differ by {turn:.0f} degrees, median: do both models show the same scene?"
        )
    if degenerate:
        sentences.append(_ON_A_LINE)
    if 2 * int(close.sum()) <= len(close):
        sentences.append(
            f"only {int(close.sum())} of {len(close)} common cameras lie within {cap:.3g} of the reference;"
            " the alignment may rest on the wrong ones"
        )
    return tuple(sentences)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class PositionEvaluation(Displayed):
    """Errors of a model's camera centers against positions measured otherwise, such as by GPS."""

    names: tuple[str, ...]
    """The k common cameras, in the reference's order."""
    missing: tuple[str, ...]
    """Cameras of the reference that the model does not have."""
    offsets: FloatArray | None
    """(k, 3) model minus reference as they stand, in the reference's axes and units; None if these are not
    the model's."""
    aligned_errors: FloatArray
    """(k,) distances after the robust similarity that fits best, in the reference's units."""
    ref_from_model: Similarity
    """That similarity."""
    statement: str
    """What is compared with what, in words."""

    @property
    def position(self) -> ErrorSummary | None:
        """Statistics of the distances as they stand; None if they mean nothing."""
        return None if self.offsets is None else summarize_errors(np.linalg.norm(self.offsets, axis=1))

    @property
    def aligned(self) -> ErrorSummary:
        """Statistics of the distances after the alignment."""
        return summarize_errors(self.aligned_errors)

    @property
    def facts(self) -> PositionFacts:
        """The figures, as they stand in JSON."""
        offsets = self.offsets
        return PositionFacts(
            statement=self.statement,
            num_reference=len(self.names) + len(self.missing),
            num_common=len(self.names),
            missing=self.missing,
            position_error=self.position,
            median_offset=None if offsets is None else np.median(offsets, axis=0).tolist(),
            aligned_position_error=self.aligned,
            ref_from_model=self.ref_from_model.facts,
        )

    def _headline(self) -> str:
        return (
            f"{len(self.names)} cameras in common, position error {self.aligned.median:.3g} (median, aligned)"
        )

    def rows(self) -> list[dict[str, str | float]]:
        """Return one row per common camera, for a table."""
        offsets = np.full((len(self.names), 3), np.nan) if self.offsets is None else self.offsets
        errors = np.column_stack([offsets, self.aligned_errors]).tolist()
        keys = ("name", "offset_x", "offset_y", "offset_z", "aligned_error")
        return [
            dict(zip(keys, (name, *row), strict=True)) for name, row in zip(self.names, errors, strict=True)
        ]


def evaluate_positions(
    model: tuple[Sequence[str], FloatArray],
    reference: tuple[Sequence[str], FloatArray],
    statement: str,
    *,
    as_they_stand: bool,
) -> PositionEvaluation:
    """Compare camera centers (n, 3) with known positions, each by distinct names.

    Args:
        model, reference: names and positions.
        statement: what is compared with what.
        as_they_stand: whether both are in the same axes and units.

    Raises:
        InputError: if fewer than 3 cameras are common, or those of either side coincide.
    """
    in_model, in_ref, _ = _common_cameras(model[0], reference[0])
    x, y = model[1][in_model], reference[1][in_ref]
    _refuse_coincident("the model", x)
    _refuse_coincident("the reference", y)
    ref_from_model = _align(x, y)
    return PositionEvaluation(
        names=tuple(reference[0][k] for k in in_ref),
        missing=_without(reference[0], in_ref),
        offsets=frozen(x - y) if as_they_stand else None,
        aligned_errors=frozen(np.linalg.norm(ref_from_model.apply(x) - y, axis=1)),
        ref_from_model=ref_from_model,
        statement="; ".join(filter(None, [statement, _say_few(len(x))])),
    )
