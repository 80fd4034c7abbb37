"""Which directions agree with locations: residuals, their level, and the excess over their own noise.

The residual of a direction is the angle between it and the baseline of its nodes. It is judged against its
own covariance and an excess s that all directions share and that none can know of itself, above all errors of
the given rotations:

    chi2_e = r_e^T (Sigma_e + s^2 I)^-1 r_e,    r_e in the tangent plane of v_e.

s makes the median of chi2 over the agreeing directions what it should be. Whether a direction agrees is
judged with the level of all residuals in place of s, which is more: neither covariances nor locations are
exact. A residual is smaller than its error, because the solution bends towards the measurement: over least
squares by the redundancy 1 - unknowns / equations, while a sum of norms fits as many directions exactly as it
has unknowns, and leaves the others alone. The locations tell which of the two they come from.
"""

from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, quantile
from sfm_shapefit.base.geometry import angle_between_deg, normalized, tangent_bases
from sfm_shapefit.base.scipy_parts import chdtri
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.solver.program import along, differences

# Probability that a normal residual counts as wrong; in 3D a chi-square of 25, "5 sigma".
_OUTLIER_PROBABILITY = 3.7e-6
_LARGEST_FITTED_SHARE = 0.3  # share of pairs; keeps the quantile below 0.65, so that a third may be wrong
_LARGEST_SHARE = 0.9  # unknowns per equation; beyond, residuals hardly say anything
_EXACTLY_FITTED = 1e-3  # share of the median residual; a normal one is below it once in a million times
_MIN_FITTED_SHARE = 0.02  # share of exactly fitted pairs; from here on locations come from a sum of norms
_MIN_LEVEL_RAD = 1e-9  # radians; exact data still get a finite information
_LEVEL_ROUNDS = 5  # rounds of "who agrees?" and "how large are their residuals?"; they settle in fewer
_BISECTIONS = 50  # halvings; double precision has no more


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AngularAgreement:
    """Which directions of a graph agree with its locations."""

    angles_rad: FloatArray
    """(m,) angle between the measured direction and the baseline, in [0, pi]."""
    agrees: BoolArray
    """(m,)"""
    level_rad: float
    """Standard deviation, per axis, of the residuals of all directions together (from their median)."""
    excess_rad: FloatArray
    """(m,) The part of each, per axis, that the direction's own covariance does not explain."""


def find_agreement(
    measured: MeasuredGraph,
    locations: FloatArray,
    right: BoolArray | None = None,
    variances: FloatArray | None = None,
) -> AngularAgreement:
    """Return which directions agree with locations (n, d) of a measured graph.

    Where most directions may be wrong, the level of all is first that of those that are taken for `right`.
    Where each has a variance (m,), rad^2, by a mixture of levels, those for right agree.
    """
    graph, freedom = measured.graph, measured.graph.dimension - 1
    covariances = own_covariances(measured)
    baselines = differences(locations, graph.edges)
    residuals = _tangential_residuals(graph.directions, baselines)
    behind = along(baselines, graph.directions) <= 0.0
    num_moving = graph.num_nodes if measured.groups is None else measured.groups.num_groups
    num_unknowns = graph.dimension * (num_moving - 1) - (0 if measured.has_scale else 1)
    used: BoolArray = np.ones(graph.num_edges, dtype=np.bool_) if right is None else right
    angles = np.linalg.norm(residuals, axis=1)
    if variances is not None:
        own = np.trace(covariances, axis1=1, axis2=2) / freedom
        excesses = np.sqrt(np.maximum(variances - own, _MIN_LEVEL_RAD**2))
        level = float(np.sqrt(np.median(variances[used]))) if used.any() else float(np.pi)
        return AngularAgreement(
            angles_rad=angles, agrees=used & ~behind, level_rad=level, excess_rad=excesses
        )
    excess, agrees = _excess(residuals, covariances, behind, num_unknowns, used)
    level = _level(angles[used], num_unknowns, freedom)
    return AngularAgreement(
        angles_rad=angles, agrees=agrees, level_rad=level, excess_rad=np.full(len(angles), excess)
    )


def own_covariances(measured: MeasuredGraph) -> FloatArray:
    """Return the covariances (m, d - 1, d - 1) that directions state themselves; 0 where they state none."""
    if measured.covariance is not None:
        return np.nan_to_num(measured.covariance)
    freedom = measured.graph.dimension - 1
    return np.zeros((measured.graph.num_edges, freedom, freedom))


def _tangential_residuals(directions: FloatArray, baselines: FloatArray) -> FloatArray:
    """Return the residual angles as vectors (m, d - 1) in tangent bases; pi long where cameras coincide."""
    units = normalized(baselines)
    angles = np.radians(angle_between_deg(directions, units))
    tangential = np.einsum("edk,ed->ek", tangent_bases(directions), units)
    vectors = normalized(tangential) * angles[:, None]  # the angle, also beyond 90 deg
    lost = ~np.isfinite(vectors).all(axis=1)  # no tangential part: an angle of 0 or pi, or no baseline
    angles = np.where(np.isnan(angles), np.pi, angles)
    vectors[lost] = 0.0
    vectors[lost, 0] = angles[lost]
    return vectors


def _fitted_share(angles: FloatArray, num_unknowns: int, freedom: int) -> tuple[float, bool]:
    """Return unknowns / equations, within limits, and whether the residuals are those of a sum of norms."""
    share = num_unknowns / max(freedom * len(angles), 1)
    middle = float(np.median(angles[angles > 0.0])) if np.any(angles > 0.0) else 0.0
    fitted = float(np.mean(angles <= _EXACTLY_FITTED * middle))
    is_exact = fitted > min(_MIN_FITTED_SHARE, 0.5 * share)
    return min(share, _LARGEST_FITTED_SHARE if is_exact else _LARGEST_SHARE), is_exact


def _level(angles: FloatArray, num_unknowns: int, freedom: int) -> float:
    """Return the standard deviation per axis that the (m,) residual angles in radians speak of."""
    share, is_exact = _fitted_share(angles, num_unknowns, freedom)
    median_length = np.sqrt(chdtri(freedom, 0.5))  # median length of a vector of unit normal components
    usual = float(quantile(angles, (1.0 + share) / 2.0 if is_exact else 0.5))
    shrunk = 1.0 if is_exact else float(np.sqrt(1.0 - share))
    return max(usual / (shrunk * float(median_length)), _MIN_LEVEL_RAD)


def _excess(
    residuals: FloatArray, covariances: FloatArray, behind: BoolArray, num_unknowns: int, used: BoolArray
) -> tuple[float, BoolArray]:
    """Return the excess s in radians and which pairs agree; each decides the other, a few times.

    The pairs that are `used` decide first.
    """
    freedom = residuals.shape[1]
    angles = np.linalg.norm(residuals, axis=1)
    values, vectors = np.linalg.eigh(covariances)
    squares = np.einsum("ekl,ek->el", vectors, residuals) ** 2
    limit = chdtri(freedom, _OUTLIER_PROBABILITY)
    inliers = used
    for _ in range(_LEVEL_ROUNDS):
        level = _level(angles[used], num_unknowns, freedom)
        inliers = (np.sum(squares / (values + level**2), axis=1) <= limit) & ~behind
        if not inliers.any():
            return level, inliers
        if np.array_equal(inliers, used):
            break
        used = inliers
    share, is_exact = _fitted_share(angles[inliers], num_unknowns, freedom)
    rank = (1.0 + share) / 2.0 if is_exact else 0.5
    wanted = float(chdtri(freedom, 0.5)) * (1.0 if is_exact else 1.0 - share)
    return _matching_excess(squares[inliers], values[inliers], rank, wanted), inliers


def _matching_excess(squares: FloatArray, variances: FloatArray, rank: float, wanted: float) -> float:
    """Return s, at least the rounding level, at which a quantile of the chi-squares is as wanted."""

    def too_large(excess: float) -> bool:
        chi2 = np.sum(squares / (np.maximum(variances, 0.0) + excess**2), axis=1)
        return float(quantile(chi2, rank)) > wanted

    low, high = _MIN_LEVEL_RAD, np.pi
    if not too_large(low):
        return low
    for _ in range(_BISECTIONS):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if too_large(middle) else (low, middle)
    return high
