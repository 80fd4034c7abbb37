"""Directions from stored relative poses and the known rotations."""

import numpy as np

from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.directions.matches import RelativePoses
from sfm_shapefit.directions.options import DirectionOptions
from sfm_shapefit.directions.pair_directions import (
    DirectionStatus,
    PairDirections,
    first_reasons,
    is_usable,
)
from sfm_shapefit.geometry import normalized


def from_relative_poses(
    poses: RelativePoses, rotations: FloatArray, options: DirectionOptions | None = None
) -> PairDirections:
    """Return directions R_j^T t_ij from relative poses and the known rotations.

    Args:
        poses: those of k pairs; their translations may have any positive length.
        rotations: (n, 3, 3) cam_from_world of all cameras.
        options: what to believe; defaults if None.

    Returns:
        Directions; what only matches can tell (residual, parallax, covariance) is NaN.
    """
    options = options or DirectionOptions()
    r_i, r_j = rotations[poses.pairs[:, 0]], rotations[poses.pairs[:, 1]]
    known = r_j @ r_i.transpose(0, 2, 1)
    sine = np.linalg.norm(poses.rotations - known, axis=(1, 2)) / np.sqrt(8.0)  # of half the angle
    mismatch = 2.0 * np.degrees(np.arcsin(np.minimum(sine, 1.0))) > options.max_rotation_error_deg
    status = first_reasons(
        (mismatch, DirectionStatus.ROTATION_MISMATCH),
        (poses.num_inliers < options.min_inliers, DirectionStatus.TOO_FEW_MATCHES),
    )
    directions = normalized(np.einsum("kab,ka->kb", r_j, poses.translations))
    unknown = np.full(len(status), np.nan)
    return PairDirections(
        pairs=poses.pairs,
        directions=np.where(is_usable(status)[:, None], directions, np.nan),
        status=status,
        num_matches=poses.num_inliers,
        num_inliers=poses.num_inliers,
        num_rivals=np.zeros(len(status), dtype=np.int64),
        cheirality_fraction=unknown,
        median_residual_px=unknown,
        parallax_deg=unknown,
        covariance=np.full((len(status), 2, 2), np.nan),
    )
