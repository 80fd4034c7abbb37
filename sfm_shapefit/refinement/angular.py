"""Robust refinement of locations in the angles of their directions: what becomes of both convex starts.

With d_e = t_i - t_j and u_e = d_e / |d_e|, the residual u_e - v_e does not depend on lengths, so that nothing
can be gained by shrinking, as it can in the convex programs. It is judged in the direction's own metric,

    chi2_e = (u_e - v_e)^T M_e (u_e - v_e),    M_e = B_e (Sigma_e + s^2 I)^-1 B_e^T + m_e v_e v_e^T,

Sigma_e the covariance of the direction, s the level of all residuals of its class together, m_e the mean
eigenvalue of the first term. It counts by the arctangent kernel, with k = 3,

    minimize  sum_e w_e / 2 * k^2 atan(chi2_e / k^2),

which forgets outliers as that of Geman and McClure does. On right directions alone its error is 1.04 times
that of least squares, theirs 1.18 times. While the level falls theirs is used all the same: it lets go of a
wrong direction early, where the arctangent may settle for a larger level.

The level starts at 2 degrees and falls to what the residuals inside the kernel say (graduated non-convexity).
A step is one of Levenberg and Marquardt: d u_e = (I - u u^T) d(d_e) / |d_e| makes the normal matrix a block
Laplacian, and so does the damping, which resists relative changes of length: lambda w_e tr(M_e) / |d_e|^2.
It never ends, and keeps a camera whose pairs are all rejected from flying off.

Sources: the residual: Zhuang, Cheong and Lee, "Baseline desensitizing in translation averaging", CVPR 2018,
with angles in place of its chords; the kernel and its graduation: Yang, Antonante, Tzoumas and Carlone,
"Graduated non-convexity for robust spatial perception", RA-L 2020.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, frozen, quantile
from sfm_shapefit.base.damping import DampingRange, take_damped_step
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.executors import in_slices
from sfm_shapefit.base.geometry import median_spread
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.base.losses import ARCTANGENT, GEMAN_MCCLURE, loss, weighed
from sfm_shapefit.base.scipy_parts import chdtri
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.factor import (
    DEFAULT_FACTOR_BYTES,
    FactorPlan,
    LaplacianFactor,
    allocate_factor,
    analyze,
)
from sfm_shapefit.refinement.cg_normal_solver import IterativeNormal
from sfm_shapefit.solver.program import SLICE, adjoint, measure_baselines
from sfm_shapefit.solver.splitting.linear import Resources, laplacian_factor, predict_factor

KERNEL_WIDTH = 3.0
"""k, in standard deviations; a residual of k counts half of what it can."""

DAMPING = DampingRange()
"""Damping of the steps, relative to the damping matrix of `AngularTerms`."""

ALIKE = 1e-6
"""Relative difference of costs; closer ones are those of the same place."""

_FIRST_LEVEL_RAD = 0.1 / KERNEL_WIDTH
# On exact data a smaller level would reject pairs for their rounding.
_LEAST_LEVEL_RAD = 1e-4 / KERNEL_WIDTH
_LEAST_SHARE = 0.2  # share of a class inside the kernel; with less most is not fitted yet, its level stays
# The floor under |d|, relative to the median length: a shorter baseline has no direction.
_SHORTEST = 1e-3
_SETTLED = 0.03  # relative change of a level; a smaller one counts as none
_CONVERGED = 1e-9  # relative decrease of the cost; a smaller one counts as none
_STILL = 1e-6  # share of the extent; a smaller move of all but a tenth of the nodes counts as none
# Likewise by level, where a step is dear: noise of a level moves the nodes of boxes of 1e4 by .03 of it.
_STILL_PER_LEVEL = 1e-3
_HOPELESS = 20.0  # last decreases; a cost above the best one by more does not catch up
_FARTHEST = 1e6  # median spreads; of nodes farther out the others are one point, whose shape is rounded away
_MAX_STEPS = 60  # steps, a bound; 15 to 40 are needed
_MAX_FLOPS = 1e10  # operations of one factorization in blocks; they take a third of a second per step


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AngularResult:
    """Locations refined in angles."""

    locations: FloatArray
    """(n, d) centered, of unit norm."""
    levels_rad: FloatArray
    """(number of classes,) the s at which it ended."""
    cost: float
    """At these levels; see `robust_cost`."""
    iterations: int
    """Factorizations."""


def plan_refinement(
    graph: ViewGraph, max_bytes: int = DEFAULT_FACTOR_BYTES, threads: int = 1
) -> FactorPlan | IterativeNormal | None:
    """Return what the refinement solves its steps with; None if its factor would take too much memory.

    Where a factor in blocks is much work the graph is well connected, and conjugate gradients need few steps.
    """
    prediction = predict_factor(graph)
    if prediction.tree is None or prediction.flops * graph.dimension**3 > _MAX_FLOPS:
        return IterativeNormal(graph, laplacian_factor(graph, Resources(threads, max_bytes), prediction))
    plan = analyze(graph.num_nodes, graph.edges, prediction.tree)
    return plan if plan.num_bytes(graph.dimension, np.float64) <= max_bytes else None


def refine_angles(
    measured: MeasuredGraph,
    start: FloatArray,
    plan: FactorPlan | LaplacianFactor,
    other: FloatArray | None = None,
    threads: int = 1,
) -> AngularResult:
    """Refine locations by robust Levenberg-Marquardt in the angles of the directions.

    The cost at the final levels is not above that of the start, which is returned if nothing better was
    found.

    Args:
        measured: a connected view graph; each of its classes of directions has a level of its own.
        start: (n, d) locations; their scale does not matter.
        plan: from `plan_refinement`; or memory for a factor, such as that over groups, in which case
            locations are and stay those of the groups.
        other: (n, d) refined locations of the other start; once the levels have settled, the refinement ends
            where it has come as low as these, and where it clearly cannot.
        threads: of the factor, if `plan` is one's plan.
    """
    graph, classes = measured.graph, measured.classes
    factor, first = allocate_normal(plan, graph.dimension, threads), unit_norm(start)
    other = None if other is None else unit_norm(other)
    t, damping, steps = first, DAMPING.first, 0
    still = _STILL_PER_LEVEL if isinstance(plan, IterativeNormal) else 0.0
    moves_singly = isinstance(plan, FactorPlan | IterativeNormal)
    levels = np.full(int(classes.max()) + 1, _FIRST_LEVEL_RAD)
    information = _information(measured, levels[classes], threads)
    while steps < _MAX_STEPS:
        lower = np.clip(residual_levels(measured, t, levels), levels / 2.0, levels)
        settled = bool((lower >= (1.0 - _SETTLED) * levels).all())
        if not settled:
            levels, information = lower, _information(measured, lower[classes], threads)
        terms = AngularTerms(graph, information, ARCTANGENT if settled else GEMAN_MCCLURE, threads)
        moved, damping, before, after = take_angular_step(terms, factor, t, damping)
        is_still = (
            _motion(t, moved) <= max(_STILL, still * levels.min()) or before - after <= _CONVERGED * before
        )
        t, steps = _within_reach(moved) if moves_singly else moved, steps + 1
        if settled and is_still:
            break
        if settled and other is not None and _is_decided(before, after, terms.cost(other)):
            break
    terms = AngularTerms(graph, information, threads=threads)
    cost, first_cost = terms.cost(t), terms.cost(first)
    if first_cost < cost:
        t, cost = first, first_cost
    return AngularResult(locations=t, levels_rad=levels, cost=cost, iterations=steps)


def _is_decided(before: float, after: float, other_cost: float) -> bool:
    """Whether a cost has reached another, or stays above it even if it falls many times as much again."""
    return abs(after - other_cost) <= ALIKE * other_cost or after - other_cost > _HOPELESS * (before - after)


def robust_cost(measured: MeasuredGraph, locations: FloatArray, levels: FloatArray) -> float:
    """Return the sum of the kernel over the pairs, each at most k^2 pi / 4 by weight; levels in radians."""
    return AngularTerms(measured.graph, information_at(measured, levels)).cost(unit_norm(locations))


class AngularTerms:
    """The robust cost of the directions, each with its own M_e, and its normal equations."""

    def __init__(
        self, graph: ViewGraph, information: FloatArray, kind: int = ARCTANGENT, threads: int = 1
    ) -> None:
        """Take M_e, (m, d, d), and the kind of the loss, see `base.losses`; threads share the pairs."""
        self._graph, self._information, self._kind, self._threads = graph, information, kind, threads

    def cost(self, t: FloatArray) -> float:
        """Return the sum of the kernel over the pairs at locations (n, d) of any scale."""
        return self._evaluate(t, 0)[0]

    def linearize(self, t: FloatArray) -> tuple[float, FloatArray, FloatArray, FloatArray]:
        """Return the cost, normal blocks (m, d, d), their damping (m,), and the gradient (m, d)."""
        return self._evaluate(t, self._graph.num_edges)

    def normal_equations(self, t: FloatArray) -> tuple[float, FloatArray, FloatArray, FloatArray]:
        """Return the cost, the blocks, the damping, and the right-hand side (n, d) of a step from t."""
        cost, blocks, damped, gradient = self.linearize(t)
        return cost, blocks, damped, -adjoint(gradient, self._graph.edges, self._graph.num_nodes)

    def move(self, t: FloatArray, step: FloatArray) -> FloatArray:
        """Return the locations (n, d) after a step from t."""
        return unit_norm(t + step)

    def _evaluate(self, t: FloatArray, rows: int) -> tuple[float, FloatArray, FloatArray, FloatArray]:
        """Return what `linearize` does, with so many rows: all, or none where the cost is enough."""
        graph, d, m = self._graph, self._graph.dimension, self._graph.num_edges
        baselines, lengths = measure_baselines(t, graph.edges, self._threads)
        given = baselines, lengths, graph.directions, graph.weights, self._information
        how = _SHORTEST * float(np.median(lengths)), self._kind
        sums, out = np.zeros(m // SLICE + 1), (np.empty((rows, d, d)), np.empty(rows), np.empty((rows, d)))
        in_slices(self._threads, m, SLICE, _linearize_pairs, given, how, sums, out)
        return float(sums.sum()), *out


def allocate_normal(plan: FactorPlan | LaplacianFactor, dimension: int, threads: int = 1) -> LaplacianFactor:
    """Return memory for a factor of what `plan_refinement` says."""
    return allocate_factor(plan, dimension, threads=threads) if isinstance(plan, FactorPlan) else plan


def take_angular_step(
    terms: AngularTerms, factor: LaplacianFactor, t: FloatArray, damping: float
) -> tuple[FloatArray, float, float, float]:
    """Take one step that lowers the cost; return locations, damping, and the cost before and after."""
    before, blocks, damped, right = terms.normal_equations(t)

    def propose(damping: float) -> tuple[FloatArray, float] | None:
        try:
            factor.refactor(blocks + (damping * damped)[:, None, None] * np.eye(t.shape[1]))
        except UnsolvableError:  # too little of the matrix is left under these weights
            return None
        proposed = terms.move(t, factor.solve(right))
        after = terms.cost(proposed)
        return (proposed, after) if after < before else None

    proposal, damping = take_damped_step(propose, damping, DAMPING)
    moved, after = (t, before) if proposal is None else proposal
    return moved, damping, before, after


def fitting_pairs(measured: MeasuredGraph, locations: FloatArray, levels: FloatArray) -> BoolArray:
    """Return which pairs fit locations (n, d), (m,): those of chi2 below k^2 at the level of each class."""
    information = information_at(measured, levels)
    residuals = _residuals(measured.graph, unit_norm(locations))
    chi2 = np.einsum("ea,eab,eb->e", residuals, information, residuals)
    return np.asarray(chi2 < KERNEL_WIDTH**2)


def residual_levels(
    measured: MeasuredGraph, locations: FloatArray, levels: FloatArray, rounds: int = 1
) -> FloatArray:
    """Return each class's level: median residual, own covariances included, inside the present kernel.

    In further rounds the kernel is that of the level before, until it stays.
    """
    graph, classes = measured.graph, measured.classes
    freedom = graph.dimension - 1
    equations = freedom * graph.num_edges
    unknowns = graph.dimension * (graph.num_nodes - 1) - 1
    fitted = max(1.0 - unknowns / equations, 0.3)  # least squares leaves this share of the variance
    median_length = np.sqrt(chdtri(freedom, 0.5) * fitted)  # with unit variance per axis
    chords = np.linalg.norm(_residuals(graph, unit_norm(locations)), axis=1)
    of_classes = [chords[classes == c] for c in range(len(levels))]
    for _ in range(rounds):
        before, levels = levels, levels.copy()
        for c, class_chords in enumerate(of_classes):
            inside = class_chords[class_chords < KERNEL_WIDTH * levels[c]]
            if len(inside) >= _LEAST_SHARE * len(class_chords) and len(class_chords):
                levels[c] = np.median(inside) / median_length
        levels = np.maximum(levels, _LEAST_LEVEL_RAD)
        if np.array_equal(levels, before):
            break
    return levels


def information_at(measured: MeasuredGraph, levels: FloatArray) -> FloatArray:
    """Return M_e, (m, d, d), at the level of each class, (number of classes,) in radians."""
    return _information(measured, levels[measured.classes])


def _information(measured: MeasuredGraph, level: FloatArray, threads: int = 1) -> FloatArray:
    """Return M_e, (m, d, d), for the level s of each pair, (m,)."""
    (m, d), covariance = measured.graph.directions.shape, measured.covariance
    if covariance is None:
        return np.asarray(np.eye(d) / level[:, None, None] ** 2)
    out = np.empty((m, d, d))
    in_slices(threads, m, SLICE, _inform, frozen(covariance), measured.graph.directions, level, out)
    return out


def unit_norm(t: FloatArray) -> FloatArray:
    """Return locations (n, d) centered and of unit norm."""
    centered = t - t.mean(axis=0)
    return np.asarray(centered / np.sqrt(np.sum(centered * centered)))


def _within_reach(t: FloatArray) -> FloatArray:
    """Return the locations (n, d) with nodes that nothing holds pulled in to where all look the same."""
    about = t - np.median(t, axis=0)
    distances = np.linalg.norm(about, axis=1, keepdims=True)
    farthest = _FARTHEST * float(np.median(distances))
    if farthest == 0.0 or distances.max() <= farthest:
        return t
    return unit_norm(about * np.minimum(1.0, farthest / np.maximum(distances, farthest)))


def _motion(t: FloatArray, moved: FloatArray) -> float:
    """Return the most that nine tenths of the nodes moved, over the extent; loose ones wander for long."""
    return float(quantile(np.linalg.norm(moved - t, axis=1), 0.9)) / median_spread(moved)


def _residuals(graph: ViewGraph, t: FloatArray) -> FloatArray:
    """Return u_e - v_e, (m, d)."""
    baselines, lengths = measure_baselines(t, graph.edges)
    units = baselines / np.maximum(lengths, _SHORTEST * np.median(lengths))[:, None]
    return np.asarray(units - graph.directions)


@kernel
def _inform(begin: int, end: int, covariance: Any, v: Any, level: Any, out: Any) -> None:
    """Write B (Sigma + level^2 I)^-1 B^T + m v v^T of the pairs begin..end-1, B as of `tangent_bases`.

    B are the last columns of I - f h h^T with h = v -+ the first axis. A covariance that is not finite is
    unknown, and counts as 0: the level alone speaks for the pair.
    """
    d = v.shape[1]
    inverse, h, turned = np.zeros((d, d)), np.empty(d), np.empty(d)
    for e in range(begin, end):
        _invert_sum(covariance[e], level[e] ** 2, inverse)
        f, mean, square = 1.0 / (1.0 + abs(v[e, 0])), 0.0, 0.0
        for a in range(d):
            h[a] = v[e, a]
            mean += inverse[a, a] / (d - 1)
        h[0] += -1.0 if v[e, 0] < 0.0 else 1.0
        for a in range(d):
            turned[a] = 0.0
            for b in range(d):
                turned[a] += f * inverse[a, b] * h[b]
            square += f * h[a] * turned[a]
        for a in range(d):
            for b in range(d):
                mirrored = h[a] * (square * h[b] - turned[b]) - turned[a] * h[b]
                out[e, a, b] = inverse[a, b] + mirrored + mean * v[e, a] * v[e, b]


@inner_kernel
def _invert_sum(covariance: Any, level2: float, a: Any) -> None:
    """Write (Sigma + level^2 I)^-1 to all but the first row and column (Gauss and Jordan's elimination)."""
    d, is_known = len(a), True
    for p in range(1, d):
        for k in range(1, d):
            is_known = is_known and np.isfinite(covariance[p - 1, k - 1])
    for p in range(1, d):
        for k in range(1, d):
            a[p, k] = covariance[p - 1, k - 1] if is_known else 0.0
        a[p, p] += level2
    for p in range(1, d):
        pivot, a[p, p] = a[p, p], 1.0
        for k in range(1, d):
            a[p, k] /= pivot
        for i in range(1, d):
            if i != p:
                factor, a[i, p] = a[i, p], 0.0
                for k in range(1, d):
                    a[i, k] -= factor * a[p, k]


@kernel
def _linearize_pairs(begin: int, end: int, given: Any, how: Any, sums: Any, out: Any) -> None:
    """Write the sum of w / 2 * k^2 rho(chi2 / k^2) over a slice; where there is room, what each pair adds.

    That is J^T M J, the damping's weight, and J^T M r, times the kernel's weight, of the pairs begin..end-1.
    J = (I - u u^T) / |d|, and I / floor where |d| is below the floor, for u = d / floor there.
    """
    (baselines, lengths, v, w, information), (floor, kind), (blocks, damped, gradient) = given, how, out
    d, total = v.shape[1], 0.0
    u, pull = np.empty(d), np.empty(d)
    across, half = np.empty((d, d)), np.empty((d, d))
    for e in range(begin, end):
        length, chi2, trace = max(lengths[e], floor), 0.0, 0.0
        for a in range(d):
            u[a] = baselines[e, a] / length
        for a in range(d):
            pull[a] = 0.0
            for b in range(d):
                pull[a] += information[e, a, b] * (u[b] - v[e, b])
            chi2 += (u[a] - v[e, a]) * pull[a]
            trace += information[e, a, a]
        x = chi2 / KERNEL_WIDTH**2
        total += 0.5 * w[e] * KERNEL_WIDTH**2 * loss(kind, x)
        if len(damped) == 0:
            continue
        radial = 1.0 if lengths[e] > floor else 0.0
        weight = weighed(kind, w[e], x)
        damped[e] = w[e] * trace / (d * length * length)
        for a in range(d):
            for b in range(d):
                across[a, b] = ((1.0 if a == b else 0.0) - radial * u[a] * u[b]) / length
        for a in range(d):
            gradient[e, a] = 0.0
            for b in range(d):
                gradient[e, a] += weight * across[a, b] * pull[b]
        _congruence(weight, across, information[e], half, blocks[e])
    sums[begin // SLICE] = total


@inner_kernel
def _congruence(weight: float, a: Any, middle: Any, half: Any, out: Any) -> None:
    """Write weight * a^T middle a of symmetric a into `out`."""
    d = len(a)
    for i in range(d):
        for j in range(d):
            half[i, j] = 0.0
            for k in range(d):
                half[i, j] += middle[i, k] * a[k, j]
    for i in range(d):
        for j in range(d):
            out[i, j] = 0.0
            for k in range(d):
                out[i, j] += weight * a[i, k] * half[k, j]
