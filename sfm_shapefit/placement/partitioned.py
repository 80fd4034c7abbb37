"""A view graph too large for one machine: solved in overlapping pieces, merged, and refined as a whole.

    cut       cameras into parts that few pairs join (`laplacian.partition`)
    overlap   each part with its neighbours that see it best, a share of its own size
    solve     each rigid body of each piece: certified ShapeFit and the robust finish, in any executor
    merge     log scales of pieces by the medians of length ratios between shared cameras, then shifts by the
              medians of their offsets, both as least absolute deviations over all pairs of pieces that share
              enough; rotations are common, so nothing turns
    refine    all cameras together in the angles of their directions, with a factor if it fits, else by
              conjugate gradients, whose memory is linear in the pairs

A piece ties to another one by four shared cameras or more; with fewer its scale would be a guess, and the
map would tear there. Pieces outside the largest body of tied ones start at their neighbours instead. The
pieces' certificates prove their own optima, not one of the whole. Where one machine holds the factor of the
graph the whole solve is better: as exact, and in less time in all. Where most pairs would join two pieces, as
in random graphs, pieces know too little, and the whole solve goes on without a factor (`choose_pieces`). It
does so, too, where a piece cannot be certified: its parts are held together by what was cut, as communities
that few pairs join, and it would tear the map.

Partition and merge follow Zhu et al., "Very large-scale global SfM by distributed motion averaging", CVPR
2018.
"""

import time
from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.executors import answers
from sfm_shapefit.laplacian.dense import one_blas_thread
from sfm_shapefit.laplacian.operators import adjacency
from sfm_shapefit.laplacian.partition import partition
from sfm_shapefit.laplacian.symbolic import SymbolicFactor
from sfm_shapefit.refinement.angular import plan_refinement
from sfm_shapefit.refinement.cg_normal_solver import IterativeNormal
from sfm_shapefit.refinement.options import PlacementOptions
from sfm_shapefit.refinement.starts import Finish, finish, finish_merged
from sfm_shapefit.rigidity import RigidPiece, rigid_pieces
from sfm_shapefit.solver.options import SolverResult, Status
from sfm_shapefit.solver.program import projected_length
from sfm_shapefit.solver.solve import solve, uncertified
from sfm_shapefit.viewgraph import ViewGraph

_CAMERAS_PER_PIECE = 15_000
_LEAST_PIECES = 4  # of a graph that does not fit: half of it would hardly be smaller
_LARGEST_CUT = 0.5  # share of pairs between parts
_OVERLAP = 0.15  # of a part; 10 % costs twice the error of 25 % before the refinement, none after it
_LEAST_LINKS = 3  # pairs of a neighbour with the part
_LEAST_SHARED = 4  # cameras, to tie two pieces
_LARGEST_GAP = 0.01  # of a piece; 1e-4 on areas and chains, 0.2 on communities, torn by 0.2 of their radius
_MOST_RATIOS = 4000  # length ratios per pair of pieces
_IRLS_STEPS = 50
_FLOOR = 1e-3  # of the median residual, under the weights
_SPREADING_SWEEPS = 20


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PieceTask:
    """A piece of a graph, to be solved anywhere."""

    graph: ViewGraph
    cameras: IntArray
    """(n,) the cameras of its nodes in the whole graph."""
    covariance: FloatArray | None
    classes: IntArray
    options: PlacementOptions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PieceSolution:
    """A solved piece."""

    cameras: IntArray
    """(k,) those that it places, in the whole graph's numbers."""
    locations: FloatArray
    """(k, d) in a scale and at an origin of its own."""
    gap: float
    """Certified, of its ShapeFit optimum."""
    seconds: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PartitionedResult:
    """A whole graph placed in pieces."""

    solve: SolverResult
    """The merged locations, with what the pieces' certificates prove; none is of the whole."""
    finish: Finish
    """The refinement of the whole."""
    pieces: tuple[PieceSolution, ...]
    num_merged: int
    """Pieces that are tied to one another; the cameras of the others started at their neighbours."""
    num_spread: int
    """Cameras that no merged piece places."""


def choose_pieces(graph: ViewGraph, options: PlacementOptions) -> IntArray | None:
    """Return the part of each camera (n,), or None where the whole solve is better.

    It is where the factor of the whole fits into `options.factor_memory`, and where most pairs would be cut.
    """
    if options.objective != "auto" or not options.refine:
        return None  # another answer is wanted
    if isinstance(plan_refinement(graph, options.factor_memory * 1_000_000), SymbolicFactor):
        return None
    count = max(_LEAST_PIECES, -(-graph.num_nodes // _CAMERAS_PER_PIECE))
    part_of = partition(adjacency(graph.num_nodes, graph.edges), count)
    cut = np.mean(part_of[graph.edges[:, 0]] != part_of[graph.edges[:, 1]])
    return None if cut > _LARGEST_CUT else part_of


def place_partitioned(
    graph: ViewGraph,
    part_of: IntArray,
    options: PlacementOptions | None = None,
    covariance: FloatArray | None = None,
    classes: IntArray | None = None,
    executor: Executor | None = None,
) -> PartitionedResult | None:
    """Place a rigid view graph in overlapping pieces, and refine it as a whole.

    Returns None as soon as a piece turns out that cannot be certified by itself: place the whole then.

    Args:
        graph: connected and parallel rigid.
        part_of: (n,) the part of each camera, see `choose_pieces`.
        options: of each piece; `factor_memory` decides how the whole is refined.
        covariance: (m, d - 1, d - 1) of each direction; None if unknown.
        classes: (m,) 0 for pairs of cameras, 1 for directions to points; None: all 0.
        executor: solves the pieces; they are solved here, one by one, if None.

    Raises:
        UnsolvableError: if no piece can be solved.
        WorkerError: if a worker died and the executor does not replace it.
    """
    options, start = options or PlacementOptions(), time.perf_counter()
    classes = np.zeros(graph.num_edges, dtype=np.int64) if classes is None else classes
    tasks = piece_tasks(graph, part_of, options, covariance, classes)
    solved_pieces = map(solve_piece, tasks) if executor is None else answers(executor, solve_piece, tasks)
    pieces: tuple[PieceSolution, ...] = ()
    for part in solved_pieces:
        if any(piece.gap > _LARGEST_GAP for piece in part):
            return None
        pieces += tuple(part)
    if not pieces:
        raise UnsolvableError("no piece has four rigid cameras; leave out the executor")
    merged, num_merged, num_spread = merge(graph, pieces)
    if not projected_length(graph, merged) > 0.0:
        raise UnsolvableError("the pieces do not fit together; leave out the executor")
    reason = _statement(pieces, num_merged, num_spread)
    solved = uncertified(graph, merged, Status.IN_PIECES, "pieces", reason, start)
    plan = plan_refinement(graph, options.factor_memory * 1_000_000) or IterativeNormal(graph)
    return PartitionedResult(
        solve=solved,
        finish=finish_merged(graph, merged, covariance, classes, plan, "the merged pieces are the one start"),
        pieces=pieces,
        num_merged=num_merged,
        num_spread=num_spread,
    )


def _statement(pieces: tuple[PieceSolution, ...], num_merged: int, num_spread: int) -> str:
    """Say how the pieces were put together."""
    largest = max(len(piece.cameras) for piece in pieces)
    gap = max(piece.gap for piece in pieces)
    loose = f"; {num_spread} cameras started at their neighbours" if num_spread else ""
    return (
        f"the factor of the whole would be too large: {len(pieces)} pieces of up to {largest} cameras, each "
        f"certified to {gap:.1e} or better, {num_merged} of them merged{loose}"
    )


# --- pieces ----------------------------------------------------------------------------------------


def piece_tasks(
    graph: ViewGraph,
    part_of: IntArray,
    options: PlacementOptions,
    covariance: FloatArray | None,
    classes: IntArray,
) -> Iterator[PieceTask]:
    """Yield the overlapping pieces of a graph."""
    for part in range(int(part_of.max()) + 1):
        inside = part_of == part
        inside[_overlap(graph, part_of == part)] = True
        rows = np.flatnonzero(inside[graph.edges].all(axis=1))
        if len(rows) == 0:
            continue
        piece, cameras = graph.restricted_to(rows)
        known = None if covariance is None else covariance[rows]
        yield PieceTask(
            graph=piece,
            cameras=cameras,
            covariance=known,
            classes=classes[rows],
            options=replace(options, threads=1, uniqueness=False),  # one piece for each worker
        )


def _overlap(graph: ViewGraph, inside: BoolArray) -> IntArray:
    """Return the neighbours of a part with most pairs into it, ties by number."""
    i, j = graph.edges.T
    outward = np.concatenate([j[inside[i] & ~inside[j]], i[inside[j] & ~inside[i]]])
    links = np.bincount(outward, minlength=graph.num_nodes)
    most = max(round(_OVERLAP * float(np.sum(inside))), _LEAST_SHARED)
    order = np.argsort(-links, kind="stable")[:most]
    return np.asarray(order[links[order] >= _LEAST_LINKS], dtype=np.int64)


@one_blas_thread()
def solve_piece(task: PieceTask) -> list[PieceSolution]:
    """Return the rigid bodies of a piece, most cameras first, solved, certified and refined each."""
    found = []
    for body in sorted(rigid_pieces(task.graph), key=lambda body: -len(body.nodes)):
        if len(body.nodes) < _LEAST_SHARED:
            break
        solution = _solve_body(task, body)
        if solution is not None:
            found.append(solution)
    return found


def _solve_body(task: PieceTask, body: RigidPiece) -> PieceSolution | None:
    """Return one rigid body's solution; None if the solver refuses it."""
    start = time.perf_counter()
    graph, nodes = task.graph.restricted_to(body.edges)
    known = None if task.covariance is None else task.covariance[body.edges]
    try:
        solved = solve(graph, task.options)
    except UnsolvableError:
        return None
    finished = finish(graph, solved, task.options, known, task.classes[body.edges])
    return PieceSolution(
        cameras=task.cameras[nodes],
        locations=np.array(finished.locations),
        gap=solved.gap,
        seconds=time.perf_counter() - start,
    )


# --- merging ---------------------------------------------------------------------------------------


def merge(graph: ViewGraph, pieces: tuple[PieceSolution, ...]) -> tuple[FloatArray, int, int]:
    """Return all cameras' locations (n, d) in one frame, the number of pieces tied, and of cameras spread."""
    ties = list(_ties(pieces))
    joined = _largest_body(len(pieces), [(p, q) for p, q, _, _ in ties])
    ties = [tie for tie in ties if tie[0] in joined]
    pairs = np.array([(p, q) for p, q, _, _ in ties], dtype=np.int64).reshape(-1, 2)
    ratios = np.array([_log_ratio(a, b) for _, _, a, b in ties]).reshape(-1, 1)
    scales = np.exp(_potentials(len(pieces), pairs, ratios))[:, 0]
    offsets = [np.median(scales[q] * b - scales[p] * a, axis=0) for p, q, a, b in ties]
    shifts = _potentials(len(pieces), pairs, np.array(offsets).reshape(len(ties), graph.dimension))

    total, count = np.zeros((graph.num_nodes, graph.dimension)), np.zeros(graph.num_nodes)
    for p in sorted(joined):
        total[pieces[p].cameras] += scales[p] * pieces[p].locations + shifts[p]
        count[pieces[p].cameras] += 1.0
    placed = count > 0.0
    total[placed] /= count[placed, None]
    return _spread(graph, total, placed), len(joined), int(np.sum(~placed))


def _ties(pieces: tuple[PieceSolution, ...]) -> Iterator[tuple[int, int, FloatArray, FloatArray]]:
    """Yield pairs of pieces that share enough cameras, with the shared ones' locations in both."""
    for p, first in enumerate(pieces):
        for q in range(p + 1, len(pieces)):
            second = pieces[q]
            shared, a, b = np.intersect1d(
                first.cameras, second.cameras, assume_unique=True, return_indices=True
            )
            if len(shared) >= _LEAST_SHARED:
                yield p, q, first.locations[a], second.locations[b]


def _log_ratio(a: FloatArray, b: FloatArray) -> float:
    """Return log(s_a / s_b): the median log ratio of lengths between random shared cameras."""
    rng = np.random.default_rng(0)
    i, j = rng.integers(len(a), size=(2, _MOST_RATIOS))
    lengths = [np.linalg.norm(x[i] - x[j], axis=1) for x in (a, b)]
    sound = (lengths[0] > 0.0) & (lengths[1] > 0.0)
    return float(np.median(np.log(lengths[1][sound] / lengths[0][sound]))) if sound.any() else 0.0


def _largest_body(count: int, pairs: list[tuple[int, int]]) -> set[int]:
    """Return the largest set of pieces that ties join, the first of equals."""
    body = list(range(count))
    for p, q in pairs:
        kept, gone = min(body[p], body[q]), max(body[p], body[q])
        body = [kept if label == gone else label for label in body]
    largest = max(sorted(set(body)), key=body.count)
    return {p for p in range(count) if body[p] == largest}


def _potentials(count: int, pairs: IntArray, wanted: FloatArray) -> FloatArray:
    """Return h (count, c) of least sum |h_p - h_q - wanted (m, c)| over the pairs; 0 without pairs."""
    if len(pairs) == 0:
        return np.zeros((count, wanted.shape[1]))
    rows = np.zeros((len(pairs), count))
    rows[np.arange(len(pairs)), pairs[:, 0]] = 1.0
    rows[np.arange(len(pairs)), pairs[:, 1]] = -1.0
    weights = np.ones(len(pairs))
    h = np.zeros((count, wanted.shape[1]))
    for _ in range(_IRLS_STEPS):
        root = np.sqrt(weights)[:, None]
        h = np.asarray(np.linalg.lstsq(root * rows, root * wanted, rcond=None)[0])
        residuals = np.linalg.norm(rows @ h - wanted, axis=1)
        floor = max(_FLOOR * float(np.median(residuals)), 1e-12)
        weights = floor / np.maximum(residuals, floor)
    return np.asarray(h)


def _spread(graph: ViewGraph, t: FloatArray, placed: BoolArray) -> FloatArray:
    """Return the locations with the cameras that are not placed at the mean of their placed neighbours."""
    known = placed.copy()
    i, j = graph.edges.T
    for _ in range(_SPREADING_SWEEPS):
        if known.all():
            break
        total, count = np.zeros_like(t), np.zeros(len(t))
        for own, other in ((i, j), (j, i)):
            rows = known[other] & ~known[own]
            np.add.at(total, own[rows], t[other[rows]])
            np.add.at(count, own[rows], 1.0)
        reached = count > 0.0
        t[reached] = total[reached] / count[reached, None]
        known |= reached
    return t
