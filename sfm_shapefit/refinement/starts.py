"""From the certified solve to the locations that are kept: a second start, and the robust finish of both.

ShapeFit's optimum concentrates length on the cleanest stretch of a long chain, and collapses under heavy
corruption; LUD has a bound on each length and does not, but is less exact. Both are refined in angles, where
neither bias exists, and the one of lower robust cost is kept. How far the two convex starts disagree says
whether ShapeFit's optimum can be believed by itself: the standard deviation, over cameras, of the log ratio
of their node lengths, a camera's node length being the median length of its pairs.
"""

from dataclasses import dataclass, replace

import numpy as np

from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.geometry import median_spread
from sfm_shapefit.laplacian.symbolic import SymbolicFactor
from sfm_shapefit.refinement.angular import (
    AngularResult,
    Metric,
    NormalFactor,
    agreeing_pairs,
    plan_refinement,
    refine_angles,
    residual_levels,
    robust_cost,
)
from sfm_shapefit.refinement.options import PlacementOptions
from sfm_shapefit.refinement.resets import put_back, strays
from sfm_shapefit.solver.options import SolverResult, Status
from sfm_shapefit.solver.program import differences, normalized_locations, projected_length
from sfm_shapefit.solver.rigs import ReducedFactor, lud_over_groups
from sfm_shapefit.solver.rigs.groups import RigidGroups
from sfm_shapefit.solver.splitting.lud import LudResult, solve_lud
from sfm_shapefit.viewgraph import ViewGraph

COLLAPSED = 0.3
"""Disagreement of the starts beyond which one of them has collapsed."""

_UNEQUAL = 0.1  # disagreement from which LUD is likely to be the better start
_LUD_STEPS = 50  # more change nothing after the refinement
_LUD_CERTIFIED_PAIRS = 50_000  # its bound costs about 100 more iterations
_LUD_PAIRS = 1_000_000  # beyond, the second start takes as long as the first
_POINT_WEIGHT = 10.0  # of a direction to a 3D point in LUD, where all have one loss whatever their noise
_TIE = 1e-3  # relative difference of costs that says nothing where the starts disagree
_OPENING_RAD = 0.1  # width of the kernel at which unrefined starts are compared at most


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Start:
    """One convex start, and what became of it."""

    name: str
    """ "ShapeFit" or "LUD"."""
    locations: FloatArray
    """(n, d) as solved."""
    refined: AngularResult | None
    """None where it was not refined."""
    put_back: IntArray
    """Nodes that the refinement threw out of the scene, and that are where the home had them instead."""

    @property
    def best(self) -> FloatArray:
        """The refined locations if there are any."""
        return self.locations if self.refined is None else self.refined.locations


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Finish:
    """The locations that are kept, and why."""

    locations: FloatArray
    """(n, d) centred, scaled like the solver's."""
    start: str
    """The program they come from: "ShapeFit", "LUD", or the name of a baseline."""
    refined: bool
    """Whether they differ from its optimum."""
    reason: str
    """Why this start, a sentence for the user."""
    disagreement: float | None
    """Standard deviation of the log ratio of node lengths between the two starts; None with one start."""
    costs: dict[str, float]
    """Robust cost of what each start led to, all at `levels_deg`."""
    levels_deg: tuple[float, ...]
    """Noise level of each class of directions: between cameras, then from cameras to points."""
    moved: tuple[float, float]
    """Median and largest move of a node by the refinement, as a share of the median distance from the
    centre."""
    num_turned_pairs: int
    """Directions, those to points too, that fit the start and not the refined locations, or the other way
    round, at `levels_deg`."""
    put_back: IntArray
    """Nodes that the refinement threw out of the scene, ascending; they are where LUD, or else the start, had
    them instead, and nothing says that they belong there."""
    lud: LudResult | None
    """The second start, with its own dual bound (0 where that was not computed)."""

    @property
    def num_put_back(self) -> int:
        """How many nodes the refinement threw out of the scene."""
        return len(self.put_back)

    @property
    def collapsed(self) -> bool:
        """Whether the starts disagree so much that one of them must have collapsed."""
        return self.disagreement is not None and self.disagreement > COLLAPSED

    def statement(self) -> str:
        """Say where the locations come from and what the refinement changed, in a sentence."""
        if not self.refined:
            return f"{self.start}, not refined: {self.reason}"
        median, largest = self.moved
        back = f"; {self.num_put_back} thrown out of the scene and put back" if self.num_put_back else ""
        nodes = "cameras and points" if len(self.levels_deg) > 1 else "cameras"
        return (
            f"{self.start}, refined in angles ({nodes} moved by {median:.2%} of the scene's radius, at most "
            f"{largest:.2%}; {self.num_turned_pairs} directions of theirs went from agreeing to "
            f"contradicting or back{back}): {self.reason}"
        )


def finish(
    graph: ViewGraph,
    solved: SolverResult,
    options: PlacementOptions,
    covariance: FloatArray | None = None,
    classes: IntArray | None = None,
    groups: RigidGroups | None = None,
) -> Finish:
    """Return the locations to keep for a solved view graph.

    Args:
        graph: connected and parallel rigid.
        solved: its certified ShapeFit solution, or a baseline's answer, which is kept as it is.
        options: which starts, and whether to refine.
        covariance: (m, d - 1, d - 1) of each direction in `tangent_bases(graph.directions)`, rad^2; NaN where
            unknown, None where all are.
        classes: (m,) 0 for pairs of cameras, 1 for directions to points; None: all 0.
        groups: the rigid groups that the nodes belong to; then every pair joins two of them, and the
            locations are theirs.
    """
    classes = np.zeros(graph.num_edges, dtype=np.int64) if classes is None else classes
    metric = Metric(covariance, classes)
    if solved.status is Status.NOT_SOLVED:
        return _as_located(graph, solved, metric)
    lud, second = _second_start(graph, classes, options.num_threads(), groups)
    plan = _plan(graph, groups, options.factor_memory_mb * 1_000_000) if options.refines else None

    apart = None if second is None else disagreement(graph, solved.locations, second)
    candidates = [("ShapeFit", solved.locations)] + ([] if second is None else [("LUD", second)])
    if apart is not None and apart > _UNEQUAL:
        candidates.reverse()  # the likely better one first: the other ends early where it loses
    starts: list[Start] = []
    for name, locations in candidates:
        rival = starts[0].best if starts else None
        home = locations if second is None else second
        starts.append(_refined(name, locations, home, graph, metric, plan, rival))
    levels = _common_levels(graph, starts, metric)
    costs = {start.name: robust_cost(graph, start.best, metric, levels) for start in starts}
    kept, reason = _choose(starts, costs, apart, options)
    if plan is None and options.refines:
        reason += "; not refined, since the factor for that would be too large"
    moved = _moves(kept)
    certified = kept.name == "ShapeFit" and moved[1] == 0.0  # to the bit
    return Finish(
        locations=solved.locations if certified else normalized_locations(graph, kept.best),
        start=kept.name,
        refined=moved[1] > 0.0,
        reason=reason,
        disagreement=apart,
        costs=costs,
        levels_deg=tuple(np.degrees(levels).tolist()),
        moved=moved,
        num_turned_pairs=_turned_pairs(graph, kept, metric, levels),
        put_back=kept.put_back,
        lud=lud,
    )


def _plan(
    graph: ViewGraph, groups: RigidGroups | None, max_bytes: int
) -> SymbolicFactor | NormalFactor | None:
    """Return what the refinement solves its steps with, or None if its factor would be too large."""
    if groups is None:
        return plan_refinement(graph, max_bytes)
    return ReducedFactor(graph.edges, groups.normalize())


def _second_start(
    graph: ViewGraph, classes: IntArray, threads: int, groups: RigidGroups | None
) -> tuple[LudResult | None, FloatArray | None]:
    """Return LUD's solution, which groups have none of, and its locations."""
    if groups is None:
        lud = _lud_start(graph, classes, threads) if has_second_start(graph) else None
        return lud, None if lud is None else lud.locations
    metric, opening = Metric(None, classes), np.full(int(classes.max()) + 1, _OPENING_RAD)
    found = []
    for point_weight in (_POINT_WEIGHT, 1.0 / _POINT_WEIGHT) if classes.any() else (1.0,):
        locations = lud_over_groups(_weighted(graph, classes, point_weight), groups)
        if locations is not None and projected_length(graph, locations) > 0.0:
            found.append((robust_cost(graph, locations, metric, opening), locations))
    return None, min(found, key=lambda pair: pair[0])[1] if found else None


def _weighted(graph: ViewGraph, classes: IntArray, point_weight: float = _POINT_WEIGHT) -> ViewGraph:
    """Return the graph with the weights that directions to points have in LUD."""
    return graph.with_weights(np.where(classes > 0, point_weight, 1.0) * graph.weights)


def _as_located(graph: ViewGraph, solved: SolverResult, metric: Metric) -> Finish:
    """Return a baseline's answer as it is."""
    start = _unrefined(solved.method, solved.locations)
    return _alone(graph, start, metric, solved.locations, "the baseline's own answer, as asked")


def _alone(graph: ViewGraph, start: Start, metric: Metric, locations: FloatArray, reason: str) -> Finish:
    """Return the finish where there is one start."""
    levels = _common_levels(graph, [start], metric)
    moved = _moves(start)
    return Finish(
        locations=locations,
        start=start.name,
        refined=moved[1] > 0.0,
        reason=reason,
        disagreement=None,
        costs={start.name: robust_cost(graph, start.best, metric, levels)},
        levels_deg=tuple(np.degrees(levels).tolist()),
        moved=moved,
        num_turned_pairs=_turned_pairs(graph, start, metric, levels),
        put_back=start.put_back,
        lud=None,
    )


def has_second_start(graph: ViewGraph) -> bool:
    """Return whether a graph is small enough for LUD beside ShapeFit, and large enough to need it."""
    return graph.num_edges <= _LUD_PAIRS and graph.num_nodes > 2


def disagreement(graph: ViewGraph, a: FloatArray, b: FloatArray) -> float:
    """Return the standard deviation of the log ratio of node lengths of two sets of locations (n, d)."""
    ratio = np.log(_node_lengths(graph, a) / _node_lengths(graph, b))
    return float(np.std(ratio))


def _node_lengths(graph: ViewGraph, t: FloatArray) -> FloatArray:
    """Return the median length of each camera's pairs, (n,), at least a millionth of the mean of all."""
    lengths = np.linalg.norm(differences(t, graph.edges), axis=1)
    camera = graph.edges.T.ravel()
    order = np.lexsort((np.tile(lengths, 2), camera))
    degree = graph.degrees()
    first = np.cumsum(degree) - degree
    ranked = np.tile(lengths, 2)[order]
    low, high = ranked[first + (degree - 1) // 2], ranked[first + degree // 2]
    return np.asarray(np.maximum(0.5 * (low + high), 1e-6 * np.mean(lengths)))


def _lud_start(graph: ViewGraph, classes: IntArray, threads: int) -> LudResult | None:
    """Return LUD's solution after a few iterations, or None where it is not a placement at all."""
    certified = graph.num_edges <= _LUD_CERTIFIED_PAIRS
    found = solve_lud(_weighted(graph, classes), _LUD_STEPS, certified=certified, threads=threads)
    usable = np.isfinite(found.locations).all() and projected_length(graph, found.locations) > 0.0
    return found if usable else None


def _unrefined(name: str, locations: FloatArray) -> Start:
    """Return a start as it was solved."""
    return Start(name=name, locations=locations, refined=None, put_back=np.empty(0, dtype=np.int64))


def _refined(
    name: str,
    locations: FloatArray,
    home: FloatArray,
    graph: ViewGraph,
    metric: Metric,
    plan: SymbolicFactor | NormalFactor | None,
    rival: FloatArray | None,
) -> Start:
    """Return a start with what the refinement makes of it; nothing, if that turns all directions round.

    `home` are the locations among which nodes are put back that the refinement throws out.
    """
    if plan is None:
        return _unrefined(name, locations)
    refined = refine_angles(graph, locations, metric, plan, rival)
    alone = np.ones(graph.num_nodes, dtype=np.bool_)
    if isinstance(plan, ReducedFactor):
        alone = np.bincount(plan.groups.group_of)[plan.groups.group_of] == 1
    refined, nodes = _without_strays(graph, home, refined, metric, alone)
    if projected_length(graph, refined.locations) <= 0.0:
        return _unrefined(name, locations)
    return Start(name=name, locations=locations, refined=refined, put_back=nodes)


def _without_strays(
    graph: ViewGraph, home: FloatArray, refined: AngularResult, metric: Metric, alone: BoolArray
) -> tuple[AngularResult, IntArray]:
    """Return a refinement whose strays are put back, and these nodes; all of the home, if that fits better.

    Only nodes that are a group of their own, `alone`, can be put back one by one.
    """
    levels = refined.levels_rad
    agreeing = agreeing_pairs(graph, refined.locations, metric, levels)
    nodes = strays(graph, home, refined.locations, agreeing, _noise(metric, levels))
    nodes = nodes[alone[nodes]]
    if len(nodes) == 0:
        return refined, nodes
    locations = _unit(put_back(home, refined.locations, nodes))
    cost, home_cost = (robust_cost(graph, t, metric, levels) for t in (locations, home))
    if home_cost < cost:
        return replace(refined, locations=_unit(home), cost=home_cost), nodes
    return replace(refined, locations=locations, cost=cost), nodes


def _noise(metric: Metric, levels: FloatArray) -> FloatArray:
    """Return the standard deviation of each direction (m,), per axis, radians."""
    variances = levels[metric.classes] ** 2
    if metric.covariance is not None:
        own = np.nan_to_num(metric.covariance, nan=0.0, posinf=0.0)
        variances = variances + np.trace(own, axis1=1, axis2=2) / own.shape[1]
    return np.asarray(np.sqrt(variances))


def _turned_pairs(graph: ViewGraph, kept: Start, metric: Metric, levels: FloatArray) -> int:
    """Return how many pairs the refinement made fit, or not fit any more."""
    if kept.refined is None:
        return 0
    before, after = (agreeing_pairs(graph, t, metric, levels) for t in (kept.locations, kept.best))
    return int(np.sum(before != after))


def _common_levels(graph: ViewGraph, starts: list[Start], metric: Metric) -> FloatArray:
    """Return the levels at which costs are compared: the smallest of each class that a start ended with."""
    ended = [start.refined.levels_rad for start in starts if start.refined is not None]
    if not ended:
        opening = np.full(int(metric.classes.max()) + 1, _OPENING_RAD)
        ended = [residual_levels(graph, start.locations, metric, opening) for start in starts]
    return np.asarray(np.min(ended, axis=0))


def _choose(
    starts: list[Start], costs: dict[str, float], apart: float | None, options: PlacementOptions
) -> tuple[Start, str]:
    """Return the start to keep and the reason."""
    by_name = {start.name: start for start in starts}
    if options.objective == "shapefit":
        return by_name["ShapeFit"], "the certified ShapeFit optimum, as asked"
    if len(starts) == 1:
        wanted = ", which LUD would have been" if options.objective == "lud" else ""
        return by_name["ShapeFit"], f"the graph has no second start{wanted}"
    if options.objective == "lud":
        return by_name["LUD"], "LUD, as asked"
    assert apart is not None
    difference = costs["LUD"] - costs["ShapeFit"]
    if apart <= COLLAPSED:
        name = "LUD" if difference < 0.0 else "ShapeFit"
        return by_name[
            name
        ], f"the starts' lengths differ by {apart:.0%}, not by a collapse; {name} fits no worse"
    if abs(difference) <= _TIE * min(costs.values()):
        return by_name["LUD"], (
            f"the starts disagree (lengths by {apart:.0%}) and fit alike: LUD, whose lengths cannot collapse"
        )
    name = "LUD" if difference < 0.0 else "ShapeFit"
    return by_name[name], f"the starts disagree (lengths by {apart:.0%}); {name} fits the directions better"


def _unit(t: FloatArray) -> FloatArray:
    centred = t - t.mean(axis=0)
    return np.asarray(centred / np.linalg.norm(centred))


def _moves(kept: Start) -> tuple[float, float]:
    """Return the median and the largest move by the refinement, see `Finish.moved`."""
    before, after = _unit(kept.locations), _unit(kept.best)
    moved = np.linalg.norm(after - before, axis=1) / median_spread(after)
    return float(np.median(moved)), float(moved.max())
