"""From the certified solve to the locations that are kept: a second start, and the refinement of both.

ShapeFit's optimum concentrates length on the cleanest stretch of a long chain, and collapses under heavy
corruption; LUD has a bound on each length and does not, but is less exact. Both are refined in angles, where
neither bias exists, and the one of lower robust cost is kept. Where even that explains few of the pairs,
ShapeFit is solved at the weights of a posterior, and kept if the directions speak for it (`reweighted`).
Whether ShapeFit's optimum can be believed by itself is seen by how far both disagree: the standard deviation,
over cameras, of the log ratio of their node lengths, which are medians of the lengths of a camera's pairs.
"""

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple, Self

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, stable_order
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import fit_similarity_l1, median_spread
from sfm_shapefit.base.record import Record
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.factor import FactorPlan, LaplacianFactor
from sfm_shapefit.refinement.angular import (
    ALIKE,
    AngularResult,
    fitting_pairs,
    plan_refinement,
    refine_angles,
    residual_levels,
    robust_cost,
    unit_norm,
)
from sfm_shapefit.refinement.cg_normal_solver import IterativeNormal
from sfm_shapefit.refinement.consensus import ResidualMixture, fit_mixture, own_variances
from sfm_shapefit.refinement.mixture import Mixture, MixtureEnd
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.refinement.posterior import TriangleEvidence
from sfm_shapefit.refinement.resets import find_strays, put_back
from sfm_shapefit.refinement.reweighted import (
    POOR_SHARE,
    Reweighted,
    can_be_reweighted,
    solve_at_triangles,
    solve_reweighted,
)
from sfm_shapefit.solver.program import differences, normalize_locations, projected_length
from sfm_shapefit.solver.reduction import Reduction
from sfm_shapefit.solver.solver_options import PAIRS_AT_SCALE, Solve, SolverResult
from sfm_shapefit.solver.splitting.linear import Resources
from sfm_shapefit.solver.splitting.lud import Lud, solve_lud

COLLAPSED = 0.3
"""Disagreement of the starts beyond which one has collapsed; see `disagreement`."""

_UNEQUAL = 0.1  # disagreement of the starts; from here on LUD is likely to be the better one
_SAME, _MANY_CAMERAS = 0.01, 1_000  # likewise, and cameras; of many starts nearer than that, one is refined
_LUD_STEPS, _GROUP_LUD_STEPS = 50, 150  # iterations; more change nothing after the refinement
_LUD_CERTIFIED_PAIRS = 50_000  # pairs; above, LUD's own bound would cost about 100 more iterations
_POINT_WEIGHT = 10.0  # LUD's weight of a direction to a 3D point; one loss there serves every noise
_TIE = 1e-3  # relative difference of costs; a smaller one says nothing where the starts disagree
_POINT_LENGTH = 1e-6  # share of the mean length of all pairs; the cameras of a shorter one stand in one place
_APART, _CAP = 0.05, 3.0  # spreads of a scene; median distance between two, and largest that counts as such
_EXPLAINED = 0.9  # share of the pairs; an answer that explains fewer may be a fold, and triangles are asked
_POORLY_EXPLAINED = 0.35  # share of the pairs; below, posteriors are followed from solve to solve, too
OPENING_RAD = 0.1
"""Largest width of the kernel, in radians, at which unrefined starts are compared; see `angular`."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Start:
    """One convex start, and what became of it."""

    name: str
    """ "ShapeFit", "LUD" or "reweighted ShapeFit"."""
    locations: FloatArray
    """(n, d) as solved."""
    refined: AngularResult | None
    """None where it was not refined."""
    reset_nodes: IntArray
    """Nodes that the refinement moved far out, and that are where the fallback has them instead."""

    @property
    def best(self) -> FloatArray:
        """The refined locations if there are any."""
        return self.locations if self.refined is None else self.refined.locations


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rival:
    """Another explanation of the directions than the kept one."""

    end: MixtureEnd
    """Its locations (n, d), in a scale and from an origin of their own, and which directions it explains."""
    is_apart: bool
    """Whether most of its locations are elsewhere; if so, it is the best end near where a start led to."""
    behind: float
    """Nats of evidence that the kept explanation has more, both at the noise of the noisier of the two."""


class Finish(Record):
    """From the certified optimum to the centers."""

    start: Annotated[str, "The convex start that was kept."]
    refined: Annotated[bool, "Whether the angular refinement moved the start."]
    reason: Annotated[str, "Why this start was kept."]
    disagreement: Annotated[float | None, "How far the two starts disagree about lengths, as a share."]
    costs: Annotated[dict[str, float], "Robust angular cost of each start after refinement."]
    levels_deg: Annotated[tuple[float, ...], "Level of the residuals, of pairs and of directions to points."]
    moved_median: Annotated[
        float,
        "Median move of cameras and points from the start that is kept, as a share of their median distance "
        "from the center.",
    ]
    moved_max: Annotated[float, "The largest such move."]
    num_turned_pairs: Annotated[
        int,
        "Directions, those to points too, that fit the start and not the refined locations, or the other way "
        "round.",
    ]
    num_put_back: Annotated[int, "Cameras that had left the scene and were put back."]
    lud: Annotated[Lud | None, "The second start; null if it was not solved."]
    reweighted: Annotated[
        Solve | None,
        "The program at the weights that are the pairs' posteriors, certified at these; null where the "
        "cameras come from another start.",
    ]

    @property
    def collapsed(self) -> bool:
        """Whether the starts disagree so much that one of them must have collapsed."""
        return self.disagreement is not None and self.disagreement > COLLAPSED

    def statement(self) -> str:
        """Say where the locations come from and what the refinement changed, in a sentence."""
        if not self.refined:
            return f"{self.start}, not refined: {self.reason}"
        back = f"; {self.num_put_back} thrown out of the scene and put back" if self.num_put_back else ""
        nodes = "cameras and points" if len(self.levels_deg) > 1 else "cameras"
        return (
            f"{self.start}, refined in angles ({nodes} moved by {self.moved_median:.2%} of the scene's "
            f"radius, at most {self.moved_max:.2%}; {self.num_turned_pairs} directions of theirs went from "
            f"agreeing to contradicting or back{back}): {self.reason}"
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RefinedPlacement:
    """The locations that are kept, and why."""

    locations: FloatArray
    """(n, d) centered, scaled like the solver's."""
    finish: Finish
    """How they were found."""
    reset_nodes: IntArray
    """Nodes that the refinement moved far out, ascending; they are where LUD, or else the start, has them
    instead, and nothing says that they belong there."""
    posterior: FloatArray
    """(m,) probability that each direction is right, by its residual and those of all (`consensus`)."""
    reweighted: Reweighted | None
    """The program at other weights that the locations come from, certified; None where another was kept."""
    variances: FloatArray | None = None
    """(m,) variance per axis of each direction if it is right, rad^2; None where one level serves all."""
    rivals: tuple[Rival, ...] = ()
    """Where other starts led to under a mixture, most evidence first; often near the kept one."""
    triangles: TriangleEvidence | None = None
    """What triangles say of the directions; None where nothing asked them, or they chose weights alone."""

    @property
    def right(self) -> BoolArray | None:
        """(m,) the directions that are taken for right; None where most of all are."""
        if self.variances is not None:
            return np.asarray(self.posterior > 0.5)
        return None if self.reweighted is None else np.asarray(self.posterior > 0.5)

    def moved_to(self, locations: FloatArray, reset_nodes: IntArray, **finish: Any) -> Self:
        """Return the same at other locations (n, d), for which the variances of directions do not hold."""
        told = replace(self.finish, num_put_back=len(reset_nodes), **finish)
        return replace(self, locations=locations, finish=told, reset_nodes=reset_nodes, variances=None)


class _Problem(NamedTuple):
    measured: MeasuredGraph
    normal_solver: FactorPlan | LaplacianFactor | None
    """What the refinement solves its steps with; None where the starts are not refined."""
    first: FloatArray
    """(n, d) ShapeFit's optimum."""
    second: FloatArray | None
    """(n, d) LUD's."""
    apart: float | None
    """See `disagreement`."""
    threads: int


def refine_starts(
    measured: MeasuredGraph, solved: SolverResult, options: PlacementOptions, *, certified: bool = True
) -> RefinedPlacement:
    """Return the locations to keep for a solved graph.

    Args:
        measured: connected and parallel rigid, or rigid groups that are tied to one another, in which case
            every pair joins two of them.
        solved: its ShapeFit solution.
        options: which starts, and whether to refine.
        certified: compute the bound of the second start, too, where that takes little.
    """
    graph = measured.graph
    lud, second = _find_second_start(measured, options.solver.num_threads(), certified)
    apart = None if second is None else disagreement(graph, solved.locations, second)
    normal_solver = _plan_normal_solver(measured, options) if options.refines else None
    threads = options.solver.num_threads()
    problem = _Problem(measured, normal_solver, solved.locations, second, apart, threads)
    kept = _find_most_evident(problem, options) or _find_best_fit(problem, options)
    median, largest = _measure_moves(kept.start)
    # To the bit: the certificate is that of these very locations.
    is_as_solved = kept.start.locations is solved.locations and largest == 0.0
    finish = Finish(
        start=kept.start.name,
        refined=largest > 0.0,
        reason=kept.reason,
        disagreement=apart,
        costs=kept.costs,
        levels_deg=tuple(np.degrees(kept.levels).tolist()),
        moved_median=median,
        moved_max=largest,
        num_turned_pairs=_count_turned_pairs(measured, kept.start, kept.levels),
        num_put_back=len(kept.start.reset_nodes),
        lud=lud,
        reweighted=None if kept.reweighted is None else kept.reweighted.solved.facts,
    )
    return RefinedPlacement(
        locations=solved.locations if is_as_solved else normalize_locations(graph, kept.start.best),
        finish=finish,
        reset_nodes=kept.start.reset_nodes,
        posterior=kept.posterior,
        reweighted=kept.reweighted,
        variances=kept.variances,
        rivals=kept.rivals,
        triangles=kept.triangles,
    )


class _Kept(NamedTuple):
    """The answer among all starts; see `RefinedPlacement` for most."""

    start: Start
    reason: str
    costs: dict[str, float]
    levels: FloatArray
    """(C,) radians."""
    posterior: FloatArray
    reweighted: Reweighted | None
    variances: FloatArray | None = None
    rivals: tuple[Rival, ...] = ()
    triangles: TriangleEvidence | None = None


def _find_best_fit(problem: _Problem, options: PlacementOptions) -> _Kept:
    """Return the start that fits the angles best, or one at other weights where that fits far more pairs."""
    measured, second, apart = problem.measured, problem.second, problem.apart
    is_iterative = isinstance(problem.normal_solver, IterativeNormal)
    # Refinements of so many are dear, and starts that are so near to one another lead to one place.
    near = _UNEQUAL if is_iterative else _SAME if measured.num_cameras >= _MANY_CAMERAS else 0.0
    candidates = [("ShapeFit", problem.first), *([] if second is None else [("LUD", second)])]
    if apart is not None and apart > _UNEQUAL:
        # The likely better one comes first: the other ends early where it loses.
        candidates.reverse()
    elif apart is not None and apart < near and options.objective != "lud":
        candidates.pop()
    reweighted, refining = None, problem
    if is_iterative and options.objective == "auto":  # what the weights answer needs no other refinement
        mixture = fit_mixture(measured, candidates[0][1], problem.threads)
        reweighted = _reweight(problem, candidates[0][1], mixture, options)
        refining = problem if reweighted is None else problem._replace(normal_solver=None)
    starts: list[Start] = []
    for name, locations in candidates:
        fallback = locations if second is None else second
        starts.append(_refine_start(refining, name, locations, fallback, starts[0].best if starts else None))
    levels = _common_levels(measured, starts)
    costs = {start.name: robust_cost(measured, start.best, levels) for start in starts}
    chosen, reason = choose_start(measured.graph, starts, costs, apart, options)
    if problem.normal_solver is None and options.refines:
        reason += "; not refined, since the factor for that would be too large"
    if reweighted is None:
        mixture = fit_mixture(measured, chosen.best, problem.threads)
        reweighted = _reweight(problem, chosen.best, mixture, options)
    if reweighted is not None:
        chosen, reason = _start_of(reweighted), _explain(mixture, reweighted)
        if reweighted.refined is not None:
            levels = np.minimum(levels, reweighted.refined.levels_rad)
        costs[chosen.name] = robust_cost(measured, chosen.best, levels)
    posterior = (mixture if reweighted is None else reweighted.mixture).posterior
    return _Kept(chosen, reason, costs, levels, posterior, reweighted)


class _Candidate(NamedTuple):
    """A start, where its descent ended, and the program that it comes from, if that has other weights."""

    name: str
    start: FloatArray
    end: MixtureEnd
    reweighted: Reweighted | None = None


def _find_most_evident(problem: _Problem, options: PlacementOptions) -> _Kept | None:
    """Return the end of most evidence under a mixture of noise levels; None if the graph has no such end."""
    measured, plan = problem.measured, problem.normal_solver
    is_bare = measured.evidence is None and measured.num_points == 0
    if not (options.objective == "auto" and is_bare and can_be_reweighted(measured)):
        return None
    if not isinstance(plan, FactorPlan):
        return None
    model = Mixture(measured, plan, options.solver.num_threads())
    candidates = _descend_from_starts(model, problem, options)
    if not candidates:
        return None
    best, end, rivals = _compare_ends(model, candidates)
    fallback = problem.first if problem.second is None else problem.second
    right, noise = end.posterior > 0.5, np.sqrt(end.variances)
    strays = find_strays(measured.graph, fallback, end.locations, right, noise)
    locations = put_back(fallback, end.locations, strays)
    if projected_length(measured.graph, locations) <= 0.0:
        return None
    levels = np.array([np.sqrt(np.median(end.variances))])
    refined = AngularResult(locations=locations, levels_rad=levels, cost=-end.bound, iterations=0)
    start = Start(name=best.name, locations=best.start, refined=refined, reset_nodes=strays)
    of_starts = "the only start" if len(candidates) == 1 else f"most evidence of {len(candidates)} starts"
    reason = f"{of_starts}, which explains {end.right_share:.0%} of the pairs by a mixture of noise levels"
    if best.reweighted is not None:
        reason += f"; {_say_certified(best.reweighted)}"
    costs = {found.name: -found.end.bound for found in candidates}
    asked = (found.reweighted.triangles for found in candidates if found.reweighted is not None)
    return _Kept(
        start=start,
        reason=reason,
        costs=costs,
        levels=levels,
        posterior=end.posterior,
        reweighted=best.reweighted,
        variances=end.variances,
        rivals=tuple(rivals),
        triangles=next(asked, None),
    )


def _compare_ends(model: Mixture, candidates: list[_Candidate]) -> tuple[_Candidate, MixtureEnd, list[Rival]]:
    """Return the candidate of most evidence, the end that it is improved to, and the others beside that.

    Another end that stands apart is improved, too: two places are compared at their best.
    """
    best = candidates[0]
    for other in candidates[1:]:
        best = other if model.lead(other.end, best.end) > 0.0 else best
    # Starts may lead to one end; the certificate at posteriors is the one that says more of it.
    same = (found for found in candidates if found.end is best.end and found.reweighted is not None)
    best = next(same, best)
    end, others = model.improve(best.end), list[MixtureEnd]()
    for other in [found for found in candidates if found.end is not best.end]:
        theirs = other.end
        if _is_apart(theirs.locations, end.locations):
            theirs = model.improve(theirs)
            if model.lead(theirs, end) > 0.0:
                best, end, theirs = other, theirs, end
        others.append(theirs)
    rivals = (
        Rival(end=x, is_apart=_is_apart(x.locations, end.locations), behind=model.lead(end, x))
        for x in others
    )
    return best, end, sorted(rivals, key=lambda rival: rival.behind)


def _is_apart(t: FloatArray, onto: FloatArray) -> bool:
    """Return whether most locations (n, d) are not at others, after the best shift and scale."""
    spread = median_spread(onto)
    # The cap: a single location that is far out would shrink all others to one point.
    fitted = fit_similarity_l1(t, onto, rotate=False, cap=_CAP * spread).apply(t)
    return bool(np.median(np.linalg.norm(fitted - onto, axis=1)) > _APART * spread)


def _descend_from_starts(model: Mixture, problem: _Problem, options: PlacementOptions) -> list[_Candidate]:
    """Return where the usual start leads to, and others where that leaves pairs unexplained.

    An end that explains no pair has no noise of its own at which another could be compared with it.
    """
    # ShapeFit's optimum collapses where the starts disagree, and LUD's cannot.
    is_lud = problem.apart is not None and problem.apart > _UNEQUAL
    name, start = ("LUD", problem.second) if is_lud else ("ShapeFit", problem.first)
    assert start is not None
    end = model.descend(start)
    if end is None:
        return []
    candidates = [_Candidate(name, start, end)]
    for other, weigh, share in (
        ("ShapeFit at triangles", _by_triangles, _EXPLAINED),
        ("reweighted ShapeFit", _by_posteriors, _POORLY_EXPLAINED),
    ):
        best = max((candidate.end for candidate in candidates), key=lambda end: end.right_share)
        if best.right_share >= share or (found := weigh(problem, best, options)) is None:
            continue
        reweighted, start = found
        end = model.descend(start)
        if end is not None:
            candidates.append(_Candidate(other, start, end, reweighted))
    return [candidate for candidate in candidates if candidate.end.posterior.max() > 0.5]


def _by_triangles(
    problem: _Problem, _best: MixtureEnd, options: PlacementOptions
) -> tuple[Reweighted, FloatArray]:
    """Return ShapeFit at the posteriors that triangles give, and the start: it or LUD at them."""
    graph = problem.measured.graph
    found = solve_at_triangles(problem.measured, options.solver.at_scale(graph.num_edges))
    if has_second_start(graph):
        second = solve_lud(found.graph, _LUD_STEPS, certified=False).locations
        if np.isfinite(second).all() and disagreement(graph, found.locations, second) > _UNEQUAL:
            return found, second
    return found, found.locations


def _by_posteriors(
    problem: _Problem, best: MixtureEnd, options: PlacementOptions
) -> tuple[Reweighted, FloatArray] | None:
    """Return the best ShapeFit at posteriors of residuals and triangles, in turn, and where it leads to."""
    mixture = fit_mixture(problem.measured, best.locations, problem.threads)
    found = _reweight(problem, best.locations, mixture, options)
    return None if found is None else (found, found.locations)


def _say_certified(reweighted: Reweighted) -> str:
    """Say what the certificate of a program at other weights is of."""
    return f"certified to {max(reweighted.solved.gap, 0.0):.1e} at weights that are the pairs' posteriors"


def _reweight(
    problem: _Problem, usual: FloatArray, mixture: ResidualMixture, options: PlacementOptions
) -> Reweighted | None:
    """Return the reweighted start where the usual answer explains few pairs and it explains them better."""
    solver, measured = problem.normal_solver, problem.measured
    if solver is None or options.objective != "auto":
        return None
    if mixture.shares[0] >= POOR_SHARE or not can_be_reweighted(measured):
        return None

    def refine(graph: ViewGraph, locations: FloatArray, fallback: FloatArray) -> AngularResult:
        weighted = replace(measured, graph=graph)
        refined = refine_angles(weighted, locations, solver, threads=problem.threads)
        return _reset_strays(weighted, fallback, refined)[0]

    return solve_reweighted(measured, usual, options.solver.at_scale(measured.graph.num_edges), refine)


def _start_of(reweighted: Reweighted) -> Start:
    return Start(
        name="reweighted ShapeFit",
        locations=reweighted.solved.locations,
        refined=reweighted.refined,
        reset_nodes=np.empty(0, dtype=np.int64),
    )


def _explain(usual: ResidualMixture, reweighted: Reweighted) -> str:
    """Say why a reweighted start is kept, and what its certificate is of."""
    before, after = usual.shares[0], reweighted.mixture.shares[0]
    explained = f"the usual starts explain {before:.0%} of the pairs, this one {after:.0%}"
    return f"{explained}; {_say_certified(reweighted)}"


def _plan_normal_solver(
    measured: MeasuredGraph, options: PlacementOptions
) -> FactorPlan | LaplacianFactor | None:
    """Return what the refinement solves its steps with; None if its factor would be too large."""
    graph, groups, max_bytes = measured.graph, measured.groups, options.solver.factor_bytes
    if groups is None:
        return plan_refinement(graph, max_bytes, options.solver.num_threads())
    try:
        return Reduction.over(graph.edges, groups.normalize(), max_bytes=max_bytes)
    except UnsolvableError:
        return None


def _find_second_start(
    measured: MeasuredGraph, threads: int, certified: bool
) -> tuple[Lud | None, FloatArray | None]:
    """Return LUD's solution after a few steps, which groups have none of, and its locations, if usable."""
    graph, classes, groups = measured.graph, measured.classes, measured.groups
    if groups is None and not has_second_start(graph):
        return None, None
    if groups is None:
        certified = certified and graph.num_edges <= _LUD_CERTIFIED_PAIRS
        weighted, resources = _weight_points(graph, classes), Resources(threads)
        lud = solve_lud(weighted, _LUD_STEPS, certified=certified, resources=resources)
        is_usable = np.isfinite(lud.locations).all() and projected_length(graph, lud.locations) > 0.0
        return (lud, lud.locations) if is_usable else (None, None)
    bare, opening = replace(measured, covariance=None), np.full(classes.max() + 1, OPENING_RAD)
    rigid, candidates = Resources(factor=Reduction.over(graph.edges, groups.normalize())), []
    for point_weight in (_POINT_WEIGHT, 1.0 / _POINT_WEIGHT) if classes.any() else (1.0,):
        weighted = _weight_points(graph, classes, point_weight)
        with suppress(UnsolvableError):
            found = solve_lud(weighted, _GROUP_LUD_STEPS, certified=False, resources=rigid).locations
            if np.isfinite(found).all() and projected_length(graph, found) > 0.0:
                candidates.append((robust_cost(bare, found, opening), found))
    return None, min(candidates, key=lambda pair: pair[0])[1] if candidates else None


def _weight_points(graph: ViewGraph, classes: IntArray, point_weight: float = _POINT_WEIGHT) -> ViewGraph:
    """Return the graph with the weights that directions to points have in LUD."""
    return graph.with_weights(np.where(classes > 0, point_weight, 1.0) * graph.weights)


def has_second_start(graph: ViewGraph) -> bool:
    """Return whether a graph is small enough for LUD beside ShapeFit, and large enough to need it."""
    return graph.num_edges <= PAIRS_AT_SCALE and graph.num_nodes > 2


def disagreement(graph: ViewGraph, a: FloatArray, b: FloatArray) -> float:
    """Return the standard deviation of the log ratio of node lengths of two sets of locations (n, d)."""
    return float(np.std(np.log(_node_lengths(graph, a) / _node_lengths(graph, b))))


def _node_lengths(graph: ViewGraph, t: FloatArray) -> FloatArray:
    """Return the median length of each camera's pairs, (n,), at least a millionth of the mean of all."""
    lengths = np.linalg.norm(differences(t, graph.edges), axis=1)
    rank, degree = np.argsort(lengths), graph.degrees()
    ranked = np.repeat(lengths[rank], 2)[stable_order(graph.edges[rank].ravel())]
    first = np.cumsum(degree) - degree
    low, high = ranked[first + (degree - 1) // 2], ranked[first + degree // 2]
    return np.asarray(np.maximum(0.5 * (low + high), _POINT_LENGTH * np.mean(lengths)))


def _is_point(graph: ViewGraph, t: FloatArray) -> bool:
    """Return whether most cameras of a start stand in one point, where angles say nothing any more."""
    lengths = np.linalg.norm(differences(t, graph.edges), axis=1)
    return bool(np.median(lengths) <= _POINT_LENGTH * np.mean(lengths))


def _refine_start(
    problem: _Problem, name: str, locations: FloatArray, fallback: FloatArray, other: FloatArray | None
) -> Start:
    """Return a start with what the refinement makes of it; nothing, if that turns all directions round.

    It ends early where the `other` start, refined, is better. Nodes moved far out are reset to the
    `fallback`.
    """
    as_solved = Start(name=name, locations=locations, refined=None, reset_nodes=np.empty(0, dtype=np.int64))
    if problem.normal_solver is None:
        return as_solved
    measured, solver = problem.measured, problem.normal_solver
    refined = refine_angles(measured, locations, solver, other, problem.threads)
    refined, nodes = _reset_strays(measured, fallback, refined)
    if projected_length(measured.graph, refined.locations) <= 0.0:
        return as_solved
    return replace(as_solved, refined=refined, reset_nodes=nodes)


def _reset_strays(
    measured: MeasuredGraph, fallback: FloatArray, refined: AngularResult
) -> tuple[AngularResult, IntArray]:
    """Return a refinement with lone strays reset, or all nodes where that fits better, and the strays."""
    levels = refined.levels_rad
    agreeing = fitting_pairs(measured, refined.locations, levels)
    nodes = find_strays(measured.graph, fallback, refined.locations, agreeing, _noise(measured, levels))
    if measured.groups is not None:
        group_of = measured.groups.group_of
        nodes = nodes[np.bincount(group_of)[group_of[nodes]] == 1]
    if len(nodes) == 0:
        return refined, nodes
    locations = unit_norm(put_back(fallback, refined.locations, nodes))
    cost, fallback_cost = (robust_cost(measured, t, levels) for t in (locations, fallback))
    if fallback_cost < cost:
        return replace(refined, locations=unit_norm(fallback), cost=fallback_cost), nodes
    return replace(refined, locations=locations, cost=cost), nodes


def _noise(measured: MeasuredGraph, levels: FloatArray) -> FloatArray:
    """Return the standard deviation of each direction (m,), per axis, radians."""
    return np.asarray(np.sqrt(levels[measured.classes] ** 2 + own_variances(measured)))


def _count_turned_pairs(measured: MeasuredGraph, chosen: Start, levels: FloatArray) -> int:
    """Return how many pairs the refinement made fit, or not fit any more."""
    if chosen.refined is None:
        return 0
    before, after = (fitting_pairs(measured, t, levels) for t in (chosen.locations, chosen.best))
    return int(np.sum(before != after))


def _common_levels(measured: MeasuredGraph, starts: list[Start]) -> FloatArray:
    """Return the levels at which costs are compared: the smallest of each class that a start ended with."""
    ended = [start.refined.levels_rad for start in starts if start.refined is not None]
    if not ended:
        opening = np.full(int(measured.classes.max()) + 1, OPENING_RAD)
        ended = [residual_levels(measured, start.locations, opening) for start in starts]
    return np.asarray(np.min(ended, axis=0))


def choose_start(
    graph: ViewGraph,
    starts: list[Start],
    costs: dict[str, float],
    apart: float | None,
    options: PlacementOptions,
) -> tuple[Start, str]:
    """Return the start to keep by its robust cost, and the reason; `apart` is how far two disagree."""
    by_name = {start.name: start for start in starts}
    if options.objective == "shapefit":
        return by_name["ShapeFit"], "the certified ShapeFit optimum, as asked"
    if apart is None:
        wanted = ", which LUD would have been" if options.objective == "lud" else ""
        return by_name["ShapeFit"], f"the graph has no second start{wanted}"
    if options.objective == "lud":
        return by_name["LUD"], "LUD, as asked"
    if len(starts) == 1:
        return by_name["ShapeFit"], f"the starts' lengths differ by {apart:.1%}, so that only one is refined"
    if _is_point(graph, by_name["ShapeFit"].best) and not _is_point(graph, by_name["LUD"].best):
        return by_name["LUD"], "most cameras of the other start are in one point"
    difference = costs["LUD"] - costs["ShapeFit"]
    name = "LUD" if difference < -ALIKE * costs["ShapeFit"] else "ShapeFit"  # not as rounding has it
    if apart <= COLLAPSED:
        reason = f"the starts' lengths differ by {apart:.0%}, not by a collapse; {name} fits no worse"
    elif abs(difference) <= _TIE * min(costs.values()):
        name = "LUD"
        reason = (
            f"the starts disagree (lengths by {apart:.0%}) and fit alike: LUD, whose lengths cannot collapse"
        )
    else:
        reason = f"the starts disagree (lengths by {apart:.0%}); {name} fits the directions better"
    return by_name[name], reason


def _measure_moves(chosen: Start) -> tuple[float, float]:
    """Return the median and the largest move by the refinement, see `Finish`."""
    before, after = unit_norm(chosen.locations), unit_norm(chosen.best)
    moved = np.linalg.norm(after - before, axis=1) / median_spread(after)
    return float(np.median(moved)), float(moved.max())
