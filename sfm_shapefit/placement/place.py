"""A view graph placed: its rigid pieces, solved, finished, judged. What `locate` and `solve` share.

Directions say nothing of the scale between two rigid pieces, nor of where they lie, so each is a placement of
its own. The largest is the answer; the others are kept apart.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.baselines import FILTERS, solve_baseline
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.judgement.second_configuration import Rival, find_rival
from sfm_shapefit.judgement.trust import Evidence
from sfm_shapefit.judgement.verdicts import Assessment, assess
from sfm_shapefit.laplacian.dense import one_blas_thread
from sfm_shapefit.refinement.options import Filter, PlacementOptions
from sfm_shapefit.refinement.starts import Finish, finish
from sfm_shapefit.rigidity import RigidPiece, rigid_pieces
from sfm_shapefit.solver.options import IterationInfo, OnIteration, SolverResult
from sfm_shapefit.solver.rigs.groups import RigidGroups
from sfm_shapefit.solver.solve import solve
from sfm_shapefit.viewgraph import ViewGraph

SMALLEST_PIECE = 3
"""Cameras; fewer have no shape that is worth a placement of its own."""
_MOST_WATCHED = 100_000
"""Edges up to which the iterations of the solve are recorded; beyond, the objectives cost seconds."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Placement:
    """The locations of one rigid piece of a view graph, and the evidence for them.

    Nodes of the graph from `num_cameras` on are 3D points, which only help to place the cameras.
    """

    graph: ViewGraph
    """The whole graph."""
    num_cameras: int
    """The nodes 0..num_cameras-1 are cameras."""
    dropped: IntArray
    """Its edges that the filter left out, ascending."""
    pieces: list[RigidPiece]
    """The parallel-rigid pieces of the others, most cameras first."""
    piece: int
    """The one that is solved: 0, the largest, or one of the further ones."""
    solve: SolverResult
    """The certified ShapeFit optimum, or a baseline's answer without certificate. Row k belongs to node
    `nodes[k]` of the graph, row e of the dual to its edge `edges[e]`."""
    finish: Finish
    """The locations that are kept, of the same nodes, and how they were found from that optimum."""
    assessment: Assessment
    """Evidence at these locations for the same nodes and edges, in the solver's units."""
    rival: Rival | None = None
    """Another placement that many of the rejected pairs agree on, its nodes those of the graph."""
    history: tuple[IterationInfo, ...] = ()
    """The iterations of the solve; empty for graphs so large that watching them would take long."""
    groups: RigidGroups | None = None
    """The rigid groups of all nodes of the graph, if nodes do not move one by one."""
    unit: float | None = None
    """Length of the unit of the offsets inside rigid groups, in the solver's units; None without groups."""

    @property
    def nodes(self) -> IntArray:
        """The nodes of the graph that are placed, cameras first, ascending."""
        return self.pieces[self.piece].nodes

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
    def considered(self) -> ViewGraph:
        """The whole graph without the edges that the filter left out."""
        return _without(self.graph, self.dropped)

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
    on_iteration: OnIteration | None = None,
) -> Placement:
    """Solve the largest rigid piece of a view graph, finish it robustly, and judge its pairs and cameras.

    Args:
        graph: any view graph with at least one edge; what its largest rigid piece leaves out is not placed.
        options: settings; defaults if None.
        covariance: (m, d - 1, d - 1) of each direction, see `assess`; unknown if None.
        evidence: support of the edges, and pairs whose matches contradict the rotations, see `assess`.
        num_cameras: nodes from here on are 3D points, joined to cameras only; none if None.
        on_iteration: called after each iteration of the solve, on graphs where that costs little.

    Raises:
        UnsolvableError: if a graph of many cameras has no three that are rigid, or see `solve`.
    """
    options = options or PlacementOptions()
    num_cameras = graph.num_nodes if num_cameras is None else num_cameras
    dropped = _dropped_edges(graph, options.filter, num_cameras)
    considered = _without(graph, dropped)
    edge_of = np.setdiff1d(np.arange(graph.num_edges), dropped)
    pieces = [
        RigidPiece(piece.nodes, edge_of[piece.edges], piece.hinges)
        for piece in ordered_pieces(considered, num_cameras)
    ]
    refuse_without_triangle(considered, pieces, num_cameras)
    parts = dropped, pieces
    return _place_piece(graph, parts, 0, options, covariance, evidence, num_cameras, on_iteration)


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
            parts = placement.dropped, pieces
            yield _place_piece(placement.graph, parts, k, options, covariance, evidence, num_cameras)
        except UnsolvableError:
            continue


def _dropped_edges(graph: ViewGraph, name: Filter, num_cameras: int) -> IntArray:
    """Return the edges that a filter leaves out; it looks at pairs of cameras only."""
    pairs = np.flatnonzero((graph.edges < num_cameras).all(axis=1))
    if name == "none":
        return pairs[:0]
    between = ViewGraph(num_cameras, graph.edges[pairs], graph.directions[pairs], graph.weights[pairs])
    dropped: IntArray = pairs[~FILTERS[name](between)]
    if len(dropped) == len(pairs):
        raise UnsolvableError(
            f"the filter {name} leaves none of the {len(pairs)} pairs; use another, or none"
        )
    return dropped


def _without(graph: ViewGraph, dropped: IntArray) -> ViewGraph:
    """Return a graph of the same nodes without some of its edges."""
    if len(dropped) == 0:
        return graph
    kept = np.setdiff1d(np.arange(graph.num_edges), dropped)
    return graph.subset(kept)


def ordered_pieces(graph: ViewGraph, num_cameras: int) -> list[RigidPiece]:
    """Return the rigid pieces, most cameras first; nodes from `num_cameras` on are points."""
    return sorted(rigid_pieces(graph), key=lambda piece: -int(np.sum(piece.nodes < num_cameras)))


def count_large(pieces: list[RigidPiece], num_cameras: int) -> int:
    """Return how many of the pieces, most cameras first, have three cameras or more."""
    return sum(int(np.sum(piece.nodes < num_cameras)) >= SMALLEST_PIECE for piece in pieces)


def refuse_without_triangle(graph: ViewGraph, pieces: list[RigidPiece], num_cameras: int) -> None:
    """Raise UnsolvableError if a graph of many cameras has no three that are rigid."""
    if not pieces or np.sum(pieces[0].nodes < num_cameras) < min(SMALLEST_PIECE, num_cameras):
        raise UnsolvableError(
            f"the {graph.num_edges} usable directions tie no three cameras to one another; "
            "match more pairs, above all pairs that close triangles"
        )


@one_blas_thread()  # as `solve`: bits must depend neither on the machine nor on what runs beside
def _place_piece(
    graph: ViewGraph,
    parts: tuple[IntArray, list[RigidPiece]],
    k: int,
    options: PlacementOptions,
    covariance: FloatArray | None,
    evidence: Evidence | None,
    num_cameras: int,
    on_iteration: OnIteration | None = None,
) -> Placement:
    """Solve piece k, finish it robustly, and judge its pairs and cameras; arguments as of `place`.

    `parts` are the edges that the filter left out, and the pieces of the others.
    """
    dropped, pieces = parts
    nodes, edges = pieces[k].nodes, pieces[k].edges
    piece, _ = graph.restricted_to(edges)
    known = None if covariance is None else covariance[edges]
    classes = np.max(graph.edges[edges] >= num_cameras, axis=1).astype(np.int64)
    heard = evidence and evidence.restricted_to(edges, nodes, graph.num_nodes)
    history: list[IterationInfo] = []

    def watch(info: IterationInfo) -> bool | None:
        history.append(info)
        return None if on_iteration is None else on_iteration(info)

    solved, finished = _solved(piece, options, known, classes, watch)
    placed = int(np.sum(nodes < num_cameras))
    memory, back = options.factor_memory_mb, finished.put_back
    assessment = assess(piece, finished.locations, known, heard, placed, unheld=back, factor_memory_mb=memory)
    rival = find_rival(piece, np.flatnonzero(classes == 0), assessment.inliers, assessment.level_deg)
    return Placement(
        graph=graph,
        num_cameras=num_cameras,
        dropped=dropped,
        pieces=pieces,
        piece=k,
        solve=solved,
        finish=finished,
        assessment=assessment,
        rival=None if rival is None else replace(rival, cameras=nodes[rival.cameras]),
        history=tuple(history),
    )


def _solved(
    piece: ViewGraph,
    options: PlacementOptions,
    covariance: FloatArray | None,
    classes: IntArray,
    watch: OnIteration,
) -> tuple[SolverResult, Finish]:
    """Solve and finish a rigid graph."""
    if options.solves_shapefit:
        solved = solve(piece, options, on_iteration=watch if piece.num_edges <= _MOST_WATCHED else None)
    else:
        solved = solve_baseline(piece, options.objective)
    return solved, finish(piece, solved, options, covariance, classes)
