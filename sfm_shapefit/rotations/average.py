"""Rotation averaging: several answers, the most consistent one kept, with sigmas and a certificate.

An answer is a spanning tree, cameras moved to where most of their pairs want them, annealed rounds, cameras
moved again, and rounds with the full information (`rotations.annealing`). Answers differ in

    the pairs      those that are sound, and those that are very sound
    the tree       by the supports of the pairs, and by those times the share of their triangles that close
    the loss       annealed from 30 or from 60 degrees

and are judged on the same pairs: by the weight of those within 5 degrees, W sqrt(n) of a pair of n matches.

Where pairs are wrong at random, counts of matches say little, and a few pairs of many matches can turn part
of the cameras. So answers are sought without counts, too, and the best of them is kept where counts mislead:

    more pairs are within 5 degrees of it, with more weight, and
    where both differ, the pairs of the counted one are hardly more than what every answer closes

Cameras that pairs of both answers join are a block; k blocks are tied to one another by k - 1 pairs whatever
these say. On graphs of ViewGraphBench with 60 % wrong, the counted answer had .9 to 1.8 pairs a tie where the
other was right. In scenes that repeat themselves, it had 200 and more: without counts they are folded, and
more pairs close in the fold than in the scene.

Large graphs have so many cycles that one answer suffices: on made ones with a fifth of the pairs wrong, the
second tree from 30 degrees fails last.

The annealed rounds weigh pairs by their supports times their closing share. What closes by chance is rare;
repeated structure, which closes too, is not told apart by this nor by any other score of the pairs alone.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, real_numbers
from sfm_shapefit.base.blas_threads import one_blas_thread
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.forests import connected_components
from sfm_shapefit.base.quaternions import matrices_of, quaternions_of
from sfm_shapefit.pairs.relative_rotations import AGREEMENT_DEG, RelativeRotations
from sfm_shapefit.rotations.annealing import (
    AveragingPairs,
    Linearized,
    anneal,
    closing_shares,
    follow_spanning_tree,
    reattach,
    reattach_blocks,
    refine_fully,
)
from sfm_shapefit.rotations.averaged import AveragedRotations
from sfm_shapefit.rotations.averaging_kernels import residual_squares
from sfm_shapefit.rotations.averaging_system import AveragingSystem, mean_eigenvalues, plan_system
from sfm_shapefit.rotations.averaging_uncertainty import estimate_sigmas
from sfm_shapefit.rotations.dual_certificate import DualCertificate, certify_rotations

_FLOOR = np.radians(0.05)  # radians added to a pair's deviation; calibration is inexact, matches share errors
_WIDEST = np.radians([30.0, 60.0])  # radians; widths at which annealing begins, one answer each: see above
_REATTACHED = np.radians(10.0)  # radians; annealing goes on from here once cameras were moved
_VERY_SOUND = 2.5  # W ln n; fewer pairs than SOUND has, but hardly any wrong one
# Pairs for each tie of blocks that a wrong answer has by chance; see above.
_MOST_BY_CHANCE = 2.5
# With more pairs, fewer answers are tried: two, and one.
_MANY_PAIRS, _MOST_PAIRS = 5_000, 100_000
# The kept answer of a small graph goes on until it stays: a round leaves about half of the way.
_LAST_ROUNDS = 40
_ROTATION_TOLERANCE = 1e-6  # entries of R R^T - I, relative asymmetry of information; smaller is rounding


def average_rotations(
    pairs: npt.ArrayLike,
    rotations: npt.ArrayLike,
    information: npt.ArrayLike | None = None,
    *,
    num_images: int | None = None,
    weights: npt.ArrayLike | None = None,
    threads: int = 1,
) -> AveragedRotations:
    """Return the rotations of images from relative rotations of pairs, many of which may be wrong.

    Images outside the largest component of the pairs get none. The answer, with standard deviations,
    agreement of the pairs and a certificate, does not depend on `threads` nor on the order of the pairs.
    InputError if there is no pair, one is given twice, or an array is not as described.

    Args:
        pairs: (k, 2) images (i, j), i != j, each pair once.
        rotations: (k, 3, 3) cam_j_from_cam_i.
        information: (k, 3, 3) inverse covariances in rad^-2 of w, where exp(w) times the true rotation is the
            given one, in axes of camera j; positive definite. (0.05 deg)^2 is added to all variances. If
            None, all pairs are alike.
        num_images: n; one more than the largest index if None.
        weights: (k,) how many matches stand behind each pair; all alike if None.
        threads: threads that share the work.

    Source: see `rotations.annealing`, `rotations.averaging_uncertainty` and `rotations.dual_certificate`.
    """
    given = check_pairs(pairs, rotations, information, weights, num_images)
    if given.num_cameras == 1:
        return _alone()
    return _choose(given, np.sqrt(given.supports), [np.ones(len(given.pairs), dtype=np.bool_)], threads)


def average_relative_rotations(
    num_images: int, relative: RelativeRotations, threads: int = 1
) -> AveragedRotations:
    """Return `average_rotations` of sound pairs; unsound ones do not count, unless all are."""
    supports = relative.weight_shares * relative.num_matches
    sound, very_sound = relative.are_sound(), relative.are_sound(_VERY_SOUND)
    used = sound if sound.any() else np.ones(len(sound), dtype=np.bool_)
    part = relative.subset(used)
    given = check_pairs(part.pairs, part.rotations, part.information, supports[used], num_images)
    if num_images == 1:
        return _alone()
    # The votes in the order of the checked pairs.
    order = np.lexsort(np.sort(part.pairs, axis=1).T[::-1])
    votes = (part.weight_shares * np.sqrt(part.num_matches))[order]
    subsets = [np.ones(len(order), dtype=np.bool_)]
    kept = very_sound[used][order]
    if kept.any() and not kept.all():
        subsets.append(kept)
    return _choose(given, votes, subsets, threads)


class _Answer(NamedTuple):
    """Rotations of all cameras of a component, with what is needed to say how well they are known."""

    members: IntArray
    """(t,) the cameras."""
    turns: FloatArray
    """(t, 4) cam_from_world."""
    given: AveragingPairs
    """The pairs among them."""
    system: AveragingSystem
    last: Linearized


class _Choice(NamedTuple):
    answer: _Answer
    agree: BoolArray
    """(k,) which of all pairs are within 5 degrees of it."""
    best_agreements: FloatArray
    """(n,) the largest share of the votes of each camera's pairs that agrees with any of the answers."""
    num_tried: int


@one_blas_thread()  # as each factor asks; asked for once, it costs what a small factor does
def _choose(
    given: AveragingPairs, votes: FloatArray, subsets: list[BoolArray], threads: int
) -> AveragedRotations:
    """Return the most consistent of several answers, by counts of matches or without."""
    chosen, counts_mislead = _most_consistent(given, votes, votes, subsets, threads), False
    if np.ptp(given.supports) > 0.0 and not chosen.agree.all():
        alike = replace(given, supports=np.ones_like(given.supports))
        plain = _most_consistent(alike, np.ones_like(votes), votes, subsets, threads)
        counts_mislead = _do_counts_mislead(given, votes, chosen.agree, plain.agree)
        chosen = plain if counts_mislead else chosen
    best = chosen.answer
    if len(best.given.pairs) <= _MANY_PAIRS:
        turns, last = refine_fully(best.given, best.system, best.turns, _LAST_ROUNDS)
        best = best._replace(turns=turns, last=last)
    n, registered = given.num_cameras, np.zeros(given.num_cameras, dtype=np.bool_)
    registered[best.members] = True
    rotations, sigmas = np.tile(np.eye(3), (n, 1, 1)), np.full(n, np.nan)
    rotations[registered] = matrices_of(best.turns)
    sigmas[registered] = np.degrees(estimate_sigmas(best.given, best.system, best.last))
    both = registered[given.pairs].all(axis=1)
    certificate = _certify(best)
    return AveragedRotations(
        rotations=rotations,
        registered=registered,
        sigmas_deg=sigmas,
        agreements=_shares_of_cameras(given, votes, chosen.agree),
        best_agreements=chosen.best_agreements,
        share=float(votes[chosen.agree].sum() / votes[both].sum()),
        num_pairs=int(np.sum(~np.isnan(best.last.distances))),
        num_tried=chosen.num_tried,
        counts_mislead=counts_mislead,
        certified=None if certificate is None else certificate.certified,
        certainty_estimated=certificate is not None and certificate.certified and not certificate.proved,
    )


def _most_consistent(
    given: AveragingPairs, scores: FloatArray, votes: FloatArray, subsets: list[BoolArray], threads: int
) -> _Choice:
    """Return the answer of the largest sum of scores (k,) of agreeing pairs; shares are of votes (k,)."""
    best, score, num_tried = None, -1.0, 0
    chosen_agree, best_agreements = np.zeros(len(votes), dtype=np.bool_), np.full(given.num_cameras, np.nan)
    for answer in _answers(given, subsets, threads):
        num_tried += 1
        agree = _agreeing(given, answer)
        best_agreements = np.fmax(best_agreements, _shares_of_cameras(given, votes, agree))
        if scores[agree].sum() > score:
            best, score, chosen_agree = answer, float(scores[agree].sum()), agree
    assert best is not None
    return _Choice(best, chosen_agree, best_agreements, num_tried)


def _do_counts_mislead(
    given: AveragingPairs, votes: FloatArray, counted: BoolArray, plain: BoolArray
) -> bool:
    """Return whether the pairs (k,) that agree without counts say more than those with counts; see above."""
    if plain.sum() <= counted.sum() or votes[plain].sum() <= votes[counted].sum():
        return False
    num_blocks, num_tied = (
        1 + int(connected_components(given.num_cameras, given.pairs[rows]).max())
        for rows in (counted & plain, counted)
    )
    most = _MOST_BY_CHANCE * (num_blocks - num_tied)
    return 0 < int(np.sum(counted & ~plain)) <= most


def _answers(given: AveragingPairs, subsets: list[BoolArray], threads: int) -> Iterator[_Answer]:
    """Yield an answer for each of the settings that the size of the graph allows."""
    for subset in subsets if len(given.pairs) <= _MOST_PAIRS else subsets[:1]:
        members, part = _largest_component(given.subset(subset))
        if len(members) < 2:
            continue
        system = plan_system(len(members), part.pairs, np.sqrt(part.supports), threads)
        weighed = replace(part, supports=part.supports * closing_shares(part, system))
        settings = list(product((weighed, part), _WIDEST))
        if len(part.pairs) > _MANY_PAIRS:
            settings = settings[: 1 if len(part.pairs) > _MOST_PAIRS else 2]
        for keyed, widest in settings:
            turns, _ = reattach(weighed, system, follow_spanning_tree(keyed))
            turns = anneal(weighed, system, turns, float(widest))
            turns, moved = reattach(weighed, system, turns)
            turns, blocks_moved = reattach_blocks(weighed, system, turns)
            if moved or blocks_moved:
                turns = anneal(weighed, system, turns, float(_REATTACHED))
            turns, last = refine_fully(part, system, turns)
            yield _Answer(members, turns, part, system, last)


def _largest_component(given: AveragingPairs) -> tuple[IntArray, AveragingPairs]:
    """Return the cameras of the largest component, ascending, and the pairs among them, renumbered."""
    labels = connected_components(given.num_cameras, given.pairs)
    inside = labels == np.argmax(np.bincount(labels))
    members = np.flatnonzero(inside).astype(np.int64)
    if inside.all():
        return members, given
    part = given.subset(inside[given.pairs].all(axis=1))
    pairs = np.ascontiguousarray(np.searchsorted(members, part.pairs).astype(np.int64))
    return members, replace(part, num_cameras=len(members), pairs=pairs)


def _agreeing(given: AveragingPairs, answer: _Answer) -> BoolArray:
    """Return which pairs are within 5 degrees of an answer, (k,); those of other cameras are not."""
    turns = np.full((given.num_cameras, 4), np.nan)
    turns[answer.members] = answer.turns
    squares = np.empty(len(given.pairs))
    residual_squares(0, len(squares), given.pairs, given.measured, turns, squares)
    return np.asarray(squares <= np.radians(AGREEMENT_DEG) ** 2)


def _shares_of_cameras(given: AveragingPairs, votes: FloatArray, agree: BoolArray) -> FloatArray:
    """Return the share of the votes of each camera's pairs that agrees, (n,); NaN where it has none."""
    ends, n = given.pairs.T.ravel(), given.num_cameras
    with np.errstate(invalid="ignore"):
        return np.asarray(
            np.bincount(ends, np.tile(votes * agree, 2), n) / np.bincount(ends, np.tile(votes, 2), n)
        )


def _certify(answer: _Answer) -> DualCertificate | None:
    """Return what shows the answer to be optimal for the pairs that are kept; None if that is not checked."""
    given, system = answer.given, answer.system
    # Pairs that are left out have the weight 0.
    weights = mean_eigenvalues(answer.last.blocks)
    kept = ~np.isnan(answer.last.distances)
    members, part = _largest_component(given.subset(kept))
    if len(members) < 2:
        return None
    if len(members) < given.num_cameras:
        # What hangs on pairs that are left out is not part of the problem.
        inside = np.zeros(given.num_cameras, dtype=np.bool_)
        inside[members] = True
        weights = weights[kept & inside[given.pairs].all(axis=1)]
        given, system = part, plan_system(len(members), part.pairs, weights, system.threads)
    return certify_rotations(system, given.measured, weights, np.ascontiguousarray(answer.turns[members]))


def _alone() -> AveragedRotations:
    return AveragedRotations(
        rotations=np.eye(3)[None],
        registered=np.ones(1, dtype=np.bool_),
        sigmas_deg=np.zeros(1),
        agreements=np.full(1, np.nan),
        best_agreements=np.full(1, np.nan),
        share=1.0,
        num_pairs=0,
    )


def check_pairs(
    pairs: npt.ArrayLike,
    rotations: npt.ArrayLike,
    information: npt.ArrayLike | None,
    weights: npt.ArrayLike | None,
    num_images: int | None,
) -> AveragingPairs:
    """Return the pairs with i < j in ascending order, or raise InputError."""
    joined = np.asarray(pairs)
    if joined.size and (joined.ndim != 2 or joined.shape[1] != 2 or joined.dtype.kind not in "iu"):
        raise InputError(f"pairs must be an integer array (k, 2), got {joined.dtype} of shape {joined.shape}")
    joined = joined.reshape(-1, 2).astype(np.int64)
    k = len(joined)
    n = num_images if num_images is not None else int(joined.max(initial=-1)) + 1
    if k == 0 and n != 1:
        raise InputError("rotations cannot be averaged without relative rotations of pairs")
    outside = ((joined < 0) | (joined >= n)).any(axis=1) | (joined[:, 0] == joined[:, 1])
    _refuse(outside, joined, f"must join two different images of 0..{n - 1}")
    measured = _numbers("rotations", rotations, (k, 3, 3))
    defect = np.abs(measured @ measured.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    _refuse((defect > _ROTATION_TOLERANCE) | (_minors(measured)[2] < 0.0), joined, "has no rotation matrix")
    supports = np.ones(k) if weights is None else _numbers("weights", weights, (k,))
    _refuse(supports <= 0.0, joined, "has a weight that is not positive")
    known = np.tile(np.eye(3) / np.radians(1.0) ** 2, (k, 1, 1))
    if information is not None:
        known = _numbers("information", information, (k, 3, 3))
        size = np.abs(known).max(axis=(1, 2), initial=0.0)
        skew = np.abs(known - known.transpose(0, 2, 1)).max(axis=(1, 2), initial=0.0)
        definite = (np.min(_minors(known), axis=0) > 0.0) & (skew <= _ROTATION_TOLERANCE * size)
        _refuse(~definite, joined, "has information that is not symmetric and positive definite")
    ends = np.sort(joined, axis=1)
    order = np.lexsort(ends.T[::-1])
    repeated = np.zeros(k, dtype=np.bool_)
    repeated[order[1:]] = (np.diff(ends[order], axis=0) == 0).all(axis=1)
    _refuse(repeated, joined, "is given twice; join what its matches say before")
    # A pair turned round is R^T, and its error -R^T w.
    back = measured.transpose(0, 2, 1)
    turned = (joined[:, 0] > joined[:, 1])[:, None, None]
    known = np.where(turned, back @ known @ measured, known)[order]
    # (H^-1 + v I)^-1, which needs no inverse of H.
    capped = known @ np.linalg.inv(np.eye(3) + float(_FLOOR) ** 2 * known)
    return AveragingPairs(
        num_cameras=n,
        pairs=np.ascontiguousarray(ends[order]),
        measured=quaternions_of(np.where(turned, back, measured)[order]),
        information=0.5 * (capped + capped.transpose(0, 2, 1)),
        supports=np.ascontiguousarray(supports[order]),
    )


def _numbers(name: str, values: npt.ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Return finite float64 numbers of a shape, or raise InputError."""
    array = real_numbers(f"{name} must be numbers of shape {shape}", values)
    if array.shape != shape:
        raise InputError(f"{name} have shape {array.shape}; {shape[0]} pairs need {shape}")
    if not np.isfinite(array).all():
        raise InputError(f"{name} must be finite numbers")
    return array


def _minors(matrices: FloatArray) -> FloatArray:
    """Return the leading minors of orders 1, 2, 3 of matrices (k, 3, 3), (3, k)."""
    a, b, c = matrices.transpose(1, 2, 0)
    crossed = np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
    return np.stack([a[0], crossed[2], np.sum(crossed * c, axis=0)])


def _refuse(bad: BoolArray, pairs: IntArray, reason: str) -> None:
    if bad.any():
        k = int(np.argmax(bad))
        raise InputError(f"pair {k} ({pairs[k, 0]}, {pairs[k, 1]}) {reason}")
