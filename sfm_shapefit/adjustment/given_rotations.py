"""How exact given rotations are, by what the matches say: held, or weighted by a standard deviation.

With rotations free, an adjustment turns each frame by some d_f from where it was given. Part of that is the
error of the given rotation, and part is chance. To tell them apart, the points are drawn into two halves, and
each half turns the frames by itself (common turns of all frames taken off):

    d_f^1 = e_f + n_f^1,    d_f^2 = e_f + n_f^2,        e_f the given error, n_f the noise of a half

    agreement   d_f^1 . d_f^2 / 3        has the mean |e_f|^2 / 3 = sigma^2, whatever the noise is
    chance      |d_f^1 - d_f^2|^2 / 12   has the mean of |n_f|^2 / 3 for all points together

Noise that neighboring keypoints share is in both, other than in a covariance from residuals. If the median
agreement does not exceed the median chance, freeing the rotations brings more noise than it takes errors
away: they are held. Otherwise sigma^2 is the mean agreement, and the adjustment weighs rotations by it. The
frames of a scene turn together, so that a median over them is uncertain itself: of 12 draws of halves from
two scenes with rotations that are right, two exceed the chance, by up to 1.5 times. Where it is between half
and three times the chance, agreement and chance are the means of three draws.

What holding them leaves open is the median agreement. A frame whose own agreement is larger than either lets
one expect, and exceeds chance by three standard deviations, has that for its sigma^2: with rotations that are
right the agreement of a frame has a standard deviation of 2 / 3^(1/2) times the chance. A frame beyond ten
of them is wrong, and must not be held: then the others, instead of being held, pull by a tenth of the chance.

What calibration errors do to the frames is the same in both halves and cannot be told from errors of the
rotations. Who measured rotations better than the matches know them has to say so.

Points of the model itself were fitted with its rotations. Where a camera yaws on the spot, or baselines are
short, lens errors turn whole groups of freed frames by degrees and gain next to nothing; that moves cameras
by 4 to 20 % of the extent in a made room, by 7 % of it with an indoor drone. Halves of sound models of 8 to
100 images move them by .6 % at most. They are believed up to 2 %, the geometric mean of .6 and 7 %. Beyond,
or where points do not fit frames, the gain counts (`without_unseen_turns`): errors of sigma about every axis
would raise the cost by as much as random turns of the freed frames do. With C the costs of held, freed and
turned frames,

    sigma_seen^2 = sigma^2 (C_held - C_free) / (C_turned - C_free)

is what the pixels show. Where it is less than half of sigma^2, the turns are of the kind that pixels do not
see, and rotations are held; `open_shape` says what that leaves open. Frames are freed all the same if the
cost of their observations, over the share of them that fits at all, is three times as large held as freed;
twice, if their own halves call them wrong. An indoor drone that yaws on the spot has right frames of up to
2.4 by that, and frames turned by 3 to 20 degrees from 4.3 on.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.freedom import Freedom
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.adjustment.solve import adjust, costs_of_frames, reprojection_errors_px
from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.geometry import extent_of, mean_rotation_l1
from sfm_shapefit.base.quaternions import rotation_vectors, rotations_of

_FEWEST_POINTS = 10  # points of a frame in each half; fewer do not determine its turn
_FEWEST_FRAMES = 3  # frames with enough points; the medians of fewer say nothing
# The halves end at this relative fall of the cost: what is left is far below the spread between them.
_FALL = 1e-4
# What unknowns leave of the errors, at least; points of two views leave a quarter.
_LEAST_REDUNDANCY = 0.1
# Median length of a normal error in the plane, in standard deviations per axis; (2 log 2)^1/2.
_MEDIAN_LENGTH = 1.1774
# Median square of a normal error in space over its mean; that of a chi-square of three degrees.
_MEDIAN_SQUARE = 0.7887
# Median agreements over chance between which one draw of halves does not decide, and the draws then; right
# rotations exceed chance by up to 1.5 times (see the header).
_UNSURE, _DRAWS = (0.5, 3.0), 3
_NEARLY_HELD = 0.1  # share of the chance by which others pull where some are wrong; they would be held
_CLEAR = 3.0 * 2.0 / np.sqrt(3.0)  # agreement over chance; three standard deviations beyond 0
_CERTAIN = 10.0 * 2.0 / np.sqrt(3.0)  # agreement over chance; ten of them, as such products have long tails
_SEEN = 0.5  # share of squared errors that the pixels show, and of observations that fit; see the header
_HARMLESS = 0.02  # share of the extent; halves that move all cameras by less are believed, see the header
_BETTER, _CLEARLY_BETTER = 2.0, 3.0  # costs of a frame, held over freed, that show it wrong; see the header
_RARE = 4.6  # mean square of a normal error in space, in variances per axis; exceeded once in 300 times


@dataclass(frozen=True, slots=True, kw_only=True)
class RotationErrors:
    """What the matches say of the given rotations; standard deviations per axis."""

    sigma_rad: float
    """Standard deviation of the given rotations; 0 where chance explains all that matches would change."""
    chance_rad: float
    """Median over the frames of what chance turns them by, all points together."""
    frame_sigmas_rad: FloatArray
    """(n,) standard deviations of each frame's rotation: the same, the median where chance explains it, or
    what the halves clearly say of the frame."""
    are_wrong: BoolArray
    """(n,) frames whose rotations are wrong beyond all chance."""
    noise_px: float
    """Standard deviation of an observation, from the median of all errors with free rotations."""
    num_frames: int
    """Frames with enough points in both halves."""
    moved: float
    """Largest distance by which free rotations move a frame, as a share of the extent."""
    are_unseen: bool = False
    """Whether freed frames would turn beyond chance, and pixels hardly gain."""

    def decide(self, freedom: Freedom) -> Freedom:
        """Return the freedom of rotations: held, if freeing them would bring more noise than it takes.

        Where others are wrong, those pull so hard that they are nearly held.
        """
        sigmas, freedom = self.frame_sigmas_rad, replace(freedom, noise_px=self.noise_px)
        if self.sigma_rad > 0.0:
            return replace(freedom, pull_rad=sigmas)
        nearly = _NEARLY_HELD * self.chance_rad if self.are_wrong.any() else 0.0
        return replace(
            freedom,
            pull_rad=np.where(self.are_wrong, sigmas, nearly),
            doubt_rad=np.where(self.are_wrong, 0.0, sigmas),
        )


def estimate_rotation_errors(problem: AdjustmentProblem, options: AdjustmentOptions) -> RotationErrors:
    """Estimate the errors of a problem's rotations from what two halves of its points make of them.

    Args:
        problem: at the given rotations; its own prior does not count.
        options: of the adjustment; rotations are free here whatever they say.
    """
    bare = replace(problem, rotation_prior=None)
    free = replace(options, hold_rotations=False, cost_tolerance=_FALL)
    draws = [_draw_halves(bare, free, 0)]
    if draws[0].known.any() and _UNSURE[0] < draws[0].ratio() < _UNSURE[1]:
        draws += [_draw_halves(bare, free, seed) for seed in range(1, _DRAWS)]
    known = np.all([draw.known for draw in draws], axis=0)
    unknowns = 3 * problem.num_points + 2 * 6 * problem.num_frames
    noise_px = noise_of(draws[0].median_error_px, unknowns, problem.num_observations)
    if np.sum(known) < _FEWEST_FRAMES:
        return RotationErrors(
            sigma_rad=0.0,
            chance_rad=0.0,
            frame_sigmas_rad=np.zeros(problem.num_frames),
            are_wrong=np.zeros(problem.num_frames, dtype=np.bool_),
            noise_px=noise_px,
            num_frames=int(np.sum(known)),
            moved=draws[0].moved,
        )
    agreement = np.mean([draw.agreement[known] for draw in draws], axis=0)
    chance = np.mean([draw.chance[known] for draw in draws], axis=0)
    is_chance = np.median(agreement) <= np.median(chance)
    variance = 0.0 if is_chance else float(max(agreement.mean(), np.median(agreement)))
    open_variance = max(float(np.median(agreement)) / _MEDIAN_SQUARE, 0.0) if is_chance else variance
    expected, rare = np.maximum(chance, np.median(chance)), _RARE * open_variance
    variances, are_wrong = np.full(problem.num_frames, open_variance), np.zeros_like(known)
    is_clear = agreement > np.maximum(_CLEAR * expected, rare)
    variances[known] = np.where(is_clear, agreement, variances[known])
    are_wrong[known] = agreement > np.maximum(_CERTAIN * expected, rare)
    return RotationErrors(
        sigma_rad=float(np.sqrt(variance)),
        chance_rad=float(np.sqrt(np.median(chance))),
        frame_sigmas_rad=np.sqrt(variances),
        are_wrong=are_wrong,
        noise_px=noise_px,
        num_frames=len(agreement),
        moved=max(draw.moved for draw in draws),
    )


def noise_of(median_error_px: float, unknowns: int, num_observations: int) -> float:
    """Return the standard deviation of an observation per axis, px, from the median error after a fit."""
    redundancy = max(1.0 - unknowns / max(2 * num_observations, 1), _LEAST_REDUNDANCY)
    return float(median_error_px / _MEDIAN_LENGTH / np.sqrt(redundancy))


def noise_px_of(problem: AdjustmentProblem) -> float:
    """Return the standard deviation of an observation per axis, px, by the median error."""
    unknowns = 3 * problem.num_points + 6 * problem.num_frames
    return noise_of(float(np.nanmedian(reprojection_errors_px(problem))), unknowns, problem.num_observations)


def without_unseen_turns(
    errors: RotationErrors, problem: AdjustmentProblem, options: AdjustmentOptions, fitting: FloatArray
) -> RotationErrors:
    """Return the errors as far as the pixels show them; see the header.

    Args:
        errors: of `estimate_rotation_errors`.
        problem, options: as there.
        fitting: (n,) share of each frame's observations of the points that fit these.
    """
    turn = errors.sigma_rad > 0.0 or errors.are_wrong.any()
    are_doubted = (turn and errors.moved > _HARMLESS) or np.any(fitting < _SEEN)
    if not (are_doubted and errors.chance_rad > 0.0):
        return errors
    bare, options = replace(problem, rotation_prior=None), replace(options, cost_tolerance=_FALL)
    assert options.loss_scale_px is not None
    free = adjust(bare, options, hold_rotations=False).problem
    turns = (errors.sigma_rad * ~problem.fixed[:, None]) * np.random.default_rng(0).standard_normal(
        (problem.num_frames, 3)
    )
    turned = replace(free, rotations=rotations_of(turns) @ free.rotations)
    freed, held, worse = (
        costs_of_frames(end, options.loss_scale_px)
        for end in (free, *(adjust(one, options, hold_rotations=True).problem for one in (bare, turned)))
    )
    rise = float(np.sum(worse - freed))
    seen = float(np.clip(np.sum(held - freed) / rise, 0.0, 1.0)) if rise > 0.0 else 0.0
    if seen >= _SEEN:
        return errors
    least = np.where(errors.are_wrong, _BETTER, _CLEARLY_BETTER)
    are_wrong = ~problem.fixed & (held > least * fitting * freed)
    sigmas = np.where(are_wrong, np.inf, 0.0)
    are_unseen = bool(turn and not are_wrong.any())
    return replace(errors, sigma_rad=0.0, frame_sigmas_rad=sigmas, are_wrong=are_wrong, are_unseen=are_unseen)


class _Halves(NamedTuple):
    """What two halves of the points make of the rotations."""

    known: BoolArray
    """(n,) frames with enough points in both halves."""
    agreement: FloatArray
    """(n,) product of the halves' turns; mean square per axis of a frame's error, whatever the noise."""
    chance: FloatArray
    """(n,) variance per axis of what noise turns the frame by, all points together."""
    median_error_px: float
    """Median error of all observations."""
    moved: float
    """Largest distance by which both move a frame together, as a share of the extent."""

    def ratio(self) -> float:
        """Return the median agreement of the frames over their median chance."""
        least = np.finfo(np.float64).tiny
        return float(np.median(self.agreement[self.known]) / max(np.median(self.chance[self.known]), least))


def _draw_halves(problem: AdjustmentProblem, options: AdjustmentOptions, seed: int) -> _Halves:
    """Draw the points into two halves, and return what each by itself makes of the rotations."""
    is_first = np.random.default_rng(seed).permutation(problem.num_points) % 2 == 0
    halves = [problem.of_points(half) for half in (is_first, ~is_first)]
    ends = [adjust(half, options).problem for half in halves]
    seen = np.min([np.bincount(half.frames_seeing(), minlength=half.num_frames) for half in halves], axis=0)
    known = (seen >= _FEWEST_POINTS) & ~problem.fixed
    errors_px = np.concatenate([reprojection_errors_px(end) for end in ends])
    agreement, chance = np.zeros(problem.num_frames), np.zeros(problem.num_frames)
    if known.any():
        first, second = (_turns(problem, end.rotations)[known] for end in ends)
        agreement[known] = np.einsum("fa,fa->f", first, second) / 3.0
        chance[known] = np.einsum("fa,fa->f", first - second, first - second) / 12.0
    ways = np.linalg.norm(np.mean([end.centers for end in ends], axis=0) - problem.centers, axis=1)
    moved = float(ways.max() / max(extent_of(problem.centers), np.finfo(np.float64).tiny))
    return _Halves(known, agreement, chance, float(np.median(errors_px[np.isfinite(errors_px)])), moved)


def _turns(problem: AdjustmentProblem, rotations: FloatArray) -> FloatArray:
    """Return by which vectors (n, 3) the frames turned; without fixed frames, their common turn taken off."""
    given = problem.rotations
    if not problem.fixed.any():
        given = given @ mean_rotation_l1(given.transpose(0, 2, 1) @ rotations)
    return rotation_vectors(rotations @ given.transpose(0, 2, 1))
