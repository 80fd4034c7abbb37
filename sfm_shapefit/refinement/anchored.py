"""Angular refinement with measured positions of some nodes: directions and anchors in one robust cost.

To the terms of `angular`, at the levels that its refinement ended with, comes one for each anchor,

    k^2 / 2 atan(chi2_a / k^2),    chi2_a = (t_a - p_a)^T Omega_a (t_a - p_a),

with the same kernel, so that an anchor far off says nothing. Anchors are taken as pairs with one more node,
which stands at the origin: the normal matrix is a block Laplacian still, and what it leaves open, a shift of
everything, is settled by that node. Units are those of the anchors; directions do not mind.
"""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.laplacian.cholesky import allocate_factor
from sfm_shapefit.laplacian.symbolic import DEFAULT_FACTOR_BYTES, SymbolicFactor
from sfm_shapefit.refinement.angular import (
    DAMPING,
    KERNEL_WIDTH,
    AngularTerms,
    Metric,
    NormalFactor,
    plan_refinement,
)
from sfm_shapefit.solver.damping import take_damped_step
from sfm_shapefit.solver.program import adjoint
from sfm_shapefit.viewgraph import ViewGraph

_MAX_STEPS = 40
# A step that lowers the cost by less than this share of it is the last one.
_CONVERGED = 1e-9


class Anchors(NamedTuple):
    """Measured positions."""

    nodes: IntArray
    """(k,) whose they are."""
    positions: FloatArray
    """(k, d)"""
    information: FloatArray
    """(k, d, d) inverse covariances."""


def refine_anchored(
    graph: ViewGraph,
    start: FloatArray,
    metric: Metric,
    levels: FloatArray,
    anchors: Anchors,
    *,
    max_bytes: int = DEFAULT_FACTOR_BYTES,
) -> FloatArray:
    """Return locations (n, d), in the anchors' units, of least cost of directions and anchors together.

    Args:
        graph: a connected view graph.
        start: (n, d) locations near the anchors.
        metric: covariance and class of each pair.
        levels: (number of classes,) in radians.
        anchors: measured positions of some nodes.
        max_bytes: what a factor of the normal equations may take.

    Raises:
        UnsolvableError: if it would take more.
    """
    problem = _Problem(AngularTerms(graph, metric, levels), anchors, max_bytes)
    t, damping = start, DAMPING.first
    cost = problem.cost(t)
    for _ in range(_MAX_STEPS):
        moved, damping, lower = _step(problem, t, damping, cost)
        if cost - lower <= _CONVERGED * cost:
            break
        t, cost = moved, lower
    return t


class _JoinedGraph(NamedTuple):
    """The pairs of the graph, and those of the anchors' nodes with the origin, which is the last node."""

    num_nodes: int
    edges: IntArray
    dimension: int


class _Problem:
    """The joint cost and its normal equations."""

    def __init__(self, terms: AngularTerms, anchors: Anchors, max_bytes: int) -> None:
        n, d = terms.graph.num_nodes, terms.graph.dimension
        links = np.stack([anchors.nodes, np.full(len(anchors.nodes), n)], axis=1)
        self.terms, self.anchors, self.num_nodes = terms, anchors, n + 1
        self.edges = np.concatenate([terms.graph.edges, links])
        plan = plan_refinement(_JoinedGraph(n + 1, self.edges, d), max_bytes)
        if plan is None:
            raise UnsolvableError(
                "the factor for the refinement with priors would take more than the "
                f"{max_bytes / 1e6:.0f} MB allowed for one; allow more, or leave this refinement out"
            )
        self.factor: NormalFactor = allocate_factor(plan, d) if isinstance(plan, SymbolicFactor) else plan

    def cost(self, t: FloatArray) -> float:
        """Return the cost at t, (n, d)."""
        return self.terms.cost(t) + float(
            np.sum(0.5 * KERNEL_WIDTH**2 * np.arctan(self._chi2(t) / KERNEL_WIDTH**2))
        )

    def normal_equations(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return blocks (m + k, d, d), damping (m + k,) and the right-hand side (n + 1, d)."""
        blocks, damped, gradient = self.terms.linearize(t)
        weights = 1.0 / (1.0 + (self._chi2(t) / KERNEL_WIDTH**2) ** 2)
        own = weights[:, None, None] * self.anchors.information
        pull = np.einsum("kab,kb->ka", own, t[self.anchors.nodes] - self.anchors.positions)
        right = -adjoint(np.concatenate([gradient, pull]), self.edges, self.num_nodes)
        return np.concatenate([blocks, own]), np.append(damped, np.zeros(len(own))), right

    def _chi2(self, t: FloatArray) -> FloatArray:
        off = t[self.anchors.nodes] - self.anchors.positions
        return np.asarray(np.einsum("ka,kab,kb->k", off, self.anchors.information, off))


def _step(problem: _Problem, t: FloatArray, damping: float, before: float) -> tuple[FloatArray, float, float]:
    """Take one step that lowers the cost; return locations, damping and the cost, the same if none does."""
    blocks, damped, right = problem.normal_equations(t)

    def propose(damping: float) -> tuple[FloatArray, float] | None:
        try:
            problem.factor.refactor(blocks + (damping * damped)[:, None, None] * np.eye(t.shape[1]))
        except UnsolvableError:
            return None
        step = problem.factor.solve(right)
        proposed = t + step[:-1] - step[-1]
        after = problem.cost(proposed)
        return (proposed, after) if after < before else None

    found, damping = take_damped_step(propose, damping, DAMPING)
    moved, after = (t, before) if found is None else found
    return moved, damping, after
