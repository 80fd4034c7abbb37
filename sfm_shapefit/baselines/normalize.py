"""The gauge in which baselines return their locations."""

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.solver.program import projected_length


def normalize_locations(graph: ViewGraph, locations: FloatArray) -> FloatArray:
    """Return the (n, d) locations centered, of unit norm, and with sum_e w_e <t_i - t_j, v_e> >= 0."""
    centered = locations - locations.mean(axis=0)
    centered = centered / np.linalg.norm(centered)
    return np.asarray(centered if projected_length(graph, centered) >= 0.0 else -centered)
