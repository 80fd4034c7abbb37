"""LUD, least unsquared deviations, by the engine that ShapeFit's splitting uses.

    minimize  sum_e w_e || t_i - t_j - s_e v_e ||    subject to  s_e >= 1

Source: Ozyesil and Singer, "Robust camera location estimation by convex programming", CVPR 2015, eq. 7.
"""

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.baselines.normalize import normalize_locations
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.solver.splitting.lud import solve_lud

# So many steps reach the optimum; as a start of a refinement 50 suffice.
_STEPS = 5000


def locate_lud(graph: ViewGraph) -> FloatArray:
    """Return LUD's locations (n, d), solved to its optimum."""
    return normalize_locations(graph, solve_lud(graph, _STEPS, certified=False).locations)
