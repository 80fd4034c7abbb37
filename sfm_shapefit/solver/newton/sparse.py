"""Newton cycles with a sparse block Cholesky factor of M, whose analysis is done once on the n cameras.

There is no lifting here: it would fill the matrix. One camera is grounded instead, and where M is singular
along T (exact data) a multiple of the weights is added to every block until it is not.
"""

from typing import Any

import numpy as np

from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.jit import kernel
from sfm_shapefit.laplacian.cholesky import CholeskyFactor, allocate_factor
from sfm_shapefit.laplacian.operators import adjacency
from sfm_shapefit.laplacian.ordering import best_order
from sfm_shapefit.laplacian.symbolic import plan_factorisation
from sfm_shapefit.solver.newton.steps import (
    EDGE_WORK,
    MU_PER_GAP,
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
    extend_step,
    is_cancelled,
    linearise,
    measure,
    pays,
    set_gradient,
    set_residuals,
    start_from,
    take,
)
from sfm_shapefit.solver.options import OnIteration
from sfm_shapefit.viewgraph import ViewGraph

_RIDGES = 0.0, 1e-12, 1e-10  # tried in turn, per stiffness of the edge


def solve_newton_sparse(
    graph: ViewGraph, tol: float, max_iterations: int, on_iteration: OnIteration | None = None
) -> tuple[FloatArray, FloatArray, int]:
    """Solve the program with a sparse Cholesky factor in d x d blocks; as `solve_newton_dense` otherwise.

    Args:
        graph: a connected, parallel-rigid view graph whose c is not 0.
        tol: the gap wanted, in units of the objective.
        max_iterations: limit of factorisations.
        on_iteration: called after every factorisation and its steps.

    Returns:
        locations (n, d), the dual (m, d), and the number of factorisations.

    Raises:
        UnsolvableError: if the directions do not determine any locations.
    """
    problem, iterate, model, step = allocate(graph)
    neighbours = adjacency(graph.num_cameras, problem.edges)
    plan = plan_factorisation(neighbours, problem.edges, best_order(neighbours))
    factor = allocate_factor(plan, graph.dimension)
    if not _factorise(problem, model, factor) or not start_from(problem, model.a, iterate):
        raise UnsolvableError("the directions do not determine the locations; check the graph's rigidity")
    progress = measure(problem, iterate, 1.0, 0.0)
    count, stalled = 0, 0
    while progress.gap > tol and count < max_iterations and stalled < STALL:
        before = progress.gap
        progress = _cycle(problem, iterate, model, factor, step, progress, tol)
        stalled = 0 if progress.gap < 0.9 * before else stalled + 1
        count += 1
        if is_cancelled(on_iteration, count, progress):
            break
    return *answer(iterate, progress, tol), count


def _cycle(
    problem: Problem,
    iterate: Iterate,
    model: Model,
    factor: CholeskyFactor,
    step: Step,
    progress: Progress,
    tol: float,
) -> Progress:
    """Factor once, then step with that factor while it pays."""
    first, multiplier = progress.gap, progress.multiplier
    mu = min(progress.mu, MU_PER_GAP * first)
    set_residuals(problem, iterate.t, iterate.r)
    linearise(iterate, mu, model)
    if not _factorise(problem, model, factor):
        return progress
    edge_work = EDGE_WORK * len(problem.w)
    step_work = edge_work + SOLVE_WORK * factor.panels.size
    work = factor.symbolic.flops * factor.block**3 + 0.5 * edge_work
    for _ in range(STEPS_PER_FACTOR):
        previous = progress.gap
        mu = min(mu, MU_PER_GAP * previous)
        target, exact = _propose(problem, iterate, model, factor, step, mu, previous)
        if not exact:
            break
        multiplier = take(problem, iterate, step, mu, multiplier, target)
        progress = measure(problem, iterate, mu, multiplier)
        work += step_work
        if progress.gap <= tol or not pays(first, previous, progress.gap, work, step_work):
            break
    return progress


def _propose(
    problem: Problem,
    iterate: Iterate,
    model: Model,
    factor: CholeskyFactor,
    step: Step,
    mu: float,
    gap: float,
) -> tuple[float, bool]:
    """Solve for the step with the factor in hand, refined until D^T y+ = lambda+ c.

    Returns:
        lambda+, and whether the refinement converged; the step must not be taken otherwise.
    """
    c, a, nodes = problem.c, model.a, step.nodes
    allowed, scale = allowed_violation(problem, gap), dot(c, a)
    set_gradient(problem, iterate, model, mu, step)
    solution = factor.solve(nodes)
    multiplier = dot(c, solution) / scale
    extend_step(problem, model, multiplier * a - solution, step)
    for _ in range(REFINEMENTS):
        violation = multiplier * c - nodes
        if np.abs(violation).max() <= allowed:
            return multiplier, True
        solution = factor.solve(violation)
        shift = dot(c, solution) / scale
        multiplier -= shift
        extend_step(problem, model, solution - shift * a, step)
    return multiplier, bool(np.abs(multiplier * c - nodes).max() <= allowed)


def _factorise(problem: Problem, model: Model, factor: CholeskyFactor) -> bool:
    """Factor M and solve for a; return whether it is positive definite."""
    m, d = model.y.shape
    blocks = np.empty((m, d, d))
    for ridge in _RIDGES:
        _set_blocks(problem, model, ridge, blocks)
        try:
            factor.refactor(blocks)
        except UnsolvableError:
            continue
        model.a[:] = factor.solve(problem.c)
        return True
    return False


@kernel(exact=True)
def _set_blocks(problem: Any, model: Any, ridge: float, blocks: Any) -> None:
    """Write S_e, plus `ridge` times its stiffness times the identity."""
    v, w, y, r = problem.v, problem.w, model.y, model.r
    d = len(problem.axes)
    for e in range(len(w)):
        inverse = 1.0 / model.rho[e]
        stiffness, bend = w[e] * inverse, 0.5 * inverse * inverse
        for k in range(d):
            for q in range(d):
                s = -stiffness * v[e, k] * v[e, q] - bend * (y[e, k] * r[e, q] + r[e, k] * y[e, q])
                blocks[e, k, q] = s + stiffness * (1.0 + ridge) if k == q else s
