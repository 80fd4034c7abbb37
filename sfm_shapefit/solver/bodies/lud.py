"""LUD over bodies: the convex start that does not collapse on long chains, see `solver.admm.lud`.

    minimise  sum_e w_e || t_i - t_j - s_e v_e ||    subject to  s_e >= 1,  t = A x

by reweighted least squares: with the lengths s_e = max(1, <t_i - t_j, v_e>) and weights w_e / ||residual||
of the last iterate, x is a linear system. Every step lowers the objective, up to the floor of the residuals.
As the start of a refinement a few dozen steps suffice; there is no certificate.

Source of the program: Ozyesil and Singer, CVPR 2015, eq. 7.
"""

import numpy as np

from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.bodies import Bodies
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.solver.bodies.reduced import ReducedFactor
from sfm_shapefit.solver.program import adjoint, along, differences
from sfm_shapefit.viewgraph import ViewGraph

_LEAST_LENGTH = 1.0
_STEPS = 60
_FLOOR = 1e-3  # of the median residual, or of the least length where all fit


def lud_over_bodies(graph: ViewGraph, bodies: Bodies, steps: int = _STEPS) -> FloatArray | None:
    """Return LUD's locations (n, d), centred, after some steps; None if the system breaks down.

    Args:
        graph: connected over the bodies; every pair joins two of them.
        bodies: of its nodes.
        steps: of reweighting.
    """
    unit = bodies.normalised()
    factor = ReducedFactor(graph.edges, unit)
    v, identity = graph.directions, np.eye(graph.dimension)
    weights, lengths = graph.weights, np.full(graph.num_edges, _LEAST_LENGTH)
    t = np.zeros((graph.num_cameras, graph.dimension))
    for _ in range(steps):
        try:
            factor.refactor(weights[:, None, None] * identity)
        except UnsolvableError:
            return None
        pulls = adjoint((weights * lengths)[:, None] * v, graph.edges, graph.num_cameras)
        t = factor.solve(pulls)
        baselines = differences(t, graph.edges)
        lengths = np.maximum(along(baselines, v), _LEAST_LENGTH)
        residuals = np.linalg.norm(baselines - lengths[:, None] * v, axis=1)
        floor = _FLOOR * (float(np.median(residuals)) or _LEAST_LENGTH)
        weights = graph.weights / np.maximum(residuals, floor)
    return np.asarray(t - t.mean(axis=0)) if np.isfinite(t).all() else None
