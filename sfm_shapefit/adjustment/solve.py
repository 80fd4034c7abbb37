"""Levenberg-Marquardt on poses, lenses and points together; the entry is `adjust`."""

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.gauge import free_similarities, restore_baselines, restore_gauge
from sfm_shapefit.adjustment.layout import Layout, lay_out
from sfm_shapefit.adjustment.lone_points import settle_points
from sfm_shapefit.adjustment.priors import add_priors, sum_priors
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.adjustment.reduced_factor import choose_solver
from sfm_shapefit.adjustment.residuals import (
    NormalEquations,
    Values,
    linearize,
    reprojection_residuals,
)
from sfm_shapefit.adjustment.schur import eliminate_points, step_points
from sfm_shapefit.base.arrays import BoolArray, FloatArray, hand_back_memory
from sfm_shapefit.base.damping import DampingRange, take_damped_step
from sfm_shapefit.base.display import Displayed
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.losses import CAUCHY, loss, weighed
from sfm_shapefit.base.quaternions import rotations_of
from sfm_shapefit.base.settings import merge_options
from sfm_shapefit.laplacian.operators import Workers

# Rounding drowns what lies beyond 1e-12 and 1e12.
_DAMPING = DampingRange(least=1e-12, most=1e12, growth=2.0, acceleration=2.0)
_LEAST_GAIN = 1e-3  # share of the predicted decrease; a step of less is refused
_ROUNDING = 1e-11  # share of the cost: a smaller predicted decrease drowns in its rounding
_NEAR = 1e-2  # relative fall of the cost by a step; after less the minimum is near, and the loss may bend
# Share of a residual's weight that the loss keeps along it near the minimum; the system stays positive.
_LEAST_CURVATURE = 0.3
# Steps of each point by itself before the first joint step; 20 steps save no joint step on real scenes.
_FIRST_SETTLING = 8
_MANY_ENTRIES = 4_000_000  # entries, 0.6 GB; more are given up while the system is factored, and made anew
_STATIONARY = 1e-6  # gradient norm; at less, steps that rounding refuses mean a minimum
_EXACT_PX = 1e-10  # rms residual in pixels; less is rounding
_LEAST_LEFT = 0.25  # share of the squares that a point leaves of its errors; that of two observations
_BEHIND_PX = 1e6  # error in pixels of a point behind its camera where frames are compared; it outweighs all


class Ending(enum.Enum):
    """Why an adjustment stopped; the value is the sentence shown to the user."""

    COST = "the last step lowered the cost by less than the tolerance"
    GRADIENT = "the gradient is zero to its tolerance"
    STALLED = "no step lowers the cost any more, though the gradient is not zero; start closer"
    MAX_ITERATIONS = "the iteration limit was reached; raise max_iterations or loosen cost_tolerance"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Adjusted(Displayed):
    """An adjustment's answer and how it went."""

    problem: AdjustmentProblem
    """The same problem at the new rotations, centers, points and lenses."""
    costs: FloatArray
    """(s + 1,) cost in px^2 at the start and after each step that lowered it."""
    gradient_norm: float
    """Largest cosine between the residuals and a parameter's column of the Jacobian, in [0, 1], at the
    answer: 0 proves a stationary point."""
    iterations: int
    """Linear systems solved, steps that were refused included."""
    ending: Ending
    """Why it stopped."""

    @property
    def converged(self) -> bool:
        """Whether it stopped at a tolerance, or at rounding."""
        return self.ending in (Ending.COST, Ending.GRADIENT)

    @property
    def cost(self) -> float:
        """The last and least cost, px^2."""
        return float(self.costs[-1])

    def summary(self) -> dict[str, Any]:
        """Return how it went in plain values."""
        return {
            "num_frames": self.problem.num_frames,
            "num_points": self.problem.num_points,
            "num_observations": self.problem.num_observations,
            "initial_cost_px2": float(self.costs[0]),
            "final_cost_px2": self.cost,
            "gradient_norm": self.gradient_norm,
            "iterations": self.iterations,
            "converged": self.converged,
            "ending": self.ending.value,
        }

    def _headline(self) -> str:
        frames, state = self.problem.num_frames, "converged" if self.converged else self.ending.name.lower()
        return f"{frames} frames, cost {self.costs[0]:.6g} to {self.cost:.6g} px^2, {state}"


def adjust(
    problem: AdjustmentProblem, options: AdjustmentOptions | None = None, **overrides: Any
) -> Adjusted:
    """Minimize the reprojection errors over centers, points and what the options free.

    Args:
        problem: the start; it is not changed.
        options: settings, see `help(AdjustmentOptions)`; defaults if None.
        **overrides: single options by name: `adjust(problem, hold_rotations=True)`.

    Returns:
        The adjusted problem. Its gauge, as far as nothing in the problem holds it, is that of the start: the
        similarity that best maps its centers to the start's is the identity.

    Raises:
        InputError: if there is no observation.
    """
    options = merge_options(options, AdjustmentOptions, overrides)
    if problem.num_observations == 0:
        raise InputError("there is no observation, so there is nothing to adjust")
    run = _Run(problem, options)
    try:
        ending = run.iterate()
        run.linearize()
    finally:
        run.workers.close()
    values = restore_gauge(problem, run.values, free_similarities(problem, options))
    if run.layout.scale_sensor >= 0:
        values = restore_baselines(problem, values)
    lenses = [lens.with_values(row) for lens, row in zip(problem.lenses, values.lenses, strict=True)]
    rig = replace(problem.rig, rotations=values.sensor_rotations, translations=values.sensor_translations)
    return Adjusted(
        problem=replace(
            problem,
            rotations=values.rotations,
            centers=values.centers,
            points=values.points,
            lenses=lenses,
            rig=rig,
        ),
        costs=np.array(run.costs),
        gradient_norm=run.gradient_norm,
        iterations=run.iterations,
        ending=ending,
    )


def reprojection_errors_px(problem: AdjustmentProblem) -> FloatArray:
    """Return how far each observation misses its pixel, (m,); NaN if its point is behind the camera."""
    return np.asarray(np.linalg.norm(reprojection_residuals(problem, values_of(problem)), axis=1))


def frames_not_gained(before: AdjustmentProblem, after: AdjustmentProblem, loss_scale_px: float) -> BoolArray:
    """Return which frames (n,) would have less cost at their pose of before, all else as it is after.

    A joint minimum is one for each frame by itself, but only a local one: a frame that few points hold may
    have been led over a ridge by the others. Both are the same problem in the same gauge.
    """
    returned = replace(after, rotations=before.rotations, centers=before.centers)
    return costs_of_frames(returned, loss_scale_px) < costs_of_frames(after, loss_scale_px)


def costs_of_frames(problem: AdjustmentProblem, loss_scale_px: float) -> FloatArray:
    """Return the cost of each frame's observations (n,), px^2."""
    errors_px = np.nan_to_num(reprojection_errors_px(problem), nan=_BEHIND_PX)
    losses = 0.5 * loss_scale_px**2 * loss(CAUCHY, (errors_px / loss_scale_px) ** 2)
    return np.bincount(problem.frames_seeing(), losses, problem.num_frames).astype(np.float64)


def choose_loss_scale_px(problem: AdjustmentProblem, scales_px: Sequence[float]) -> float:
    """Return the scale of the Cauchy loss with which a problem near its minimum would be adjusted finest.

    With errors r the covariance of what is estimated is in proportion to

        E |psi(r)|^2 / (E div psi(r))^2,        psi(r) = r / (1 + |r|^2 / c^2),

    the asymptotic variance of an M-estimator. Where most observations are far better than the worst, as
    those of features in photographs, small c are better; under normal errors 2.4 standard deviations are.

    A point follows its own l observations: of their 2 l residuals 2 l - 3 are left. So |r|^2 is that share of
    the error's square, and the observation tells that share about the cameras. Points of two observations
    count where there are no others: with one residual left, they say little of what it is in the plane.

    Args:
        problem: at or near its minimum.
        scales_px: to choose from.

    Source: Huber, "Robust Estimation of a Location Parameter", 1964; for adaptive scales and the correction
    for what is fitted, Huber, "Robust Statistics", 1981, sections 4 and 7.6.
    """
    lengths = np.bincount(problem.points_seen, minlength=problem.num_points)[problem.points_seen]
    left = np.maximum(1.0 - 1.5 / lengths, _LEAST_LEFT)
    squares = reprojection_errors_px(problem) ** 2 / left
    counts = np.isfinite(squares) & (lengths >= min(3, int(lengths.max(initial=0))))
    squares, left = squares[counts], left[counts]

    def variance(scale_px: float) -> float:
        weights = weighed(CAUCHY, 1.0, squares / scale_px**2)
        slope = float(np.sum(left * weights**2))  # (div psi) / 2 = w - w^2 |r|^2 / c^2 = w^2
        return float(np.sum(left * weights**2 * squares)) / max(slope, 1e-300) ** 2

    return min(scales_px, key=variance)


def values_of(problem: AdjustmentProblem) -> Values:
    """Return the numbers of a problem that an adjustment changes."""
    return Values(
        rotations=problem.rotations,
        centers=problem.centers,
        points=problem.points,
        lenses=np.array([lens.values() for lens in problem.lenses]).reshape(-1, 8),
        sensor_rotations=np.ascontiguousarray(problem.rig.rotations, dtype=np.float64),
        sensor_translations=np.ascontiguousarray(problem.rig.translations, dtype=np.float64),
    )


def linearize_all(
    problem: AdjustmentProblem,
    layout: Layout,
    values: Values,
    options: AdjustmentOptions,
    workers: Workers,
    least_curvature: float = 1.0,
) -> NormalEquations:
    """Return the normal equations of observations and priors; see `linearize`."""
    normal = linearize(layout, values, options.loss_scale_px, workers, least_curvature)
    add_priors(problem, layout, values, options.noise_px, normal)
    return normal


class _Told(NamedTuple):
    """What a step that was tried says: a reason to stop, or None to go on from other equations."""

    ending: Ending | None


class _Run:
    def __init__(self, problem: AdjustmentProblem, options: AdjustmentOptions) -> None:
        self.problem, self.options = problem, options
        self.workers = Workers(options.threads)
        self.layout = lay_out(problem, options)
        hand_back_memory()  # what the layout was made of goes before the largest arrays come
        self.factor = choose_solver(problem, self.layout, options, self.workers)
        self.values, cost = self.settle(values_of(problem), _FIRST_SETTLING * options.settles_points)
        self.damping = options.first_damping
        self.costs = [cost]
        self.gradient_norm, self.iterations = math.inf, 0
        self.bends, self.near = False, _NEAR

    def settle(self, values: Values, steps: int) -> tuple[Values, float]:
        """Return values whose points have taken some steps by themselves, and the cost of all at these."""
        points, cost = settle_points(self.layout, values, self.options.loss_scale_px, self.workers, steps)
        priors = sum_priors(self.problem, values, self.options.noise_px)
        return replace(values, points=points), cost + priors

    def iterate(self) -> Ending:
        """Take steps until a reason to stop."""
        while True:
            normal = self.linearize()
            exact = 0.5 * self.problem.num_observations * _EXACT_PX**2
            if self.gradient_norm <= self.options.gradient_tolerance or self.costs[-1] <= exact:
                return Ending.GRADIENT
            ending = self.lower(normal)
            if ending is not None:
                return ending
            # The next equations would else be held beside these.
            del normal

    def linearize(self) -> NormalEquations:
        """Return the normal equations at the best values, and note their gradient."""
        least = _LEAST_CURVATURE if self.bends else 1.0
        normal = linearize_all(self.problem, self.layout, self.values, self.options, self.workers, least)
        self.gradient_norm = _gradient_norm(normal, self.costs[-1])
        return normal

    def lower(self, normal: NormalEquations) -> Ending | None:
        """Raise the damping until a step lowers the cost; return a reason to stop, or None to go on."""
        told, _ = take_damped_step(partial(self.attempt, normal), self.damping, _DAMPING)
        return Ending.STALLED if told is None else told.ending

    def attempt(self, normal: NormalEquations, damping: float) -> "_Told | None":
        """Try one step, take it if it lowers the cost; None asks for one of more damping."""
        if self.iterations >= self.options.max_iterations:
            return _Told(Ending.MAX_ITERATIONS)
        self.iterations += 1
        before = self.costs[-1]
        proposal = self.propose(normal, damping)
        values, predicted = (self.values, math.inf) if proposal is None else proposal
        values, after = (
            (values, before) if proposal is None else self.settle(values, int(self.options.settles_points))
        )
        if after < before and before - after >= _LEAST_GAIN * predicted:
            gain = (before - after) / predicted if predicted > 0.0 else 1.0
            slower = max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
            self.values, self.damping = values, max(damping * slower, _DAMPING.least)
            self.costs.append(after)
            is_near = before - after <= self.near * before
            self.bends = is_near and self.options.loss_scale_px is not None
            small = before - after <= self.options.cost_tolerance * before
            return _Told(Ending.COST if small else None)
        if predicted <= _ROUNDING * before:
            return _Told(Ending.COST if self.gradient_norm <= _STATIONARY else Ending.STALLED)
        if not self.bends:
            return None
        self.bends, self.near = False, 0.1 * self.near
        return _Told(None)

    def propose(self, normal: NormalEquations, damping: float) -> tuple[Values, float] | None:
        """Return the values after a damped step and the decrease predicted; None if it has no solution."""
        layout, is_large = self.layout, len(normal.entries) > _MANY_ENTRIES
        system = eliminate_points(layout, normal, damping, self.workers)
        if is_large:
            normal.entries = normal.entries[:0].copy()
        try:
            self.factor.refactor(system)
            steps = self.factor.solve(system.right[:, :, None])[:, :, 0]
        except UnsolvableError:
            steps = None
        inverses = system.inverses
        del system
        if is_large:
            self.factor.give_back()
            normal.entries = self.linearize().entries
        if steps is None:
            return None
        point_steps = step_points(layout, normal, inverses, steps, self.workers)
        diagonal = np.einsum("naa->na", normal.nodes)
        damped = float(np.sum(diagonal * steps**2) + np.sum(normal.points[:, [0, 3, 5]] * point_steps**2))
        slope = float(np.sum(normal.node_gradients * steps) + np.sum(normal.point_gradients * point_steps))
        predicted = 0.5 * (damping * damped - slope)
        values = move(layout, self.values, steps, point_steps)
        return None if values is None or not math.isfinite(predicted) else (values, predicted)


def move(layout: Layout, values: Values, steps: FloatArray, point_steps: FloatArray) -> Values | None:
    """Return the values after steps of nodes (N, 6) and points (k, 3); None if a focal length is lost."""
    frames = np.flatnonzero(layout.node_of_frame >= 0)
    own = steps[layout.node_of_frame[frames]]
    centers, rotations, lenses = values.centers.copy(), values.rotations, values.lenses.copy()
    centers[frames] += own[:, :3]
    if layout.turns:
        rotations = rotations.copy()
        rotations[frames] = rotations_of(own[:, 3:]) @ rotations[frames]
    lens, value = np.nonzero(layout.lens_slots >= 0)
    lenses[lens, value] += steps[layout.node_of_lens[lens], layout.lens_slots[lens, value]]
    if (lenses[:, :2] <= 0.0).any():
        return None
    sensor_rotations, sensor_translations = _move_sensors(layout, values, steps)
    return Values(
        rotations=rotations,
        centers=centers,
        points=values.points + point_steps,
        lenses=lenses,
        sensor_rotations=sensor_rotations,
        sensor_translations=sensor_translations,
    )


def _move_sensors(layout: Layout, values: Values, steps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the poses of all cameras in their rigs after steps of nodes (N, 6)."""
    rotations, translations = values.sensor_rotations, values.sensor_translations
    cameras = np.flatnonzero(layout.sensor_of_camera >= 0)
    if not len(cameras):
        return rotations, translations
    sensors = layout.sensor_of_camera[cameras]
    own = steps[layout.node_of_sensor[sensors]]
    before = -np.einsum("cba,cb->ca", rotations[cameras], translations[cameras])
    after = before + np.einsum("cab,cb->ca", layout.sensor_bases[sensors], own[:, :3])
    kept = sensors == layout.scale_sensor
    after[kept] *= np.linalg.norm(before[kept], axis=1, keepdims=True) / np.linalg.norm(
        after[kept], axis=1, keepdims=True
    )
    rotations, translations = rotations.copy(), translations.copy()
    # R exp(w) = (exp(-w) R^T)^T
    rotations[cameras] = (rotations_of(-own[:, 3:]) @ rotations[cameras].transpose(0, 2, 1)).transpose(
        0, 2, 1
    )
    translations[cameras] = -np.einsum("cab,cb->ca", rotations[cameras], after)
    return rotations, translations


def _gradient_norm(normal: NormalEquations, cost: float) -> float:
    """Return max_k |g_k| / sqrt(H_kk 2 cost) over all parameters (More 1978, the MINPACK test)."""
    if cost == 0.0:
        return 0.0
    largest = 0.0
    for diagonal, gradient in (
        (np.einsum("naa->na", normal.nodes), normal.node_gradients),
        (normal.points[:, [0, 3, 5]], normal.point_gradients),
    ):
        squares = np.divide(gradient**2, diagonal, out=np.zeros_like(gradient), where=diagonal > 0.0)
        largest = max(largest, float(squares.max(initial=0.0)))
    return math.sqrt(largest / (2.0 * cost))
