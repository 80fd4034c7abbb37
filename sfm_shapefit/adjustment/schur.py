"""Points eliminated: the reduced system of the nodes, and the points' steps from the nodes' steps.

    S_ij = U_ij - sum_p W_ip^T V_p^-1 W_jp        c_i = -b_i + sum_p W_ip^T V_p^-1 b_p
    dX_p = -V_p^-1 (b_p + sum_i W_ip d_i)

V_p is 3 x 3. Where it is singular (all observations behind their cameras; a single view, without damping) a
generalised inverse serves as well, for W_ip vanishes on the same directions: the point is held along them,
and says nothing of its cameras that it should not. An unknown on which nothing depends, such as the pose of a
camera without observations, is held too: its diagonal entry becomes 1.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sfm_shapefit.adjustment.layout import SLOTS, Layout
from sfm_shapefit.adjustment.residuals import NormalEquations
from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.jit import kernel, subtract_block
from sfm_shapefit.laplacian.operators import Workers

_ENTRIES_WORTH_A_THREAD = 1_000  # entries; each meets all others of its point, which takes long
_ENTRIES_OF_POINTS_WORTH_A_THREAD = 50_000  # entries; each is only multiplied by a step
_SINGULAR = 1e-12  # least pivot of a point's block, relative to its diagonal: a parallax of 1e-6 rad

UNDETERMINED = "the observations do not determine all cameras; fix some, or give priors"
"""What is said of a system that is singular."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReducedSystem:
    """The symmetric system of the nodes, in blocks."""

    diagonal: FloatArray
    """(N, 6, 6)"""
    pairs: FloatArray
    """(P, 6, 6) block (i, j) of each pair i < j."""
    right: FloatArray
    """(N, 6)"""
    inverses: FloatArray
    """(k, 6) V_p^-1, packed as V."""

    def times(self, pair_nodes: IntArray, x: FloatArray) -> FloatArray:
        """Return the product with x (N, b), of the first b slots of each node."""
        out = np.empty_like(x, order="C")
        _multiply(pair_nodes, self.diagonal, self.pairs, np.ascontiguousarray(x), out)
        return out


def eliminate_points(
    layout: Layout, normal: NormalEquations, damping: float, workers: Workers
) -> ReducedSystem:
    """Return the reduced system, each diagonal entry of the full one raised by the factor 1 + damping."""
    inverses = invert_points(normal, damping)
    diagonal = normal.nodes.copy()
    entries = np.einsum("naa->na", diagonal)
    entries *= 1.0 + damping
    entries[(entries == 0.0) | ~layout.active] = 1.0
    right = -normal.node_gradients
    pairs = np.zeros((len(layout.pairs), SLOTS, SLOTS))
    pairs[layout.link_pair] = normal.links

    def work(begin: int, end: int) -> None:
        _reduce(
            begin, end, layout.first_of_node, layout.entries_by_node, layout.entry_point, layout.entry_node,
            layout.first_entry, layout.first_pair, layout.pairs, normal.entries, inverses,
            normal.point_gradients, diagonal, pairs, right,
        )  # fmt: skip

    workers.share(layout.first_of_node, work, _ENTRIES_WORTH_A_THREAD)
    return ReducedSystem(diagonal=diagonal, pairs=pairs, right=right, inverses=inverses)


def invert_points(normal: NormalEquations, damping: float) -> FloatArray:
    """Return the inverses (k, 6) of the points' blocks, damped; packed as these."""
    inverses = np.empty_like(normal.points)
    _invert(normal.points, damping, inverses)
    return inverses


def step_points(
    layout: Layout,
    normal: NormalEquations,
    inverses: FloatArray,
    node_steps: FloatArray,
    workers: Workers,
) -> FloatArray:
    """Return the steps of the points (k, 3) that belong to steps of the nodes (N, 6)."""
    steps = np.empty_like(normal.point_gradients)

    def work(begin: int, end: int) -> None:
        _back_substitute(
            begin, end, layout.first_entry, layout.entry_node, normal.entries, inverses,
            normal.point_gradients, node_steps, steps,
        )  # fmt: skip

    workers.share(layout.first_entry, work, _ENTRIES_OF_POINTS_WORTH_A_THREAD)
    return steps


@kernel
def _invert(blocks: Any, damping: float, inverses: Any) -> None:
    """Invert 3 x 3 blocks L D L^T with a damped diagonal; the inverse of a pivot that is rounding is 0."""
    more = 1.0 + damping
    for p in range(len(blocks)):
        v = blocks[p]
        d0, d, f = v[0] * more, v[3] * more, v[5] * more
        i0 = 1.0 / d0 if d0 > 0.0 else 0.0
        l10, l20 = v[1] * i0, v[2] * i0
        d1 = d - l10 * v[1]
        i1 = 1.0 / d1 if d1 > _SINGULAR * d else 0.0
        l21 = (v[4] - l20 * v[1]) * i1
        d2 = f - l20 * v[2] - l21 * (v[4] - l20 * v[1])
        i2 = 1.0 / d2 if d2 > _SINGULAR * f else 0.0
        m20 = l10 * l21 - l20  # the inverse of L has -l10, m20 and -l21 below its diagonal
        inverses[p, 0] = i0 + l10 * l10 * i1 + m20 * m20 * i2
        inverses[p, 1] = -l10 * i1 - m20 * l21 * i2
        inverses[p, 2] = m20 * i2
        inverses[p, 3] = i1 + l21 * l21 * i2
        inverses[p, 4] = -l21 * i2
        inverses[p, 5] = i2


@kernel
def _reduce(
    begin: int, end: int, first_of_node: Any, entries_by_node: Any, entry_point: Any, entry_node: Any,
    first_entry: Any, first_pair: Any, pair_nodes: Any, entries: Any, inverses: Any, point_gradients: Any,
    diagonal: Any, pairs: Any, right: Any,
) -> None:  # fmt: skip
    """Subtract what the points explain from the rows begin..end-1."""
    place = np.empty(len(first_of_node) - 1, np.int64)
    spread = np.empty((3, SLOTS * SLOTS))
    for i in range(begin, end):
        for s in range(first_pair[i], first_pair[i + 1]):
            place[pair_nodes[s, 1]] = s
        for q in range(first_of_node[i], first_of_node[i + 1]):
            e = entries_by_node[q]
            p = entry_point[e]
            v00, v01, v02 = inverses[p, 0], inverses[p, 1], inverses[p, 2]
            v11, v12, v22 = inverses[p, 3], inverses[p, 4], inverses[p, 5]
            g0, g1, g2 = point_gradients[p, 0], point_gradients[p, 1], point_gradients[p, 2]
            for a in range(SLOTS):
                w0, w1, w2 = entries[e, 0, a], entries[e, 1, a], entries[e, 2, a]
                x = v00 * w0 + v01 * w1 + v02 * w2
                y = v01 * w0 + v11 * w1 + v12 * w2
                z = v02 * w0 + v12 * w1 + v22 * w2
                for c in range(SLOTS * a, SLOTS * a + SLOTS):
                    spread[0, c], spread[1, c], spread[2, c] = x, y, z
                right[i, a] += x * g0 + y * g1 + z * g2
            subtract_block(spread, entries, e, diagonal, i)
            for other in range(e + 1, first_entry[p + 1]):
                subtract_block(spread, entries, other, pairs, place[entry_node[other]])


@kernel
def _back_substitute(
    begin: int,
    end: int,
    first_entry: Any,
    entry_node: Any,
    entries: Any,
    inverses: Any,
    gradients: Any,
    node_steps: Any,
    steps: Any,
) -> None:
    """Write -V^-1 (b + sum W d) for the points begin..end-1."""
    for p in range(begin, end):
        x, y, z = gradients[p, 0], gradients[p, 1], gradients[p, 2]
        for e in range(first_entry[p], first_entry[p + 1]):
            step = node_steps[entry_node[e]]
            for c in range(SLOTS):
                x += entries[e, 0, c] * step[c]
                y += entries[e, 1, c] * step[c]
                z += entries[e, 2, c] * step[c]
        v = inverses[p]
        steps[p, 0] = -(v[0] * x + v[1] * y + v[2] * z)
        steps[p, 1] = -(v[1] * x + v[3] * y + v[4] * z)
        steps[p, 2] = -(v[2] * x + v[4] * y + v[5] * z)


@kernel
def _multiply(pair_nodes: Any, diagonal: Any, pairs: Any, x: Any, out: Any) -> None:
    """Write the product of a symmetric matrix of blocks with x (N, b); blocks may be larger than b."""
    b = x.shape[1]
    for i in range(len(x)):
        for a in range(b):
            total = 0.0
            for c in range(b):
                total += diagonal[i, a, c] * x[i, c]
            out[i, a] = total
    for k in range(len(pair_nodes)):
        i, j = pair_nodes[k, 0], pair_nodes[k, 1]
        for a in range(b):
            total, own = 0.0, x[i, a]
            for c in range(b):
                total += pairs[k, a, c] * x[j, c]
                out[j, c] += pairs[k, a, c] * own
            out[i, a] += total
