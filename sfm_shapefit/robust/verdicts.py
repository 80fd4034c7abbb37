"""What the solved locations say of each pair and camera: residual, verdict, uncertainty, trust.

The residual of a pair is the angle between its measured direction and the solved baseline. It is
judged against its own covariance and the level s of all residuals together, which carries what a
pair cannot know of itself, above all errors of the given rotations:

    chi2_e = r_e^T (Sigma_e + s^2 I)^-1 r_e,    r_e in the tangent plane of v_e.

The covariance of the locations is the inverse of H = D^T diag(B_e (Sigma_e + s^2 I)^-1 B_e^T / l_e^2) D
over the inlier pairs, l_e the length of the baseline, in the gauge of fixed centroid and scale.
"""

import enum
from dataclasses import dataclass

import numpy as np
from scipy.sparse import eye_array
from scipy.sparse.linalg import splu
from scipy.special import chdtri

from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.geometry import angle_between_deg, normalized, tangent_bases
from sfm_shapefit.laplacian.operators import assemble, laplacian_pattern
from sfm_shapefit.rigidity import parallel_rigid_pieces
from sfm_shapefit.solver.program import adjoint, along, differences
from sfm_shapefit.viewgraph import ViewGraph

_OUTLIER_PROBABILITY = 3.7e-6  # of a normal residual; in 3D a chi-square of 25, "5 sigma"
_LARGEST_FITTED_SHARE = 0.3  # keeps the quantile below 0.65, so that a third of the pairs may be wrong
_MIN_LEVEL_RAD = 1e-9  # exact data: a finite information all the same
_SMALLEST_RIGID = 3  # cameras; two have no shape, so nothing in it is uncertain
_DENSE_UNKNOWNS = 1500
_RIDGE = 1e-12  # of the largest diagonal entry: a camera that nothing holds becomes infinite, not singular
_SAMPLES = 200  # standard deviations from 200 samples are right to 5 %


class Verdict(enum.Enum):
    """What the solution says of a measured direction."""

    INLIER = "inlier"
    OUTLIER = "outlier"
    UNDETERMINED = "undetermined"
    """One of its cameras is not placed, so nothing can be said."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Assessment:
    """Evidence for each pair and camera of a solved view graph."""

    residuals_deg: FloatArray
    """(m,) angle between the measured direction and the solved baseline, in [0, 180]."""
    inliers: BoolArray
    """(m,) whether the pair agrees with the solution."""
    level_deg: float
    """Standard deviation, per axis, of the residuals of all pairs together (from their median)."""
    trust: FloatArray
    """(n,) share of the camera's pairs that agree with the solution."""
    sigmas: FloatArray
    """(n, d) standard deviation of each location in the units of `locations`, with centroid and scale
    held fixed; infinite for cameras outside the largest rigid piece of the inlier pairs."""


def assess(graph: ViewGraph, locations: FloatArray, covariance: FloatArray | None = None) -> Assessment:
    """Judge pairs and cameras by a solution.

    Args:
        graph: the solved view graph.
        locations: (n, d) its locations.
        covariance: (m, d - 1, d - 1) covariance of each direction in `tangent_bases(graph.directions)`,
            rad^2; NaN where it is unknown, None where all are.
    """
    freedom = graph.dimension - 1
    own = 0.0 if covariance is None else np.nan_to_num(covariance)
    baselines = differences(locations, graph.edges)
    residuals_deg = angle_between_deg(graph.directions, normalized(baselines))
    residuals_deg = np.where(np.isnan(residuals_deg), 180.0, residuals_deg)  # coincident cameras
    level = _residual_level(graph, np.radians(residuals_deg))
    information = np.linalg.inv(
        own + level**2 * np.broadcast_to(np.eye(freedom), (graph.num_edges, freedom, freedom))
    )

    bases = tangent_bases(graph.directions)
    tangential = np.einsum("edk,ed->ek", bases, normalized(baselines))
    tangential = normalized(tangential) * np.radians(residuals_deg)[:, None]  # angle, also beyond 90 deg
    chi2 = np.einsum("ek,ekl,el->e", *(np.nan_to_num(tangential), information, np.nan_to_num(tangential)))
    behind = along(baselines, graph.directions) <= 0.0
    inliers: BoolArray = (chi2 <= chdtri(freedom, _OUTLIER_PROBABILITY)) & ~behind

    agreeing = np.bincount(graph.edges[inliers].ravel(), minlength=graph.num_cameras)
    return Assessment(
        residuals_deg=residuals_deg,
        inliers=inliers,
        level_deg=float(np.degrees(level)),
        trust=agreeing / np.maximum(graph.degrees(), 1),
        sigmas=_location_sigmas(graph, locations, inliers, bases @ information @ bases.transpose(0, 2, 1)),
    )


def _residual_level(graph: ViewGraph, residuals: FloatArray) -> float:
    """Return the standard deviation per axis that the (m,) residual angles in radians speak of.

    The solution of a sum of norms fits as many equations exactly as there are unknowns. The median of the
    other residuals stands at the (1 + share) / 2 quantile of all.
    """
    freedom = graph.dimension - 1
    unknowns = graph.dimension * (graph.num_cameras - 1) - 1
    share = min(unknowns / (freedom * graph.num_edges), _LARGEST_FITTED_SHARE)
    median_length = np.sqrt(chdtri(freedom, 0.5))  # of a vector of unit normal components
    return max(float(np.quantile(residuals, (1.0 + share) / 2.0) / median_length), _MIN_LEVEL_RAD)


def _location_sigmas(
    graph: ViewGraph, locations: FloatArray, inliers: BoolArray, information: FloatArray
) -> FloatArray:
    """Return the standard deviations of the locations from the (m, d, d) information of the directions.

    Only the largest rigid piece of the inlier pairs has any: a loose camera would move the centroid.
    """
    sigmas = np.full(locations.shape, np.inf)
    pieces = parallel_rigid_pieces(graph.num_cameras, graph.edges[inliers], graph.dimension)
    rows = np.flatnonzero(inliers)[pieces == 0]
    held, edges = np.unique(graph.edges[rows], return_inverse=True)
    if len(held) < _SMALLEST_RIGID:
        return sigmas
    edges, t = edges.reshape(-1, 2), locations[held]
    lengths = np.linalg.norm(differences(t, edges), axis=1)
    blocks = information[rows] / np.maximum(lengths, 1e-12 * lengths.max())[:, None, None] ** 2
    variances_of = _dense_variances if t.size <= _DENSE_UNKNOWNS else _sampled_variances
    variances = variances_of(len(held), edges, blocks, _gauge_directions(t))
    found = np.sqrt(np.maximum(variances, 0.0)).reshape(t.shape)
    is_loose = (found > np.ptp(t, axis=0).max()).any(axis=1)
    sigmas[held] = np.where(is_loose[:, None], np.inf, found)
    return sigmas


def _gauge_directions(locations: FloatArray) -> FloatArray:
    """Return an orthonormal basis (n d, d + 1) of what the program fixes: the shifts and the scale."""
    n, d = locations.shape
    centred = (locations - locations.mean(axis=0)).ravel()
    return np.column_stack([np.tile(np.eye(d), (n, 1)) / np.sqrt(n), centred / np.linalg.norm(centred)])


def _dense_variances(n: int, edges: IntArray, blocks: FloatArray, gauge: FloatArray) -> FloatArray:
    """Return the diagonal of the inverse of H on the complement of the gauge, shape (n d,)."""
    hessian = assemble(laplacian_pattern(n, edges), blocks).toarray()
    size = float(hessian.diagonal().max())
    hessian += size * gauge @ gauge.T + _RIDGE * size * np.eye(len(hessian))
    inverse = np.linalg.inv(hessian)
    return np.asarray(np.diagonal(inverse) - np.sum(gauge**2, axis=1) / size)


def _sampled_variances(n: int, edges: IntArray, blocks: FloatArray, gauge: FloatArray) -> FloatArray:
    """Estimate the same diagonal from samples H^-1 b with b of covariance H, shape (n d,)."""
    hessian = assemble(laplacian_pattern(n, edges), blocks)
    ridge = _RIDGE * float(hessian.diagonal().max())
    regular = (hessian + ridge * eye_array(hessian.shape[0], format="csc")).tocsc()
    factor = splu(regular, permc_spec="MMD_AT_PLUS_A")
    values, vectors = np.linalg.eigh(blocks)
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    rng = np.random.default_rng(0)
    total = np.zeros(len(gauge))
    for _ in range(_SAMPLES):
        noise = np.einsum("eab,eb->ea", roots, rng.standard_normal(blocks.shape[:2]))
        sample = factor.solve(adjoint(noise, edges, n).ravel())
        sample -= gauge @ (gauge.T @ sample)
        total += sample**2
    return total / _SAMPLES
