"""The entry to the solvers over rigid groups: choose a method, solve, certify; and the start of LUD."""

import time
from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.blas_threads import one_blas_thread
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.solver.certificate import Certificate
from sfm_shapefit.solver.newton.sparse import solve_newton_reduced
from sfm_shapefit.solver.options import OnIteration, SolverOptions, SolverResult
from sfm_shapefit.solver.program import scale_functional
from sfm_shapefit.solver.rigs.certificate import certify_groups
from sfm_shapefit.solver.rigs.reduced import RigidReduction
from sfm_shapefit.solver.solve import Choice, run_choice
from sfm_shapefit.solver.splitting.linear import Resources
from sfm_shapefit.solver.splitting.lud import solve_lud

_LUD_STEPS = 150  # steps of LUD as the start of a refinement; more hardly move it
_DIRECTIONS_CANCEL = 1e-12  # A^T c relative to the sum of weights; smaller counts as 0


@one_blas_thread()  # more would split, and round, the sums of long vectors differently
def solve_groups(
    graph: ViewGraph,
    groups: RigidGroups,
    options: SolverOptions | None = None,
    on_iteration: OnIteration | None = None,
    *,
    certified: bool = True,
) -> SolverResult:
    """Solve ShapeFit over groups, with a certificate.

    Returns locations A x in the program's own scale, and a feasible dual, 0 on pairs inside a group;
    `equality_residual` is as in `certify_groups`.

    Args:
        graph: a view graph; pairs inside a group take no part.
        groups: groups of its nodes, tied to one another by the pairs between them (`largest_tied`).
        options: solver settings; the methods are "newton", which "auto" means, and "conic", else InputError.
        on_iteration: called after each iteration (not by "conic"); returning False cancels the solve.
        certified: as in `solve`.

    Raises:
        UnsolvableError: if no pair joins two groups, the pairs do not determine the groups, or a factor over
            the groups would take more than `options.factor_memory_mb`.
    """
    options = options or SolverOptions()
    start = time.perf_counter()
    outer = groups.joins(graph.edges)
    if not outer.any():
        raise UnsolvableError("no pair joins two groups, so that nothing can be placed")
    between = graph.subset(outer)
    unit = groups.normalize()
    c = unit.reduce(scale_functional(between))
    if not np.linalg.norm(c) > _DIRECTIONS_CANCEL * between.weights.sum():
        raise UnsolvableError("the directions cancel at every group, so no scale can be fixed")

    def prove(locations: FloatArray, dual_between: FloatArray) -> Certificate:
        dual = np.zeros_like(graph.directions)
        dual[outer] = dual_between
        return certify_groups(graph, groups, locations, dual, uniqueness=options.uniqueness)

    choice = _choose_method(between, unit, options)
    return run_choice(between, choice, options, on_iteration, prove if certified else None, start)


def refuse_admm(options: SolverOptions) -> None:
    """Raise InputError if the solver is asked for that does not know groups."""
    if options.solver == "admm":
        raise InputError("rigs and fixed cameras have no solver admm; choose auto, newton or conic")


def _choose_method(graph: ViewGraph, groups: RigidGroups, options: SolverOptions) -> Choice:
    """Return the solver that is asked for, if it knows groups."""
    refuse_admm(options)
    by_size = f"{groups.num_nodes} nodes in {groups.num_groups} groups"
    reason = by_size if options.solver == "auto" else "asked for"
    if options.solver == "conic":
        from sfm_shapefit.solver.conic import solve_conic

        return Choice("conic", lambda graph, tol, limit, _: solve_conic(graph, tol, limit, groups), reason)
    factor = RigidReduction(
        graph.edges, groups, threads=options.num_threads(), max_bytes=options.factor_bytes
    )

    def newton(graph: ViewGraph, tol: float, limit: int, watch: OnIteration | None) -> tuple[Any, ...]:
        return solve_newton_reduced(graph, factor, tol, limit, watch)

    return Choice("newton", newton, reason)


def lud_over_groups(graph: ViewGraph, groups: RigidGroups, max_steps: int = _LUD_STEPS) -> FloatArray | None:
    """Return LUD's locations (n, d), centered, after some steps; None if the system breaks down.

    The splitting sees the groups through its linear solve alone, which moves the locations by A x. Every pair
    of the graph joins two groups, and all groups are connected.
    """
    try:
        factor = RigidReduction(graph.edges, groups.normalize())
        resources = Resources(factor=factor)
        locations = solve_lud(graph, max_steps, certified=False, resources=resources).locations
    except UnsolvableError:
        return None
    return locations if np.isfinite(locations).all() else None
