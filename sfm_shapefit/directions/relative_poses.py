"""Directions from stored relative poses and the known rotations."""

import numpy as np

from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.directions.options import DirectionOptions
from sfm_shapefit.directions.pair_directions import DirectionStatus, PairDirections
from sfm_shapefit.geometry import normalized


def from_relative_poses(
    pairs: IntArray,
    cam2_from_cam1: tuple[FloatArray, FloatArray],
    rotations: FloatArray,
    num_inliers: IntArray,
    options: DirectionOptions | None = None,
) -> PairDirections:
    """Return directions R_j^T t_ij from relative poses and the known rotations.

    Args:
        pairs: (k, 2) camera indices i < j.
        cam2_from_cam1: rotations (k, 3, 3) and translations (k, 3), of any positive length, of camera j
            from camera i.
        rotations: (n, 3, 3) cam_from_world of all cameras.
        num_inliers: (k,) inlier matches behind each relative pose.
        options: what to believe; defaults if None.

    Returns:
        Directions; what only matches can tell (residual, parallax, covariance) is NaN.
    """
    options = options or DirectionOptions()
    relative_rotations, translations = cam2_from_cam1
    r_i, r_j = rotations[pairs[:, 0]], rotations[pairs[:, 1]]
    known = r_j @ r_i.transpose(0, 2, 1)
    sine = np.linalg.norm(relative_rotations - known, axis=(1, 2)) / np.sqrt(8.0)  # of half the angle
    mismatch = 2.0 * np.degrees(np.arcsin(np.minimum(sine, 1.0))) > options.max_rotation_error_deg
    status = np.full(len(pairs), DirectionStatus.USABLE, dtype=object)
    status[num_inliers < options.min_inliers] = DirectionStatus.TOO_FEW_MATCHES
    status[mismatch] = DirectionStatus.ROTATION_MISMATCH
    usable: BoolArray = np.array([value is DirectionStatus.USABLE for value in status], dtype=np.bool_)
    directions = normalized(np.einsum("kab,ka->kb", r_j, translations))
    unknown = np.full(len(pairs), np.nan)
    return PairDirections(
        pairs=pairs,
        directions=np.where(usable[:, None], directions, np.nan),
        status=list(status),
        num_matches=num_inliers,
        num_inliers=num_inliers,
        num_rivals=np.zeros(len(pairs), dtype=np.int64),
        cheirality_fraction=unknown,
        median_residual_px=unknown,
        parallax_deg=unknown,
        covariance=np.full((len(pairs), 2, 2), np.nan),
    )
