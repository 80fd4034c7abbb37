"""The gauge in which baselines return their locations."""

import numpy as np

from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.geometry import normalized
from sfm_shapefit.solver.program import differences
from sfm_shapefit.viewgraph import ViewGraph


def unit_gauge(graph: ViewGraph, locations: FloatArray) -> FloatArray:
    """Return the (n, d) locations centred, of unit norm, and turned to the side that the pairs point to.

    That is sum_e w_e cos(t_i - t_j, v_e) >= 0: each pair counts alike however long it is. Least squares may
    leave one camera far out and the others close together, whose many short baselines then decide.
    """
    centred = locations - locations.mean(axis=0)
    centred = centred / np.linalg.norm(centred)
    cosines = np.einsum("ek,ek->e", normalized(differences(centred, graph.edges)), graph.directions)
    aligned: FloatArray = centred if np.nansum(graph.weights * cosines) >= 0.0 else -centred
    return aligned
