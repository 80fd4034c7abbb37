"""Is there another placement that many pairs agree on?

1. *Another end of the refinement*, in a bare graph. A start may lead to another place than the one that is
kept. Pairs that both explain decide nothing between them; where the other explains more than half as many
alone as the kept one does alone, the directions decide nothing either. Where half of all pairs are shifted
along a corridor whose segments repeat, that number was 0.69 to 1.15 times the kept one's, whichever of the
two was right, and the ends stood 2 % of the extent apart. It was 0.05 to 0.22 for folds of
rotation-symmetric scenes, which lose; where 28 % of the pairs are shifted both ends stand in one place.

2. *The rejected pairs by themselves*. Pairs that are wrong at random contradict each other as much as the
solution. Pairs of repeated structure (facades, a symmetric object) agree with one another on a second
configuration, and where they are many the solution may be a compromise, or the wrong one of the two. So the
rejected pairs are solved by themselves.

n cameras have d (n - 1) - 1 unknowns, and a direction d - 1 equations: even random directions can be made
to agree as far as there are unknowns, at most f = (d (n - 1) - 1) / (d - 1) pairs of them. The share
(agreeing - f) / (all - f) of the pairs beyond these was -2.7 to -0.1 for random ones, and 0.5 to 1 where
all wrong pairs agree on one configuration.

The program of 2 is LUD (Ozyesil, Singer 2015, "Robust camera location estimation by convex programming"), a
few iterations, which cost some hundredths of the placement.

3. *A fold*, in a bare graph. Where a scene has four equal sides, a placement may lay them over one another:
it explains wrong pairs, and rejects right ones, which close triangles with others. So the placement is a
fold if it rejects more than a third of all pairs, and triangles (`refinement.posterior`) speak for most of
these: for 52 to 66 % in folds, for at most 45 % in right answers to such scenes, for 20 % of random pairs.
"""

import enum
from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, IntArray, distinct
from sfm_shapefit.base.geometry import angle_between_deg, normalized
from sfm_shapefit.graph.rigidity import parallel_rigid_pieces
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.refinement.posterior import TriangleEvidence, weigh_by_triangles
from sfm_shapefit.refinement.starts import RefinedPlacement
from sfm_shapefit.solver.program import differences
from sfm_shapefit.solver.splitting.lud import solve_lud

_NEARLY_AS_MANY = 0.5  # ratio of pairs; an explanation with twice as many is believed
_FEWEST_ALONE = 2  # pairs; so many fit by chance alone
_MANY_REJECTED = 1.0 / 3.0  # share of pairs; right answers reject as many where wrong ones are random
_MOST = 0.5  # share of the rejected pairs; see the header
_LEAST_OF_AGREEING = 0.2  # share of the solution's pairs; a smaller second configuration is chance
_LEAST_SHARE = 0.3  # share of agreeing pairs beyond those that unknowns can fit; random ones stay below 0
_FEWEST_SPARE = 20.0  # pairs beyond those that unknowns can fit; a share of fewer is chance
_STEPS = 20  # iterations of LUD; enough to see who agrees
_LEVELS = 5.0  # levels of error; a pair agrees within these, ...
_ANGLE_DEG = (3.0, 10.0)  # ... degrees, at least and at most; a level may be tiny or huge
_MAX_PAIRS = 1_000_000  # pairs; as for the second start of a placement, which takes as long


class Found(enum.Enum):
    """How another placement shows; the value tells of its pairs, its cameras, and the pairs against it."""

    BY_A_START = "{} pairs fit another placement of {} cameras and not this one, which {} fit alone"
    BY_TRIANGLES = (
        "{} rejected pairs of {} cameras close triangles all the same, against {} that agree with this "
        "placement: it may be a fold"
    )
    BY_REJECTED_PAIRS = (
        "{} rejected pairs agree with one another on another placement of {} cameras, against {} pairs that "
        "agree with this one"
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SecondConfiguration:
    """Another placement that many pairs agree on."""

    found: Found
    cameras: IntArray
    """Nodes of the graph that it places, ascending."""
    num_pairs: int
    """Pairs that agree with it, and not with the solution."""
    num_against: int
    """Pairs that agree with the solution; if another start led here, and not with it."""

    @property
    def is_as_good(self) -> bool:
        """Whether nothing says that the solution is the right one of the two."""
        return self.found is not Found.BY_REJECTED_PAIRS

    @property
    def clause(self) -> str:
        """What was found, in short."""
        return {
            Found.BY_A_START: "another placement explains the pairs nearly as well",
            Found.BY_TRIANGLES: "most of the rejected pairs close triangles, as where a scene is folded",
            Found.BY_REJECTED_PAIRS: "many rejected pairs agree on a second configuration",
        }[self.found]

    def statement(self) -> str:
        """Say what was found and what to do, for the user."""
        what = self.found.value.format(self.num_pairs, len(self.cameras), self.num_against)
        if self.is_as_good:
            return f"{what}; where sides or segments of the scene look alike, leave out pairs between these"
        return f"{what}: repeated structure, or two scenes in one"


def find_rival(refined: RefinedPlacement) -> SecondConfiguration | None:
    """Return the best other end of the refinement that explains nearly as much, if any."""
    kept = refined.posterior > 0.5
    for rival in refined.rivals:
        theirs = rival.end.posterior > 0.5
        alone, against = int(np.sum(theirs & ~kept)), int(np.sum(kept & ~theirs))
        if rival.is_apart and alone > max(_NEARLY_AS_MANY * against, _FEWEST_ALONE):
            nodes = np.arange(len(refined.locations))
            return SecondConfiguration(
                found=Found.BY_A_START, cameras=nodes, num_pairs=alone, num_against=against
            )
    return None


def find_fold(
    graph: ViewGraph, inliers: BoolArray, triangles: TriangleEvidence | None = None
) -> SecondConfiguration | None:
    """Return what triangles, weighed if None, say of the pairs that a placement rejects; None if no fold."""
    rejected = np.flatnonzero(~inliers)
    if len(rejected) <= _MANY_REJECTED * len(inliers):
        return None
    triangles = weigh_by_triangles(graph) if triangles is None else triangles
    closing = rejected[triangles.log_odds[rejected] > 0.0]
    if len(closing) <= _MOST * len(rejected):
        return None
    cameras, against = distinct(graph.edges[closing]), int(inliers.sum())
    return SecondConfiguration(
        found=Found.BY_TRIANGLES, cameras=cameras, num_pairs=len(closing), num_against=against
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
    return SecondConfiguration(
        found=Found.BY_REJECTED_PAIRS, cameras=nodes, num_pairs=alike, num_against=agreeing
    )
