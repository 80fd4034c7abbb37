"""A view graph placed: its largest rigid piece, solved and judged. What `locate` and `solve` share."""

from dataclasses import dataclass

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.rigidity import RigidPiece, rigid_pieces
from sfm_shapefit.robust.trust import Evidence
from sfm_shapefit.robust.verdicts import Assessment, assess
from sfm_shapefit.solver.options import SolverOptions, SolverResult
from sfm_shapefit.solver.solve import solve
from sfm_shapefit.viewgraph import ViewGraph


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Placement:
    """The locations of a view graph's largest rigid piece, and the evidence for them."""

    graph: ViewGraph
    """The whole graph."""
    pieces: list[RigidPiece]
    """Its parallel-rigid pieces, largest first; piece 0 is the one that is solved."""
    solve: SolverResult
    """Row k belongs to camera `cameras[k]` of the graph, row e of the dual to its edge `edges[e]`."""
    assessment: Assessment
    """Evidence for the same cameras and edges, in the solver's units."""

    @property
    def cameras(self) -> IntArray:
        """The cameras of the graph that are placed, ascending."""
        return self.pieces[0].cameras

    @property
    def edges(self) -> IntArray:
        """The edges of the graph that place them, ascending."""
        return self.pieces[0].edges

    @property
    def rejected_pairs(self) -> IntArray:
        """The pairs (k, 2) of the graph that contradict the solution."""
        pairs: IntArray = self.graph.edges[self.edges[~self.assessment.inliers]]
        return pairs


def place(
    graph: ViewGraph,
    options: SolverOptions | None = None,
    covariance: FloatArray | None = None,
    evidence: Evidence | None = None,
) -> Placement:
    """Solve the largest rigid piece of a view graph and judge its pairs and cameras by the solution.

    Args:
        graph: any view graph with at least one edge; what its largest rigid piece leaves out is not placed.
        options: settings of the solver; defaults if None.
        covariance: (m, d - 1, d - 1) of each direction, see `assess`; unknown if None.
        evidence: support of the edges, and pairs whose matches contradict the rotations, see `assess`.

    Raises:
        UnsolvableError: if a graph of many cameras has no three that are rigid, or see `solve`.
    """
    pieces = rigid_pieces(graph)
    if not pieces or len(pieces[0].cameras) < min(3, graph.num_cameras):
        raise UnsolvableError(
            f"the {graph.num_edges} usable directions tie no three cameras to one another; "
            "match more pairs, above all pairs that close triangles"
        )
    piece, _ = graph.restricted_to(pieces[0].edges)
    solved = solve(piece, options)
    known = None if covariance is None else covariance[pieces[0].edges]
    heard = evidence and evidence.restricted_to(pieces[0].edges, pieces[0].cameras, graph.num_cameras)
    return Placement(
        graph=graph, pieces=pieces, solve=solved, assessment=assess(piece, solved.locations, known, heard)
    )
