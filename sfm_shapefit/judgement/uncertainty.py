"""How uncertain the locations are, and how much each direction decides for itself.

Near the solution a direction with error e_ij in the tangent plane of the baseline u_ij, length l_ij, sees the
locations through B_ij^T (t_i - t_j) / l_ij. The information about the locations is the block Laplacian

    H = D^T diag(B_e Lambda_e B_e^T / l_e^2) D,          Lambda_e = information of the direction, rad^-2,

and their covariance its inverse. H has the shifts and the scale as its null space, exactly, since B_e is
orthogonal to u_e. Three facts make the inverse cheap and the gauge exact:

    A = H + K K^T with one camera grounded and one baseline's length held is regular and as sparse as H;
    A^-1 at the nodes and edges comes from its Cholesky factor (`laplacian.selected`);
    C = S A^-1 S^T with S = I - N F^T is the covariance with F^T t held fixed, N spanning the null space and
    F^T N = I (the S-transformation: Baarda 1973; Teunissen 1985, "Zero order design"), of rank d + 1.

F is the centroid and the scale of the cameras that are held and stand among the others; one that nearly
nothing holds would lend its uncertainty to all, and one that stands far off would set the scale alone.

Where nodes move in rigid groups, the unknowns are the centers of these, with the scale of their offsets held:
it is the unit in which positions are given. H is the Laplacian of the graph of groups, N the translations
alone, and F^T t the mean of the cameras, or one group that stays where it is. All nodes of a group share its
covariance.

Directions whose errors are correlated (`correlated_errors`) do not have the covariance A^-1. For them the
errors are sampled: each sample of all directions moves the locations by A^-1 D^T (B Lambda theta / l), and
the standard deviations are those of the samples.

The leverage of a direction is trace(Lambda_e Cov(B_e^T (t_i - t_j) / l_e)) / (d - 1), in [0, 1]: the share of
its own fitted value that it decides itself. The leverages of all directions add up to the number of unknowns
over d - 1. Where it is 1 no other direction checks it, and its residual is 0 whatever was measured
(Cook and Weisberg 1982, "Residuals and Influence in Regression", section 2.1).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import distances_in_spreads, median_spread
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.judgement.limits import LOCAL_SHARE
from sfm_shapefit.laplacian.factor import Factor, FactorPlan, analyze, factorize
from sfm_shapefit.laplacian.selected import SelectedInverse, regauged
from sfm_shapefit.solver.program import adjoint, differences
from sfm_shapefit.solver.splitting.linear import ONE_THREAD, Resources

# Shares of each block's trace, added in turn; loose nodes become large, finite.
_RIDGES = (1e-12, 1e-10, 1e-8)
_FAR = 10.0  # spreads from the cameras' median; one that stands farther away may not decide the gauge
_LOOSENING_ROUNDS = 20  # rounds in which cameras leave the gauge; a bound
_SHORTEST = 1e-12  # share of the longest baseline; a shorter one counts as that long


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraUncertainty:
    """Covariances of the locations and leverages of the directions of a rigid graph."""

    covariances: FloatArray
    """(n, d, d) covariance of each location, in squared units of the locations; centroid and scale of the
    cameras in `gauge` held fixed; from samples, where the errors of the directions are given as such."""
    leverages: FloatArray
    """(m,) in [0, 1]."""
    gauge: BoolArray
    """(n,) the nodes whose centroid and scale are held fixed."""
    scale_sigma: float = np.inf
    """Relative standard deviation of the scale by offsets in rigid groups; infinite without any."""

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations along the axes, (n, d)."""
        return standard_deviations(self.covariances)


class Information(NamedTuple):
    """What the directions of m pairs say of the two ends of each, at given locations."""

    units: FloatArray
    """(m, d) directions of the baselines."""
    lengths: FloatArray
    """(m,) lengths of the baselines."""
    across: FloatArray
    """(m, d, d) P Lambda P with P = I - u u^T, rad^-2: the scale stays exactly free."""
    blocks: FloatArray
    """(m, d, d) the same per length squared: the blocks of the Laplacian H."""

    @property
    def pulls(self) -> FloatArray:
        """What an error of each direction pulls its ends by, (m, d, d)."""
        return np.asarray(self.across / self.lengths[:, None, None])

    def ridged(self, share: float) -> FloatArray:
        """Return the blocks with a share of the trace of each added to its diagonal."""
        traces = np.trace(self.blocks, axis1=1, axis2=2)
        return np.asarray(self.blocks + share * traces[:, None, None] * np.eye(self.blocks.shape[1]))

    def leverages(self, inverse: SelectedInverse, ends: IntArray) -> FloatArray:
        """Return how much each direction decides for itself, (m,), from the inverse at its ends (m, 2)."""
        i, j = ends.T
        relative = inverse.nodes[i] + inverse.nodes[j] - inverse.edges - inverse.edges.transpose(0, 2, 1)
        shares = np.einsum("eab,eba->e", self.blocks, relative) / (self.blocks.shape[1] - 1)
        return np.asarray(np.clip(shares, 0.0, 1.0))


def inform(locations: FloatArray, edges: IntArray, information: FloatArray) -> Information:
    """Return what directions of information (m, d, d), rad^-2, say of the ends of the pairs (m, 2)."""
    baselines = differences(locations, edges)
    lengths = np.linalg.norm(baselines, axis=1)
    lengths = np.maximum(lengths, _SHORTEST * lengths.max())
    units = baselines / lengths[:, None]
    projector = np.eye(units.shape[1]) - units[:, :, None] * units[:, None, :]
    across = projector @ information @ projector
    return Information(units, lengths, across, across / lengths[:, None, None] ** 2)


def propagate(
    locations: FloatArray,
    edges: IntArray,
    information: FloatArray,
    num_cameras: int | None = None,
    errors: Iterable[FloatArray] | None = None,
    resources: Resources = ONE_THREAD,
) -> CameraUncertainty | None:
    """Return the uncertainty of locations from the information of the directions.

    None if the factor would take more than is allowed; 2 GB from about a hundred thousand cameras in space
    on.

    Args:
        locations: (n, d) at the solution; nodes beyond `num_cameras` are points.
        edges: (m, 2) pairs that make the nodes rigid, none of length 0.
        information: (m, d, d) of each direction, rad^-2; only what lies across the baseline counts.
        num_cameras: the first so many nodes may decide the gauge; all if None.
        errors: samples (m, s, d) of the errors of the directions in radians, in consecutive parts, of which
            only one is held at a time; independent errors of that information if None.
        resources: threads and limit of the factor.

    Raises:
        UnsolvableError: if the information is singular beyond repair: the graph is in pieces.
    """
    n, d = locations.shape
    terms = inform(locations, edges, information)
    del information  # which is large, as the factor will be
    if errors is None:
        terms = terms._replace(across=terms.across[:0].copy())
    plan = analyze(n, edges)
    if plan.num_bytes(d) > resources.memory_bytes:
        return None
    factor = _grounded_factor(plan, terms, resources.threads)
    inverse = factor.selected_inverse()
    is_camera = np.arange(n) < (n if num_cameras is None else num_cameras)
    covariances, gauge = _fix_gauge(factor, inverse, locations, is_camera)
    if errors is not None:
        right = _right_side(edges, terms.pulls, errors, n)
        covariances = scatter(_moved(factor, right, *_gauge_pair(locations, gauge)))
    return CameraUncertainty(covariances=covariances, leverages=terms.leverages(inverse, edges), gauge=gauge)


class GroupGauge(NamedTuple):
    """Rigid groups, and what of them is held fixed."""

    groups: RigidGroups
    share: FloatArray
    """(B,) not negative, with sum 1: the groups whose weighted mean is held fixed."""
    has_cameras: BoolArray
    """(B,) the groups that show how large the scene is."""


def propagate_groups(
    locations: FloatArray,
    edges: IntArray,
    information: FloatArray,
    gauge: GroupGauge,
    errors: Iterable[FloatArray] | None = None,
    resources: Resources = ONE_THREAD,
) -> CameraUncertainty | None:
    """Return the uncertainty of nodes of rigid groups, whose scale is held; the rest is as in `propagate`.

    Args:
        locations: (n, d) at the solution.
        edges: (m, 2) pairs that tie the groups, each between two of them.
        information: (m, d, d) of each direction.
        gauge: the groups of the nodes, and what of them is held fixed.
        errors: samples, as in `propagate`.
        resources: threads and limit of the factor.
    """
    groups, share, has_cameras = gauge
    terms, d = inform(locations, edges, information), locations.shape[1]
    ends = np.ascontiguousarray(groups.group_of[edges])
    plan = analyze(groups.num_groups, ends)
    if plan.num_bytes(d) > resources.memory_bytes:
        return None
    factor = factorize(plan, terms.ridged(_RIDGES[0]), threads=resources.threads)
    inverse = factor.selected_inverse()
    null = np.tile(np.eye(d), (len(share), 1, 1))
    fixed = share[:, None, None] * null
    covariances = regauged(inverse.nodes, factor.solve, null, fixed)
    if errors is not None:
        right = _right_side(ends, terms.pulls, errors, len(share))
        covariances = scatter(_moved(factor, right, null, fixed))
    return CameraUncertainty(
        covariances=covariances[groups.group_of],
        leverages=terms.leverages(inverse, ends),
        gauge=share[groups.group_of] > 0.0,
        scale_sigma=_scale_sigma(factor, groups.split(groups.center().fit(locations)[0])[0], has_cameras),
    )


def _scale_sigma(factor: Factor, centers: FloatArray, gauge: BoolArray) -> float:
    """Return the relative standard deviation of the scale of groups at centers (B, d), read off some (B,)."""
    size = _gauge_pair(centers, gauge & (distances_in_spreads(centers, centers[gauge]) <= _FAR))[1][:, :, -1]
    return float(np.sqrt(max(float(np.vdot(size, factor.solve(size))), 0.0)))


def scatter(samples: FloatArray) -> FloatArray:
    """Return the covariances (n, d, d) of samples (n, d, s) of mean zero."""
    return np.asarray(samples @ samples.transpose(0, 2, 1) / samples.shape[2])


def standard_deviations(covariances: FloatArray) -> FloatArray:
    """Return the roots of the diagonals of covariances (n, d, d), (n, d)."""
    return np.asarray(np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0.0)))


def _right_side(edges: IntArray, pulls: FloatArray, errors: Iterable[FloatArray], n: int) -> FloatArray:
    """Return D^T (Lambda theta / l) of each sample, (n, d, s), from theta in consecutive parts."""
    total, start = np.zeros((n, pulls.shape[1], 1)), 0
    for part in errors:
        stop = start + len(part)
        forces = pulls[start:stop] @ part.transpose(0, 2, 1)
        if start == 0:
            total = np.zeros((n, *forces.shape[1:]))
        flat = forces.reshape(len(part), total.shape[1] * total.shape[2])  # a part may be empty
        total += adjoint(flat, edges[start:stop], n).reshape(total.shape)
        start = stop
    return total


def _moved(factor: Factor, right: FloatArray, null: FloatArray, fixed: FloatArray) -> FloatArray:
    """Return S A^-1 of the right sides (n, d, s), in the gauge of N and F."""
    moved = factor.solve(right)
    drift = np.einsum("nak,nas->ks", fixed, moved)
    for a in range(moved.shape[1]):  # axis by axis: the samples are large
        moved[:, a] -= null[:, a] @ drift
    return moved


def _grounded_factor(plan: FactorPlan, terms: Information, threads: int) -> Factor:
    """Factor H with its last camera grounded and the length of its longest baseline held."""
    longest = int(np.argmax(terms.lengths))
    held = np.trace(terms.blocks[longest]) * np.outer(terms.units[longest], terms.units[longest])
    for ridge in _RIDGES:
        regular = terms.ridged(ridge)
        regular[longest] += held
        try:
            return factorize(plan, regular, threads=threads)
        except UnsolvableError:
            if ridge == _RIDGES[-1]:
                raise
    raise AssertionError("unreachable")


def _fix_gauge(
    factor: Factor, inverse: SelectedInverse, locations: FloatArray, is_camera: BoolArray
) -> tuple[FloatArray, BoolArray]:
    """Return the covariances in the gauge of the cameras that are held, and which these are."""
    gauge = is_camera & (distances_in_spreads(locations, locations[is_camera]) <= _FAR)
    least = max(3, int(np.sum(is_camera)) // 2)
    for _ in range(_LOOSENING_ROUNDS):
        covariances = regauged(inverse.nodes, factor.solve, *_gauge_pair(locations, gauge))
        sizes = np.sqrt(np.maximum(np.trace(covariances, axis1=1, axis2=2), 0.0))
        largest = float(sizes[gauge].max())
        if largest <= LOCAL_SHARE * median_spread(locations[gauge]):
            break
        kept = gauge & (sizes < 0.5 * largest)
        if np.sum(kept) < least:
            break
        gauge = kept
    return covariances, gauge


def _gauge_pair(locations: FloatArray, gauge: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return N and F, (n, d, d + 1): shifts and scale, and what reads them off the nodes in `gauge`."""
    n, d = locations.shape
    centered = locations - locations[gauge].mean(axis=0)
    null = np.zeros((n, d, d + 1))
    null[:, range(d), range(d)] = 1.0
    null[:, :, d] = centered
    fixed = np.where(gauge[:, None, None], null, 0.0)
    fixed[:, :, :d] /= np.sum(gauge)
    fixed[:, :, d] /= np.sum(centered[gauge] ** 2)
    return null, fixed
