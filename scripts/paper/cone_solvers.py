"""ShapeFit by a generic cone solver, Clarabel: as a user would write it with cvxpy, and called directly.

Called directly, one camera is grounded, and each edge has one cone of d - 1 rows beside its bound, in an
orthonormal basis B_e of the complement of v_e:

    minimize    sum_e w_e s_e
    subject to  <c, T> = kappa,    (s_e, B_e^T (t_i - t_j)) in the second-order cone,    t_0 = 0

The multiplier of edge e is (w_e, z_e) in the same cone, and y_e = -B_e z_e the dual of the program.
"""

import clarabel
import cvxpy as cp
import numpy as np
from scipy.sparse import csc_array

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import tangent_bases
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.solver.program import scale_functional

Solution = tuple[FloatArray, FloatArray | None, int]
"""Locations, dual if the solver gives one, iterations."""


def solve_cvxpy(graph: ViewGraph, tol: float) -> Solution:
    """Write the program down as in the paper, with a scale near 1, and let cvxpy and Clarabel solve it."""
    v, m = graph.directions, graph.num_edges
    t = cp.Variable((graph.num_nodes, graph.dimension))
    baselines = t[graph.edges[:, 0]] - t[graph.edges[:, 1]]
    lengths = cp.sum(cp.multiply(v, baselines), axis=1)
    residuals = baselines - cp.multiply(v, cp.reshape(lengths, (m, 1), order="C"))
    problem = cp.Problem(
        cp.Minimize(cp.sum(cp.norm(residuals, 2, axis=1))),
        [cp.sum(lengths) == m, cp.sum(t, axis=0) == 0],
    )
    problem.solve(solver=cp.CLARABEL, tol_gap_abs=tol, tol_gap_rel=tol, tol_feas=tol, max_threads=1)
    return t.value, None, int(problem.solver_stats.num_iters)


def solve_direct(graph: ViewGraph, tol: float) -> Solution:
    """Build the cone program and solve it with Clarabel's tolerances set to `tol`, on one thread."""
    n, m, d = graph.num_nodes, graph.num_edges, graph.dimension
    bases = tangent_bases(graph.directions)
    unknowns = (n - 1) * d + m
    c = scale_functional(graph)[1:].ravel()
    values, rows, columns = _cone_entries(graph, bases)
    entries = np.concatenate([c, values])
    places = np.concatenate([np.zeros(len(c), dtype=np.int64), rows]), np.r_[: len(c), columns]
    matrix = csc_array((entries, places), shape=(1 + m * d, unknowns))
    right = np.zeros(1 + m * d)
    right[0] = graph.weights.sum()
    cost = np.concatenate([np.zeros((n - 1) * d), graph.weights])

    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tol
    cones = [clarabel.ZeroConeT(1), *(clarabel.SecondOrderConeT(d) for _ in range(m))]
    quadratic = csc_array((unknowns, unknowns))
    solution = clarabel.DefaultSolver(quadratic, cost, matrix, right, cones, settings).solve()
    t = np.vstack([np.zeros((1, d)), np.reshape(solution.x[: (n - 1) * d], (-1, d))])
    z = np.reshape(solution.z[1:], (m, d))[:, 1:]
    return t, -np.einsum("edk,ek->ed", bases, z), int(solution.iterations)


def _cone_entries(graph: ViewGraph, bases: FloatArray) -> tuple[FloatArray, np.ndarray, np.ndarray]:
    """Return values, rows and columns of -(s_e, B_e^T (t_i - t_j)) below row 0."""
    m, d, k = bases.shape
    first = 1 + d * np.arange(m)
    parts = [(-np.ones(m), first, (graph.num_nodes - 1) * d + np.arange(m))]
    for end, sign in ((0, -1.0), (1, 1.0)):
        nodes = graph.edges[:, end] - 1
        kept = nodes >= 0
        row = np.broadcast_to((first[:, None] + 1 + np.arange(k))[:, None, :], (m, d, k))[kept]
        column = np.broadcast_to((nodes[:, None] * d + np.arange(d))[:, :, None], (m, d, k))[kept]
        parts.append((sign * bases[kept].ravel(), row.ravel(), column.ravel()))
    values, rows, columns = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return values, rows, columns
