"""LUD over groups: the convex start that does not collapse on long chains, see `solver.splitting.lud`.

    minimise  sum_e w_e || t_i - t_j - s_e v_e ||    subject to  s_e >= 1,  t = A x

which is a sum of distances w_e dist(t_i - t_j, C_e) to the rays C_e = {s v_e, s >= 1}. Splitting with z_e
for the baselines makes a step of two parts: z_e by the proximal map of a distance, which moves its point
towards the ray by 1 / rho at most, and x by least squares with weights w_e, whose matrix is factored once:

    z = prox(D A x + u),    u <- u + D A x - z,    A^T D^T W D A x = A^T D^T W (z - u)

As the start of a refinement some dozens of steps suffice; there is no certificate.

Source of the program: Ozyesil and Singer, CVPR 2015, eq. 7.
"""

import numpy as np

from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.solver.program import adjoint, along, differences
from sfm_shapefit.solver.rigs.groups import RigidGroups
from sfm_shapefit.solver.rigs.reduced import ReducedFactor
from sfm_shapefit.viewgraph import ViewGraph

_LEAST_LENGTH = 1.0
_PENALTY = 1.0  # rho: a baseline moves by the least length in a step at most
_RELAXATION = 1.6
_STEPS = 150


def lud_over_groups(graph: ViewGraph, groups: RigidGroups, steps: int = _STEPS) -> FloatArray | None:
    """Return LUD's locations (n, d), centred, after some steps; None if the system breaks down.

    Args:
        graph: connected over the groups; every pair joins two of them.
        groups: of its nodes.
        steps: of the splitting.
    """
    edges, v, w = graph.edges, graph.directions, graph.weights
    factor = ReducedFactor(edges, groups.normalised())
    try:
        factor.refactor(w[:, None, None] * np.eye(graph.dimension))
    except UnsolvableError:
        return None
    z, u = _LEAST_LENGTH * v, np.zeros_like(v)
    t = np.zeros((graph.num_nodes, graph.dimension))
    for _ in range(steps):
        t = factor.solve(adjoint(w[:, None] * (z - u), edges, graph.num_nodes))
        relaxed = _RELAXATION * differences(t, edges) + (1.0 - _RELAXATION) * z
        z = _towards_rays(relaxed + u, v)
        u = u + relaxed - z
    return np.asarray(t - t.mean(axis=0)) if np.isfinite(t).all() else None


def _towards_rays(points: FloatArray, v: FloatArray) -> FloatArray:
    """Return the points (m, d) moved towards their rays by 1 / rho, or onto them where that is nearer."""
    away = points - np.maximum(along(points, v), _LEAST_LENGTH)[:, None] * v
    distances = np.linalg.norm(away, axis=1, keepdims=True)
    return np.asarray(points - away * np.minimum(1.0, 1.0 / (_PENALTY * np.maximum(distances, 1e-300))))
