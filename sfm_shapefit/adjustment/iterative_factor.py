"""The reduced system solved by conjugate gradients, for steps of more cameras than a factor should have.

The preconditioner adds what many small systems say, and a coarse one (two-level additive Schwarz):

    M^-1 = sum_b R_b^T S_b^-1 R_b + Z (Z^T S Z)^-1 Z^T

S_b is the system of the nodes of a block alone. METIS cuts the nodes into blocks, and each grows by those
that are tied most to it. Blocks do not see how a long row of cameras bends, which takes n^-4 of what it takes
to move one camera; Z does. It has seven columns for each of many small groups, the small similarities of its
frames, and each frame weighs those of its neighbors' groups (smoothed aggregation). Lenses and sensors that
more frames share than a block has stand in no block: they are unknowns of the coarse system.

A step need not be exact. Iterations end where the decrease that the step promises hardly grows any more; as
conjugate gradients give the best step x of their space, it is c^T x / 2 for the right-hand side c, whenever
they end. Against a factor, on facades of 1,000 and 2,500 frames and a ring of 300: 7, 9 and 4 iterations to
an error of a hundredth in the energy norm, 26 to 43 to a millionth; 17 to 22 to a hundredth where all share a
lens that is free.

Sources: Toselli, Widlund, "Domain decomposition methods", 2005, chapters 2 and 3; Vanek, Mandel, Brezina,
"Algebraic multigrid by smoothed aggregation", 1996; where to end: Nash, Sofer, "Assessing a search direction
within a truncated-Newton method", 1990, and for adjustments Agarwal, Snavely, Seitz, Szeliski, "Bundle
adjustment in the large", 2010.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sfm_shapefit.adjustment.gauge import small_similarities
from sfm_shapefit.adjustment.layout import SLOTS, Layout
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.adjustment.schur import UNDETERMINED, ReducedSystem
from sfm_shapefit.base.arrays import FloatArray, IntArray, distinct, rank_within, sum_by
from sfm_shapefit.base.blas_threads import one_blas_thread
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.base.lists import RowLists
from sfm_shapefit.laplacian.blocks import cut_graph, grow_blocks
from sfm_shapefit.laplacian.factor import Factor, allocate_factor, analyze
from sfm_shapefit.laplacian.operators import Workers

# Nodes of a block, and the share of them by which it grows; the counts of iterations hardly depend on them.
_BLOCK, _OVERLAP = 150, 0.15
_GROUP = 12  # frames of a group; with thrice as many, iterations are a third more
_GROUPS_OF_A_NODE = 4  # groups whose similarities a frame weighs at most; the others weigh next to nothing
_OWN_SHARE = 0.2  # weight of a frame's own group, over that of its neighbors; they make it smooth
_PAIRS_AT_ONCE = 100_000  # pairs of nodes that are looked at together; they take 50 MB
_SIMILARITY = 7  # unknowns of a group; three shifts, three turns, one scaling
# Shares of the diagonal that are added to it, in turn until there is a factor: of 32 bits for a block, as its
# rounding only costs iterations, and of 64 for the coarse system, where the least motions are.
_RIDGES_OF_BLOCKS, _RIDGES_OF_COARSE = (1e-7, 1e-5, 1e-3, 1e-1), (1e-13, 1e-11, 1e-9, 1e-7)
# The last iteration adds at most such a share of the decrease promised, over the number of iterations. They
# cost little beside what a step is made of, and a bend shows in the last digits of the decrease alone.
_ENOUGH, _MOST_ITERATIONS = 1e-8, 500


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """A small system over a graph of its own."""

    edges: IntArray
    """(m, 2)"""
    ridges: tuple[float, ...]
    factor: Factor

    @classmethod
    def of_block(cls, num_nodes: int, edges: IntArray, size: int) -> "_Part":
        return cls(edges, _RIDGES_OF_BLOCKS, allocate_factor(analyze(num_nodes, edges), size, np.float32))

    @classmethod
    def of_groups(cls, num_groups: int, edges: IntArray) -> "_Part":
        return cls(edges, _RIDGES_OF_COARSE, allocate_factor(analyze(num_groups, edges), _SIMILARITY))

    def refactor(self, diagonal: FloatArray, off_diagonal: FloatArray) -> None:
        """Factor the system of these blocks with the smallest ridge that lets it be factored."""
        entries = np.einsum("naa->na", diagonal)
        given = entries.copy()
        for ridge in self.ridges:
            entries[:] = given * (1.0 + ridge)
            if self.factor.refactor_blocks(diagonal, off_diagonal):
                return
        raise UnsolvableError(UNDETERMINED)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _CoarseSpace:
    """Z, and the system Z^T S Z."""

    groups: IntArray
    """(N, 4) the groups that move each node; a node that is shared is a group of its own."""
    weights: FloatArray
    """(N, 4) by how much; 0 for none."""
    motions: FloatArray
    """(N, 6, 7) how a node moves with a similarity about the origin; the identity where it is shared."""
    bases: FloatArray
    """(G, 7, 7) the similarities about the middle of each group, as ones about the origin."""
    part: _Part

    def reduce(self, x: FloatArray) -> FloatArray:
        """Return Z^T x, (G, 7), for x (N, 6)."""
        felt = np.einsum("nas,na->ns", self.motions, x)
        rows = (self.weights[:, :, None] * felt[:, None]).reshape(-1, _SIMILARITY)
        return np.asarray(
            np.einsum("gst,gs->gt", self.bases, sum_by(self.groups.ravel(), rows, len(self.bases)))
        )

    def expand(self, moves: FloatArray) -> FloatArray:
        """Return Z y, (N, 6), for y (G, 7)."""
        about = np.einsum("gst,gt->gs", self.bases, moves)
        return np.asarray(
            np.einsum("nas,ns->na", self.motions, np.einsum("nq,nqs->ns", self.weights, about[self.groups]))
        )

    def refactor(self, system: ReducedSystem, pair_nodes: IntArray) -> None:
        count, edges = len(self.bases), self.part.edges
        first = np.searchsorted(edges[:, 0], np.arange(count + 1))
        diagonal = np.zeros((count, _SIMILARITY, _SIMILARITY))
        off_diagonal = np.zeros((len(edges), _SIMILARITY, _SIMILARITY))
        _coarsen(
            (system.diagonal, system.pairs, pair_nodes), (self.groups, self.weights, self.motions),
            (first, np.ascontiguousarray(edges[:, 1])), diagonal, off_diagonal,
        )  # fmt: skip
        turned = self.bases.transpose(0, 2, 1)
        diagonal = turned @ diagonal @ self.bases
        entries = np.einsum("gaa->ga", diagonal)
        entries[entries <= 0.0] = 1.0  # motions that move no unknown
        self.part.refactor(diagonal, turned[edges[:, 0]] @ off_diagonal @ self.bases[edges[:, 1]])


class _Block:
    """The nodes of a block, the pairs among them, and their system."""

    __slots__ = ("nodes", "part", "rows", "size", "solution")

    def __init__(self, nodes: IntArray, layout: Layout, size: int) -> None:
        """Take ascending nodes, of so many slots each."""
        pairs_of = RowLists(layout.first_pair, np.arange(len(layout.pairs))).subset(nodes)
        seconds = layout.pairs[pairs_of.rows, 1]
        places = np.searchsorted(nodes, seconds).clip(max=len(nodes) - 1)
        inside = nodes[places] == seconds
        edges = np.stack([pairs_of.list_of_rows(), places], axis=1)[inside]
        self.nodes, self.rows, self.size = nodes, pairs_of.rows[inside], size
        self.part = _Part.of_block(len(nodes), edges, size)
        self.solution = np.zeros((0, size))

    def refactor(self, system: ReducedSystem) -> None:
        b = self.size
        self.part.refactor(system.diagonal[self.nodes, :b, :b], system.pairs[self.rows, :b, :b])

    def solve(self, residual: FloatArray) -> None:
        """Solve for its part of a residual (N, 6)."""
        self.solution = self.part.factor.solve(residual[self.nodes, : self.size])


class IterativeFactor:
    """What steps are solved with in place of a factor of the whole; the answer does not depend on threads."""

    def __init__(self, problem: AdjustmentProblem, layout: Layout, workers: Workers) -> None:
        """Take what is adjusted; the first system says where it is cut."""
        self._problem, self._layout, self._workers = problem, layout, workers
        self._size = int(layout.active.any(axis=0).sum())
        self._blocks: list[_Block] = []
        self._space: _CoarseSpace | None = None
        self._system: ReducedSystem | None = None

    def refactor(self, system: ReducedSystem) -> None:
        """Factor the blocks and the coarse system."""
        self._system = system
        if self._space is None:
            self._space = self._cut(system)

        def job(block: _Block) -> Callable[[], None]:
            return lambda: block.refactor(system)

        with one_blas_thread():
            self._workers.run([job(block) for block in self._blocks])
            self._space.refactor(system, self._layout.pairs)

    def solve(self, right: FloatArray) -> FloatArray:
        """Return steps (N, 6, r) for right-hand sides (N, 6, r), each good enough for a step."""
        sides = range(right.shape[2])
        with one_blas_thread():
            return np.stack([self._iterate(right[:, :, k] * self._layout.active) for k in sides], axis=2)

    def give_back(self) -> None:
        """Give up the system; blocks are small."""
        self._system = None

    def _iterate(self, right: FloatArray) -> FloatArray:
        """Return the solution (N, 6) of conjugate gradients from 0."""
        x, residual, direction = np.zeros_like(right), right, np.zeros_like(right)
        promised, before = 0.0, np.inf
        for k in range(1, _MOST_ITERATIONS + 1):
            corrected = self._precondition(residual)
            product = float(np.vdot(residual, corrected))
            direction = corrected + product / before * direction
            applied = self._apply(direction)
            curvature = float(np.vdot(direction, applied))
            if not (product > 0.0 and curvature > 0.0):  # rounding alone is left
                break
            length, before = product / curvature, product
            x, residual = x + length * direction, residual - length * applied
            promised += length * product
            if k * length * product <= _ENOUGH * promised:
                break
        return x

    def _apply(self, x: FloatArray) -> FloatArray:
        """Return S x for x (N, 6)."""
        assert self._system is not None
        out = np.zeros_like(x)
        out[:, : self._size] = self._system.times(self._layout.pairs, x[:, : self._size])
        return out * self._layout.active

    def _precondition(self, residual: FloatArray) -> FloatArray:
        """Return M^-1 times a residual (N, 6)."""
        assert self._space is not None

        def job(block: _Block) -> Callable[[], None]:
            return lambda: block.solve(residual)

        self._workers.run([job(block) for block in self._blocks])
        out = self._space.expand(self._space.part.factor.solve(self._space.reduce(residual)))
        for block in self._blocks:  # in order, whoever solved it
            out[block.nodes, : self._size] += block.solution
        return out * self._layout.active

    def _cut(self, system: ReducedSystem) -> _CoarseSpace:
        """Cut the nodes into blocks, by how strongly a system ties them, and return the coarse space."""
        layout, count = self._layout, self._layout.num_nodes
        num_frames = int(np.sum(layout.node_of_frame >= 0))
        degrees = np.bincount(layout.pairs.ravel(), minlength=count)
        is_shared = (np.arange(count) >= num_frames) & (degrees > _BLOCK)
        own = ~is_shared[layout.pairs].any(axis=1)
        ties, strengths = layout.pairs[own], _strengths(system, layout.pairs)[own]
        block_of = cut_graph(count, ties, strengths, _BLOCK)
        for grown in grow_blocks(block_of, ties, strengths, _OVERLAP):
            nodes = grown[~is_shared[grown]]
            if len(nodes):
                self._blocks.append(_Block(nodes, layout, self._size))
        among = (ties < num_frames).all(axis=1)
        groups, weights = _group_frames(num_frames, ties[among], strengths[among])
        return self._span(groups, weights, np.flatnonzero(is_shared))

    def _span(self, groups: IntArray, weights: FloatArray, shared: IntArray) -> _CoarseSpace:
        """Return the coarse space of groups of frames, (F, 4) with their weights, and of shared nodes."""
        problem, layout, frames = self._problem, self._layout, len(groups)
        moving = np.flatnonzero(layout.node_of_frame >= 0)  # whose nodes are the first, in order
        count = int(groups.max(initial=-1)) + 1
        arms = problem.centers[moving] - problem.centers[moving].mean(axis=0)
        motions = np.zeros((layout.num_nodes, SLOTS, _SIMILARITY))
        motions[:frames] = small_similarities(problem.rotations[moving], arms, np.zeros(3))
        motions[shared] = np.eye(SLOTS, _SIMILARITY)
        every = np.zeros((layout.num_nodes, _GROUPS_OF_A_NODE), dtype=np.int64)
        every[:frames], every[shared, 0] = groups, count + np.arange(len(shared))
        shares = np.zeros(every.shape)
        shares[:frames], shares[shared, 0] = weights, 1.0
        rows = (weights[:, :, None] * arms[:, None]).reshape(-1, 3)
        total = np.bincount(groups.ravel(), weights.ravel(), count)
        middles = sum_by(groups.ravel(), rows, count) / np.where(total > 0.0, total, 1.0)[:, None]
        bases = np.tile(np.eye(_SIMILARITY), (count + len(shared), 1, 1))
        bases[:count, :3] = small_similarities(np.zeros((count, 3, 3)), -middles, np.zeros(3))[:, :3]
        edges = _pairs_of_groups(every, shares, layout.pairs, len(bases))
        return _CoarseSpace(
            groups=every,
            weights=shares,
            motions=motions * layout.active[:, :, None],
            bases=bases,
            part=_Part.of_groups(len(bases), edges),
        )


def _strengths(system: ReducedSystem, pairs: IntArray) -> FloatArray:
    """Return how strongly pairs are tied, (P,): the norm of their block, unknowns scaled to curvature 1."""
    curvatures = np.einsum("naa->na", system.diagonal)
    scales = np.sqrt(np.where(curvatures > 0.0, curvatures, np.inf))  # what is rounding ties nothing
    squares = np.empty(len(pairs))
    for first in range(0, len(pairs), _PAIRS_AT_ONCE):
        own = slice(first, first + _PAIRS_AT_ONCE)
        i, j = pairs[own].T
        scaled = system.pairs[own] / (scales[i, :, None] * scales[j, None, :])
        squares[own] = np.einsum("kab,kab->k", scaled, scaled)
    return np.sqrt(squares)


def _group_frames(num_frames: int, ties: IntArray, strengths: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the groups that move each frame, and by which weights of sum 1, both (n, 4)."""
    group_of = cut_graph(num_frames, ties, strengths, _GROUP)
    ends, others = np.concatenate([ties, ties[:, ::-1]]).T
    sums = np.bincount(ends, np.tile(strengths, 2), num_frames)
    keys = np.concatenate([ends, np.arange(num_frames)]) * num_frames
    keys, rows = np.unique(keys + group_of[np.append(others, np.arange(num_frames))], return_inverse=True)
    weights = np.bincount(rows, np.concatenate([np.tile(strengths, 2), _OWN_SHARE * sums]))
    frames, groups = np.divmod(keys, num_frames)
    ranks = rank_within(frames, -weights, groups)
    largest = ranks < _GROUPS_OF_A_NODE
    places = frames[largest], ranks[largest]
    found = np.zeros((num_frames, _GROUPS_OF_A_NODE), dtype=np.int64)
    shares = np.zeros(found.shape)
    found[places], shares[places] = groups[largest], weights[largest]
    return found, shares / np.where(sums > 0.0, shares.sum(axis=1), 1.0)[:, None]  # what nothing ties stays


def _pairs_of_groups(groups: IntArray, weights: FloatArray, pairs: IntArray, count: int) -> IntArray:
    """Return the pairs of groups (K, 2), sorted, g < h, that a node or a pair of nodes ties."""
    nodes, keys = np.arange(len(groups)), [np.empty(0, np.int64)]
    ends = np.concatenate([pairs, np.stack([nodes, nodes], axis=1)])
    for first in range(0, len(ends), _PAIRS_AT_ONCE):
        i, j = ends[first : first + _PAIRS_AT_ONCE].T
        g, h = np.broadcast_arrays(groups[i, :, None], groups[j, None, :])
        tied = (weights[i, :, None] > 0.0) & (weights[j, None, :] > 0.0) & (g != h)
        g, h = g[tied], h[tied]
        keys.append(distinct(np.minimum(g, h) * count + np.maximum(g, h)))
    return np.stack(np.divmod(distinct(np.concatenate(keys)), count), axis=1)


@kernel
def _coarsen(system: Any, space: Any, edges: Any, diagonal: Any, off_diagonal: Any) -> None:
    """Add Z^T S Z, of similarities about the origin, to blocks of the groups and of their pairs."""
    own, between, pair_nodes = system
    groups, weights, motions = space
    size = motions.shape[2]
    half, block = np.empty((motions.shape[1], size)), np.empty((size, size))
    for i in range(len(own)):
        _congruence(motions[i], own[i], motions[i], half, block)
        for q in range(groups.shape[1]):
            for r in range(groups.shape[1]):
                weight = weights[i, q] * weights[i, r]
                if weight > 0.0 and groups[i, q] <= groups[i, r]:
                    _add(edges, (groups[i, q], groups[i, r]), weight, block, diagonal, off_diagonal)
    for k in range(len(pair_nodes)):
        i, j = pair_nodes[k, 0], pair_nodes[k, 1]
        _congruence(motions[i], between[k], motions[j], half, block)
        for q in range(groups.shape[1]):
            for r in range(groups.shape[1]):
                weight = weights[i, q] * weights[j, r]
                if weight > 0.0:
                    g, h = groups[i, q], groups[j, r]
                    _add(edges, (g, h), weight, block, diagonal, off_diagonal)
                    if g == h:
                        _add(edges, (h, g), weight, block.T, diagonal, off_diagonal)


@inner_kernel
def _congruence(left: Any, middle: Any, right: Any, half: Any, out: Any) -> None:
    """Write left^T middle right."""
    for a in range(len(middle)):
        for t in range(right.shape[1]):
            total = 0.0
            for c in range(len(middle)):
                total += middle[a, c] * right[c, t]
            half[a, t] = total
    for s in range(left.shape[1]):
        for t in range(right.shape[1]):
            total = 0.0
            for a in range(len(middle)):
                total += left[a, s] * half[a, t]
            out[s, t] = total


@inner_kernel
def _add(edges: Any, ends: Any, weight: float, block: Any, diagonal: Any, off_diagonal: Any) -> None:
    """Add a block (g, h), turned if g > h, where it belongs."""
    first, seconds = edges
    g, h = ends
    if g == h:
        for s in range(len(block)):
            for t in range(len(block)):
                diagonal[g, s, t] += weight * block[s, t]
        return
    low, high = min(g, h), max(g, h)
    begin, end = first[low], first[low + 1]
    while begin < end:
        middle = (begin + end) // 2
        if seconds[middle] < high:
            begin = middle + 1
        else:
            end = middle
    for s in range(len(block)):
        for t in range(len(block)):
            off_diagonal[begin, s, t] += weight * (block[s, t] if g < h else block[t, s])
