"""What was measured, as one value: the view graph, how certain its directions are, and what moves together.

Everything that places cameras takes a `MeasuredGraph`, and everything that works on a part of it, such as one
rigid piece, takes what `MeasuredGraph.part` makes of it.
"""

from dataclasses import KW_ONLY, dataclass

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, distinct, real_numbers
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.graph.viewgraph import ViewGraph


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evidence:
    """What the matches say beyond the directions of a graph."""

    contradicting: IntArray
    """(q, 2) other pairs, whose matches contradict the given rotations."""
    errors: FloatArray | None = None
    """(m, s, d - 1) samples of the errors of the directions, in their tangent bases, radians, for pairs that
    share keypoints (`judgement.correlated_errors`); the pairs' errors are independent if None."""
    facts_per_match: float = 1.0
    """Constraints on the cameras that the tracks of the matches give, for each match; see
    `judgement.correlated_errors`. Variances from independent errors are too small by this factor."""

    def part(self, rows: IntArray, nodes: IntArray, num_nodes: int) -> "Evidence":
        """Return the evidence for a graph of some of the edges and nodes, renumbered.

        Args:
            rows: indices of the edges that are kept, in their new order.
            nodes: indices of the nodes that are kept, in their new order.
            num_nodes: nodes of the graph that this evidence belongs to.
        """
        new = np.full(num_nodes, -1, dtype=np.int64)
        new[nodes] = np.arange(len(nodes))
        pairs = new[self.contradicting.reshape(-1, 2)]
        return Evidence(
            contradicting=pairs[(pairs >= 0).all(axis=1)],
            errors=None if self.errors is None else self.errors[rows],
            facts_per_match=self.facts_per_match,
        )


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredGraph:
    """A view graph with all that is known of its directions and nodes."""

    graph: ViewGraph
    """Cameras first, then 3D points, which are joined to cameras only."""
    _: KW_ONLY
    covariance: FloatArray | None = None
    """(m, d - 1, d - 1) covariance of each direction in `tangent_bases(graph.directions)`, rad^2; NaN where
    unknown, None where all are."""
    evidence: Evidence | None = None
    """What the matches say beyond them; None if unknown."""
    num_points: int = 0
    """How many of the nodes, the last ones, are 3D points, which only help to place the cameras."""
    groups: RigidGroups | None = None
    """Which nodes move together; None where each moves by itself."""
    fixed_group: int | None = None
    """The group that stays where it is; None if there is no such group."""

    @property
    def num_cameras(self) -> int:
        """Number of nodes that are cameras, the first ones."""
        return self.graph.num_nodes - self.num_points

    @property
    def is_pair(self) -> BoolArray:
        """(m,) whether an edge joins two cameras; the others join a camera and a point."""
        inside = self.graph.edges < self.num_cameras
        return np.asarray(inside[:, 0] & inside[:, 1])

    @property
    def pairs(self) -> IntArray:
        """The edges that join two cameras, ascending."""
        return np.flatnonzero(self.is_pair)

    @property
    def classes(self) -> IntArray:
        """(m,) the class of noise of each edge: 0 for pairs of cameras, 1 for directions to points."""
        return (~self.is_pair).astype(np.int64)

    @property
    def moving(self) -> IntArray:
        """(n,) what moves with each node: the number of its rigid group, or its own without groups."""
        return np.arange(self.graph.num_nodes) if self.groups is None else self.groups.group_of

    @property
    def has_scale(self) -> bool:
        """Whether a group has two nodes apart that others see; else the directions leave the scale open."""
        if self.groups is None:
            return False
        nodes = distinct(self.graph.edges[self.groups.joins(self.graph.edges)])
        return bool(len(nodes)) and self.groups.restricted_to(nodes).have_extent

    @property
    def cameras_per_group(self) -> IntArray:
        """(B,) number of cameras in each rigid group; 0 for a point, which is a group of its own."""
        assert self.groups is not None
        group_of = self.groups.group_of[: self.num_cameras]
        return np.bincount(group_of, minlength=self.groups.num_groups).astype(np.int64)

    def part(self, rows: IntArray) -> tuple["MeasuredGraph", IntArray]:
        """Return what was measured of the edges `rows` and of their nodes, renumbered.

        The second value is (n',) the index in this graph of each of its nodes, ascending. A fixed group of
        which no node is left is fixed no more.
        """
        if len(rows) == self.graph.num_edges and np.array_equal(rows, np.arange(len(rows))):
            graph, nodes = self.graph, distinct(self.graph.edges)
            if len(nodes) == graph.num_nodes:  # all of it, and samples of errors are large
                return self, nodes
        graph, nodes = self.graph.restricted_to(rows)
        return self._with_rows(graph, rows, nodes), nodes

    def subset(self, rows: IntArray) -> "MeasuredGraph":
        """Return what was measured of the same nodes by the edges `rows`."""
        return self._with_rows(self.graph.subset(rows), rows, np.arange(self.graph.num_nodes))

    def without_points(self) -> "MeasuredGraph":
        """Return what was measured of all cameras alone, with the numbers that they have."""
        if self.num_points == 0:
            return self
        rows, graph = self.pairs, self.graph
        names = None if graph.names is None else graph.names[: self.num_cameras]
        bare = ViewGraph(
            self.num_cameras, graph.edges[rows], graph.directions[rows], graph.weights[rows], names
        )
        return self._with_rows(bare, rows, np.arange(self.num_cameras))

    def _with_rows(self, graph: ViewGraph, rows: IntArray, nodes: IntArray) -> "MeasuredGraph":
        """Return what is left of the edges `rows` and of the nodes, whose graph is given."""
        groups, fixed = self.groups, self.fixed_group
        if groups is not None and fixed is not None:
            present = distinct(groups.group_of[nodes])
            fixed = int(np.searchsorted(present, fixed)) if fixed in present else None
        return MeasuredGraph(
            graph,
            covariance=None if self.covariance is None else self.covariance[rows],
            evidence=self.evidence and self.evidence.part(rows, nodes, self.graph.num_nodes),
            num_points=int(np.sum(nodes >= self.num_cameras)),
            groups=None if groups is None else groups.restricted_to(nodes),
            fixed_group=fixed,
        )


def direction_covariances(graph: ViewGraph, sigma: npt.ArrayLike) -> FloatArray:
    """Return the covariances (m, d - 1, d - 1) of directions from these, or from standard deviations (m,)."""
    given = real_numbers("sigma must be numbers, NaN where they are unknown", sigma)
    m, k = graph.num_edges, graph.dimension - 1
    if given.shape not in ((m,), (m, k, k)):
        raise InputError(
            f"sigma has shape {given.shape}; give one standard deviation, radians, for each of the {m} "
            f"directions, or covariances of shape {(m, k, k)}"
        )
    known = np.nan_to_num(given, posinf=np.inf, neginf=-np.inf)
    if given.ndim > 1 and not np.allclose(known, known.swapaxes(1, 2)):
        raise InputError("sigma has covariances that are not symmetric; give symmetric ones")
    if np.any(known > (np.pi if given.ndim == 1 else np.pi**2)) and not np.isinf(known).any():
        raise InputError(
            "sigma has values beyond pi radians, the largest angle; give radians, and NaN where they are "
            "unknown"
        )
    if np.isinf(known).any() or np.any((known if given.ndim == 1 else np.linalg.eigvalsh(known)) < 0.0):
        raise InputError(
            "sigma has negative or infinite values; give standard deviations or covariances, and NaN where "
            "they are unknown"
        )
    return np.asarray(np.square(given)[:, None, None] * np.eye(k) if given.ndim == 1 else given)
