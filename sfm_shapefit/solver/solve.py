"""The one entry to the solvers: check the graph, choose a method, solve, certify."""

import time

import numpy as np

from sfm_shapefit.arrays import frozen
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.rigidity import is_parallel_rigid
from sfm_shapefit.solver.certificate import Certificate, certify
from sfm_shapefit.solver.conic import solve_conic
from sfm_shapefit.solver.options import SolverOptions, SolverResult, Status
from sfm_shapefit.solver.program import normalized_locations, projected_length, scale_functional
from sfm_shapefit.viewgraph import ViewGraph

_DIRECTIONS_CANCEL = 1e-9  # relative size of c below which the scale constraint says nothing


def solve(graph: ViewGraph, options: SolverOptions | None = None) -> SolverResult:
    """Solve ShapeFit on a parallel-rigid view graph, with a certificate of optimality.

    Args:
        graph: n cameras, m pairs, directions in any dimension d >= 2.
        options: solver settings; defaults if None.

    Returns:
        Locations, status, objective, and a feasible dual point whose value bounds the optimum from below.
        Not reaching the tolerance is reported in `status`, not raised.

    Raises:
        UnsolvableError: if the graph has fewer than two cameras, is not connected, is not parallel rigid,
            or its directions cancel at every camera (the scale constraint is empty).

    Source: Hand, Lee, Voroninski (2015), arXiv 1506.01437.
    """
    options = options or SolverOptions()
    _refuse_undetermined(graph)
    start = time.perf_counter()
    locations, dual, iterations = solve_conic(graph, options.tol, options.max_iterations)
    length = projected_length(graph, locations)
    if not (np.isfinite(locations).all() and length > 0.0):
        raise UnsolvableError("the solver found no finite locations; check the directions of the graph")
    locations = normalized_locations(graph, locations)
    certificate = certify(graph, locations, dual)
    return SolverResult(
        locations=frozen(locations),
        status=_status(certificate, options, iterations),
        objective=certificate.objective,
        dual_bound=certificate.dual_bound,
        dual=certificate.dual,
        equality_residual=certificate.equality_residual,
        iterations=iterations,
        seconds=time.perf_counter() - start,
        method="conic",
        method_reason="asked for" if options.method == "conic" else "the only solver so far",
    )


def _refuse_undetermined(graph: ViewGraph) -> None:
    """Raise UnsolvableError where the program has no unique answer whatever the directions say."""
    if graph.num_cameras < 2 or graph.num_edges == 0:
        raise UnsolvableError("the graph has no pair of cameras; nothing can be placed")
    components = int(graph.components().max()) + 1
    if components > 1:
        raise UnsolvableError(
            f"the graph falls into {components} connected components; solve each one separately"
        )
    if not is_parallel_rigid(graph.num_cameras, graph.edges, graph.dimension):
        raise UnsolvableError(
            "the graph is not parallel rigid, so the directions do not determine the locations; "
            "solve its largest piece (sfm_shapefit.rigidity.rigid_pieces)"
        )
    c = scale_functional(graph)
    if np.linalg.norm(c) <= _DIRECTIONS_CANCEL * graph.weights.sum():
        raise UnsolvableError("the directions cancel at every camera, so no scale can be fixed")


def _status(certificate: Certificate, options: SolverOptions, iterations: int) -> Status:
    if certificate.gap <= options.tol:
        return Status.CONVERGED
    return Status.MAX_ITERATIONS if iterations >= options.max_iterations else Status.INACCURATE
