"""Distances between cameras or points at an adjustment's answer, and how well they are known.

A distance d has the gradient g_p in the points and g in the nodes. With the points eliminated (`schur`),

    var d = noise_px^2 (g_p^T V^-1 g_p + r^T Z K^-1 Z^T r),        r = g - W^T V^-1 g_p,

with K and Z of `covariance`: where nothing holds the scale, a distance is known relative to the size of the
scene, the similarity of the centers taken off.
"""

import numpy as np

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.covariance import GroundedSystem, ground_system, motions_read_by
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.adjustment.solve import linearize_all, values_of
from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.laplacian.operators import Workers

_PACKED = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # places in a point's packed block; it is symmetric


def estimate_lengths(
    problem: AdjustmentProblem, options: AdjustmentOptions, ends: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return distances (k,) in units of the world, and their standard deviations.

    Args:
        problem: `Adjusted.problem`.
        options: as it was adjusted with; `noise_px` is that of the observations.
        ends: (k, 2) rows of cameras, followed by those of points.

    Raises:
        UnsolvableError: if the observations leave more open than a similarity.
    """
    system = ground_system(problem, options)
    turned = problem.rig.sensor_centers()[:, None, :] @ problem.rotations[problem.rig.frame_of_camera]
    places = np.concatenate([problem.centers[problem.rig.frame_of_camera] + turned[:, 0], problem.points])
    apart = places[ends[:, 1]] - places[ends[:, 0]]
    lengths = np.linalg.norm(apart, axis=1)
    along = apart / np.where(lengths > 0.0, lengths, 1.0)[:, None]
    right = np.zeros((system.layout.num_nodes, 6, len(ends)))
    of_points = np.zeros(len(ends))
    workers = Workers(options.threads)
    normal = linearize_all(problem, system.layout, values_of(problem), options, workers)
    workers.close()
    count = len(problem.rig.frame_of_camera)
    for sign, own in ((-1.0, ends[:, 0]), (1.0, ends[:, 1])):
        for k, (end, direction) in enumerate(zip(own.tolist(), sign * along, strict=True)):
            if end < count:
                _add_camera(right[:, :, k], problem, system, end, direction)
            else:
                of_points[k] += _add_point(right[:, :, k], system, normal.entries, end - count, direction)
    return lengths, options.noise_px * np.sqrt(np.maximum(of_points + _of_nodes(system, right), 0.0))


def _add_camera(
    right: FloatArray, problem: AdjustmentProblem, system: GroundedSystem, camera: int, direction: FloatArray
) -> None:
    """Add the gradient of a camera's place along a direction: its frame moves, and turns its sensor."""
    frame = problem.rig.frame_of_camera[camera]
    node = system.layout.node_of_frame[frame]
    if node < 0:
        return
    offset = problem.rig.sensor_centers()[camera]
    gradient = np.concatenate([direction, np.cross(problem.rotations[frame] @ direction, offset)])
    right[node] += np.where(system.layout.active[node], gradient, 0.0)


def _add_point(
    right: FloatArray, system: GroundedSystem, entries: FloatArray, point: int, direction: FloatArray
) -> float:
    """Add what the nodes have of a point's gradient; return the variance of the point by itself."""
    moved = system.inverses[point][_PACKED] @ direction
    for entry in range(*system.layout.first_entry[point : point + 2].tolist()):
        right[system.layout.entry_node[entry]] -= entries[entry].T @ moved
    return float(direction @ moved)


def _of_nodes(system: GroundedSystem, right: FloatArray) -> FloatArray:
    """Return r^T Z K^-1 Z^T r of each column."""
    if system.free.size:
        dual = motions_read_by(system)
        right = right - dual @ np.einsum("nai,nak->ik", system.motions, right)
    return np.asarray(np.einsum("nak,nak->k", right, system.factor.solve(np.ascontiguousarray(right))))
