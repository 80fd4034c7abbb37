"""Angular refinement with measured positions of some nodes: directions and anchors in one robust cost.

To the terms of `angular`, at the levels that its refinement ended with, comes one for each anchor,

    k^2 / 2 atan(chi2_a / k^2),    chi2_a = (t_a - p_a)^T Omega_a (t_a - p_a),

with the same kernel, so that an anchor far off says nothing. Anchors are taken as pairs with one more node,
which stands at the origin: the normal matrix is a block Laplacian still, and what it leaves open, a shift of
everything, is settled by that node. Units are those of the anchors; directions do not mind.
"""

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.losses import ARCTANGENT, loss, weighed
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.factor import DEFAULT_FACTOR_BYTES
from sfm_shapefit.refinement.angular import (
    DAMPING,
    KERNEL_WIDTH,
    AngularTerms,
    allocate_normal,
    information_at,
    plan_refinement,
    take_angular_step,
)
from sfm_shapefit.scene.known_positions import KnownPositions
from sfm_shapefit.solver.program import adjoint

_MAX_STEPS = 40  # steps, a bound; a start near the answer needs few
_CONVERGED = 1e-9  # relative decrease of the cost; a smaller one is the last


def weighted_anchors(anchors: KnownPositions, t: FloatArray) -> KnownPositions:
    """Return the anchors of plain squares whose pull at locations (n, d) is that of these."""
    weights = weighed(ARCTANGENT, 1.0, anchors.chi2(t) / KERNEL_WIDTH**2)
    return anchors._replace(information=weights[:, None, None] * anchors.information)


def refine_anchored(
    measured: MeasuredGraph,
    start: FloatArray,
    levels: FloatArray,
    anchors: KnownPositions,
    *,
    max_bytes: int = DEFAULT_FACTOR_BYTES,
) -> FloatArray:
    """Return locations (n, d), in the anchors' units, of least cost of directions and anchors together.

    Args:
        measured: a connected view graph.
        start: (n, d) locations near the anchors.
        levels: (number of classes,) in radians.
        anchors: measured positions of some nodes.
        max_bytes: limit of a factor of the normal equations; above, UnsolvableError.
    """
    graph = measured.graph
    plan = plan_refinement(_join(graph, anchors), max_bytes)
    if plan is None:
        raise UnsolvableError(
            "the factor for the refinement with priors would take more than the "
            f"{max_bytes / 1e6:.0f} MB allowed for one; allow more, or leave this refinement out"
        )
    factor = allocate_normal(plan, graph.dimension)
    terms = _AnchoredTerms(graph, information_at(measured, levels), anchors)
    t, damping = start, DAMPING.first
    for _ in range(_MAX_STEPS):
        moved, damping, before, after = take_angular_step(terms, factor, t, damping)
        if before - after <= _CONVERGED * before:
            break
        t = moved
    return t


def _join(graph: ViewGraph, anchors: KnownPositions) -> ViewGraph:
    """Return the pairs of the graph, and those of the anchors' nodes with the origin, the last node."""
    n = graph.num_nodes
    links = np.stack([anchors.indices, np.full(len(anchors.indices), n)], axis=1)
    no_directions = np.broadcast_to(np.eye(graph.dimension)[0], (len(links), graph.dimension))
    return ViewGraph(
        n + 1, np.concatenate([graph.edges, links]), np.concatenate([graph.directions, no_directions])
    )


class _AnchoredTerms(AngularTerms):
    """The joint cost and its normal equations, over the pairs of `_join`."""

    def __init__(self, graph: ViewGraph, information: FloatArray, anchors: KnownPositions) -> None:
        super().__init__(graph, information)
        self._anchors, self._joined = anchors, _join(graph, anchors)

    def cost(self, t: FloatArray) -> float:
        return super().cost(t) + self._anchors_cost(t)

    def _anchors_cost(self, t: FloatArray) -> float:
        kernels = 0.5 * KERNEL_WIDTH**2 * loss(ARCTANGENT, self._anchors.chi2(t) / KERNEL_WIDTH**2)
        return float(np.sum(kernels))

    def normal_equations(self, t: FloatArray) -> tuple[float, FloatArray, FloatArray, FloatArray]:
        """Return the cost, blocks (m + k, d, d), damping (m + k,) and the right-hand side (n + 1, d)."""
        cost, blocks, damped, gradient = self.linearize(t)
        anchor_blocks = weighted_anchors(self._anchors, t).information
        pull = np.einsum("kab,kb->ka", anchor_blocks, self._anchors.off(t))
        right = -adjoint(np.concatenate([gradient, pull]), self._joined.edges, self._joined.num_nodes)
        cost, damped = cost + self._anchors_cost(t), np.append(damped, np.zeros(len(anchor_blocks)))
        return cost, np.concatenate([blocks, anchor_blocks]), damped, right

    def move(self, t: FloatArray, step: FloatArray) -> FloatArray:
        """Return the locations (n, d) after a step (n + 1, d), with the origin where it is."""
        return np.asarray(t + step[:-1] - step[-1])
