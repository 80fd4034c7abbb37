"""l_inf: the locations whose worst pair is as good as can be. One wrong pair decides the answer.

    minimize  gamma    subject to  || t_i - t_j - s_e v_e || <= gamma,  s_e >= 1

as a second-order cone program through cvxpy and Clarabel; for small graphs.

Sources: Kahl, "Multiple view geometry and the L-infinity norm", ICCV 2005; in this form, with boxes in
place of cones: Moulon, Monasse and Marlet, "Global fusion of relative motions", ICCV 2013, eq. 7.
"""

import warnings

import numpy as np
from scipy.sparse import csr_array

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.baselines.normalize import normalize_locations
from sfm_shapefit.graph.viewgraph import ViewGraph

# More pairs would take many minutes.
_MOST_PAIRS = 20_000


def locate_linf(graph: ViewGraph) -> FloatArray:
    """Return the l_inf locations (n, d).

    Raises:
        UnsolvableError: if the graph is too large, or the cone solver finds no point.
    """
    import cvxpy as cp

    n, m, d = graph.num_nodes, graph.num_edges, graph.dimension
    if m > _MOST_PAIRS:
        raise UnsolvableError(
            f"l_inf goes through a generic cone solver, for at most {_MOST_PAIRS} pairs; this graph has {m}, "
            "so choose another objective"
        )
    rows = np.tile(np.arange(m), 2)
    signs = np.repeat([1.0, -1.0], m)
    incidence = csr_array((signs, (rows, graph.edges.T.ravel())), shape=(m, n))
    t, s, gamma = cp.Variable((n, d)), cp.Variable((m, 1)), cp.Variable()
    misfits = incidence @ t - cp.multiply(s, graph.directions)
    bounded = cp.SOC(gamma * np.ones(m), misfits, axis=1)
    program = cp.Problem(cp.Minimize(gamma), [bounded, s >= 1.0, t[0] == 0.0])
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Solution may be inaccurate")
            program.solve(solver=cp.CLARABEL)
    except cp.error.SolverError as error:
        raise UnsolvableError(f"the conic solver found no l_inf locations ({error})") from error
    if t.value is None:
        raise UnsolvableError(f"the conic solver stopped with status {program.status!r} and no answer")
    return normalize_locations(graph, np.asarray(t.value))
