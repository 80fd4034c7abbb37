"""Directions of many pairs from their matches, and which to believe."""

from collections.abc import Callable
from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, frozen
from sfm_shapefit.base.executors import in_ranges
from sfm_shapefit.pairs.direction_options import DirectionOptions
from sfm_shapefit.pairs.kernels import MEASURES, MIN_MATCHES, estimate_pairs
from sfm_shapefit.pairs.pair_directions import DirectionStatus, PairDirections, first_reasons, is_usable
from sfm_shapefit.scene.matches import RayMatches


def estimate_directions(
    matches: RayMatches, options: DirectionOptions | None = None, threads: int = 1
) -> PairDirections:
    """Return one direction per pair from its matches and the known rotations.

    Each pair is estimated on its own and with the same draws: neither batches nor `threads` change a bit of
    the answer.
    """
    options = options or DirectionOptions()
    k = len(matches.pairs)
    directions, measures, moments = np.zeros((k, 3)), np.zeros((k, len(MEASURES))), np.zeros((k, 2, 2, 2))
    settings = (options.inlier_threshold_px, options.num_hypotheses)
    run_over_pairs(estimate_pairs, matches, threads, *settings, directions, measures, moments)
    return _judge(matches, directions, measures, moments, options)


def run_over_pairs(kernel: Callable[..., None], matches: RayMatches, threads: int, *others: Any) -> None:
    """Call a kernel with ranges of pairs, the arrays of all, and what else it takes, from several threads."""
    rays = frozen(np.ascontiguousarray(matches.rays_i)), frozen(np.ascontiguousarray(matches.rays_j))
    arrays = (frozen(matches.offsets), *rays, frozen(matches.pixel_angles))
    in_ranges(threads, len(matches.pairs), kernel, *arrays, *others)


def _judge(
    matches: RayMatches,
    directions: FloatArray,
    measures: FloatArray,
    moments: FloatArray,
    options: DirectionOptions,
) -> PairDirections:
    """Decide which estimates to believe, and give the others their reason."""
    num_matches = matches.lengths()
    inliers, front, behind, voters, rivals, loyal, residual_px, parallax_rad = measures.T
    covariance = _tangent_covariance(moments)
    sigma_deg = np.degrees(np.sqrt(np.linalg.eigvalsh(covariance)[:, -1]))
    status = first_reasons(
        (num_matches < max(options.min_inliers, MIN_MATCHES), DirectionStatus.TOO_FEW_MATCHES),
        (inliers < options.min_inlier_ratio * num_matches, DirectionStatus.LOW_INLIER_RATIO),
        (inliers < options.min_inliers, DirectionStatus.FEW_INLIERS),
        ((sigma_deg > options.max_sigma_deg) | (voters < options.min_inliers), DirectionStatus.NO_PARALLAX),
        (rivals > options.max_rival_share * loyal, DirectionStatus.TWO_MOTIONS),
        (front <= options.min_sign_majority * behind, DirectionStatus.AMBIGUOUS_SIGN),
        (front < options.min_inliers, DirectionStatus.FEW_INLIERS),
    )
    usable = is_usable(status)
    return PairDirections(
        pairs=matches.pairs,
        directions=np.where(usable[:, None], directions, np.nan),
        status=status,
        num_matches=np.asarray(num_matches, dtype=np.int64),
        num_inliers=inliers.astype(np.int64),
        num_rivals=rivals.astype(np.int64),
        cheirality_fraction=front / np.maximum(voters, 1.0),
        median_residual_px=residual_px,
        parallax_deg=np.degrees(parallax_rad),
        covariance=np.where(usable[:, None, None], covariance, np.nan),
    )


def _tangent_covariance(moments: FloatArray) -> FloatArray:
    """Return A^-1 B A^-1 in each direction's tangent basis, shape (k, 2, 2), from A and B (k, 2, 2, 2).

    Where A has no information, and where the variance exceeds (1 rad)^2, it is that, which means: unknown.
    """
    curvature, slope_variance = moments.transpose(1, 0, 2, 3)
    values, vectors = np.linalg.eigh(curvature)
    inverse = (vectors / np.maximum(values, 1.0)[:, None, :]) @ vectors.transpose(0, 2, 1)
    variances, axes = np.linalg.eigh(inverse @ slope_variance @ inverse)
    variances[values[:, 0] <= 1.0, 1] = 1.0
    return np.asarray((axes * np.minimum(variances, 1.0)[:, None, :]) @ axes.transpose(0, 2, 1))
