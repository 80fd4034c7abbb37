"""Newton cycles with a sparse block Cholesky factor of M, whose analysis is done once on the n cameras.

Lifting by c c^T would fill the matrix; one pair is pinned instead, see `solver.reduction`. Over rigid groups
a step of the unknowns is a step of their nodes, dT = A dx, and everything per pair (residuals, the
linearization, the dual y+, the two step lengths) stays as it is. Only the equations for the step differ:

    (A^T M A) dx = lambda+ A^T c - A^T D^T g,    <A^T c, dx> = 0
"""

from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.factor import Factor, FactorPlan, allocate_factor, analyze
from sfm_shapefit.solver.newton import steps
from sfm_shapefit.solver.newton.steps import Iterate, Linearization, NewtonProgress, Problem, Work
from sfm_shapefit.solver.program import along, differences
from sfm_shapefit.solver.reduction import Pin, Reduction, System, factor_pinned
from sfm_shapefit.solver.solver_options import OnIteration

_RIDGES = 0.0, 1e-12, 1e-10  # added to the blocks, per stiffness of the edge; in turn until M is definite


def solve_newton_sparse(
    graph: ViewGraph,
    tol: float,
    max_iterations: int,
    on_iteration: OnIteration | None = None,
    *,
    start: tuple[FloatArray, FloatArray] | None = None,
    factor: Factor | None = None,
) -> tuple[FloatArray, FloatArray, int]:
    """Solve the program with a sparse Cholesky factor in d x d blocks.

    Returns locations (n, d), the dual (m, d), and the number of factorizations. UnsolvableError if the
    directions do not determine any locations.

    Args:
        graph: a connected, parallel-rigid view graph whose c is not 0.
        tol: the gap wanted, in units of the objective.
        max_iterations: limit of factorizations.
        on_iteration: called after every factorization and its steps.
        start: locations (n, d) with L(T) > 0 and a feasible dual (m, d), such as that of a `Certificate`; the
            steps then begin with the smoothing that their gap allows. The closer, the fewer factorizations.
        factor: from `allocate_newton`; of one thread if None.
    """
    reduction = Reduction(allocate_newton(graph) if factor is None else factor)
    return solve_newton_reduced(graph, reduction, tol, max_iterations, on_iteration, start)


def allocate_newton(graph: ViewGraph, plan: FactorPlan | None = None, *, threads: int = 1) -> Factor:
    """Return memory for the factor of `solve_newton_sparse`; `plan` is the graph's, if there is one."""
    if plan is None:
        plan = analyze(graph.num_nodes, graph.edges, graph.elimination_tree())
    return allocate_factor(plan, steps.working_dimension(graph), threads=threads)


def solve_newton_reduced(
    graph: ViewGraph,
    reduction: Reduction,
    tol: float,
    max_iterations: int,
    on_iteration: OnIteration | None = None,
    start: tuple[FloatArray, FloatArray] | None = None,
) -> tuple[FloatArray, FloatArray, int]:
    """Solve the program over the unknowns of a reduction; all else is as in `solve_newton_sparse`."""
    work = steps.allocate(graph, reduction.factor.block)
    problem, iterate = work.problem, work.iterate
    if start is None:
        system = _factorize(problem, work.linearization, reduction, int(np.argmax(problem.w)))
        first = None if system is None else system.solve(0.0 * reduction.reduce(problem.c), 1.0)[1]
        if first is None or not steps.start_from(problem, reduction.expand(first), iterate):
            raise UnsolvableError("the directions do not determine the locations; check the graph's rigidity")
    else:
        _begin_at(problem, *start, iterate)
    progress, count, stalled = NewtonProgress(*steps.measure_gap(problem, iterate)), 0, 0
    while progress.gap > tol and count < max_iterations and stalled < steps.STALL:
        before = progress.gap
        progress = _cycle(work, reduction, progress, tol)
        stalled = 0 if progress.gap < 0.9 * before else stalled + 1
        count += 1
        if steps.is_cancelled(on_iteration, count, progress):
            break
    return *steps.answer(problem, iterate, progress, tol, graph.dimension), count


def _begin_at(problem: Problem, locations: FloatArray, dual: FloatArray, iterate: Iterate) -> None:
    """Take over locations and a feasible dual."""
    d = problem.c.shape[1]
    centered = steps.padded(locations - locations.mean(axis=0), d)
    iterate.t[:] = (problem.kappa / steps.dot(problem.c, centered)) * centered
    steps.set_residuals(problem, iterate.t, iterate.r)
    iterate.y[:] = iterate.feasible[:] = np.einsum("ekq,ek->eq", problem.basis, steps.padded(dual, d))


def _cycle(work: Work, reduction: Reduction, progress: NewtonProgress, tol: float) -> NewtonProgress:
    """Factor once, then step with that factor while it pays."""
    problem, iterate, linearization, step = work
    first = progress.gap
    mu = steps.smoothing(progress, progress.mu)
    steps.set_residuals(problem, iterate.t, iterate.r)
    steps.linearize_program(problem, iterate, mu, linearization)
    ends = problem.edges.astype(np.int64)
    longest = int(np.argmax(along(differences(iterate.t, ends), problem.v)))
    system = _factorize(problem, linearization, reduction, longest)
    if system is None:
        return NewtonProgress(*steps.close_cycle(iterate, progress, mu, first))
    factor, edge_work = reduction.factor, steps.EDGE_WORK * len(problem.w)
    step_work = edge_work + steps.SOLVE_WORK * factor.plan.num_entries * factor.block**2
    done = factor.plan.flops * factor.block**3 + 0.5 * edge_work
    for _ in range(steps.STEPS_PER_FACTOR):
        previous = progress.gap
        mu = steps.smoothing(progress, mu)
        target, exact = _propose(work, system, mu, previous)
        if not exact:
            break
        progress = NewtonProgress(*steps.take_step(problem, iterate, step, mu, progress, target))
        done += step_work
        if progress.gap <= tol or not steps.pays(first, previous, progress.gap, done, step_work):
            break
    return NewtonProgress(*steps.close_cycle(iterate, progress, progress.mu, first))


def _propose(work: Work, system: System, mu: float, gap: float) -> tuple[float, bool]:
    """Return lambda+ of the refined step, and whether A^T D^T y+ = lambda+ A^T c: else do not take it."""
    problem, iterate, linearization, step = work
    reduction = system.reduction
    c = reduction.reduce(problem.c)
    allowed = steps.allowed_violation(problem, gap)
    steps.set_gradient(problem, iterate, linearization, mu, step)
    drift = problem.kappa - steps.dot(problem.c, iterate.t)
    multiplier, dx = system.solve(-reduction.reduce(step.nodes), drift)
    _extend(work, reduction, dx)
    for _ in range(steps.REFINEMENTS):
        violation = multiplier * c - reduction.reduce(step.nodes)
        if np.abs(violation).max() <= allowed:
            return multiplier, True
        shift, dx = system.solve(violation, drift - steps.dot(problem.c, step.t))
        multiplier += shift
        _extend(work, reduction, dx)
    return multiplier, bool(np.abs(multiplier * c - reduction.reduce(step.nodes)).max() <= allowed)


def _extend(work: Work, reduction: Reduction, dx: FloatArray) -> None:
    """Add dx to the step; see `steps.extend_step`."""
    work.step.addend[:] = reduction.expand(dx)
    steps.extend_step(work.problem, work.linearization, work.step)


def _factorize(
    problem: Problem, linearization: Linearization, reduction: Reduction, pinned: int
) -> System | None:
    """Factor M' of the unknowns, with more ridge if it is not positive definite; None if it never is."""
    m, d = problem.v.shape
    blocks, c = np.empty((m, d, d)), reduction.reduce(problem.c)
    stiffness = float(np.mean(problem.w * linearization.inverse))
    pin = Pin(pinned, problem.edges[pinned], problem.v[pinned], stiffness)
    for ridge in _RIDGES:
        _set_blocks(problem, linearization, ridge, blocks)
        system = factor_pinned(reduction, blocks, c, pin)
        if system is not None:
            return system
    return None


@kernel
def _set_blocks(problem: Any, linearization: Any, ridge: float, blocks: Any) -> None:
    """Write S_e, plus `ridge` times its stiffness times the identity."""
    basis, s = problem.basis, linearization.s
    for e in range(len(problem.w)):
        stiffness = problem.w[e] * linearization.inverse[e]
        for k in range(len(problem.axes)):
            for q in range(len(problem.axes)):
                x = ridge * stiffness if k == q else 0.0
                for f in range(len(problem.transverse)):
                    for g in range(len(problem.transverse)):
                        x += basis[e, k, f] * s[e, f, g] * basis[e, q, g]
                blocks[e, k, q] = x
