"""A measured graph placed: split into pieces, each solved and refined.

Directions say nothing of the scale between two rigid pieces, nor of where they lie, so each is a placement of
its own. The largest is the answer; the others are kept apart. Rigid groups, such as the frames of rigs and
the fixed cameras, have one piece, the groups that the pairs tie to one another.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, Self

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray, distinct
from sfm_shapefit.base.blas_threads import one_blas_thread
from sfm_shapefit.base.display import Displayed
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.rigidity import RigidPiece, rigid_pieces, rigid_pieces_of_groups
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.refinement.agreement import AngularAgreement, find_agreement
from sfm_shapefit.refinement.near import stay_near
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.refinement.starts import RefinedPlacement, refine_starts
from sfm_shapefit.solver.program import differences
from sfm_shapefit.solver.solve import refuse_admm, solve
from sfm_shapefit.solver.solver_options import IterationInfo, OnIteration, SolverResult
from sfm_shapefit.solver.tied import largest_tied

SMALLEST_PIECE = 3
"""Cameras; fewer have no shape that is worth a placement of its own."""
_LEAST_OFFSETS = 1e-6  # median baselines; with shorter ones their scale means nothing
_MOST_WATCHED = 100_000
"""Edges up to which the iterations of the solve are recorded; beyond, the objectives cost seconds."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Placement(Displayed):
    """The locations of one rigid piece of a measured graph, and which directions agree with them."""

    measured: MeasuredGraph
    """The whole graph."""
    pieces: list[RigidPiece]
    """Its parallel-rigid pieces, most cameras first; or the one of tied rigid groups."""
    piece: int
    """The one that is placed: 0, the largest, or one of the further ones."""
    certified: SolverResult
    """The ShapeFit optimum, with a certificate if one was asked for. Row k belongs to node `nodes[k]` of the
    graph, row e of the dual to its edge `edges[e]`."""
    refined: RefinedPlacement
    """The locations that are kept, of the same nodes, and how they were found from that optimum."""
    agreement: AngularAgreement
    """Which edges agree with the locations."""
    history: tuple[IterationInfo, ...]
    """The iterations of the solve; empty for graphs so large that watching them would take long."""
    unit: float | None
    """Length of the unit of the offsets inside rigid groups, in the solver's units; None where these, such as
    sensors that share one center, leave the scale open."""

    @property
    def graph(self) -> ViewGraph:
        """The whole view graph."""
        return self.measured.graph

    @property
    def groups(self) -> RigidGroups | None:
        """The rigid groups of all nodes of the graph, if nodes do not move one by one."""
        return self.measured.groups

    @property
    def num_cameras(self) -> int:
        """The nodes 0..num_cameras-1 of the graph are cameras, the others 3D points."""
        return self.measured.num_cameras

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
        """The centers (k, d) of `cameras` only, row by row of these, in the solver's units."""
        return self.refined.locations[: len(self.cameras)]

    @property
    def edges(self) -> IntArray:
        """The edges of the graph that place them, ascending."""
        return self.pieces[self.piece].edges

    @property
    def pairs(self) -> IntArray:
        """Edges that join two cameras, as rows of everything per edge."""
        return np.flatnonzero(self.measured.is_pair[self.edges])

    @property
    def num_pairs(self) -> int:
        """Pairs of cameras of the whole graph; they stand before the directions to points."""
        return len(self.measured.pairs)

    @property
    def rejected_pairs(self) -> IntArray:
        """The pairs (k, 2) of cameras that contradict the solution."""
        rejected = self.pairs[~self.agreement.agrees[self.pairs]]
        return np.asarray(self.graph.edges[self.edges[rejected]])

    def summary(self) -> dict[str, Any]:
        """Return the main figures in plain values."""
        return {
            "num_nodes": self.graph.num_nodes,
            "num_placed": len(self.nodes),
            "num_pairs": self.num_pairs,
            "num_pairs_rejected": len(self.rejected_pairs),
            "residual_level_deg": float(np.degrees(self.agreement.level_rad)),
            "start": self.refined.finish.start,
            "solve": self.certified.summary(),
        }

    def _headline(self) -> str:
        rejected = f"{len(self.rejected_pairs)} of {self.num_pairs} pairs rejected"
        return f"{len(self.nodes)} of {self.graph.num_nodes} nodes placed, {rejected}"

    def without_error_samples(self) -> Self:
        """Return the placement without the samples of its directions' errors, its largest arrays."""
        evidence = self.measured.evidence
        if evidence is None:
            return self
        measured = replace(self.measured, evidence=replace(evidence, errors=None))
        return replace(self, measured=measured)

    def measured_part(self) -> MeasuredGraph:
        """Return what was measured of the piece that is placed."""
        return self.measured.part(self.edges)[0]


class ContradictedOffsetsError(UnsolvableError):
    """The offsets inside rigid groups come out with no length, or a negative one."""

    def __init__(self, length: float, placement: Placement, wrong: Sequence[str] = ()) -> None:
        """Keep the offsets' length, in baselines, and the placement, right where they are too short.

        Which sensors are wrong is said in sentences, if that is known.
        """
        super().__init__(
            "the directions contradict the known offsets between cameras: their scale comes out as "
            f"{length:.1e} of a baseline; {'; '.join(wrong) or 'check the rigs, or which cameras are fixed'}"
        )
        self.length, self.placement = length, placement


def place_pieces(
    measured: MeasuredGraph,
    options: PlacementOptions,
    *,
    near: RefinedPlacement | None = None,
    certified: bool = True,
    on_iteration: OnIteration | None = None,
) -> Iterator[Placement]:
    """Place the rigid pieces of a measured graph, each with a scale of its own, most cameras first.

    Args:
        measured: with at least one edge, best with what is known of its directions.
        options: settings.
        near: an earlier placement, at the centers (n, 3) where an adjustment has all cameras of the graph
            since, in any scale and from any origin, NaN for those it lacks. A piece all of whose cameras are
            there is solved for its certificate only, and they stay.
        certified: False proves nothing, for locations that are only a start; see `solve`.
        on_iteration: called after each iteration of the largest piece's solve, on graphs where that costs
            little; returning False ends the solve there, and the placement goes on from the last iterate.

    Yields:
        The largest piece, and further ones of three cameras or more but for those that the solver refuses.

    Raises:
        InputError: if an option does not go with rigid groups.
        UnsolvableError: if a graph of many cameras has no three that are rigid, if the pairs do not tie its
            rigid groups to one another, or see `solve`.
    """
    if measured.groups is not None:
        refuse_admm(options.solver)
    if measured.has_scale:
        pieces = [find_tied_piece(measured)]
    else:
        pieces = order_pieces(measured)
        refuse_without_triangle(measured, pieces)
    how = _PieceOptions(options, near, certified)
    yield _place_piece(measured, pieces, 0, how, on_iteration)
    for k in range(1, count_large(pieces, measured)):
        with suppress(UnsolvableError):
            yield _place_piece(measured, pieces, k, how)


class _PieceOptions(NamedTuple):
    """How pieces are placed; see `place_pieces`."""

    options: PlacementOptions
    near: RefinedPlacement | None
    certified: bool


@one_blas_thread()  # as `solve`: bits must depend neither on the machine nor on what runs beside
def _place_piece(
    measured: MeasuredGraph,
    pieces: list[RigidPiece],
    k: int,
    how: _PieceOptions,
    on_iteration: OnIteration | None = None,
) -> Placement:
    """Solve piece k, refine it robustly, and see which directions agree."""
    part, _ = measured.part(pieces[k].edges)
    history: list[IterationInfo] = []

    def watch(info: IterationInfo) -> bool | None:
        history.append(info)
        return None if on_iteration is None else on_iteration(info)

    solved = solve(
        part.graph,
        how.options.solver.at_scale(part.graph.num_edges),
        groups=part.groups,
        on_iteration=watch if part.graph.num_edges <= _MOST_WATCHED else None,
        certified=how.certified,
    )
    nodes, near = pieces[k].nodes, how.near
    centers = None if near is None else near.locations[nodes[nodes < measured.num_cameras]]
    if near is None or centers is None or not np.isfinite(centers).all():
        refined = refine_starts(part, solved, how.options, certified=how.certified)
    else:
        refined = stay_near(part, solved, centers, near)
    unit, length = measure_unit(part, refined.locations) if part.has_scale else (None, np.inf)
    placement = Placement(
        measured=measured,
        pieces=pieces,
        piece=k,
        certified=solved,
        refined=refined,
        agreement=find_agreement(part, refined.locations, refined.right, refined.variances),
        history=tuple(history),
        unit=unit,
    )
    if not length > _LEAST_OFFSETS:
        raise ContradictedOffsetsError(length, placement)
    return placement


@one_blas_thread()
def replace_locations(placement: Placement, refined: RefinedPlacement) -> Placement:
    """Return a placement with other locations of the same nodes, and which directions agree with these.

    Judgements of the placement do not hold for the new locations, and are left out.
    """
    moved = {item.name: getattr(placement, item.name) for item in fields(Placement)}
    moved["refined"] = refined
    part = placement.measured_part()
    moved["agreement"] = find_agreement(part, refined.locations, refined.right, refined.variances)
    return Placement(**moved)


def order_pieces(measured: MeasuredGraph) -> list[RigidPiece]:
    """Return the rigid pieces, most cameras first; of rigid groups, those that directions alone make."""
    if measured.groups is None:
        pieces = rigid_pieces(measured.graph)
    else:
        pieces = rigid_pieces_of_groups(measured.graph, measured.groups)
    return sorted(pieces, key=lambda piece: -int(np.sum(piece.nodes < measured.num_cameras)))


def count_large(pieces: list[RigidPiece], measured: MeasuredGraph) -> int:
    """Return how many of the pieces, most cameras first, have three or more that move by themselves."""
    return sum(_count_moving(piece.nodes, measured) >= SMALLEST_PIECE for piece in pieces)


def _count_moving(nodes: IntArray, measured: MeasuredGraph) -> int:
    """Return the number of cameras among some nodes, or of the groups that these are in."""
    return len(distinct(measured.moving[nodes[nodes < measured.num_cameras]]))


def refuse_without_triangle(measured: MeasuredGraph, pieces: list[RigidPiece]) -> None:
    """Raise UnsolvableError if a graph of many cameras has no three that are rigid."""
    num_moving, num_edges = _count_moving(np.arange(measured.num_cameras), measured), measured.graph.num_edges
    if not pieces or _count_moving(pieces[0].nodes, measured) < min(SMALLEST_PIECE, num_moving):
        cure = "match more pairs, above all pairs that close triangles, if these are the right matches"
        against = () if measured.evidence is None else measured.evidence.contradicting
        if len(against) > num_edges:
            cure = f"{len(against)} pairs contradict the rotations: these are wrong, or of another scene"
        raise UnsolvableError(
            f"the {num_edges} usable directions tie no three cameras to one another; {cure}"
        )


def find_tied_piece(measured: MeasuredGraph) -> RigidPiece:
    """Return the nodes of the groups that the pairs tie to one another, and the edges between these groups.

    They are those around the fixed group, or the largest set if none is fixed. UnsolvableError, which says
    which, if the pairs do not tie the groups.
    """
    groups, edges = measured.groups, measured.graph.edges
    assert groups is not None
    sizes = measured.cameras_per_group
    tied = largest_tied(edges, groups, sizes, around=measured.fixed_group)
    if np.sum(sizes[tied] > 0) < 2:
        raise UnsolvableError(
            "the pairs tie no two frames to one another; match more pairs, of different cameras of a frame"
            if measured.fixed_group is None
            else "the pairs tie no camera to the fixed ones; match the new images with more of those"
        )
    inside = np.isin(groups.group_of[edges], tied).all(axis=1)
    rows = np.flatnonzero(inside & groups.joins(edges))
    return RigidPiece(nodes=distinct(edges[rows]), edges=rows, hinges=np.zeros(0, dtype=np.int64))


def measure_unit(part: MeasuredGraph, locations: FloatArray) -> tuple[float, float]:
    """Return the length of the offsets' unit at locations (n, d), and that of the offsets in baselines."""
    assert part.groups is not None
    unit = float(part.groups.split(part.groups.fit(locations)[0])[1][0])
    size = float(np.linalg.norm(part.groups.center().offsets, axis=1).max())
    baseline = float(np.median(np.linalg.norm(differences(locations, part.graph.edges), axis=1)))
    return unit, unit * size / baseline
