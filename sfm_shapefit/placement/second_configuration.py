"""Do the rejected pairs agree on another placement?

Pairs that are wrong at random contradict each other as much as the solution. Pairs of repeated structure
(facades, a symmetric object) agree with one another on a second configuration, and where they are many the
solution may be a compromise, or the wrong one of the two. So the rejected pairs are solved by themselves.

n cameras have d (n - 1) - 1 unknowns, and a direction d - 1 equations: even random directions can be made to
agree as far as there are unknowns, at most f = (d (n - 1) - 1) / (d - 1) pairs of them. The share
(agreeing - f) / (all - f) of the pairs beyond these was -2.7 to -0.1 for random ones, and 0.5 to 1 where all
wrong pairs agree on one configuration.

The program is LUD (Ozyesil, Singer 2015, "Robust camera location estimation by convex programming"), a few
iterations, which cost some hundredths of the placement.
"""

from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, IntArray
from sfm_shapefit.base.geometry import angle_between_deg, normalized
from sfm_shapefit.graph.rigidity import parallel_rigid_pieces
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.solver.program import differences
from sfm_shapefit.solver.splitting.lud import solve_lud

_LEAST_OF_AGREEING = 0.2  # share of the solution's pairs; a smaller second configuration is chance
_LEAST_SHARE = 0.3  # share of agreeing pairs beyond those that unknowns can fit; random ones stay below 0
_FEWEST_SPARE = 20.0  # pairs beyond those that unknowns can fit; a share of fewer is chance
_STEPS = 20  # iterations of LUD; enough to see who agrees
_LEVELS = 5.0  # levels of error; a pair agrees within these, ...
_ANGLE_DEG = (3.0, 10.0)  # ... degrees, at least and at most; a level may be tiny or huge
_MAX_PAIRS = 1_000_000  # pairs; as for the second start of a placement, which takes as long


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SecondConfiguration:
    """Another placement that many of the rejected pairs agree on."""

    cameras: IntArray
    """Nodes of the graph that it places, ascending."""
    num_pairs: int
    """Rejected pairs that agree with it."""
    num_against: int
    """Pairs that agree with the solution."""

    def statement(self) -> str:
        """Say what was found, for the user."""
        return (
            f"{self.num_pairs} rejected pairs agree with one another on another placement of "
            f"{len(self.cameras)} cameras, against {self.num_against} pairs that agree with this one: "
            "repeated structure, or two scenes in one"
        )


def find_second_configuration(
    graph: ViewGraph, judged: IntArray, inliers: BoolArray, level_deg: float
) -> SecondConfiguration | None:
    """Return the placement that the rejected pairs agree on, if they do.

    Only pairs of cameras are `judged`, not directions to points; inliers (m,) agree with the solution, with
    residuals of standard deviation `level_deg` per axis.
    """
    rejected = judged[~inliers[judged]]
    agreeing = len(judged) - len(rejected)
    if not _LEAST_OF_AGREEING * agreeing <= len(rejected) <= _MAX_PAIRS or len(rejected) < _FEWEST_SPARE:
        return None
    pieces = parallel_rigid_pieces(graph.num_nodes, graph.edges[rejected], graph.dimension)
    rigid, nodes = graph.restricted_to(rejected[pieces == np.argmax(np.bincount(pieces))])
    fitted = (graph.dimension * (rigid.num_nodes - 1) - 1) / (graph.dimension - 1)
    if rigid.num_edges - fitted < _FEWEST_SPARE:
        return None
    second = solve_lud(rigid, _STEPS, certified=False).locations
    angles = angle_between_deg(rigid.directions, normalized(differences(second, rigid.edges)))
    alike = int(np.sum(angles <= np.clip(_LEVELS * level_deg, *_ANGLE_DEG)))
    if alike - fitted < _LEAST_SHARE * (rigid.num_edges - fitted) or alike < _LEAST_OF_AGREEING * agreeing:
        return None
    return SecondConfiguration(cameras=nodes, num_pairs=alike, num_against=agreeing)
