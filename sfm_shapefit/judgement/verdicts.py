"""What the solved locations say of each pair and camera: residual, verdict, uncertainty, trust.

Residuals, and which pairs agree, are `refinement.agreement`. How uncertain the locations are, and how much a
pair decides for itself, is `uncertainty`; what all pairs of a camera say together is `trust`.
"""

import enum
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import INSIDE, METRIC_SIGMA, distances_in_spreads, tangent_bases
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.rigidity import parallel_rigid_pieces
from sfm_shapefit.judgement.limits import SMALLEST_SHAPE
from sfm_shapefit.judgement.trust import CameraTrust, judge_cameras
from sfm_shapefit.judgement.turns import Doubts
from sfm_shapefit.judgement.uncertainty import (
    GroupGauge,
    propagate,
    propagate_groups,
    standard_deviations,
)
from sfm_shapefit.placement.conditioning import Conditioning, LooseCameras, condition
from sfm_shapefit.refinement.agreement import AngularAgreement, find_agreement, own_covariances
from sfm_shapefit.solver.splitting.linear import ONE_THREAD, Resources
from sfm_shapefit.solver.tied import largest_tied

_PART = 2_000  # directions whose error samples are worked on at a time; bounds the memory
_LOOSENING_RAD = 1e-4  # radians of noise, at least, in the search for loose nodes; with none, none would be
# Median distances within which the uncertainty is computed, the next where that is singular; farther nodes do
# not say how large the scene is.
_REACHES = (np.inf, 1e3, INSIDE)
_SCALE_APART = 0.02  # relative; half of what makes a camera loose that is two spreads from the middle
_UNCHECKED_LEVERAGE = 0.99  # leverage; from here on agreement means nothing, 1 % of an error shows


class Verdict(enum.Enum):
    """What the solution says of a measured direction."""

    INLIER = "inlier"
    OUTLIER = "outlier"
    UNDETERMINED = "undetermined"
    """One of its cameras is not placed, or no other pair checks it, so nothing can be said."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Assessment(CameraTrust):
    """Evidence for each pair and camera of a solved view graph."""

    residuals_deg: FloatArray
    """(m,) angle between the measured direction and the solved baseline, in [0, 180]."""
    inliers: BoolArray
    """(m,) whether the pair agrees with the solution."""
    leverages: FloatArray
    """(m,) share of its own fitted direction that an agreeing pair decides itself, in [0, 1]; 0 for outliers,
    NaN for agreeing pairs outside the largest rigid piece of those."""
    level_deg: float
    """Standard deviation, per axis, of the residuals of all pairs together (from their median)."""
    loose_groups: tuple[LooseCameras, ...]
    """Cameras that the agreeing pairs leave loose at the solution although the graph is rigid, and why."""
    covariances: FloatArray
    """(n, d, d) covariance of each location in the units of `locations`, with centroid and scale of the
    cameras held fixed; of infinite diagonal for nodes outside the largest rigid piece of the inlier pairs;
    NaN, all of them, where the graph is too large for its factor."""
    scale_sigma: float | None = None
    """Relative standard deviation of the scale by offsets in rigid groups, if it is above a tenth."""
    doubts: Doubts | None = None
    """What the pairs' own rotations say of those given; None if they were not asked."""

    @property
    def ambiguous(self) -> BoolArray:
        """(k,) cameras that another rotation rivals by their matches, and which no pixels confirm."""
        return np.zeros(len(self.trust), dtype=np.bool_) if self.doubts is None else self.doubts.ambiguous

    @property
    def sigmas(self) -> FloatArray:
        """(n, d) standard deviation of each location along the axes."""
        return standard_deviations(self.covariances)

    def verdict(self, pair: int) -> Verdict:
        """Return what the solution says of a pair."""
        if not self.inliers[pair]:
            return Verdict.OUTLIER
        checked = self.leverages[pair] < _UNCHECKED_LEVERAGE
        return Verdict.INLIER if checked else Verdict.UNDETERMINED


def assess(
    measured: MeasuredGraph,
    locations: FloatArray,
    *,
    undetermined_nodes: IntArray | None = None,
    resources: Resources = ONE_THREAD,
    agreement: AngularAgreement | None = None,
) -> Assessment:
    """Judge pairs and cameras by a solution.

    Args:
        measured: the solved graph; with rigid groups each pair joins two of them. What it has fixed stays
            where it is; else the mean of the cameras does.
        locations: (n, d) its locations.
        undetermined_nodes: nodes whose position is a placeholder, such as those that the refinement reset:
            their standard deviations are infinite, and they hold no others; none if None.
        resources: threads and limit of the factor for standard deviations.
        agreement: agreement of the same graph with the same locations; computed anew if None.
    """
    agreement = agreement or find_agreement(measured, locations)
    found = find_hold(
        measured, locations, agreement, undetermined_nodes, resources, apart_from_scale=_SCALE_APART
    )
    held, sigmas = found.conditioning, standard_deviations(found.covariances)
    judged = judge_cameras(measured, locations, agreement.agrees, sigmas, held)
    return Assessment(
        **{item.name: getattr(judged, item.name) for item in fields(CameraTrust)},
        residuals_deg=np.degrees(agreement.angles_rad),
        inliers=agreement.agrees,
        leverages=found.leverages,
        level_deg=float(np.degrees(agreement.level_rad)),
        loose_groups=held.groups,
        covariances=found.covariances,
        scale_sigma=found.scale_sigma if METRIC_SIGMA < found.scale_sigma < np.inf else None,
    )


class Hold(NamedTuple):
    """How well the agreeing pairs hold each location."""

    covariances: FloatArray
    """(n, d, d), see `Assessment`."""
    leverages: FloatArray
    """(m,)"""
    conditioning: Conditioning
    scale_sigma: float
    """Relative standard deviation of the scale by the offsets in rigid groups, infinite where these leave it
    open."""


def find_hold(
    measured: MeasuredGraph,
    locations: FloatArray,
    agreement: AngularAgreement,
    undetermined_nodes: IntArray | None,
    resources: Resources,
    *,
    apart_from_scale: float = np.inf,
) -> Hold:
    """Return how well the agreeing pairs hold each location.

    A scale of a larger relative standard deviation than `apart_from_scale` is no part of that, unless a group
    is fixed: all cameras would seem loose that are far from the middle.
    """
    graph, freedom, inliers = measured.graph, measured.graph.dimension - 1, agreement.agrees
    own, excess, bases = own_covariances(measured), agreement.excess_rad, tangent_bases(graph.directions)
    information = np.linalg.inv(own + (excess**2)[:, None, None] * np.eye(freedom))
    sigma_of_pair = np.sqrt(np.trace(own, axis1=1, axis2=2) / freedom + excess**2)
    # Exact directions are propagated as if they had some noise, and scaled back.
    scale = min(float(np.median(sigma_of_pair)) / _LOOSENING_RAD, 1.0)
    information = scale**2 * (bases @ information @ bases.transpose(0, 2, 1))
    del own, bases  # before the factor, the most memory of a large run
    errors = None if measured.evidence is None else measured.evidence.errors
    sampled = None if errors is None else _Sampled(errors, excess, scale)
    open_nodes = np.empty(0, np.int64) if undetermined_nodes is None else undetermined_nodes
    holding = inliers & ~np.isin(graph.edges, open_nodes).any(axis=1)
    known, scale_sigma = (measured, locations, holding, information, sampled, resources), np.inf
    if measured.has_scale:
        covariances, leverages, scale_sigma = _propagate_groups(*known)
        scale_sigma *= scale
    if not measured.has_scale or (scale_sigma > apart_from_scale and measured.fixed_group is None):
        covariances, leverages = _propagate_freely(*known)
    leverages[inliers & ~holding] = np.nan
    if sampled is None and measured.evidence is not None:
        covariances = covariances / measured.evidence.facts_per_match
    covariances = scale**2 * covariances
    k, sigmas = measured.num_cameras, standard_deviations(covariances)
    conditioning = condition(locations, graph.edges, inliers, sigmas, k, undetermined_nodes)
    return Hold(covariances, leverages, conditioning, scale_sigma)


class _Sampled(NamedTuple):
    errors: FloatArray
    """(m, s, d - 1) that sharing keypoints explains, in tangent bases, radians."""
    excess: FloatArray
    """(m,) standard deviation of what it does not explain."""
    scale: float
    """By which the errors are divided."""

    def parts(self, directions: FloatArray, rows: IntArray) -> Iterator[FloatArray]:
        """Yield the errors (., s, d) of the given rows in world axes, a part at a time."""
        random = np.random.default_rng(0)
        for start in range(0, len(self.errors), _PART):
            own = self.errors[start : start + _PART]
            excess = self.excess[start : start + _PART, None, None]
            whole = own + excess * random.standard_normal(own.shape)
            first, last = np.searchsorted(rows, (start, start + _PART))
            chosen = rows[first:last]
            bases = tangent_bases(directions[chosen]).transpose(0, 2, 1)
            yield whole[chosen - start] @ bases / self.scale


def _infinite_covariances(locations: FloatArray) -> FloatArray:
    """Return the covariances (n, d, d) of locations that nothing holds."""
    n, d = locations.shape
    return np.tile(np.diag(np.full(d, np.inf)), (n, 1, 1))


def _propagate_freely(
    measured: MeasuredGraph,
    locations: FloatArray,
    inliers: BoolArray,
    information: FloatArray,
    sampled: _Sampled | None,
    resources: Resources,
) -> tuple[FloatArray, FloatArray]:
    """Return the covariances (n, d, d) and the leverages (m,) of locations whose scale is open.

    Only the largest rigid piece of the inlier pairs has any: a loose camera would move the centroid. Where
    baselines of very different lengths make that singular, only its nodes within some radii have any. A rigid
    group, whose nodes are then at one place, counts as one node.
    """
    graph, node_of = measured.graph, measured.moving
    ends, locations = node_of[graph.edges], locations[np.unique(node_of, return_index=True)[1]]
    num_cameras = int(node_of[: measured.num_cameras].max(initial=-1)) + 1
    covariances, leverages = _infinite_covariances(locations), np.where(inliers, np.nan, 0.0)
    distances = distances_in_spreads(locations, locations[:num_cameras])
    for reach in _REACHES:
        used = np.flatnonzero(inliers & (distances[ends] <= reach).all(axis=1))
        rows = used[parallel_rigid_pieces(len(locations), ends[used], graph.dimension) == 0]
        nodes, edges = np.unique(ends[rows], return_inverse=True)
        cameras = int(np.sum(nodes < num_cameras))
        if cameras < SMALLEST_SHAPE:
            break
        try:
            samples = None if sampled is None else sampled.parts(graph.directions, rows)
            found = propagate(
                locations[nodes], edges.reshape(-1, 2), information[rows], cameras, samples, resources
            )
        except UnsolvableError:  # singular in spite of the ridge
            continue
        if found is None:
            covariances[:] = np.nan
            break
        inside = locations[nodes[distances[nodes] <= INSIDE]]
        is_held = ~(found.sigmas > _extent(inside)).any(axis=1)
        covariances[nodes[is_held]] = found.covariances[is_held]
        leverages[rows] = found.leverages
        break
    else:
        if measured.evidence is not None:  # pixels may know them all the same
            covariances[:] = np.nan
    return covariances[node_of], leverages


def _extent(locations: FloatArray) -> float:
    """Return the longest side of the box around locations (n, d); 0 of none."""
    return float(np.ptp(locations, axis=0).max()) if len(locations) else 0.0


def _propagate_groups(
    measured: MeasuredGraph,
    locations: FloatArray,
    inliers: BoolArray,
    information: FloatArray,
    sampled: _Sampled | None,
    resources: Resources,
) -> tuple[FloatArray, FloatArray, float]:
    """Return the covariances (n, d, d) and the leverages (m,) of rigid groups, their scale given.

    The third value is the relative standard deviation of that scale: infinite where the pairs tie no two
    groups, 0 where it was not computed.

    Only the groups that the inlier pairs tie at these locations have any: those around the fixed one, or most
    cameras.
    """
    graph, groups, fixed = measured.graph, measured.groups, measured.fixed_group
    assert groups is not None
    covariances = _infinite_covariances(locations)
    leverages = np.where(inliers, np.nan, 0.0)
    cameras = measured.cameras_per_group
    tied = largest_tied(graph.edges[inliers], groups, cameras, locations, around=fixed)
    inside = np.isin(groups.group_of, tied)
    rows = np.flatnonzero(inliers & inside[graph.edges].all(axis=1))
    if len(tied) < 2 or len(rows) == 0:
        return covariances, leverages, np.inf
    nodes = np.flatnonzero(inside)
    edges = np.searchsorted(nodes, graph.edges[rows])
    share = cameras[tied].astype(np.float64) if fixed is None else (tied == fixed).astype(np.float64)
    samples = None if sampled is None else sampled.parts(graph.directions, rows)
    gauge = GroupGauge(groups.restricted_to(nodes), share / share.sum(), cameras[tied] > 0)
    try:
        found = propagate_groups(locations[nodes], edges, information[rows], gauge, samples, resources)
    except UnsolvableError:
        found = None
    if found is None:
        return np.full_like(covariances, np.nan), leverages, 0.0
    is_held = ~(found.sigmas > _extent(locations[nodes])).any(axis=1)
    covariances[nodes[is_held]] = found.covariances[is_held]
    leverages[rows] = found.leverages
    return covariances, leverages, found.scale_sigma
