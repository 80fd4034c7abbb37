"""How exact given rotations are, as far as the matches tell: held, or weighted by a standard deviation.

With rotations free, an adjustment turns each frame by some d_f from where it was given. Part of that is the
error of the given rotation, and part is chance. To tell them apart, the points are drawn into two halves, and
each half turns the frames by itself (common turns of all frames taken off):

    d_f^1 = e_f + n_f^1,    d_f^2 = e_f + n_f^2,        e_f the given error, n_f the noise of a half

    agreement   d_f^1 . d_f^2 / 3        has the mean |e_f|^2 / 3 = sigma^2, whatever the noise is
    chance      |d_f^1 - d_f^2|^2 / 12   has the mean of |n_f|^2 / 3 for all points together

Noise that neighboring keypoints share is in both, other than in a covariance from residuals.

Single frames first. A few that are far off must not say what is usual, so that is the median agreement over
what it is of a normal error. With the noise s^2 of a half, |d_f^1 + d_f^2|^2 / 6 has the mean 2 sigma^2 + s^2
and |d_f^1 - d_f^2|^2 / 6 has s^2, both by three degrees of freedom. Frames differ in noise, and three
numbers hardly tell it: it is drawn towards what is common, as far as the frames' own numbers say that it
is (Smyth, "Linear models and empirical Bayes methods for assessing differential expression", 2004): if
1 / s^2 is spread by nu degrees of freedom, the numbers are s_0^2 F(3, nu), and their quartiles tell nu and
s_0. With what is usual for sigma^2 the ratio of the former to 2 sigma^2 + s^2 is F(3, m), where s^2 has
nu + 3 degrees of freedom and the sum m = (nu + 3) (1 + 2 sigma^2 / s^2)^2 (Satterthwaite). A frame beyond
what that gives to any one of all frames once in a hundred times has its agreement for its sigma^2, and no
part in what follows.

Then all others. If their median agreement does not exceed their median chance, freeing the rotations brings
more noise than it takes errors away: they are held, and what that leaves open is what is usual. Otherwise
sigma^2 is their mean agreement, and the adjustment weighs rotations by it. Where single frames are off and
the others would be held, all are weighted: those by their own sigma, the others by what is usual, and by a
tenth of the chance at least, which is a hundred times what the matches say of them.

What calibration errors do to the frames is the same in both halves and cannot be told from errors of the
rotations. Who measured rotations better than the matches know them has to say so.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc, fdtri

from sfm_shapefit.adjustment.options import AdjustmentOptions
from sfm_shapefit.adjustment.priors import rotation_vectors
from sfm_shapefit.adjustment.problem import AdjustmentProblem, RotationPrior, isotropic_information
from sfm_shapefit.adjustment.solve import adjust, reprojection_errors_px
from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.geometry import mean_rotation_l1

# A frame that sees fewer points in a half says nothing.
_FEWEST_POINTS = 10
_FEWEST_FRAMES = 3
# The halves end at this relative fall of the cost: what is left is far below the spread between them.
_FALL = 1e-4
# What unknowns leave of the errors, at least; points of two views leave a quarter.
_LEAST_REDUNDANCY = 0.1
# Of a normal error in the plane, the median length over the standard deviation per axis.
_MEDIAN_LENGTH = 1.1774
# Of a normal error in space, the median square over the mean.
_MEDIAN_SQUARE = 0.7887
# How probable it may be that any frame at all is singled out by chance.
_FALSE_ALARM = 0.01
_FREEDOM = 3.0
# Of the chance: rotations that pull by that stay what they are, for all that the matches say.
_AS_GOOD_AS_HELD = 0.1


class RotationWeight(NamedTuple):
    """How an adjustment treats the rotations that it was given."""

    hold: bool = False
    """They stay what they are, to the last bit."""
    sigma_rad: float | None = None
    """Standard deviation per axis by which they pull; None: they do not."""
    noise_px: float = 0.5
    """Standard deviation of an observation per axis, which the pull is weighed against."""
    frame_sigmas_rad: FloatArray | None = None
    """(n,) the same for each frame: by these they pull, or may be wrong although they are held. None: as
    above for all, and held ones are right."""

    def apply(self, problem: AdjustmentProblem, given: FloatArray) -> AdjustmentProblem:
        """Return the problem with the pull of the given rotations (n, 3, 3)."""
        if self.hold or self.sigma_rad is None:
            return problem
        sigmas = self.frame_sigmas_rad
        if sigmas is None:
            sigmas = np.full(problem.num_frames, self.sigma_rad)
        prior = RotationPrior(rotations=given, information=isotropic_information(sigmas))
        return replace(problem, rotation_prior=prior)

    def singled_out(self, num_frames: int) -> BoolArray:
        """Return the frames (n,) that pull less than the others: their given rotations are clearly wrong."""
        if self.hold or self.frame_sigmas_rad is None:
            return np.zeros(num_frames, dtype=np.bool_)
        return np.asarray(self.frame_sigmas_rad > self.frame_sigmas_rad.min())

    def open_rad(self) -> float | FloatArray:
        """Return the standard deviation per axis of the errors of held rotations, or one per frame."""
        return self.frame_sigmas_rad if self.hold and self.frame_sigmas_rad is not None else 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RotationErrors:
    """What the matches say of the given rotations; standard deviations per axis."""

    sigma_rad: float
    """Of the given rotations' errors but those that are clearly larger; 0 where all are held."""
    is_chance: bool = True
    """Whether chance explains what the matches would change, but for frames that are clearly off."""
    chance_rad: float
    """Median over the frames of what chance turns them by, all points together."""
    frame_sigmas_rad: FloatArray
    """(n,) of the errors of each frame's rotation: what is usual, or what the halves clearly say of it."""
    noise_px: float
    """Of an observation, from the median of all errors with free rotations."""
    num_frames: int
    """Frames that say anything."""

    def weight(self) -> RotationWeight:
        """Return how to treat the rotations: held, if freeing them would bring more noise than it takes."""
        hold = self.sigma_rad == 0.0
        return RotationWeight(hold, self.sigma_rad or None, self.noise_px, self.frame_sigmas_rad)


def estimate_rotation_errors(problem: AdjustmentProblem, options: AdjustmentOptions) -> RotationErrors:
    """Estimate the errors of a problem's rotations from what two halves of its points make of them.

    Args:
        problem: at the given rotations; its own prior does not count.
        options: of the adjustment; rotations are free here whatever they say.
    """
    bare = replace(problem, rotation_prior=None)
    free = replace(options, hold_rotations=False, cost_tolerance=_FALL)
    is_first = np.random.default_rng(0).permutation(problem.num_points) % 2 == 0
    halves = [bare.of_points(half) for half in (is_first, ~is_first)]
    ends = [adjust(half, free).problem for half in halves]
    seen = np.min([_count_observations(half) for half in halves], axis=0)
    known = (seen >= _FEWEST_POINTS) & ~problem.is_fixed()
    first, second = (_turns(bare, end.rotations)[known] for end in ends)
    errors_px = np.concatenate([reprojection_errors_px(end) for end in ends])
    unknowns = 3 * problem.num_points + 2 * 6 * problem.num_frames
    redundancy = max(1.0 - unknowns / max(2 * problem.num_observations, 1), _LEAST_REDUNDANCY)
    noise_px = float(np.median(errors_px[np.isfinite(errors_px)])) / _MEDIAN_LENGTH / np.sqrt(redundancy)
    if len(first) < _FEWEST_FRAMES:
        return RotationErrors(
            sigma_rad=0.0,
            chance_rad=0.0,
            frame_sigmas_rad=np.zeros(problem.num_frames),
            noise_px=noise_px,
            num_frames=len(first),
        )
    agreement = np.einsum("fa,fa->f", first, second) / 3.0
    chance = np.einsum("fa,fa->f", first - second, first - second) / 12.0
    usual = max(float(np.median(agreement)) / _MEDIAN_SQUARE, 0.0)
    clear = _are_clearly_off(first, second, usual) & (agreement > usual)
    rest, by_chance = agreement[~clear], float(np.median(chance[~clear]))
    is_chance = bool(np.median(rest) <= by_chance)
    if not is_chance:
        variance = open_variance = max(float(rest.mean()), usual)
    elif clear.any():
        variance = open_variance = max(usual, _AS_GOOD_AS_HELD**2 * by_chance)
    else:
        variance, open_variance = 0.0, usual
    variances = np.full(problem.num_frames, open_variance)
    variances[known] = np.where(clear, agreement, open_variance)
    return RotationErrors(
        sigma_rad=float(np.sqrt(variance)),
        is_chance=is_chance,
        chance_rad=float(np.sqrt(by_chance)),
        frame_sigmas_rad=np.sqrt(variances),
        noise_px=noise_px,
        num_frames=len(first),
    )


def _are_clearly_off(first: FloatArray, second: FloatArray, usual: float) -> BoolArray:
    """Return which frames (n,) turn more in both halves, by (n, 3) each, than a usual variance explains."""
    both, apart = (np.sum(d**2, axis=1) / 6.0 for d in (first + second, first - second))
    low, middle, high = np.maximum(np.percentile(apart, [25.0, 50.0, 75.0]), 1e-300)
    nu = _spread_of_noise(float(high / low))
    common = middle / fdtri(_FREEDOM, nu, 0.5)
    noise = (nu * common + _FREEDOM * apart) / (nu + _FREEDOM)
    freedom = (nu + _FREEDOM) * (1.0 + 2.0 * usual / noise) ** 2
    chance = fdtrc(_FREEDOM, freedom, both / (2.0 * usual + noise))
    return np.asarray(len(first) * chance < _FALSE_ALARM)


def _spread_of_noise(quartiles: float) -> float:
    """Return nu of an F(3, nu) whose upper quartile is so many times its lower one, in [1, 1e6]."""
    low, high = 1.0, 1e6
    while high > 1.001 * low:
        nu = float(np.sqrt(low * high))
        wider = fdtri(_FREEDOM, nu, 0.75) / fdtri(_FREEDOM, nu, 0.25) > quartiles
        low, high = (nu, high) if wider else (low, nu)
    return low


def _turns(problem: AdjustmentProblem, rotations: FloatArray) -> FloatArray:
    """Return by which vectors (n, 3) the frames turned; without fixed frames, their common turn taken off."""
    given = problem.rotations
    if not problem.is_fixed().any():
        given = given @ mean_rotation_l1(given.transpose(0, 2, 1) @ rotations)
    return rotation_vectors(rotations @ given.transpose(0, 2, 1))


def _count_observations(problem: AdjustmentProblem) -> IntArray:
    """Return how many observations each frame has, (n,)."""
    return np.bincount(problem.frames_seeing(), minlength=problem.num_frames).astype(np.int64)
