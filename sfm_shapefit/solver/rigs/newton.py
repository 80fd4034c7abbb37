"""Primal-dual Newton steps over groups: the steps of `newton`, with the matrix and the balance reduced by A.

A step of the groups is a step of their nodes, dT = A dx, and everything per pair (residuals, the
linearisation, the dual y+, the two step lengths) is that of `newton.steps`. Only the equations for the step
differ:

    (A^T M A) dx = lambda+ A^T c - A^T D^T g,    <A^T c, dx> = 0
"""

import time

import numpy as np

from sfm_shapefit.arrays import FloatArray, frozen
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.laplacian.dense import one_blas_thread
from sfm_shapefit.solver.newton.steps import (
    EDGE_WORK,
    REFINEMENTS,
    SOLVE_WORK,
    STALL,
    STEPS_PER_FACTOR,
    Iterate,
    Model,
    Problem,
    Progress,
    Step,
    allocate,
    allowed_violation,
    answer,
    dot,
    ended,
    extend_step,
    linearise,
    measured,
    pays,
    set_gradient,
    set_residuals,
    smoothing,
    start_from,
    taken,
)
from sfm_shapefit.solver.options import SolverOptions, SolverResult, Status
from sfm_shapefit.solver.program import along, differences, normalized_locations, projected_length
from sfm_shapefit.solver.rigs.certificate import certify_groups
from sfm_shapefit.solver.rigs.groups import RigidGroups
from sfm_shapefit.solver.rigs.reduced import ReducedFactor, System, factor_pinned
from sfm_shapefit.viewgraph import ViewGraph

_RIDGES = 0.0, 1e-12, 1e-10  # tried in turn, per stiffness of the edge
_MAX_ITERATIONS = 100
_LARGEST_RESIDUAL = 1e-9  # of the dual's equality, beyond which the bound is not to be called rigorous
_CANCEL = 1e-12  # size of A^T c, of the sum of weights, that is rounding


@one_blas_thread()
def solve_groups(graph: ViewGraph, groups: RigidGroups, options: SolverOptions | None = None) -> SolverResult:
    """Solve ShapeFit over groups, with a certificate.

    Args:
        graph: a view graph; pairs inside a group take no part.
        groups: of its nodes, tied to one another by the pairs between them (`largest_tied`).
        options: `tol` and `max_iterations` are read; there is one method.

    Returns:
        Locations A x in the program's own scale, and a feasible dual, 0 on pairs inside a group. The equality
        that holds for it is the balance per group and that for the scale; `equality_residual` is its largest
        violation.

    Raises:
        UnsolvableError: if no pair joins two groups, or the pairs do not determine the groups.
    """
    options = options or SolverOptions()
    begin = time.perf_counter()
    outer = groups.joins(graph.edges)
    if not outer.any():
        raise UnsolvableError("no pair joins two groups, so that nothing can be placed")
    between = graph.subset(outer)
    limit = options.max_iterations or _MAX_ITERATIONS
    locations, dual, iterations = _solve(between, groups.normalised(), options.tol, limit)
    if not (np.isfinite(locations).all() and projected_length(between, locations) > 0.0):
        raise UnsolvableError("the solver found no finite locations; check the directions of the graph")
    locations = normalized_locations(between, locations)
    every = np.zeros_like(graph.directions)
    every[outer] = dual
    certificate = certify_groups(graph, groups, locations, every, uniqueness=options.uniqueness)
    converged = certificate.gap <= options.tol and certificate.equality_residual <= _LARGEST_RESIDUAL
    unfinished = Status.MAX_ITERATIONS if iterations >= limit else Status.INACCURATE
    return SolverResult(
        locations=frozen(locations),
        status=Status.CONVERGED if converged else unfinished,
        objective=certificate.objective,
        dual_bound=certificate.dual_bound,
        dual=certificate.dual,
        equality_residual=certificate.equality_residual,
        unique=certificate.unique,
        iterations=iterations,
        seconds=time.perf_counter() - begin,
        method="newton",
        method_reason=f"{graph.num_nodes} nodes in {groups.num_groups} groups",
    )


def _solve(
    graph: ViewGraph, groups: RigidGroups, tol: float, max_iterations: int
) -> tuple[FloatArray, FloatArray, int]:
    """Return locations, dual, and the number of factorisations."""
    problem, iterate, model, step = allocate(graph)
    if not np.linalg.norm(groups.reduce(problem.c)) > _CANCEL * problem.kappa:
        raise UnsolvableError("the directions cancel at every group, so no scale can be fixed")
    factor = ReducedFactor(graph.edges, groups)
    system = _factorise(problem, model, factor, int(np.argmax(problem.w)))
    start = None if system is None else system.solve(np.zeros(groups.num_unknowns), 1.0)[1]
    if start is None or not start_from(problem, groups.expand(start), iterate):
        raise UnsolvableError("the directions do not determine the groups; check which of them hang free")
    progress = measured(problem, iterate)
    count, stalled = 0, 0
    while progress.gap > tol and count < max_iterations and stalled < STALL:
        before = progress.gap
        progress = _cycle(problem, iterate, model, factor, step, progress, tol)
        stalled = 0 if progress.gap < 0.9 * before else stalled + 1
        count += 1
    return *answer(problem, iterate, progress, tol), count


def _cycle(
    problem: Problem,
    iterate: Iterate,
    model: Model,
    factor: ReducedFactor,
    step: Step,
    progress: Progress,
    tol: float,
) -> Progress:
    """Factor once, then step with that factor while it pays."""
    first = progress.gap
    mu = smoothing(progress, progress.mu)
    set_residuals(problem, iterate.t, iterate.r)
    linearise(problem, iterate, mu, model)
    ends = problem.edges.astype(np.int64)
    longest = int(np.argmax(along(differences(iterate.t, ends), problem.v)))
    system = _factorise(problem, model, factor, longest)
    if system is None:
        return ended(iterate, progress, mu, first)
    edge_work = EDGE_WORK * len(problem.w)
    step_work = edge_work + SOLVE_WORK * factor.factor.panels.size
    work = factor.factor.symbolic.flops * factor.factor.block**3 + 0.5 * edge_work
    for _ in range(STEPS_PER_FACTOR):
        previous = progress.gap
        mu = smoothing(progress, mu)
        target, exact = _propose(problem, iterate, model, system, step, mu, previous)
        if not exact:
            break
        progress = taken(problem, iterate, step, mu, progress, target)
        work += step_work
        if progress.gap <= tol or not pays(first, previous, progress.gap, work, step_work):
            break
    return ended(iterate, progress, progress.mu, first)


def _propose(
    problem: Problem, iterate: Iterate, model: Model, system: System, step: Step, mu: float, gap: float
) -> tuple[float, bool]:
    """Solve for the step with the factor in hand, refined until A^T D^T y+ = lambda+ A^T c.

    Returns:
        lambda+, and whether the refinement converged; the step must not be taken otherwise.
    """
    groups, c = system.factor.groups, system.rows[0]
    allowed = allowed_violation(problem, gap)
    set_gradient(problem, iterate, model, mu, step)
    drift = problem.kappa - dot(problem.c, iterate.t)
    multiplier, dx = system.solve(-groups.reduce(step.nodes), drift)
    extend_step(problem, model, groups.expand(dx), step)
    for _ in range(REFINEMENTS):
        violation = multiplier * c - groups.reduce(step.nodes)
        if np.abs(violation).max() <= allowed:
            return multiplier, True
        shift, dx = system.solve(violation, drift - dot(problem.c, step.t))
        multiplier += shift
        extend_step(problem, model, groups.expand(dx), step)
    return multiplier, bool(np.abs(multiplier * c - groups.reduce(step.nodes)).max() <= allowed)


def _factorise(problem: Problem, model: Model, factor: ReducedFactor, pinned: int) -> System | None:
    """Factor the reduced matrix, with more ridge if it is not positive definite; None if it never is."""
    i, j = (int(node) for node in problem.edges[pinned])
    v = problem.v[pinned]
    scale = problem.w * model.inverse
    stiffness = float(np.mean(scale))
    across = problem.basis @ model.s @ problem.basis.transpose(0, 2, 1)
    c = factor.groups.reduce(problem.c)
    for ridge in _RIDGES:
        blocks = across + (ridge * scale)[:, None, None] * np.eye(len(v))
        blocks[pinned] += stiffness * np.outer(v, v)
        system = factor_pinned(factor, blocks, c, ((i, j), v), stiffness)
        if system is not None:
            return system
    return None
