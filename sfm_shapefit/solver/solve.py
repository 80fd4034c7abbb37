"""The one entry to the solvers: check the graph, choose a method, solve, certify."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, frozen
from sfm_shapefit.base.blas_threads import one_blas_thread
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.settings import merge_options
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.rigidity import is_parallel_rigid
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.factor import FactorPlan, analyze
from sfm_shapefit.solver.certificate import Asked, Certificate, certify_as_asked
from sfm_shapefit.solver.factor_choice import FEW_UNKNOWNS, prefers_dense_factor
from sfm_shapefit.solver.newton.dense import solve_newton_dense
from sfm_shapefit.solver.newton.sparse import allocate_newton, solve_newton_reduced, solve_newton_sparse
from sfm_shapefit.solver.program import normalize_locations, objective, scale_functional
from sfm_shapefit.solver.reduction import Reduction
from sfm_shapefit.solver.solver_options import (
    IterationInfo,
    OnIteration,
    SolverOptions,
    SolverResult,
    Status,
    Watch,
)
from sfm_shapefit.solver.splitting.linear import Prediction, Resources, predict_factor
from sfm_shapefit.solver.splitting.split_then_newton import HybridStop, solve_hybrid

# c relative to the sum of weights, of nodes and of groups; smaller, the scale constraint says nothing
_DIRECTIONS_CANCEL, _DIRECTIONS_CANCEL_AT_GROUPS = 1e-9, 1e-12
_LARGEST_RESIDUAL = 1e-9  # violation of the dual's equality; with more a bound is not called rigorous
_ITERATION_LIMITS = {"newton": 100, "admm": 2000, "conic": 200}
_LARGEST_NEWTON_FLOPS = 4e9  # operations of one block factorization; from here on splitting is faster
# Newton steps left 18 of 2,501 graphs of 12 nodes in the plane, directions off by 1e-6 and a third drawn at
# random, above a gap of 1e-8, one of them at 3e-4. Splitting brings all of these below.
_STALLED = "Newton steps stalled above the tolerance: splitting"


class SolverRun(NamedTuple):
    """What a solver returns; the certificate decides what it is worth."""

    locations: FloatArray
    dual: FloatArray
    iterations: int
    note: str = ""
    """How it ended, where that is not plain from the certificate."""


class Choice(NamedTuple):
    """A method and the reason for it."""

    method: str
    solve: Callable[[ViewGraph, float, int, OnIteration | None], tuple[Any, ...]]
    """From graph, tolerance, limit of iterations and callback to the fields of a `SolverRun`."""
    reason: str


@one_blas_thread()  # more would split, and round, the sums of long vectors differently
def solve(
    graph: ViewGraph,
    options: SolverOptions | None = None,
    *,
    groups: RigidGroups | None = None,
    on_iteration: OnIteration | None = None,
    certified: bool = True,
    **overrides: Any,
) -> SolverResult:
    """Solve ShapeFit on a parallel-rigid view graph, or over rigid groups, with a certificate of optimality.

        graph = ViewGraph(num_cameras, edges, directions)     # (m, 2) pairs (i, j), (m, d) of t_i - t_j
        result = solve(graph)
        result.locations, result.gap, result.unique

    Its optimum collapses on long chains and under heavy corruption; `sfm_shapefit.place` copes with that.

    Args:
        graph: n cameras, m pairs, directions in any dimension d >= 2.
        options: solver settings, see `help(SolverOptions)`; defaults if None.
        groups: groups of the nodes, tied to one another by the pairs between them, if nodes do not move one
            by one. Pairs inside a group take no part, and have dual 0; the methods are "newton" and "conic".
        on_iteration: called after each iteration (not by "conic"); returning False cancels the solve.
        certified: False proves nothing of the locations, for those that are only a start.
        **overrides: single options by name: `solve(graph, tol=1e-6)`.

    Returns:
        Locations, status, objective, and a feasible dual point whose value bounds the optimum from below.
        Not reaching the tolerance is reported in `status`, not raised.

    Raises:
        InputError: if a method is asked for that does not know groups.
        UnsolvableError: if the graph has fewer than two cameras, is not connected, is not parallel rigid,
            or its directions cancel at every camera (the scale constraint is empty); with groups, if the
            pairs do not determine them, or a factor over them would take more than `factor_memory_mb`.

    Source: Hand, Lee, Voroninski (2015), arXiv 1506.01437.
    """
    options = merge_options(options, SolverOptions, overrides)
    start = time.perf_counter()
    if groups is None:
        between, outer = graph, None
        _refuse_undetermined(graph)
        choice = choose_method(graph, options)
    else:
        outer = groups.joins(graph.edges)
        between, unit = graph.subset(outer), groups.normalize()
        _refuse_open_groups(between, unit)
        choice = _choose_over_groups(between, unit, options)
    limit = options.max_iterations or _ITERATION_LIMITS[choice.method]
    watch = Watch(on_iteration, limit=limit)
    may_split = (
        options.solver == "auto" and choice.method == "newton" and graph.dimension == 2 and outer is None
    )
    run = SolverRun(*choice.solve(between, options.tol, limit, watch if on_iteration else None))
    locations = normalize_locations(between, run.locations)
    if certified:
        asked = Asked(options.tol, options.uniqueness, options.num_threads())
        certificate = certify_as_asked(between, locations, run.dual, groups, asked)
    else:  # nothing but what always holds
        value, none = objective(between, locations), np.zeros_like(run.dual)
        certificate = Certificate(objective=value, dual_bound=0.0, dual=none, equality_residual=0.0)
    if outer is not None:
        dual = np.zeros_like(graph.directions)
        dual[outer] = certificate.dual
        certificate = replace(certificate, dual=frozen(dual))
    status = Status.MAX_ITERATIONS if run.iterations >= limit else Status.INACCURATE
    if certificate.gap <= options.tol and certificate.equality_residual <= _LARGEST_RESIDUAL:
        status = Status.CONVERGED
    elif watch.cancelled:
        status = Status.CANCELLED
    found = SolverResult(
        locations=frozen(locations),
        status=status,
        objective=certificate.objective,
        dual_bound=certificate.dual_bound,
        dual=certificate.dual,
        equality_residual=certificate.equality_residual,
        unique=certificate.unique,
        iterations=run.iterations,
        seconds=time.perf_counter() - start,
        method=choice.method,
        method_reason="; ".join(filter(None, [choice.reason, run.note])),
    )
    if status is Status.INACCURATE and certified and may_split:
        found = _split_stalled(graph, found, options, on_iteration)
    return found


def _split_stalled(
    graph: ViewGraph, stalled: SolverResult, options: SolverOptions, on_iteration: OnIteration | None
) -> SolverResult:
    """Return what splitting finds where Newton steps have stalled, or what these found if that is nearer."""
    before, go_on = stalled.iterations, on_iteration
    if on_iteration is not None:  # where nobody hears of them, iterations compute no objective
        go_on = partial(_go_on, on_iteration, before)
    found = solve(graph, options, solver="admm", max_iterations=None, on_iteration=go_on)
    nearer = found if found.gap < stalled.gap else stalled
    return replace(
        nearer,
        status=found.status if found.status is Status.CANCELLED else nearer.status,
        iterations=before + found.iterations,
        seconds=stalled.seconds + found.seconds,
        method_reason=_STALLED if nearer is found else stalled.method_reason,
    )


def _go_on(on_iteration: OnIteration, before: int, info: IterationInfo) -> bool | None:
    """Tell of an iteration of a run that follows another of so many iterations."""
    return on_iteration(replace(info, iteration=before + info.iteration))


def choose_method(graph: ViewGraph, options: SolverOptions) -> Choice:
    """Pick the solver by the size of the problem and the predicted fill of its factor, without solving."""
    asked = options.solver != "auto"
    if options.solver == "conic":
        from sfm_shapefit.solver.conic import solve_conic

        return Choice("conic", lambda graph, tol, limit, _: solve_conic(graph, tol, limit), "asked for")
    resources = Resources.of(options)
    if options.solver == "admm":
        return Choice("admm", partial(_split, resources, None), "asked for")
    predict = cache(partial(predict_factor, graph))

    def flops() -> float:
        return predict().flops * graph.dimension**3

    if prefers_dense_factor(graph, flops):
        unknowns = graph.num_nodes * graph.dimension
        reason = f"{unknowns} unknowns{': dense' if unknowns <= FEW_UNKNOWNS else ', dense graph'}"
        return Choice("newton", solve_newton_dense, "asked for" if asked else reason)
    predicted = "no order would keep a factor sparse"
    if flops() < np.inf:
        predicted = f"{flops() / 1e9:.2g} Gflop for a sparse factor"
    if asked or flops() <= _LARGEST_NEWTON_FLOPS:
        newton = partial(_solve_sparse, resources.threads)
        return Choice("newton", newton, "asked for" if asked else predicted)
    return Choice("admm", partial(_split, resources, predict()), f"{predicted}: splitting is faster")


def refuse_admm(options: SolverOptions) -> None:
    """Raise InputError if the solver is asked for that does not know groups."""
    if options.solver == "admm":
        raise InputError("rigs and fixed cameras have no solver admm; choose auto, newton or conic")


def _choose_over_groups(graph: ViewGraph, groups: RigidGroups, options: SolverOptions) -> Choice:
    """Return the solver that is asked for, if it knows groups."""
    refuse_admm(options)
    by_size = f"{groups.num_nodes} nodes in {groups.num_groups} groups"
    reason = by_size if options.solver == "auto" else "asked for"
    if options.solver == "conic":
        from sfm_shapefit.solver.conic import solve_conic

        return Choice("conic", lambda graph, tol, limit, _: solve_conic(graph, tol, limit, groups), reason)
    threads, max_bytes = options.num_threads(), options.factor_bytes
    reduction = Reduction.over(graph.edges, groups, threads=threads, max_bytes=max_bytes)

    def newton(graph: ViewGraph, tol: float, limit: int, watch: OnIteration | None) -> tuple[Any, ...]:
        return solve_newton_reduced(graph, reduction, tol, limit, watch)

    return Choice("newton", newton, reason)


def _solve_sparse(
    threads: int, graph: ViewGraph, tol: float, limit: int, watch: OnIteration | None
) -> tuple[FloatArray, FloatArray, int]:
    return solve_newton_sparse(graph, tol, limit, watch, factor=allocate_newton(graph, threads=threads))


def _split(
    resources: Resources,
    prediction: Prediction | None,
    graph: ViewGraph,
    tol: float,
    limit: int,
    watch: OnIteration | None,
) -> SolverRun:
    found = solve_hybrid(graph, tol, limit, resources, prediction, watch)
    note = "" if found.stop is HybridStop.CERTIFIED else found.stop.value
    return SolverRun(found.locations, found.certificate.dual, found.iterations, note)


def _refuse_undetermined(graph: ViewGraph) -> None:
    """Raise UnsolvableError where the program has no unique answer whatever the directions say."""
    if graph.num_nodes < 2 or graph.num_edges == 0:
        raise UnsolvableError("the graph has no pair of cameras; nothing can be placed")
    if not is_parallel_rigid(graph.num_nodes, graph.edges, graph.dimension):
        components = int(graph.components().max()) + 1
        if components > 1:
            raise UnsolvableError(
                f"the graph falls into {components} connected components; solve each one separately"
            )
        raise UnsolvableError(
            "the graph is not parallel rigid, so the directions do not determine the locations; "
            "solve its largest piece (sfm_shapefit.graph.rigidity.rigid_pieces)"
        )
    c = scale_functional(graph)
    if np.linalg.norm(c) <= _DIRECTIONS_CANCEL * graph.weights.sum():
        raise UnsolvableError("the directions cancel at every camera, so no scale can be fixed")


def _refuse_open_groups(between: ViewGraph, unit: RigidGroups) -> None:
    """Raise UnsolvableError where the pairs between groups say nothing of them."""
    if not between.num_edges:
        raise UnsolvableError("no pair joins two groups, so that nothing can be placed")
    c = unit.reduce(scale_functional(between))
    if not np.linalg.norm(c) > _DIRECTIONS_CANCEL_AT_GROUPS * between.weights.sum():
        raise UnsolvableError("the directions cancel at every group, so no scale can be fixed")


def plan_factor(measured: MeasuredGraph) -> FactorPlan | None:
    """Return the plan of the largest factor of a placement; None where no order keeps one sparse."""
    edges = np.ascontiguousarray(measured.graph.edges)
    if measured.groups is not None:
        ends = measured.groups.group_of[edges[measured.groups.joins(edges)]]
        return analyze(measured.groups.num_groups, np.ascontiguousarray(ends))
    if predict_factor(measured.graph).tree is None:
        return None
    return analyze(measured.graph.num_nodes, edges, measured.graph.elimination_tree())
