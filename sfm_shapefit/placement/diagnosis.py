"""What a view graph says before anything is solved: pieces, hinges, weak cameras, corruption, and the plan.

Rigidity is exact and blind to the directions (`graph.rigidity`). What the directions say beyond it:

weak cameras   A camera's pairs hold it by the stacked projectors P_v = I - v v^T of their measured
               directions; the squared singular values of that stack are the eigenvalues of sum P_v. `spread`
               is the least over the greatest of these: 0 where all directions are parallel, so that the
               camera may slide along them, 1 where they point evenly everywhere.
corruption     In a triangle without errors each direction lies on the arc between the other two. The
               estimate is the share, of pairs in a triangle, whose iterated mean angle to these arcs
               (`graph.triangle_scores`) is above 0.3 rad: within 0.03 of the true share up to 0.2, within
               0.09 at 0.5, on six synthetic families (`scripts/results/notes.md#corruption-by-triangles`). It
               does not see wrong pairs that agree with one another; in the plane it is too low.

A camera most of whose matches contradict the rotations is named as well. Where the scene repeats itself
right cameras are among these, unless the pairs' own relative rotations (`judgement.turns`) confirm them.
"""

from typing import Annotated

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.record import Record
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.rigidity import RigidPiece, left_out_reasons
from sfm_shapefit.graph.triangle_scores import triangle_scores
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.placement.conditioning import FEW_PAIRS, NEARLY_PARALLEL, direction_spread
from sfm_shapefit.placement.place import count_large, order_pieces, refuse_without_triangle
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.refinement.starts import has_second_start
from sfm_shapefit.solver.solve import choose_method

WRONG_SCORE_RAD = 0.3
"""Mean angle to its triangles from which a pair counts as wrong; see above."""

_MAX_SCORED_PAIRS = 200_000  # pairs; more take half a minute, and corruption is not estimated
_CONTRADICTED_SHARE = 0.5  # share of a camera's pairs; if more contradict triangles its rotation may be wrong
# Cameras of a piece: fewer have no triangle.
_SMALLEST_CHECKED = 3


class PieceDiagnosis(Record):
    """A parallel-rigid piece of three cameras or more."""

    num_cameras: Annotated[int, "Cameras of it."]
    hinges: Annotated[tuple[str, ...], "Names of the cameras that it shares with other pieces."]


class WeakCamera(Record):
    """A camera that would be placed, and may be placed badly."""

    name: Annotated[str, "Of its image."]
    num_pairs: Annotated[int, "Pairs with a usable direction."]
    spread: Annotated[
        float, "How far the directions that hold it are from parallel, in [0, 1]; rays to points count."
    ]
    reasons: Annotated[tuple[str, ...], "Why it may be placed badly, in words."]


class Corruption(Record):
    """An estimate from the directions alone of how many pairs are wrong."""

    share: Annotated[
        float | None, "Of the pairs in a triangle; null where none is, or where they are too many to look at."
    ]
    num_checked: Annotated[int, "Pairs in a triangle."]
    statement: Annotated[str, "The same in words."]


class PlannedPlacement(Record):
    """What a placement of the largest piece would do."""

    solver: Annotated[str, "The solver that would run."]
    solver_reason: Annotated[str, "Why it would be chosen."]
    second_start: Annotated[bool, "Whether LUD is solved beside ShapeFit."]
    finish: Annotated[str, "What becomes of the starts, a sentence."]


class Diagnosis(Record):
    """Properties of a view graph that are known without solving."""

    dimension: Annotated[int, "Of the locations."]
    num_cameras: Annotated[int, "Nodes of the graph that are no points."]
    num_points: Annotated[int, "3D points that join as further nodes."]
    num_pairs: Annotated[int, "Pairs of cameras with a usable direction."]
    components: Annotated[
        tuple[int, ...],
        "Cameras of each connected component, the largest first; single cameras have one of their own.",
    ]
    pieces: Annotated[
        tuple[PieceDiagnosis, ...],
        "Parallel-rigid pieces of three cameras or more, the largest first: that one would be placed, the "
        "others written beside it, each with a scale of its own.",
    ]
    left_out: Annotated[dict[str, str], "Cameras outside the largest piece, and why."]
    weak: Annotated[tuple[WeakCamera, ...], "Cameras that may be placed badly, and why."]
    corruption: Annotated[Corruption, "How many pairs are wrong, as far as triangles tell."]
    plan: Annotated[PlannedPlacement | None, "Null if nothing can be placed."]
    obstacle: Annotated[str, "Why nothing can be placed; empty if something can."]


def diagnose(
    measured: MeasuredGraph | ViewGraph,
    options: PlacementOptions | None = None,
    confirmed: BoolArray | None = None,
) -> Diagnosis:
    """Diagnose a view graph without solving.

    Args:
        measured: any view graph, best with the statistics of its pairs.
        options: how it would be placed; defaults if None.
        confirmed: (n,) cameras whose rotation is right, though pairs of theirs are wrong; none if None.
    """
    if isinstance(measured, ViewGraph):
        measured = MeasuredGraph(measured)
    options = options or PlacementOptions()
    graph, n, pairs = measured.graph, measured.num_cameras, measured.without_points().graph
    pieces = order_pieces(measured)
    obstacle = ""
    try:
        refuse_without_triangle(measured, pieces)
    except UnsolvableError as error:
        obstacle = str(error)
    scores = triangle_scores(pairs) if pairs.num_edges <= _MAX_SCORED_PAIRS else None
    contradicted: BoolArray = np.zeros(graph.num_edges, dtype=np.bool_)
    if scores is not None:
        contradicted[measured.pairs] = scores > WRONG_SCORE_RAD
    confirmed = np.zeros(n, dtype=np.bool_) if confirmed is None else confirmed
    none = np.zeros((0, 2), dtype=np.int64)
    against = none if measured.evidence is None else measured.evidence.contradicting
    outside = left_out_reasons(graph, [] if obstacle else pieces)
    return Diagnosis(
        dimension=graph.dimension,
        num_cameras=n,
        num_points=measured.num_points,
        num_pairs=pairs.num_edges,
        components=tuple(sorted(np.bincount(pairs.components()).tolist(), reverse=True)),
        pieces=tuple(
            PieceDiagnosis(
                num_cameras=int(np.sum(piece.nodes < n)),
                hinges=tuple(graph.name_of(k) for k in piece.hinges.tolist() if k < n),
            )
            for piece in pieces[: count_large(pieces, measured)]
        ),
        left_out={graph.name_of(camera): reason for camera, reason in outside.items() if camera < n},
        weak=() if obstacle else _find_weak_cameras(measured, pieces[0], contradicted, against, confirmed),
        corruption=_corruption(pairs, scores),
        plan=None if obstacle else _plan_placement(graph.restricted_to(pieces[0].edges)[0], options),
        obstacle=obstacle,
    )


def _find_weak_cameras(
    measured: MeasuredGraph,
    piece: RigidPiece,
    contradicted: BoolArray,
    against: IntArray,
    confirmed: BoolArray,
) -> tuple[WeakCamera, ...]:
    """Return the cameras of the largest piece that little holds, or that most triangles contradict.

    Pairs (m,) that their triangles contradict hold nothing; the matches of those `against` (q, 2) contradict
    the given rotations. Neither is held against cameras (n,) whose rotation is `confirmed`.
    """
    graph, n = measured.graph, measured.graph.num_nodes
    ends, is_pair = graph.edges[piece.edges], measured.is_pair[piece.edges]
    wrong = contradicted[piece.edges]
    num_pairs = np.bincount(ends[is_pair].ravel(), minlength=n)
    num_wrong = np.bincount(ends[wrong].ravel(), minlength=n)
    num_ties = np.bincount(ends.ravel(), minlength=n)
    spread = direction_spread(n, ends[~wrong], graph.directions[piece.edges[~wrong]])
    num_against = np.bincount(against.ravel(), minlength=n)
    weak = []
    for camera in piece.nodes[piece.nodes < measured.num_cameras].tolist():
        reasons = []
        if num_ties[camera] <= FEW_PAIRS and len(piece.nodes) >= _SMALLEST_CHECKED:
            reasons.append("two pairs or fewer hold it")
        if num_wrong[camera] > _CONTRADICTED_SHARE * num_pairs[camera] and not confirmed[camera]:
            reasons.append(
                f"{num_wrong[camera]} of its {num_pairs[camera]} pairs contradict their triangles: "
                "its rotation may be wrong"
            )
        if num_against[camera] > num_pairs[camera] and not confirmed[camera]:
            reasons.append(
                f"the matches of {num_against[camera]} further pairs contradict the rotations, more "
                f"than its {num_pairs[camera]} usable ones, as in scenes that repeat"
            )
        if num_ties[camera] > num_wrong[camera] and spread[camera] < NEARLY_PARALLEL:
            reasons.append("the directions that hold it are nearly parallel: it may slide along them")
        if reasons:
            weak.append(
                WeakCamera(
                    name=graph.name_of(camera),
                    num_pairs=int(num_pairs[camera]),
                    spread=float(spread[camera]),
                    reasons=tuple(reasons),
                )
            )
    return tuple(weak)


def _corruption(pairs: ViewGraph, scores: FloatArray | None) -> Corruption:
    """Return the estimate from the triangle scores (m,) of the pairs; None: too many."""
    if scores is None:
        statement = f"not estimated: more than {_MAX_SCORED_PAIRS} pairs"
        return Corruption(share=None, num_checked=0, statement=statement)
    checked = int(np.sum(_in_triangle(pairs)))
    if checked == 0:
        return Corruption(share=None, num_checked=0, statement="not estimated: no pair is in a triangle")
    share = float(np.sum(scores > WRONG_SCORE_RAD)) / checked
    return Corruption(
        share=share,
        num_checked=checked,
        statement=f"about {share:.0%} of the usable pairs, judged by the triangles of {checked} of "
        f"{pairs.num_edges}",
    )


def _in_triangle(graph: ViewGraph) -> BoolArray:
    """Return which pairs (m,) have a common neighbor."""
    from scipy.sparse import coo_array  # here, since it takes long to import

    i, j = graph.edges.T
    half = coo_array((np.ones(len(i)), (i, j)), shape=(graph.num_nodes, graph.num_nodes)).tocsr()
    adjacency = half + half.T
    return np.asarray((adjacency @ adjacency)[i, j]).ravel() > 0.0


def _plan_placement(piece: ViewGraph, options: PlacementOptions) -> PlannedPlacement:
    choice = choose_method(piece, options.solver)
    second = has_second_start(piece)
    if options.objective == "shapefit":
        finish = "ShapeFit's certified optimum is kept as it is, as asked"
    elif not second:
        finish = "ShapeFit alone: no second start for two cameras, nor for more than a million pairs"
    elif options.objective == "lud":
        finish = "LUD is solved too and kept, as asked"
    else:
        finish = "LUD is solved too, and the start that fits the angles better is kept"
    if options.objective != "shapefit":
        finish += ", refined in angles" if options.refine else ", unrefined, as asked"
    return PlannedPlacement(
        solver=choice.method, solver_reason=choice.reason, second_start=second, finish=finish
    )
