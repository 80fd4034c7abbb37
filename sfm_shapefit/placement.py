"""A view graph placed: its rigid pieces, solved, finished, judged. What `locate` and `solve` share.

Directions say nothing of the scale between two rigid pieces, nor of where they lie, so each is a placement of
its own. The largest is the answer; the others are kept apart.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.bodies import Bodies
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.rigidity import RigidPiece, rigid_pieces
from sfm_shapefit.robust.finish import Finish, finish
from sfm_shapefit.robust.options import PlacementOptions
from sfm_shapefit.robust.trust import Evidence
from sfm_shapefit.robust.verdicts import Assessment, assess
from sfm_shapefit.solver.options import SolverResult
from sfm_shapefit.solver.solve import solve
from sfm_shapefit.viewgraph import ViewGraph

SMALLEST_PIECE = 3
"""Cameras; fewer have no shape that is worth a placement of its own."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Placement:
    """The locations of one rigid piece of a view graph, and the evidence for them.

    Nodes of the graph from `num_cameras` on are 3D points, which only help to place the cameras.
    """

    graph: ViewGraph
    """The whole graph."""
    num_cameras: int
    """The nodes 0..num_cameras-1 are cameras."""
    pieces: list[RigidPiece]
    """Its parallel-rigid pieces, most cameras first."""
    piece: int
    """The one that is solved: 0, the largest, or one of the further ones."""
    solve: SolverResult
    """The certified ShapeFit optimum. Row k belongs to node `nodes[k]` of the graph, row e of the dual to
    its edge `edges[e]`."""
    finish: Finish
    """The locations that are kept, of the same nodes, and how they were found from that optimum."""
    assessment: Assessment
    """Evidence at these locations for the same nodes and edges, in the solver's units."""
    bodies: Bodies | None = None
    """The rigid bodies of all nodes of the graph, if nodes do not move one by one."""
    unit: float | None = None
    """Length of the unit of the offsets inside rigid bodies, in the solver's units; None without bodies."""

    @property
    def nodes(self) -> IntArray:
        """The nodes of the graph that are placed, cameras first, ascending."""
        return self.pieces[self.piece].cameras

    @property
    def cameras(self) -> IntArray:
        """The cameras of the graph that are placed, ascending; the first rows of everything per node."""
        return self.nodes[self.nodes < self.num_cameras]

    @property
    def locations(self) -> FloatArray:
        """The centres (k, d) of `cameras`, in the solver's units."""
        return self.finish.locations[: len(self.cameras)]

    @property
    def edges(self) -> IntArray:
        """The edges of the graph that place them, ascending."""
        return self.pieces[self.piece].edges

    @property
    def pairs(self) -> IntArray:
        """Those of `edges` that join two cameras, as rows of everything per edge."""
        return np.flatnonzero((self.graph.edges[self.edges] < self.num_cameras).all(axis=1))

    @property
    def num_pairs(self) -> int:
        """Pairs of cameras of the whole graph; they stand before the directions to points."""
        return int(np.sum((self.graph.edges < self.num_cameras).all(axis=1)))

    @property
    def rejected_pairs(self) -> IntArray:
        """The pairs (k, 2) of cameras that contradict the solution."""
        rejected = self.pairs[~self.assessment.inliers[self.pairs]]
        pairs: IntArray = self.graph.edges[self.edges[rejected]]
        return pairs


def place(
    graph: ViewGraph,
    options: PlacementOptions | None = None,
    covariance: FloatArray | None = None,
    evidence: Evidence | None = None,
    num_cameras: int | None = None,
) -> Placement:
    """Solve the largest rigid piece of a view graph, finish it robustly, and judge its pairs and cameras.

    Args:
        graph: any view graph with at least one edge; what its largest rigid piece leaves out is not placed.
        options: settings; defaults if None.
        covariance: (m, d - 1, d - 1) of each direction, see `assess`; unknown if None.
        evidence: support of the edges, and pairs whose matches contradict the rotations, see `assess`.
        num_cameras: nodes from here on are 3D points, joined to cameras only; none if None.

    Raises:
        UnsolvableError: if a graph of many cameras has no three that are rigid, or see `solve`.
    """
    options = options or PlacementOptions()
    num_cameras = graph.num_cameras if num_cameras is None else num_cameras
    pieces = ordered_pieces(graph, num_cameras)
    refuse_without_triangle(graph, pieces, num_cameras)
    return _place_piece(graph, pieces, 0, options, covariance, evidence, num_cameras)


def place_further(
    placement: Placement,
    options: PlacementOptions | None = None,
    covariance: FloatArray | None = None,
    evidence: Evidence | None = None,
) -> Iterator[Placement]:
    """Solve the further rigid pieces of at least three cameras, each with a scale of its own.

    Args:
        placement: the graph and its largest piece.
        options, covariance, evidence: as they were given to `place`, for the whole graph.

    Yields:
        Placements, most cameras first; a piece that the solver refuses is left out.
    """
    options = options or PlacementOptions()
    pieces, num_cameras = placement.pieces, placement.num_cameras
    for k in range(1, count_large(pieces, num_cameras)):
        try:
            yield _place_piece(placement.graph, pieces, k, options, covariance, evidence, num_cameras)
        except UnsolvableError:
            continue


def ordered_pieces(graph: ViewGraph, num_cameras: int) -> list[RigidPiece]:
    """Return the rigid pieces, most cameras first; nodes from `num_cameras` on are points."""
    return sorted(rigid_pieces(graph), key=lambda piece: -int(np.sum(piece.cameras < num_cameras)))


def count_large(pieces: list[RigidPiece], num_cameras: int) -> int:
    """Return how many of the pieces, most cameras first, have three cameras or more."""
    return sum(int(np.sum(piece.cameras < num_cameras)) >= SMALLEST_PIECE for piece in pieces)


def refuse_without_triangle(graph: ViewGraph, pieces: list[RigidPiece], num_cameras: int) -> None:
    """Raise UnsolvableError if a graph of many cameras has no three that are rigid."""
    if not pieces or np.sum(pieces[0].cameras < num_cameras) < min(SMALLEST_PIECE, num_cameras):
        raise UnsolvableError(
            f"the {graph.num_edges} usable directions tie no three cameras to one another; "
            "match more pairs, above all pairs that close triangles"
        )


def _place_piece(
    graph: ViewGraph,
    pieces: list[RigidPiece],
    k: int,
    options: PlacementOptions,
    covariance: FloatArray | None,
    evidence: Evidence | None,
    num_cameras: int,
) -> Placement:
    """Solve piece k, finish it robustly, and judge its pairs and cameras; arguments as of `place`."""
    nodes, edges = pieces[k].cameras, pieces[k].edges
    piece, _ = graph.restricted_to(edges)
    known = None if covariance is None else covariance[edges]
    classes = np.max(graph.edges[edges] >= num_cameras, axis=1).astype(np.int64)
    heard = evidence and evidence.restricted_to(edges, nodes, graph.num_cameras)
    solved = solve(piece, options)
    finished = finish(piece, solved, options, known, classes)
    placed = int(np.sum(nodes < num_cameras))
    return Placement(
        graph=graph,
        num_cameras=num_cameras,
        pieces=pieces,
        piece=k,
        solve=solved,
        finish=finished,
        assessment=assess(piece, finished.locations, known, heard, placed),
    )
