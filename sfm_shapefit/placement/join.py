"""Two models joined: the similarity between their worlds, its uncertainty, and when it is refused.

Directions end at the border of a model, and so does its scale. Two models are still tied by matches between
their images, too few to be pairs of one model, or by positions that are known of cameras of both. From either
comes the similarity first_from_second, y = s R x + t, by a robust fit to more than it needs; its standard
deviations are those of a jackknife, which leaves out one witness (a pair of images, a position) after the
other, so that errors which the matches of a pair share count once:

    variance = (m - 1) / m sum_i (theta_i - theta)^2        (Efron, Stein 1981, "The jackknife")

A join is refused where it is not over-determined; where pairs that contradict it agree among themselves on
another one, as those of a thing that stands there twice do; or where scale, turn or place stay too uncertain.
Two models whose scales are known, as those of rigs, are joined by a rigid motion.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.adjustment.priors import cross_matrices
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.geometry import (
    Similarity,
    compose,
    fit_similarity,
    fits_of_few_points,
    invert,
    mean_rotation_l1,
    median_spread,
    normalized,
    rotation_angles_deg,
)
from sfm_shapefit.base.wording import counted
from sfm_shapefit.placement.gauge import fit_to_priors, prior_gauge
from sfm_shapefit.scene.given import PositionPriors

FEWEST_WITNESSES = 3
"""Pairs of images, or known positions in each model, that a join needs; two leave nothing to check it by."""
_FEWEST_MATCHES = 24  # matches of a pair that can be a witness; fewer are chance
_FEWEST_POINTS = 6  # points that both models have; from fewer no start is drawn
_LEAST_RIVAL_SHARE = 0.25  # share of the best join's pairs; from here on another join is a rival
_MOST_AGAINST = 3.0  # pairs that contradict the best join, per agreeing pair; beyond, it is refused
# Turns that single pairs suggest agree up to the first; the second is how many groups of them are tried.
_SAME_TURN_DEG = 5.0
_MOST_TURNS = 8  # groups of turns that are tried; bounds the time where single pairs scatter
_LARGEST_SCALE_SIGMA = 0.05  # relative standard deviation of the scale; above, the join is refused
_LARGEST_TURN_SIGMA_DEG = 3.0  # degrees, standard deviation of the turn; above, the join is refused
_LARGEST_CENTER_SIGMA = 0.1  # standard deviation of the place in spreads of the second model; likewise
_NUM_SAMPLES = 256  # draws of few points; if half are good, none of these is with odds 1e-15
_NUM_REFINED = 4  # draws; only the best are refined
_REWEIGHTINGS = 20  # steps, a bound; weights settle in fewer
_MOST_MATCHES = 1_000  # matches; more make the fit no better
_MOST_FITS = 12  # groups by which witnesses are left out; each is a fit of its own


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModelJoin:
    """How a second model stands in the world of a first one."""

    first_from_second: Similarity
    scale_sigma: float
    """Relative standard deviation of its scale."""
    turn_sigma_deg: float
    """Standard deviation of the angle by which its rotation is off."""
    center_sigma: float
    """Median standard deviation of the second model's cameras, in units of the first."""
    evidence: str
    """What it rests on, in words."""
    agreeing: BoolArray | None = None
    """(k,) which of the matches between the models agree with it; None if it does not rest on matches."""


class Ties(NamedTuple):
    """k matches between images of two models: the rays of each, and the points it is seen to be of."""

    eyes_first: FloatArray
    """(k, 3) center of the first model's camera."""
    eyes_second: FloatArray
    """(k, 3) center of the second one's."""
    rays_first: FloatArray
    """(k, 3) unit rays in the first model's world."""
    rays_second: FloatArray
    """(k, 3) in the second one's."""
    points_first: FloatArray
    """(k, 3) NaN where the keypoint observes no point."""
    points_second: FloatArray
    """(k, 3)"""
    pairs: IntArray
    """(k,) the pair of images of each match, any numbers."""
    tolerances: FloatArray
    """(k,) radians by which a ray may miss."""

    def subset(self, rows: BoolArray | IntArray) -> "Ties":
        """Return some of the matches."""
        return Ties(
            self.eyes_first[rows],
            self.eyes_second[rows],
            self.rays_first[rows],
            self.rays_second[rows],
            self.points_first[rows],
            self.points_second[rows],
            self.pairs[rows],
            self.tolerances[rows],
        )


def join_by_matches(
    ties: Ties, turns: FloatArray, centers: FloatArray, metric_sigma: float | None = None
) -> ModelJoin:
    """Return the join of two models by matches between their images, which are too few to be pairs alone.

    A match whose keypoint in one model observes a point says where that is seen from the other; where neither
    observes one, both rays and the two centers lie in a plane. UnsolvableError, whose message is the reason,
    a clause, if it is not safe.

    Args:
        ties: the matches.
        turns: (h, 3, 3) rotations first_from_second that single pairs of images suggest.
        centers: (n, 3) of the second model's cameras.
        metric_sigma: relative standard deviation of the scale between the models, which is 1, if both are
            metric.
    """
    metric = metric_sigma is not None
    num_matches, num_pairs = len(ties.pairs), len(np.unique(ties.pairs))
    if num_matches < _FEWEST_MATCHES or num_pairs < FEWEST_WITNESSES:
        raise UnsolvableError(
            f"between them are {num_matches} matches of {counted(num_pairs, 'pair')} of images, and a join "
            f"needs {_FEWEST_MATCHES} of {FEWEST_WITNESSES}"
        )
    used = ties.subset(np.arange(0, num_matches, -(-num_matches // _MOST_MATCHES)))
    best = _search(used, turns, metric=metric)
    agreeing = _misses(best, ties) <= 1.0
    supporting = _supporting_pairs(ties.pairs, agreeing)
    if agreeing.sum() < _FEWEST_MATCHES or len(supporting) < FEWEST_WITNESSES:
        raise UnsolvableError(
            f"no more than {len(supporting)} of {num_pairs} pairs of images between them agree on one join"
        )
    _refuse_rivals(used.subset(~np.isin(used.pairs, supporting)), turns, len(supporting), metric=metric)
    right = used.subset(np.isin(used.pairs, supporting))
    fits = [
        _refine(best, right.subset(~np.isin(right.pairs, some)), metric=metric)
        for some in _groups_left_out(supporting)
    ]
    evidence = (
        f"{int(agreeing.sum())} of {num_matches} matches between them, of {len(supporting)} of "
        f"{num_pairs} pairs of images"
    )
    join = _with_errors(best, [fits], centers, evidence, agreeing)
    if metric_sigma is not None:
        # Errors of the size of the second model move its cameras about their middle.
        spread = metric_sigma * median_spread(centers)
        place = float(np.hypot(join.center_sigma, spread))
        join = replace(join, scale_sigma=metric_sigma, center_sigma=place)
    refuse_uncertain(join, centers)
    return join


class PlacedByPriors(NamedTuple):
    """A model on the position priors of its cameras, and how well it stands there."""

    centers: FloatArray
    """(n, 3) centers of its cameras, in its world."""
    priors_from_model: Similarity
    parts: tuple[Similarity, ...]
    """The same without some of the priors in turn."""
    num_priors: int


def place_by_priors(centers: FloatArray, priors: PositionPriors) -> PlacedByPriors:
    """Return a model, cameras at `centers` (n, 3), on their position priors, for `join_by_priors`.

    UnsolvableError, whose message is the reason, a clause, if they are few, lie on a line, or do not fit.
    """
    best, parts = _fit_priors(centers, priors)
    return PlacedByPriors(centers, best, tuple(parts), len(priors))


def join_by_priors(first: PlacedByPriors, second: PlacedByPriors) -> ModelJoin:
    """Return the join of two models by position priors; UnsolvableError, the reason, if it is not safe."""
    one, other = first.priors_from_model, second.priors_from_model
    errors = [[_chain(part, other) for part in first.parts], [_chain(one, part) for part in second.parts]]
    evidence = f"position priors of {first.num_priors} and {second.num_priors} cameras"
    join = _with_errors(_chain(one, other), errors, second.centers, evidence)
    refuse_uncertain(join, second.centers)
    return join


def refuse_uncertain(join: ModelJoin, centers: FloatArray) -> None:
    """Raise UnsolvableError if a join of a model with these centers (n, 3) is too uncertain."""
    size = join.first_from_second.scale * median_spread(centers)
    if join.scale_sigma > _LARGEST_SCALE_SIGMA:
        raise UnsolvableError(f"the scale between them is known to {join.scale_sigma:.0%} only")
    if join.turn_sigma_deg > _LARGEST_TURN_SIGMA_DEG:
        raise UnsolvableError(f"the turn between them is known to {join.turn_sigma_deg:.2g} deg only")
    if join.center_sigma > _LARGEST_CENTER_SIGMA * size:
        raise UnsolvableError(
            f"where one stands beside the other is known to {join.center_sigma / size:.0%} of its size only"
        )


def _chain(priors_from_first: Similarity, priors_from_second: Similarity) -> Similarity:
    return compose(invert(priors_from_first), priors_from_second)


def _fit_priors(centers: FloatArray, priors: PositionPriors) -> tuple[Similarity, list[Similarity]]:
    """Return a model's map onto its priors, and maps that leave out some; UnsolvableError if none is good."""
    if len(priors) <= FEWEST_WITNESSES:
        raise UnsolvableError(
            f"one of them has {counted(len(priors), 'position prior')}, and a join needs "
            f"{FEWEST_WITNESSES + 1} in each"
        )
    try:
        gauge = prior_gauge(centers, priors, axes_known=False)
    except InputError as error:
        raise UnsolvableError(str(error)) from error
    if gauge.warning or gauge.axes is None:
        raise UnsolvableError(gauge.warning)
    source, target = centers[priors.known.indices], priors.known.positions
    best, weights, _ = fit_to_priors(source, priors, median_spread(target), rotate=True)
    parts = [
        fit_similarity(source, target, np.where(np.isin(np.arange(len(target)), left_out), 0.0, weights))
        for left_out in _groups_left_out(np.arange(len(target)))
    ]
    return best, parts


def _groups_left_out(witnesses: IntArray) -> list[IntArray]:
    """Return the witnesses in groups, of which each is left out once."""
    count = min(len(witnesses), _MOST_FITS)
    return [witnesses[k::count] for k in range(count)]


def _supporting_pairs(pairs: IntArray, agreeing: BoolArray) -> IntArray:
    """Return the pairs of which most matches agree, ascending."""
    names, place, counts = np.unique(pairs, return_inverse=True, return_counts=True)
    return np.asarray(names[2.0 * np.bincount(place, agreeing, len(counts)) > counts])


def _search(ties: Ties, turns: FloatArray, *, metric: bool) -> Similarity:
    """Return the similarity of least cost of all that the matches suggest; of scale 1 if it is `metric`."""
    starts = sorted(_starts(ties, turns, metric=metric), key=lambda fit: _cost(fit, ties))[:_NUM_REFINED]
    if not starts:
        raise UnsolvableError("the matches between them suggest no common scale")
    return min((_refine(start, ties, metric=metric) for start in starts), key=lambda fit: _cost(fit, ties))


def _refuse_rivals(rest: Ties, turns: FloatArray, num_supporting: int, *, metric: bool) -> None:
    """Raise UnsolvableError if pairs that contradict a join agree among themselves on another one."""
    num_against = len(np.unique(rest.pairs))
    if num_against > _MOST_AGAINST * num_supporting:
        raise UnsolvableError(
            f"{num_against} of {num_against + num_supporting} pairs of images between them contradict the "
            "join that most want"
        )
    if num_against < _LEAST_RIVAL_SHARE * num_supporting or len(rest.pairs) < _FEWEST_MATCHES:
        return
    try:
        rival = _search(rest, turns, metric=metric)
    except UnsolvableError:
        return
    num_rivals = len(_supporting_pairs(rest.pairs, _misses(rival, rest) <= 1.0))
    if num_rivals >= max(_LEAST_RIVAL_SHARE * num_supporting, 2):
        raise UnsolvableError(
            f"two joins are possible: {counted(num_supporting, 'pair')} of images between them agree on one, "
            f"{num_rivals} on another"
        )


def _starts(ties: Ties, turns: FloatArray, *, metric: bool) -> Iterator[Similarity]:
    """Yield similarities that a few points of both models, or the rotation of a pair, suggest."""
    for fit in _free_starts(ties, turns):
        if not metric:
            yield fit
            continue
        # The same motion without its scaling, about the middle of the second model's cameras.
        middle = ties.eyes_second.mean(axis=0)
        shift = fit.apply(middle[None])[0] - fit.rotation @ middle
        yield Similarity(scale=1.0, rotation=fit.rotation, translation=shift)


def _free_starts(ties: Ties, turns: FloatArray) -> Iterator[Similarity]:
    """Yield the same, of any scale."""
    both = np.asarray(np.isfinite(ties.points_first + ties.points_second).all(axis=1), dtype=np.bool_)
    if both.sum() >= _FEWEST_POINTS:
        points = ties.subset(both)
        fits = fits_of_few_points(points.points_second, points.points_first, rotate=True, count=_NUM_SAMPLES)
        yield from (fit for fit in fits if fit.scale > 0.0)
    for turn in _frequent_turns(turns):
        scale, *shift = _solve_scale_and_shift(ties, turn).tolist()
        if scale > 0.0:
            yield Similarity(scale=scale, rotation=turn, translation=np.array(shift))


def _frequent_turns(turns: FloatArray) -> Iterator[FloatArray]:
    """Yield the turn that most of the turns (h, 3, 3) agree with, then that of the others, and so on."""
    for _ in range(_MOST_TURNS):
        if not len(turns):
            return
        apart = rotation_angles_deg(turns[:, None].transpose(0, 1, 3, 2) @ turns[None])
        near = apart <= _SAME_TURN_DEG
        chosen = int(np.argmax(near.sum(axis=1)))
        yield mean_rotation_l1(turns[near[chosen]])
        turns = turns[~near[chosen]]


def _solve_scale_and_shift(ties: Ties, turn: FloatArray) -> FloatArray:
    """Return scale and shift (4,) of a similarity of known rotation, by reweighted least squares (L1).

    Each tie is linear in them: a ray u meets a point of the other model, or normal n = u_first x u_second is
    orthogonal to the baseline.
    """
    eyes, rays = ties.eyes_second @ turn.T, ties.rays_second @ turn.T
    points = ties.points_second @ turn.T
    into_second = cross_matrices(rays)
    into_first = cross_matrices(ties.rays_first)
    normals = np.cross(ties.rays_first, rays)[:, None, :]
    matrices, targets = [], []
    for across, moved, aim, there in (
        (into_second, eyes, ties.points_first, np.isfinite(ties.points_first).all(axis=1)),
        (into_first, points, ties.eyes_first, np.isfinite(points).all(axis=1)),
        (normals, eyes, ties.eyes_first, np.ones(len(eyes), dtype=np.bool_)),
    ):
        rows = across[there]
        matrices.append(np.concatenate([rows @ moved[there, :, None], rows], axis=2).reshape(-1, 4))
        targets.append((rows @ aim[there, :, None]).ravel())
    matrix, target = np.concatenate(matrices), np.concatenate(targets)
    floor = 1e-6 * (float(np.abs(target).max()) or 1.0)
    weights = np.ones(len(target))
    solution = np.zeros(4)
    for _ in range(_REWEIGHTINGS):
        solution = np.linalg.lstsq(weights[:, None] * matrix, weights * target)[0]
        weights = np.maximum(np.abs(matrix @ solution - target), floor) ** -0.5
    return solution


def _off(fit: Similarity, ties: Ties) -> tuple[FloatArray, FloatArray]:
    """Return how rays miss points of the other model, (2, k, 3), and one another, (k,), in tolerances.

    Both are NaN where they do not apply: a pair of rays counts where neither keypoint observes a point.
    """
    there, back = fit.apply(ties.points_second), invert(fit).apply(ties.points_first)
    off = np.stack(
        [
            normalized(there - ties.eyes_first) - ties.rays_first,
            normalized(back - ties.eyes_second) - ties.rays_second,
        ]
    )
    rays = ties.rays_second @ fit.rotation.T
    baselines = normalized(fit.apply(ties.eyes_second) - ties.eyes_first)
    planes = [np.linalg.norm(np.cross(baselines, one), axis=1) for one in (ties.rays_first, rays)]
    volume = np.vecdot(np.cross(ties.rays_first, rays), baselines)
    apart = volume / np.maximum(np.minimum(*planes), 1e-12)
    apart = np.where(np.isnan(off).any(axis=2).all(axis=0), apart, np.nan)
    return off / ties.tolerances[:, None], apart / ties.tolerances


def _misses(fit: Similarity, ties: Ties) -> FloatArray:
    """Return by how many tolerances rays miss what they should see, the worst of each match, (k,)."""
    off, apart = _off(fit, ties)
    return np.asarray(np.fmax.reduce([*np.linalg.norm(off, axis=2), np.abs(apart)]))


def _cost(fit: Similarity, ties: Ties) -> float:
    return float(np.minimum(_misses(fit, ties), 1.0).sum())


def _refine(start: Similarity, ties: Ties, *, metric: bool) -> Similarity:
    """Return the similarity of least robust (Cauchy) angular cost; it keeps a `metric` scale of its start."""
    # Here, since they take long to import, and every command that writes results loads this module.
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    middle = ties.eyes_second.mean(axis=0)
    size = start.scale * (median_spread(ties.eyes_second) or 1.0)

    def moved(x: FloatArray) -> Similarity:
        turn = Rotation.from_rotvec(x[:3]).as_matrix() @ start.rotation
        scale = start.scale if metric else start.scale * float(np.exp(x[6]))
        there = start.apply(middle[None])[0] + size * x[3:6]
        return Similarity(scale=scale, rotation=turn, translation=there - scale * turn @ middle)

    def residuals(x: FloatArray) -> FloatArray:
        off, apart = _off(moved(x), ties)
        return np.asarray(np.nan_to_num(np.concatenate([off.ravel(), apart]), nan=0.0))

    return moved(
        least_squares(residuals, np.zeros(6 if metric else 7), loss="cauchy", f_scale=0.3, max_nfev=50).x
    )


def _with_errors(
    best: Similarity,
    fits: Sequence[Sequence[Similarity]],
    centers: FloatArray,
    evidence: str,
    agreeing: BoolArray | None = None,
) -> ModelJoin:
    """Return a join with the errors of its jackknives, whose variances add up; one per kind of witness."""
    scale, turn, place = 0.0, 0.0, np.zeros(len(centers))
    for partial in fits:
        share = (len(partial) - 1) / len(partial)
        scale += share * sum(np.log(fit.scale / best.scale) ** 2 for fit in partial)
        turn += share * sum(
            float(rotation_angles_deg(fit.rotation @ best.rotation.T)) ** 2 for fit in partial
        )
        place += share * sum(
            np.sum((fit.apply(centers) - best.apply(centers)) ** 2, axis=1) for fit in partial
        )
    return ModelJoin(
        first_from_second=best,
        scale_sigma=float(np.sqrt(scale)),
        turn_sigma_deg=float(np.sqrt(turn)),
        center_sigma=float(np.sqrt(np.median(place))),
        evidence=evidence,
        agreeing=agreeing,
    )
