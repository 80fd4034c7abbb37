"""LUD, least unsquared deviations: the convex start that does not collapse on long chains.

    minimize  sum_e w_e || t_i - t_j - s_e v_e ||    subject to  s_e >= 1

No stretch of a chain escapes the bound on each length, where ShapeFit's single constraint <c, T> = kappa lets
all length gather on the cleanest stretch. The dual is

    maximize  sum_e nu_e,  nu_e = -<y_e, v_e>    subject to  D^T y = 0,  ||y_e|| <= w_e,  nu_e >= 0

An approximate y is made feasible by y' = y - N D h with (D^T N D) h = D^T y, where N_e = I on edges with
nu_e > 0 and N_e = P_e (orthogonal to v_e) on the others, and by a common scaling. Edges whose nu_e turns
negative join the others, and the repair is repeated.

Source: Ozyesil and Singer, "Robust camera location estimation by convex programming", CVPR 2015, eq. 7.
"""

from typing import Annotated

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.blas_threads import one_blas_thread
from sfm_shapefit.base.record import Record
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.approximate import Preconditioner, conjugate_gradients
from sfm_shapefit.solver.program import across, adjoint, along, differences
from sfm_shapefit.solver.solver_options import OnIteration
from sfm_shapefit.solver.splitting.edges import EdgePasses, edge_data
from sfm_shapefit.solver.splitting.engine import Goal, Iteration, Stop, Tuning
from sfm_shapefit.solver.splitting.linear import ONE_THREAD, Resources, laplacian_factor

_LEAST_LENGTH = 1.0  # least <t_i - t_j, v_e> of a pair, which sets the scale; as in the paper
_TUNING = Tuning(relaxation=1.6, renewals=(), penalty=1.0, accelerate=False)
_REPAIRS = 12  # repairs of the dual; each shrinks its violation
_CG_TOL = 1e-7  # residual to which the balance is restored; twice, which makes 1e-14
_CG_STEPS = 300  # conjugate gradient steps; a bound


class Lud(Record):
    """The LUD start and its own dual bound, in its own units."""

    objective: Annotated[float, "Value of the LUD program at its start."]
    dual_bound: Annotated[float | None, "No placement has a lower objective."]
    equality_residual: Annotated[float | None, "Violation of the dual's equality, as in `Solve`."]
    iterations: Annotated[int, "Iterations of its solver."]
    locations: FloatArray
    """(n, d) centered; the least edge length is about 1."""
    stop: Stop
    """Why the iteration ended."""


@one_blas_thread()  # more would split, and round, the sums of long vectors differently
def solve_lud(
    graph: ViewGraph,
    max_iterations: int = 50,
    *,
    tol: float = 1e-8,
    certified: bool = True,
    resources: Resources = ONE_THREAD,
    on_iteration: OnIteration | None = None,
) -> Lud:
    """Solve LUD by ADMM with constant penalties, so that its Laplacian is factored once.

    Args:
        graph: a connected view graph.
        max_iterations: 25 to 50 suffice as the start of a robust refinement.
        tol: relative error of the objective, estimated, at which to stop early.
        certified: compute the dual bound, at the price of about 100 iterations.
        resources: threads of the passes over edges, and the factor, by default what `laplacian_factor` picks.
        on_iteration: called after each iteration; returning False cancels and returns the iterate.
    """
    factor = laplacian_factor(graph, resources)
    passes = EdgePasses(edge_data(graph, _LEAST_LENGTH), resources.threads)
    try:
        iteration = Iteration(passes, factor, _TUNING, None, float(graph.weights.sum()))
        outcome = iteration.run(Goal(tol, 0.0, max_iterations), on_iteration)
        dual = passes.in_graph_order(passes.dual(outcome.state.x, outcome.state.rho))
    finally:
        passes.close()
    t = outcome.state.t - outcome.state.t.mean(axis=0)
    baselines = differences(t, graph.edges)
    lengths = np.maximum(along(baselines, graph.directions), _LEAST_LENGTH)
    deviations = np.linalg.norm(baselines - lengths[:, None] * graph.directions, axis=1)
    bound, residual = 0.0, 0.0
    if certified:
        factor.refactor(np.ones(graph.num_edges))
        bound, residual = _dual_bound(graph, dual, factor)
    return Lud(
        locations=t,
        objective=float(graph.weights @ deviations),
        dual_bound=bound,
        equality_residual=residual,
        iterations=outcome.iterations,
        stop=outcome.stop,
    )


def _dual_bound(graph: ViewGraph, dual: FloatArray, precondition: Preconditioner) -> tuple[float, float]:
    """Return the value of the feasible dual point nearest to `dual`, and its equality residual."""
    v, w, n = graph.directions, graph.weights, graph.num_nodes
    bound_active = along(dual, v) < -1e-6 * w
    for _ in range(_REPAIRS):
        y = _balance(graph, dual, bound_active, precondition)
        still_active = bound_active & (along(y, v) <= 0.0)
        if (still_active == bound_active).all():  # then once more, to rounding
            y = _balance(graph, y, bound_active, precondition)
            still_active = bound_active & (along(y, v) <= 0.0)
        if (still_active == bound_active).all():
            break
        bound_active = still_active
    else:
        return 0.0, 0.0
    y /= max(1.0, float(np.max(np.linalg.norm(y, axis=1) / w)))
    degree = np.bincount(graph.edges.ravel(), weights=np.repeat(w, 2), minlength=n).max()
    residual = float(np.linalg.norm(adjoint(y, graph.edges, n), axis=1).max() / degree)
    return float(-along(y, v)[bound_active].sum()), residual


def _balance(graph: ViewGraph, dual: FloatArray, free: BoolArray, precondition: Preconditioner) -> FloatArray:
    """Return the dual moved to D^T y = 0, by all directions on `free` edges and across v on the others."""
    edges, v, n = graph.edges, graph.directions, graph.num_nodes

    def allowed(z: FloatArray) -> FloatArray:
        return np.where(free[:, None], z, across(z, v))

    def product(x: FloatArray) -> FloatArray:
        return adjoint(allowed(differences(x, edges)), edges, n)

    y = allowed(dual)
    total = adjoint(y, edges, n)
    h = conjugate_gradients(
        product, precondition, total, tol=_CG_TOL, max_iterations=_CG_STEPS, coupled_nodes=len(total)
    ).x
    return np.asarray(y - allowed(differences(h, edges)))
