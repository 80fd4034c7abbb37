"""What is rigid by its graph and yet loose by its geometry.

The test of rigidity takes positions to be general. At the solution they need not be: cameras on a line see
each other along it, the pairs of a far camera are nearly parallel, the triangles of a distant group are
skinny. The covariance of the locations (`uncertainty`) sees all of these. Here its loose cameras are put into
groups that move together, with what makes them loose:

    few pairs   two agreeing pairs or fewer
    parallel    the directions of its agreeing pairs span a narrow cone: the camera may slide along it
    on a line   the group lies on a line, along which nothing fixes their spacing
    together    each camera is held well by its neighbors, the group is not held by the rest
    distance    nothing holds it at any distance: the refinement had thrown it out of the scene
"""

import enum
from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, distinct, sum_by
from sfm_shapefit.base.forests import connected_components
from sfm_shapefit.base.geometry import median_spread, normalized
from sfm_shapefit.solver.program import differences

LOOSE_SHARE = 0.05
"""Standard deviation from which a camera is loose; in median distances of the cameras from their median."""
FEW_PAIRS = 2
"""Pairs of a camera up to which they are too few to check one another: each fits one of its d unknowns."""
NEARLY_PARALLEL = 0.02
"""The `direction_spread` below which directions are nearly parallel: within about 8 degrees."""
_SMALLEST_LINE = 3  # cameras; two are on a line whatever they do
_ON_A_LINE = 0.02  # second over first singular value of positions; smaller on a line, bends included


class Looseness(enum.Enum):
    """Why cameras are loose; the value is what reports say."""

    UNTIED = "no agreeing pairs tie it to the others rigidly"
    FEW_PAIRS = "two agreeing pairs or fewer hold it"
    PARALLEL = "the directions of its agreeing pairs are nearly parallel"
    ON_A_LINE = "it is on a straight stretch, along which nothing fixes the spacing"
    DISTANCE = "its directions leave its distance open"
    TOGETHER = "it moves with its neighbors, which the rest does not hold"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LooseCameras:
    """Cameras that are loose together."""

    cameras: IntArray
    """Ascending."""
    cause: Looseness
    """Cause that most of them have."""
    sigma: float
    """Largest standard deviation among them, in the locations' units; infinite if nothing holds them."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Conditioning:
    """How well the agreeing pairs hold each camera."""

    num_pairs: IntArray
    """(k,) agreeing pairs of each camera."""
    causes: tuple[Looseness | None, ...]
    """k causes; None where a camera is not loose."""
    groups: tuple[LooseCameras, ...]
    """The largest standard deviation first."""


def condition(
    locations: FloatArray,
    edges: IntArray,
    inliers: BoolArray,
    sigmas: FloatArray,
    num_cameras: int,
    undetermined_nodes: IntArray | None = None,
) -> Conditioning:
    """Find the cameras that the pairs leave loose at the solution, and why.

    Args:
        locations: (n, d); the first `num_cameras` are cameras, the others points.
        edges: (m, 2).
        inliers: (m,) pairs that agree with the solution.
        sigmas: (n, d) standard deviations of the locations, infinite where nothing holds them.
        num_cameras: k.
        undetermined_nodes: nodes whose distance is open, with infinite standard deviations; none if None.
    """
    n = len(locations)
    is_undetermined = np.isin(np.arange(n), [] if undetermined_nodes is None else undetermined_nodes)
    used = edges[inliers]
    num_pairs = np.bincount(used.ravel(), minlength=n)
    narrowness = direction_spread(n, used, normalized(differences(locations, used)))
    largest = sigmas.max(axis=1)
    loose = largest > LOOSE_SHARE * median_spread(locations[:num_cameras])
    loose[num_cameras:] = False
    labels = connected_components(n, used[loose[used].all(axis=1)])
    causes: list[Looseness | None] = [None] * num_cameras
    groups = []
    for label in distinct(labels[loose]).tolist():
        members = np.flatnonzero(loose & (labels == label))
        is_straight = _is_straight(locations[members])
        for camera in members.tolist():
            causes[camera] = _cause(int(num_pairs[camera]), float(narrowness[camera]), float(largest[camera]))
            is_parallel = narrowness[camera] < NEARLY_PARALLEL
            if is_undetermined[camera] and (is_parallel or num_pairs[camera] > FEW_PAIRS):
                causes[camera] = Looseness.DISTANCE
            elif is_straight:
                causes[camera] = Looseness.ON_A_LINE
        cause = _most_frequent([causes[camera] for camera in members.tolist()])
        groups.append(LooseCameras(cameras=members, cause=cause, sigma=float(largest[members].max())))
    return Conditioning(
        num_pairs=num_pairs[:num_cameras].astype(np.int64),
        causes=tuple(causes),
        groups=tuple(sorted(groups, key=lambda group: (-group.sigma, int(group.cameras[0])))),
    )


def direction_spread(num_nodes: int, edges: IntArray, directions: FloatArray) -> FloatArray:
    """Return how far the directions (m, d) at each node are from parallel, (n,) in [0, 1]; 0 without any.

    The least over the greatest eigenvalue of the sum of I - u u^T: the squared ratio of the singular values
    of the stacked projectors. Directions that are not finite count as none.
    """
    d = directions.shape[1]
    projectors = np.nan_to_num(np.eye(d) - directions[:, :, None] * directions[:, None, :]).reshape(-1, d * d)
    sums = sum_by(edges.ravel(), np.repeat(projectors, 2, axis=0), num_nodes)
    values = np.linalg.eigvalsh(sums.reshape(num_nodes, d, d))
    return np.asarray(np.maximum(values[:, 0], 0.0) / np.maximum(values[:, -1], 1e-300))


def _cause(num_pairs: int, narrowness: float, sigma: float) -> Looseness:
    if num_pairs <= FEW_PAIRS:
        return Looseness.FEW_PAIRS
    if narrowness < NEARLY_PARALLEL:
        return Looseness.PARALLEL
    return Looseness.TOGETHER if np.isfinite(sigma) else Looseness.UNTIED


def _is_straight(positions: FloatArray) -> bool:
    """Return whether the positions of a loose group, three or more, lie on a line."""
    if len(positions) < _SMALLEST_LINE:
        return False
    values = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    return bool(values[1] < _ON_A_LINE * values[0])


def _most_frequent(causes: list[Looseness | None]) -> Looseness:
    """Return the cause that most have, the first declared of equals."""
    return max(Looseness, key=lambda cause: (causes.count(cause), -list(Looseness).index(cause)))
