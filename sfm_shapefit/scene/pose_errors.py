"""Errors of camera poses as the field measures them: AUC of relative poses, ATE and RPE of a trajectory.

The error of a pair of cameras is the larger of the angle between its two relative rotations and the angle
between its two translation directions (Jin et al., "Image matching across wide baselines", 2021; so measure
SuperGlue, GLOMAP and others). No alignment has a part in it. The area under the curve (AUC) is that under the
recall as a function of the error, by trapezoids between the sorted errors, divided by the threshold.

ATE and RPE are those of evo and of Sturm et al. ("A benchmark for the evaluation of RGB-D SLAM systems",
2012): with poses P_k of the model, moved by the similarity of least squares (Umeyama) onto the reference's
Q_k, ATE is the distance of the centers, and RPE the translation and the angle of

    (Q_k^-1 Q_k+1)^-1 (P_k^-1 P_k+1)
"""

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.geometry import angle_between_deg, fit_similarity, normalized, rotation_angles_deg
from sfm_shapefit.base.record import Record

MOST_COMPARED_PAIRS = 2_000_000  # pairs of cameras; as many are drawn of more, by a fixed seed
# Distance of two cameras over the extent of all; closer ones have no direction from one to the other.
_COINCIDENT = 1e-9


class ErrorSummary(Record):
    """Statistics of one kind of error over the common cameras."""

    median: Annotated[float, "Of all errors."]
    mean: Annotated[float, "Of all errors."]
    rms: Annotated[float, "Root of the mean square."]
    max: Annotated[float, "The largest error."]


class TrajectoryErrors(Record):
    """Errors of cameras that follow one another in the order of their names, as evo defines them."""

    ate: Annotated[ErrorSummary, "Absolute trajectory error, in the reference's units."]
    rpe: Annotated[ErrorSummary, "Translation of the relative pose error of neighbors, in these units."]
    rpe_rotation_deg: Annotated[ErrorSummary, "Angle of the relative pose error of neighbors."]


class NamedPoses(NamedTuple):
    """n cameras, known by their names."""

    names: tuple[str, ...]
    """Each distinct."""
    rotations: FloatArray
    """(n, 3, 3) cam_from_world."""
    centers: FloatArray
    """(n, 3) in world axes."""

    def taken(self, order: IntArray) -> "NamedPoses":
        """Return some of the cameras, in another order."""
        names = tuple(self.names[k] for k in order.tolist())
        return NamedPoses(names, self.rotations[order], self.centers[order])


def summarize_errors(errors: FloatArray) -> ErrorSummary:
    """Return the statistics of errors of shape (k,)."""
    return ErrorSummary(
        median=float(np.median(errors)),
        mean=float(errors.mean()),
        rms=float(np.sqrt(np.mean(errors**2))),
        max=float(errors.max()),
    )


def area_under_recall(errors: FloatArray, num_missing: int, thresholds: Sequence[float]) -> list[float]:
    """Return the area under the recall of errors (k,) up to each threshold, divided by it.

    Args:
        errors: those that are known.
        num_missing: how many more there should be; their errors are infinite.
        thresholds: positive.
    """
    total = len(errors) + num_missing
    known = np.concatenate([[0.0], np.sort(errors)])
    recall = np.arange(len(known)) / max(total, 1)
    areas = []
    for threshold in thresholds:
        count = int(np.searchsorted(known, threshold, side="right"))
        x = np.append(known[:count], threshold)
        y = np.append(recall[:count], recall[count - 1])
        areas.append(float(np.trapezoid(y, x)) / threshold)
    return areas


def relative_pose_errors(model: NamedPoses, reference: NamedPoses, extent: float) -> FloatArray:
    """Return the error of each pair of n cameras in degrees, of at most `MOST_COMPARED_PAIRS` pairs.

    Args:
        model, reference: the same cameras in two worlds.
        extent: of the reference's cameras, which says when two of them stand at one place; then their
            rotations alone are compared.
    """
    first, second = _pairs(len(model.centers))
    turns = [poses.rotations[second] @ _transposed(poses.rotations[first]) for poses in (model, reference)]
    errors = rotation_angles_deg(turns[0] @ _transposed(turns[1]))
    baselines = [
        np.einsum("kab,kb->ka", poses.rotations[first], poses.centers[second] - poses.centers[first])
        for poses in (model, reference)
    ]
    apart = np.linalg.norm(baselines[1], axis=1) > _COINCIDENT * extent
    angles = angle_between_deg(normalized(baselines[0][apart]), normalized(baselines[1][apart]))
    # What has no baseline at all in the model has no direction either: that is no small error.
    angles = np.nan_to_num(angles, nan=180.0)
    errors[apart] = np.maximum(errors[apart], angles)
    return np.asarray(errors)


def trajectory_errors(model: NamedPoses, reference: NamedPoses) -> TrajectoryErrors:
    """Return ATE and RPE of n corresponding cameras in the order of time."""
    onto = fit_similarity(model.centers, reference.centers)
    moved = NamedPoses(model.names, model.rotations @ onto.rotation.T, onto.apply(model.centers))
    turns, shifts = [], []
    for poses in (moved, reference):
        earlier, after = poses.rotations[:-1], poses.rotations[1:]
        turns.append(earlier @ _transposed(after))
        shifts.append(np.einsum("kab,kb->ka", earlier, np.diff(poses.centers, axis=0)))
    return TrajectoryErrors(
        ate=summarize_errors(np.linalg.norm(moved.centers - reference.centers, axis=1)),
        rpe=summarize_errors(np.linalg.norm(shifts[0] - shifts[1], axis=1)),
        rpe_rotation_deg=summarize_errors(rotation_angles_deg(_transposed(turns[1]) @ turns[0])),
    )


def _pairs(n: int) -> tuple[IntArray, IntArray]:
    """Return the cameras of all pairs i < j of n, or of as many as are looked at."""
    if n * (n - 1) // 2 <= MOST_COMPARED_PAIRS:
        first, second = np.triu_indices(n, 1)
        return first, second
    rng = np.random.default_rng(0)
    first = rng.integers(0, n, MOST_COMPARED_PAIRS)
    second = (first + rng.integers(1, n, MOST_COMPARED_PAIRS)) % n
    return np.minimum(first, second), np.maximum(first, second)


def _transposed(matrices: FloatArray) -> FloatArray:
    return np.swapaxes(matrices, 1, 2)
