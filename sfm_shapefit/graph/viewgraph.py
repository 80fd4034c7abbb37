"""The view graph: nodes (cameras, and 3D points where they help), pairs, and one direction per pair.

An edge (i, j) carries the unit direction of t_i - t_j: it points from camera j to camera i
(Hand, Lee, Voroninski 2015, eq. 1).
"""

import numbers
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import FloatArray, IntArray, frozen, real_numbers
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.forests import connected_components
from sfm_shapefit.laplacian.operators import adjacency
from sfm_shapefit.laplacian.ordering import best_order
from sfm_shapefit.laplacian.symbolic import EliminationTree

_UNIT_NORM_TOLERANCE = 1e-6  # absolute; a direction printed with 7 digits passes, a wrong one does not
_WEIGHTS = (1e-60, 1e60)  # least and largest; products of three, over all pairs, stay finite and not 0
# Rounding of a norm; dividing by 1 to rounding only changes last bits.
_ROUNDING = 8.0 * np.finfo(np.float64).eps


@dataclass(frozen=True, slots=True, init=False, eq=False)
class ViewGraph:
    """Cameras 0..n-1 and the measured directions between pairs of them. Arrays are read-only.

    A pair that is given more than once is merged into its first occurrence: weights add, and the
    direction is that of the weighted sum. Directions are renormalized to unit length; those which have it
    to rounding are kept to the last bit, so that a graph of a graph's edges has the same directions.
    """

    num_nodes: int
    edges: IntArray
    """(m, 2) camera indices (i, j); each unordered pair stands once."""
    directions: FloatArray
    """(m, d) unit directions of t_i - t_j in world axes."""
    weights: FloatArray
    """(m,) positive weights; an edge of weight 2 counts as two equal edges."""
    names: tuple[str, ...] | None
    """Names of the cameras, if they have any."""
    _tree: EliminationTree | None

    def __init__(
        self,
        num_nodes: int,
        edges: npt.ArrayLike,
        directions: npt.ArrayLike,
        weights: npt.ArrayLike | None = None,
        names: Sequence[str] | None = None,
    ) -> None:
        """Check and store a view graph.

        Args:
            num_nodes: n >= 0; a graph without cameras is what no edges at all are restricted to.
            edges: (m, 2) integers in [0, n).
            directions: (m, d) unit vectors, d >= 2.
            weights: (m,) finite and positive; 1 if None.
            names: n names, for messages and reports.

        Raises:
            InputError: naming the first edge that is out of range, a self-loop, not a unit vector, not
                of positive weight, or whose duplicates cancel each other.
        """
        edge_array, direction_array, weight_array = _check_arrays(num_nodes, edges, directions, weights)
        if names is not None and len(names) != num_nodes:
            raise InputError(f"the graph has {num_nodes} cameras but {len(names)} names; give one name each")
        edge_array, direction_array, weight_array = _merge_duplicates(
            edge_array, direction_array, weight_array
        )
        object.__setattr__(self, "num_nodes", int(num_nodes))
        object.__setattr__(self, "edges", frozen(edge_array))
        object.__setattr__(self, "directions", frozen(direction_array))
        object.__setattr__(self, "weights", frozen(weight_array))
        object.__setattr__(self, "names", None if names is None else tuple(names))
        object.__setattr__(self, "_tree", None)

    def __reduce__(self) -> tuple[Any, ...]:
        """Make it anew where it is unpickled: arrays that can be written to are another type for kernels."""
        return ViewGraph, (self.num_nodes, self.edges, self.directions, self.weights, self.names)

    @property
    def num_edges(self) -> int:
        """Number of pairs, m."""
        return len(self.edges)

    @property
    def dimension(self) -> int:
        """Dimension d of the space the cameras live in."""
        return int(self.directions.shape[1])

    def degrees(self) -> IntArray:
        """Return the number of pairs of each camera, shape (n,)."""
        return np.bincount(self.edges.ravel(), minlength=self.num_nodes).astype(np.int64)

    def components(self) -> IntArray:
        """Return the connected component of each camera, shape (n,), numbered from 0 by first camera."""
        return connected_components(self.num_nodes, self.edges)

    def elimination_tree(self) -> EliminationTree:
        """Return the tree of `best_order`, found once: a placement asks for it four times."""
        tree = self._tree or best_order(adjacency(self.num_nodes, self.edges))
        object.__setattr__(self, "_tree", tree)
        return tree

    def name_of(self, node: int) -> str:
        """Return the name of a node, or its number where the graph has no names."""
        return str(node) if self.names is None else self.names[node]

    def with_weights(self, weights: FloatArray) -> "ViewGraph":
        """Return the graph with other weights, (m,)."""
        return ViewGraph(self.num_nodes, self.edges, self.directions, weights, self.names)

    def subset(self, rows: npt.NDArray[np.integer] | npt.NDArray[np.bool_]) -> "ViewGraph":
        """Return the graph of the same nodes with the given edges, by index or by a mask (m,)."""
        return ViewGraph(
            self.num_nodes, self.edges[rows], self.directions[rows], self.weights[rows], self.names
        )

    def restricted_to(self, edge_indices: npt.NDArray[np.integer]) -> tuple["ViewGraph", IntArray]:
        """Return the graph of some edges and their cameras, renumbered, and their indices here, ascending."""
        cameras, renumbered = np.unique(self.edges[edge_indices], return_inverse=True)
        names = None if self.names is None else [self.names[c] for c in cameras]
        directions, weights = self.directions[edge_indices], self.weights[edge_indices]
        graph = ViewGraph(len(cameras), renumbered.reshape(-1, 2), directions, weights, names)
        return graph, cameras.astype(np.int64)


def _check_arrays(
    num_nodes: int, edges: npt.ArrayLike, directions: npt.ArrayLike, weights: npt.ArrayLike | None
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the inputs as arrays of the right type and shape, or raise InputError."""
    if not isinstance(num_nodes, numbers.Integral) or num_nodes < 0:
        raise InputError(f"num_nodes must be a whole number >= 0, got {num_nodes}")
    raw_edges = np.asarray(edges)
    if raw_edges.size and not np.issubdtype(raw_edges.dtype, np.integer):
        raise InputError(f"edges must be integers, got {raw_edges.dtype}; give camera indices in [0, n)")
    if raw_edges.size and raw_edges.shape[1:] != (2,):
        raise InputError(f"edges have shape {raw_edges.shape}; give one row (i, j) per pair, shape (m, 2)")
    # By rows, whatever the caller has them by: kernels are compiled anew for every other layout.
    i = raw_edges.astype(np.int64, order="C").reshape(-1, 2)
    v = np.array(real_numbers("directions must be numbers of shape (m, d)", directions), order="C")
    if v.ndim != 2 or len(v) != len(i) or v.shape[1] < 2:
        raise InputError(
            f"directions have shape {v.shape} for {len(i)} edges; give one row of length d >= 2 per edge"
        )
    w = np.ones(len(i)) if weights is None else np.array(real_numbers("weights must be numbers", weights))
    if w.shape != (len(i),):
        raise InputError(f"weights have shape {w.shape} for {len(i)} edges; give one number per edge")

    _refuse(~((i >= 0) & (i < num_nodes)).all(axis=1), i, f"is outside the cameras 0..{num_nodes - 1}")
    _refuse(i[:, 0] == i[:, 1], i, "joins a camera with itself; remove it")
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(v, axis=1)
    _refuse(
        ~(np.abs(norms - 1.0) <= _UNIT_NORM_TOLERANCE), i, "has a direction that is not a finite unit vector"
    )
    _refuse(~(np.isfinite(w) & (w > 0.0)), i, "has a weight that is not finite and positive; remove it")
    least, most = _WEIGHTS
    _refuse((w < least) | (w > most), i, f"has a weight outside {least:g} to {most:g}; scale all weights")
    norms[np.abs(norms - 1.0) <= _ROUNDING] = 1.0
    return i, v / norms[:, None], w


def _refuse(bad: npt.NDArray[np.bool_], edges: IntArray, reason: str) -> None:
    if bad.any():
        index = int(np.argmax(bad))
        raise InputError(f"edge {index} ({edges[index, 0]}, {edges[index, 1]}) {reason}")


def _merge_duplicates(
    edges: IntArray, directions: FloatArray, weights: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Merge repeated unordered pairs into their first occurrence."""
    _, first, group = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_inverse=True)
    if len(first) == len(edges):
        return edges, directions, weights
    order = np.argsort(first)  # groups in order of first occurrence
    target = np.argsort(order)[group.ravel()]
    first_rows = first[order]

    flipped = edges[:, 0] != edges[first_rows][target][:, 0]
    signed = np.where(flipped, -1.0, 1.0)[:, None] * directions * weights[:, None]
    total = np.zeros((len(first_rows), directions.shape[1]))
    np.add.at(total, target, signed)
    weight = np.bincount(target, weights=weights, minlength=len(first_rows))
    length = np.linalg.norm(total, axis=1)
    cancelled = np.zeros(len(edges), dtype=np.bool_)
    cancelled[first_rows] = length < 1e-9 * weight
    _refuse(cancelled, edges, "is given several times with directions that cancel; keep one")
    # A pair given once keeps its direction to the last bit.
    single = np.bincount(target, minlength=len(first_rows)) == 1
    merged = np.where(single[:, None], directions[first_rows], total / length[:, None])
    return edges[first_rows], np.asarray(merged, dtype=np.float64), weight.astype(np.float64)
