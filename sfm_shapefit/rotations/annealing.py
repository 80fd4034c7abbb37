"""Rotations from pairs: along a spanning tree, by annealed rounds, then with the full information.

    tree       the maximum spanning tree by the pairs' support, from its most supported pair
    annealed   weights sqrt(support) / (1 + (|x| / tau)^2)^2, tau from 30 or 60 deg, times 3/4 a round, down
               to 5 deg; each round one step of a Laplacian system, no camera farther than .5 rad
    full       blocks R_j^T H R_j, pairs beyond 5 deg left out, Geman and McClure's loss of the Mahalanobis
               length at three times its median

Between them cameras move to where most of their pairs want them: a camera whose link in the tree is false may
sit where that pair alone fits, and no narrowing loss frees it. Blocks of cameras then do the same.

The wide loss in the beginning has one minimum near the tree's answer; the narrow one in the end does not see
false pairs. The full information from the start is not robust: false pairs state theirs as well.

Sources: Chatterjee, Govindu, "Efficient and robust large-scale rotation averaging", ICCV 2013 (reweighted
steps on the Laplacian); Black, Rangarajan, "On the unification of line processes", IJCV 1996, and Blake,
Zisserman, "Visual reconstruction", 1987 (annealing a robust loss); Zhang et al., "Revisiting rotation
averaging: uncertainties and robust losses", CVPR 2023 (information of the pairs).
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, frozen
from sfm_shapefit.base.forests import connected_components, merge_sets, root_of
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.base.quaternions import matrices_of, quaternions_of
from sfm_shapefit.laplacian.operators import Adjacency, adjacency, group_by
from sfm_shapefit.pairs.relative_rotations import AGREEMENT_DEG
from sfm_shapefit.rotations.averaging_kernels import (
    close_triangles,
    follow_tree,
    move_to_modes,
    residual_squares,
    reweigh_pairs,
    turn_cameras,
    weigh_blocks,
)
from sfm_shapefit.rotations.averaging_system import AveragingSystem

_ROUNDS = 14  # rounds; nine lead from 60 degrees down to 5, the others are spent there
_COOLING = 0.75  # factor on the width per round; see the header
_COLDEST = np.radians(AGREEMENT_DEG)
LONGEST_STEP = 0.5
"""Radians that a camera turns in a step, at most; steps are of first order."""
FULL_LIMIT = np.radians(AGREEMENT_DEG)
"""Radians; pairs with a larger residual are left out of the phase with the full information."""
SCALE_OF_MEDIAN = 3.0
"""Width of the loss with the full information; in medians of the Mahalanobis lengths."""
# Triangles that close to within about this angle count as closed.
_CLOSING_SCALE = np.radians(AGREEMENT_DEG)
_VOTING_SCALE = np.radians(10.0)  # radians; predictions of a rotation within about this vote for each other
# A camera moves only for so much more votes: by less, two could move for one another for ever.
_MARGIN = 0.05
# A move can make a neighbor move; whoever is still wrong after these has annealing to come.
_SWEEPS = 5
SETTLED = 1e-7
"""Radians; rounds end when no step is longer."""
_REDUCTION, LAST_REDUCTION = 3e-2, 1e-4  # share of the residual, without a factor; rounds, and the last ones


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AveragingPairs:
    """What is averaged: k pairs that join n cameras."""

    num_cameras: int
    pairs: IntArray
    """(k, 2)"""
    measured: FloatArray
    """(k, 4) cam_j_from_cam_i, unit quaternions (x, y, z, w)."""
    information: FloatArray
    """(k, 3, 3) in axes of camera j, rad^-2, capped."""
    supports: FloatArray
    """(k,) how many matches stand behind each pair, W n."""

    def subset(self, rows: IntArray | BoolArray) -> "AveragingPairs":
        """Return the given pairs, in that order."""
        return AveragingPairs(
            num_cameras=self.num_cameras,
            pairs=np.ascontiguousarray(self.pairs[rows]),
            measured=np.ascontiguousarray(self.measured[rows]),
            information=np.ascontiguousarray(self.information[rows]),
            supports=self.supports[rows],
        )


class Linearized(NamedTuple):
    """The last system with the full information."""

    blocks: FloatArray
    """(k, 3, 3) robust blocks in world axes, 0 for pairs that are left out."""
    distances: FloatArray
    """(k,) Mahalanobis lengths, NaN for pairs that are left out."""


def follow_spanning_tree(given: AveragingPairs) -> FloatArray:
    """Return the rotations (n, 4) along the maximum spanning tree, all with the root at the identity."""
    n, pairs = given.num_cameras, given.pairs
    ranked = np.argsort(-given.supports, kind="stable")
    order, (parents, links) = np.empty(n, dtype=np.int64), np.full((2, n), -1)
    reached = _grow_tree(pairs, ranked, int(pairs[ranked[0], 0]) if len(pairs) else 0, order, parents, links)
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
    follow_tree(order[:reached], parents, links, pairs, given.measured, turns)
    return turns


@kernel
def _grow_tree(pairs: Any, ranked: Any, root: int, order: Any, parents: Any, links: Any) -> int:
    """Fill in the tree of the pairs that rank first, as `follow_tree` takes it; return its size."""
    n, count = len(parents), 0
    forest, taken, ends = np.arange(n), np.empty(n, np.int64), np.empty(2 * n, np.int64)
    for rank in range(len(ranked)):
        i, j = pairs[ranked[rank], 0], pairs[ranked[rank], 1]
        if root_of(forest, i) != root_of(forest, j):
            merge_sets(forest, i, j)
            taken[count], ends[2 * count], ends[2 * count + 1] = ranked[rank], i, j
            count += 1
    pointers, entries = group_by(ends[: 2 * count], n)
    order[0], reached = root, 1
    for head in range(n):
        if head == reached:
            break
        node = order[head]
        for p in range(pointers[node], pointers[node + 1]):
            other = ends[entries[p] ^ 1]
            if other != parents[node]:
                parents[other], links[other], order[reached] = node, taken[entries[p] // 2], other
                reached += 1
    return reached


def closing_shares(given: AveragingPairs, system: AveragingSystem) -> FloatArray:
    """Return which share of its triangles closes for each pair, (k,), one half where it has none.

    Pairs ascend, with i < j. The share counts a triangle that closes, and one that does not, of average
    weight beside those that there are.
    """
    weights = np.sqrt(given.supports)
    closing, all_votes = _triangle_votes(given, system, weights)
    mean = float(weights.mean())
    return np.asarray((closing + mean) / (all_votes + 2.0 * mean))


def _triangle_votes(
    given: AveragingPairs, system: AveragingSystem, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the votes (k,) of the triangles of each pair that close, and of all; see `close_triangles`."""
    graph, k = system.graph, len(given.pairs)
    closing, all_votes = np.empty(k), np.empty(k)
    system.over_pairs(
        close_triangles, graph.pointers, graph.neighbors, graph.edge_of, given.pairs, given.measured, weights,
        float(_CLOSING_SCALE), closing, all_votes,
    )  # fmt: skip
    return closing, all_votes


def anneal(given: AveragingPairs, system: AveragingSystem, turns: FloatArray, widest: float) -> FloatArray:
    """Return rotations (n, 4) after rounds of a robust loss that narrows from `widest`, in radians."""
    turns, k = turns.copy(), len(given.pairs)
    weights = np.sqrt(given.supports / given.supports.mean())
    robust, pulls = np.empty(k), np.empty((k, 3))
    for step in range(_ROUNDS):
        tau = max(widest * _COOLING**step, float(_COLDEST))
        system.over_pairs(reweigh_pairs, given.pairs, given.measured, turns, weights, tau, robust, pulls)
        steps = system.solve_scalar(robust, system.gradient_of(pulls), _REDUCTION)
        turned = turn_cameras(turns, steps, LONGEST_STEP)
        if tau <= _COLDEST and turned <= SETTLED:
            break
    return turns


def reattach(given: AveragingPairs, system: AveragingSystem, turns: FloatArray) -> tuple[FloatArray, int]:
    """Return rotations (n, 4) with cameras moved to where most of their pairs want them, and the moves."""
    return _move(given.pairs, given.measured, turns, np.sqrt(given.supports), system.graph)


def reattach_blocks(
    given: AveragingPairs, system: AveragingSystem, turns: FloatArray
) -> tuple[FloatArray, int]:
    """Return rotations (n, 4) with blocks of cameras turned as most pairs between them say, and the moves.

    The cameras of a block are tied by triangles of agreeing pairs. Where one or two pairs alone tie it to the
    rest, these may be wrong, and no camera of it can move by itself. The largest block stays.
    """
    block_of = _find_blocks(given, system, turns)
    between = np.flatnonzero(block_of[given.pairs[:, 0]] != block_of[given.pairs[:, 1]])
    if not len(between):
        return turns, 0
    # From block to block, each in the axes that it has in the world at present.
    (i, j), pairs, rotations = given.pairs[between].T, block_of[given.pairs[between]], matrices_of(turns)
    relative = rotations[j].transpose(0, 2, 1) @ matrices_of(given.measured[between]) @ rotations[i]
    count = int(block_of.max()) + 1
    graph = adjacency(count, pairs)
    no_pair_moves_the_last = np.minimum(graph.pointers, graph.pointers[-2])
    graph = replace(graph, pointers=frozen(no_pair_moves_the_last))
    as_they_are = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
    votes = np.sqrt(given.supports[between])
    turned, moved = _move(pairs, quaternions_of(relative), as_they_are, votes, graph)
    return (quaternions_of(rotations @ matrices_of(turned)[block_of]) if moved else turns), moved


def _find_blocks(given: AveragingPairs, system: AveragingSystem, turns: FloatArray) -> IntArray:
    """Return the block of each camera (n,), the largest one as the last; see `reattach_blocks`."""
    squares = np.empty(len(given.pairs))
    system.over_pairs(residual_squares, given.pairs, given.measured, turns, squares)
    agrees = squares <= _COLDEST**2
    _, votes = _triangle_votes(given, system, agrees.astype(np.float64))
    block_of = connected_components(given.num_cameras, given.pairs[agrees & (votes > 0.0)])
    order = np.argsort(np.bincount(block_of), kind="stable")
    return np.asarray(np.argsort(order)[block_of])


def _move(
    pairs: IntArray, measured: FloatArray, turns: FloatArray, votes: FloatArray, graph: Adjacency
) -> tuple[FloatArray, int]:
    """Return rotations (n, 4) that are moved to where most of the votes (k,) want them, and the moves."""
    turns, all_moved = turns.copy(), 0
    for _ in range(_SWEEPS):
        moved = move_to_modes(
            graph.pointers, graph.neighbors, graph.edge_of, pairs, measured, turns, votes,
            float(_VOTING_SCALE), _MARGIN,
        )  # fmt: skip
        all_moved += moved
        if not moved:
            break
    return turns, all_moved


def refine_fully(
    given: AveragingPairs, system: AveragingSystem, turns: FloatArray, rounds: int = 8
) -> tuple[FloatArray, Linearized]:
    """Return rotations (n, 4) after rounds with the full information, and the system at the answer."""
    turns, k = turns.copy(), len(given.pairs)
    distances, blocks, pulls = np.empty(k), np.empty((k, 3, 3)), np.empty((k, 3))

    def weigh(scale: float) -> float:
        system.over_pairs(
            weigh_blocks, given.pairs, given.measured, turns, given.information, FULL_LIMIT, scale, distances,
            blocks, pulls,
        )  # fmt: skip
        inside = distances[~np.isnan(distances)]
        return max(SCALE_OF_MEDIAN * float(np.median(inside)) if len(inside) else 1.0, 1e-12)

    scale = weigh(1.0)
    scale = weigh(scale)
    for step in range(rounds):
        tol = LAST_REDUCTION if step == rounds - 1 else _REDUCTION
        steps = system.solve_blocks(blocks, system.gradient_of(pulls), tol)
        turned = turn_cameras(turns, steps, LONGEST_STEP)
        scale = weigh(scale)
        if turned <= SETTLED:
            break
    return turns, Linearized(blocks, distances)
