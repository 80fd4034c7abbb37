"""Levenberg-Marquardt on poses, lenses and points together; the entry is `adjust`."""

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.divided import Parts, Pass, largest_share
from sfm_shapefit.adjustment.gauge import free_similarities, restore_baselines, restore_gauge
from sfm_shapefit.adjustment.layout import SLOTS, Layout, lay_out
from sfm_shapefit.adjustment.lone_points import settle_points
from sfm_shapefit.adjustment.priors import add_priors, sum_priors
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.adjustment.reduced_factor import ReducedFactor, choose_solver
from sfm_shapefit.adjustment.residuals import (
    NormalEquations,
    Values,
    linearize,
    reprojection_residuals,
)
from sfm_shapefit.adjustment.schur import ReducedSystem, eliminate_points, step_points
from sfm_shapefit.base.arrays import BoolArray, FloatArray, hand_back_memory
from sfm_shapefit.base.damping import DampingRange, take_damped_step
from sfm_shapefit.base.display import Displayed
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.executors import Crew
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
MANY_ENTRIES = 4_000_000  # entries, 0.6 GB; more are given up while the system is factored, and made anew
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
    problem: AdjustmentProblem,
    options: AdjustmentOptions | None = None,
    *,
    crew: Crew | None = None,
    **overrides: Any,
) -> Adjusted:
    """Minimize the reprojection errors over centers, points and what the options free.

    Args:
        problem: the start; it is not changed.
        options: settings, see `help(AdjustmentOptions)`; defaults if None.
        crew: divides the observations among parts, see `divided`, for less memory here or elsewhere; the
            answer is another one by rounding. None: they stay together.
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
    run = _Run(problem, options) if crew is None else _DividedRun(problem, options, crew)
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
        return float(np.sum(left * weights**2 * squares)) / max(slope**2, 1e-300)

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
    """Steps by observations that are all in this process."""

    normal: NormalEquations

    def __init__(self, problem: AdjustmentProblem, options: AdjustmentOptions) -> None:
        self.problem, self.options = problem, options
        self.workers = Workers(options.threads)
        self.layout = self.lay_out()
        hand_back_memory()  # what the layout was made of goes before the largest arrays come
        self.factor = self.choose_solver()
        self.damping, self.bends, self.near = options.first_damping, False, _NEAR
        self.values, cost = self.settle(values_of(problem), _FIRST_SETTLING * options.settles_points)
        self.costs = [cost]
        self.gradient_norm, self.iterations = math.inf, 0

    def lay_out(self) -> Layout:
        return lay_out(self.problem, self.options)

    def choose_solver(self) -> ReducedFactor:
        return choose_solver(self.problem, self.layout, self.options, self.workers)

    @property
    def least_curvature(self) -> float:
        """How far the loss may bend, see `linearize`."""
        return _LEAST_CURVATURE if self.bends else 1.0

    def settle(self, values: Values, steps: int) -> tuple[Values, float]:
        """Return values whose points have taken some steps by themselves, and the cost of all at these."""
        points, cost = settle_points(self.layout, values, self.options.loss_scale_px, self.workers, steps)
        return replace(values, points=points), cost + self.cost_of_priors(values)

    def cost_of_priors(self, values: Values) -> float:
        """Return the cost of all that was known before, px^2."""
        return sum_priors(self.problem, values, self.options.noise_px)

    def iterate(self) -> Ending:
        while True:
            self.linearize()
            exact = 0.5 * self.problem.num_observations * _EXACT_PX**2
            if self.gradient_norm <= self.options.gradient_tolerance or self.costs[-1] <= exact:
                return Ending.GRADIENT
            told, _ = take_damped_step(self.attempt, self.damping, _DAMPING)
            self.forget()
            if told is None:
                return Ending.STALLED
            if told.ending is not None:
                return told.ending

    def linearize(self) -> None:
        """Make the normal equations at the best values, and note their gradient."""
        self.normal = self.equations()
        nodes, points = np.einsum("naa->na", self.normal.nodes), self.normal.points[:, [0, 3, 5]]
        self.note_gradient(
            largest_share(nodes, self.normal.node_gradients),
            largest_share(points, self.normal.point_gradients),
        )

    def note_gradient(self, *largest: float) -> None:
        """Note max_k |g_k| / sqrt(H_kk 2 cost) over all parameters (More 1978, the MINPACK test)."""
        cost = self.costs[-1]
        self.gradient_norm = math.sqrt(max(largest) / (2.0 * cost)) if cost else 0.0

    def forget(self) -> None:
        """Give up the equations: the next ones would else be held beside them."""
        del self.normal

    def equations(self) -> NormalEquations:
        given = self.problem, self.layout, self.values, self.options, self.workers
        return linearize_all(*given, self.least_curvature)

    def attempt(self, damping: float) -> "_Told | None":
        """Try one step, take it if it lowers the cost; None asks for one of more damping."""
        if self.iterations >= self.options.max_iterations:
            return _Told(Ending.MAX_ITERATIONS)
        self.iterations += 1
        before = self.costs[-1]
        values, predicted, after = self.propose(damping) or (self.values, math.inf, before)
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

    def propose(self, damping: float) -> tuple[Values, float, float] | None:
        """Return the values after a damped step, the decrease predicted, and the cost; None without one."""
        stepped = self.step(damping)
        if stepped is None:
            return None
        values, cost, (damped, slope) = stepped
        predicted = float(0.5 * (damping * damped - slope))
        return (values, predicted, cost) if math.isfinite(predicted) else None

    def step(self, damping: float) -> tuple[Values, float, tuple[float, float]] | None:
        """Return values, their cost, and the step's square by curvatures and slope; None without a step."""
        layout, normal = self.layout, self.normal
        is_large = len(normal.entries) > MANY_ENTRIES
        system = eliminate_points(layout, normal, damping, self.workers)
        if is_large:
            normal.entries = normal.entries[:0].copy()
        steps = self.solve(system)
        inverses = system.inverses
        del system
        if is_large:
            self.factor.give_back()
            normal.entries = self.equations().entries
        if steps is None:
            return None
        point_steps = step_points(layout, normal, inverses, steps, self.workers)
        diagonal = np.einsum("naa->na", normal.nodes)
        damped = float(np.sum(diagonal * steps**2) + np.sum(normal.points[:, [0, 3, 5]] * point_steps**2))
        slope = float(np.sum(normal.node_gradients * steps) + np.sum(normal.point_gradients * point_steps))
        values = move(layout, self.values, steps, point_steps)
        if values is None:
            return None
        return *self.settle(values, int(self.options.settles_points)), (damped, slope)

    def solve(self, system: ReducedSystem) -> FloatArray | None:
        """Return the steps of the nodes (N, 6); None if the system has no solution."""
        try:
            self.factor.refactor(system)
            return self.factor.solve(system.right[:, :, None])[:, :, 0]
        except UnsolvableError:
            return None


class _DividedRun(_Run):
    """Steps by observations in parts, which a crew has."""

    def __init__(self, problem: AdjustmentProblem, options: AdjustmentOptions, crew: Crew) -> None:
        self.crew = crew
        super().__init__(problem, options)

    def lay_out(self) -> Layout:
        """Divide the observations; return the structure without them."""
        self.parts = Parts(self.problem, self.options, self.crew)
        return self.parts.layout

    def choose_solver(self) -> ReducedFactor:
        return choose_solver(self.problem, self.layout, self.options, self.workers, is_divided=True)

    def settle(self, values: Values, steps: int) -> tuple[Values, float]:
        points, cost = self.parts.settle(values, self.how(self.damping), steps)
        return replace(values, points=points), cost + self.cost_of_priors(values)

    def how(self, damping: float) -> Pass:
        return Pass(self.options.loss_scale_px, self.least_curvature, damping, self.crew.threads_of_task)

    def linearize(self) -> None:
        """Make the damped equations at the best values, and note their gradient."""
        self.made = self.how(self.damping)
        self.total = self.parts.linearize(self.values, self.made)
        hand_back_memory()  # what the parts have sent, before the factor comes
        self.note_gradient(self.total.largest, largest_share(self.total.curvatures, self.total.gradients))

    def forget(self) -> None:
        del self.total

    def step(self, damping: float) -> tuple[Values, float, tuple[float, float]] | None:
        if self.made.damping != damping:  # after a step that was refused
            self.made = self.made._replace(damping=damping)
            self.total = self.parts.linearize(self.values, self.made)
        total = self.total
        steps = self.solve(total.system(self.layout.active))
        self.factor.give_back()
        total.diagonal, total.pairs = np.empty((2, 0, SLOTS, SLOTS))
        moved = None if steps is None else move(self.layout, self.values, steps, np.zeros(3))
        if steps is None or moved is None:
            return None
        settling = int(self.options.settles_points)
        points, cost, (damped, slope) = self.parts.step(self.values, moved, steps, self.made, settling)
        damped += np.sum(total.curvatures * steps**2)
        slope += np.sum(total.gradients * steps)
        return replace(moved, points=points), cost + self.cost_of_priors(moved), (damped, slope)


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
