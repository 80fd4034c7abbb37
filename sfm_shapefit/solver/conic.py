"""The reference solver: the ShapeFit program as a generic second-order cone program.

The door to cvxpy and Clarabel. One cone of d rows per edge, in an orthonormal basis B_e of the complement of
v_e; camera 0 is grounded, which is sum_i t_i = 0 after centering:

    minimize    sum_e w_e s_e
    subject to  ||z_e|| <= s_e,    z_e = B_e^T (t_i - t_j),    <c, T> = kappa,    t_0 = 0

With groups (`sfm_shapefit.graph.groups`) t = A x, and x takes the place of t, group 0 grounded. The
multipliers of z_e = B_e^T (t_i - t_j) are the dual y_e in that basis. Slow, and trusted: every other solver
is tested against it.
"""

import contextlib
import warnings
from typing import Any

import numpy as np
from scipy.sparse import bsr_array, coo_array, csr_array, hstack, kron

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import tangent_bases
from sfm_shapefit.graph.groups import RigidGroups, separate
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.solver.program import scale_functional

_LEAST_CONE_TOL = 1e-12  # tolerance of the cone solver; double precision serves no smaller one
# The cone solver's tolerance per tolerance of ours: its own gap is relative to an inexact dual.
_CONE_TOL_PER_TOL = 1e-3
_LOOSER_FACTORS = (1.0, 10.0, 100.0, 1000.0)  # on the tolerance; tried in turn until a point is returned


def solve_conic(
    graph: ViewGraph, tol: float, max_iterations: int, groups: RigidGroups | None = None
) -> tuple[FloatArray, FloatArray, int]:
    """Solve the program with cvxpy and Clarabel; return locations (n, d), approximate dual (m, d), and steps.

    UnsolvableError if the cone solver returns no point at all.

    Args:
        graph: a connected, parallel-rigid view graph.
        tol: the certified gap wanted.
        max_iterations: limit of interior-point steps.
        groups: groups of its nodes, where the program is that over groups; no pair may lie inside one.
    """
    import cvxpy as cp

    bases = tangent_bases(graph.directions)
    m, d = graph.num_edges, graph.dimension
    reduction = _reduction(groups or separate(graph.num_nodes, d))
    matrix = _operator(graph, bases) @ reduction
    c = reduction.T @ scale_functional(graph).ravel()

    t = cp.Variable(matrix.shape[1])
    z = cp.Variable((d - 1, m))
    s = cp.Variable(m)
    fits = cp.vec(z, order="F") == matrix @ t
    program = cp.Problem(
        cp.Minimize(graph.weights @ s),
        [fits, cp.SOC(s, z, axis=0), c @ t == graph.weights.sum()],
    )
    iterations = _run(program, max(_CONE_TOL_PER_TOL * tol, _LEAST_CONE_TOL), max_iterations)
    if t.value is None or fits.dual_value is None:
        raise UnsolvableError(
            f"the conic solver stopped with status {program.status!r} and no answer; "
            "check the graph's rigidity and its directions"
        )
    locations = np.reshape(reduction @ t.value, (-1, d))
    y = np.einsum("edk,ek->ed", bases, np.reshape(fits.dual_value, (m, d - 1)))
    points_up = np.sum(y * (locations[graph.edges[:, 0]] - locations[graph.edges[:, 1]])) >= 0.0
    return locations, y if points_up else -y, iterations


def _operator(graph: ViewGraph, bases: FloatArray) -> csr_array:
    """Return the sparse map from (t_0, ..., t_{n-1}) to all B_e^T (t_i - t_j), stacked edge by edge."""
    m, d, k = bases.shape
    signs = np.tile([1.0, -1.0], m), (np.repeat(np.arange(m), 2), graph.edges.ravel())
    incidence = coo_array(signs, shape=(m, graph.num_nodes))
    across = bsr_array((bases.transpose(0, 2, 1), np.arange(m), np.arange(m + 1)), shape=(m * k, m * d))
    return csr_array(across @ kron(incidence, np.eye(d)))


def _reduction(groups: RigidGroups) -> csr_array:
    """Return A without the columns of group 0, which is grounded, and without those of s without offsets."""
    n, d = groups.offsets.shape
    belongs = coo_array((np.ones(n), (np.arange(n), groups.group_of)), shape=(n, groups.num_groups))
    moving = csr_array(kron(belongs, np.eye(d)))[:, d:]
    if not groups.offsets.any():
        return moving
    scaled = (groups.offsets.ravel(), (np.arange(n * d), np.repeat(groups.units, d)))
    return csr_array(hstack([moving, coo_array(scaled, shape=(n * d, groups.num_units))]))


def _run(program: Any, tolerance: float, max_iterations: int) -> int:
    """Run Clarabel on a cvxpy problem; return its number of steps. An inaccurate point is still a point.

    At a tolerance near rounding it now and then has none, and one at ten or a hundred times that.
    """
    import cvxpy as cp

    for looser in _LOOSER_FACTORS:
        limits = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), looser * tolerance)
        with warnings.catch_warnings(), contextlib.suppress(cp.error.SolverError):
            warnings.filterwarnings("ignore", message="Solution may be inaccurate")
            program.solve(solver=cp.CLARABEL, max_iter=max_iterations, **limits)
            return int(program.solver_stats.num_iters or 0)
    return max_iterations
