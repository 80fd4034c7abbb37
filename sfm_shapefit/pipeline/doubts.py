"""Ask the pairs of doubtful cameras for rotations of their own, and let trust follow them.

What fits the given rotations and leaves small residuals is not asked: in a clean scene that is all.
"""

from dataclasses import replace

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, rank_within, rows_taken
from sfm_shapefit.judgement.doubted import believe_rotations, weigh_doubts
from sfm_shapefit.judgement.judged import Judged
from sfm_shapefit.judgement.turns import Doubt, find_turned, fit_as_placed, weigh_pairs
from sfm_shapefit.pairs.essential import (
    LikelyPoses,
    concatenate_rotations,
    estimate_relative_rotations,
    have_many_pairs,
)
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import Lens, Origin
from sfm_shapefit.scene.matches import MatchBatch, RayMatches, is_among, rows_of_pairs

_LEAST_MATCHES = 8  # matches; a pair of fewer is never sound, see `RelativeRotations.are_sound`
_POOR = 0.9  # robust weight of a pair as placed; below, its camera is asked whether it is turned
_DOUBTFUL_SHARE = 0.1  # share of a camera's matches in poor pairs; above, all pairs of the camera are asked
_LIKELY = 0.6
"""Robust weight of a pair as placed, from which a pair of very many is first tried as it is given: no other
pose fits as many matches.

Where pairs are fewer all are asked without prejudice, see "Pairs tried as they are given" in
scripts/results/notes.md.
"""
_AS_WELL = 0.95
"""Share of the robust weight with which `map` found a pair's pose; near that pose, with other intrinsics and
fewer matches, it is the answer again if it keeps as much. Other trials would end there, or at a worse one."""
_MOST_PAIRS = 40
"""Pairs of a camera that are asked at most, those with most matches; a thousand take more than a second.

See "Pairs tried as they are given" in scripts/results/notes.md.
"""
_MOST_ASKED = 30_000  # pairs of all cameras together; beyond 750 images each camera has fewer for it
_FEWEST_PAIRS = 6  # pairs of a camera, however many cameras there are; see `_MOST_PAIRS`
_MOST_MATCHES = 150  # matches of a pair that are looked at; more hardly change its rotation
_AGREEING_DEG = 3.0  # degrees; a direction so near agrees with the solution, whatever its standard deviation


def ask_pairs(
    source: MatchSource, directions: PairDirections, threads: int, among: IntArray | None = None
) -> RelativeRotations:
    """Return the relative rotations of the pairs of doubtful cameras.

    Only pairs `among` some images are asked, by their index; None: all.
    """
    pairs = directions.pairs[_doubtful_pairs(directions, source.images.num_images)]
    if source.fixed is not None:
        pairs = pairs[~source.fixed[pairs].all(axis=1)]
    if among is not None:
        pairs = pairs[np.isin(pairs, among).all(axis=1)]
    are_many = have_many_pairs(source.images.num_images, len(directions.pairs))
    return ask_rotations(source, pairs, threads, directions if are_many else None)


def ask_rotations(
    source: MatchSource, pairs: IntArray, threads: int, given: PairDirections | None = None
) -> RelativeRotations:
    """Return the relative rotations that the matches of the asked pairs (k, 2) have by themselves.

    What pairs say alone, or else the `given` directions, those of many pairs, is tried first.
    """

    def ask(batch: MatchBatch) -> RelativeRotations:
        rays = _thin(source.images, batch)
        likely = _poses_alone(source.alone, rays.pairs)
        if likely is None and given is not None:
            rows = np.flatnonzero(is_among(given.pairs, rays.pairs))  # both ascend
            likely = _poses_as_given(source.images, given, rows)
        return estimate_relative_rotations(rays, threads, are_many=given is not None, likely=likely)

    return concatenate_rotations(list(source.view.measured(source.view.of_pairs(pairs), ask, threads)))


def _poses_as_given(images: Images, directions: PairDirections, rows: IntArray) -> LikelyPoses:
    """Return the relative poses of pairs by the given rotations and the directions measured with them.

    Only of pairs most of whose matches fit that: a turned camera's would be drawn to how it is placed.
    """
    i, j = directions.pairs[rows].T
    translations = np.einsum("kab,kb->ka", images.rotations[j], directions.directions[rows])
    translations[fit_as_placed(directions)[rows] < _LIKELY] = np.nan
    rotations = images.rotations[j] @ images.rotations[i].transpose(0, 2, 1)
    return LikelyPoses(rotations, translations, np.full(len(rows), _LIKELY))


def _poses_alone(alone: RelativeRotations | None, pairs: IntArray) -> LikelyPoses | None:
    """Return the relative poses that pairs (k, 2) have by themselves, as far as that was asked before."""
    if alone is None or alone.translations is None or not len(alone.pairs):
        return None
    rows = rows_of_pairs(pairs, alone.pairs)
    translations = np.where((rows >= 0)[:, None], alone.translations[rows], np.nan)
    return LikelyPoses(alone.rotations[rows], translations, _AS_WELL * alone.weight_shares[rows])


def doubt_cameras(
    placement: Judged,
    directions: PairDirections,
    relative: RelativeRotations | None,
    images: Images,
    confirmed: BoolArray | None = None,
    sigma_rad: float = np.inf,
) -> Judged:
    """Return the placement with a trust that follows what the pairs say of the rotations.

    What `ask_pairs` returned is `relative`; if None, the given rotations are believed. Pairs of a model's own
    tracks hold no second scene, and say nothing of `confirmed` cameras (k,); None: pairs of a database. The
    given rotations are known to `sigma_rad` about each axis.
    """
    if relative is None:
        return replace(placement, assessment=believe_rotations(placement.assessment))
    place_of = np.full(images.num_images, -1)
    place_of[placement.cameras] = np.arange(len(placement.cameras))
    pairs = weigh_pairs(directions, _agreements(placement, directions), relative, images.rotations)
    ends = place_of[pairs.pairs]
    inside = np.flatnonzero((ends >= 0).all(axis=1) & _weighed(directions, images.num_images))
    pairs = rows_taken(pairs, inside)._replace(pairs=ends[inside])
    labels = np.arange(len(placement.cameras))
    if placement.groups is not None:
        _, labels = np.unique(placement.groups.group_of[placement.cameras], return_inverse=True)
    guesses = np.array([_is_guess(lens) for lens in images.lenses])[images.lens_of[placement.cameras]]
    doubts = replace(find_turned(pairs, labels), guessed=guesses)
    doubts = doubts if confirmed is None else doubts.without(confirmed).without_repetition()
    doubts = doubts.known_to(sigma_rad)
    return replace(placement, assessment=weigh_doubts(placement.assessment, doubts))


def _is_guess(lens: Lens) -> bool:
    """Return whether nothing but a guess has told the focal length, the first parameter."""
    return lens.origin is Origin.GUESS and lens.given[:1] in ((), lens.parameters[:1])


def confirm_rotations(source: MatchSource, directions: PairDirections, threads: int) -> BoolArray:
    """Return which images (n,) have a rotation that the matches of their pairs confirm, none being placed.

    As `doubt_cameras` judges them, but for the baselines, which are not known yet.
    """
    images = source.images
    relative = ask_pairs(source, directions, threads)
    pairs = weigh_pairs(directions, np.full(len(directions.pairs), np.nan), relative, images.rotations)
    pairs = rows_taken(pairs, _weighed(directions, images.num_images))
    kinds = find_turned(pairs, images.frame_of).kinds
    return np.array([kind is Doubt.RIGHT for kind in kinds])


def _doubtful_pairs(directions: PairDirections, num_images: int) -> BoolArray:
    """Return which pairs are asked, (k,): those of doubtful cameras."""
    counts = directions.num_matches.astype(np.float64)
    poor = fit_as_placed(directions) < _POOR
    ends = directions.pairs.ravel()
    total = np.bincount(ends, np.repeat(counts, 2), num_images)
    share = np.bincount(ends, np.repeat(counts * poor, 2), num_images) / np.maximum(total, 1.0)
    chosen = (share[directions.pairs] > _DOUBTFUL_SHARE).any(axis=1)
    return np.asarray(chosen & (counts >= _LEAST_MATCHES) & _strongest(directions, num_images))


def _most_pairs(num_images: int) -> int:
    """Return how many pairs of each camera are asked at most."""
    return max(_FEWEST_PAIRS, min(_MOST_PAIRS, _MOST_ASKED // max(num_images, 1)))


def _strongest(directions: PairDirections, num_images: int) -> BoolArray:
    """Return which pairs are among those of most matches of one of their cameras, (k,)."""
    rank = rank_within(directions.pairs.T.ravel(), np.tile(-directions.num_matches, 2))
    return np.asarray((rank < _most_pairs(num_images)).reshape(2, -1).any(axis=0))


def _weighed(directions: PairDirections, num_images: int) -> BoolArray:
    """Return which pairs have a part in the doubts, (k,).

    Where few of many are asked, only those that may be: the others would speak for their cameras, and never
    against them.
    """
    if _most_pairs(num_images) == _MOST_PAIRS:
        return np.ones(len(directions.pairs), dtype=np.bool_)
    return _strongest(directions, num_images)


def _thin(images: Images, batch: RayMatches) -> RayMatches:
    """Return pairs with few of their matches, taken evenly, their rays in camera axes."""
    thin = batch.thinned(_MOST_MATCHES)
    turns = thin.spread(images.rotations[thin.pairs])
    rays_i, rays_j = (
        np.einsum("kab,kb->ka", turns[:, side], rays) for side, rays in enumerate((thin.rays_i, thin.rays_j))
    )
    return replace(thin, rays_i=rays_i, rays_j=rays_j)


def _agreements(placement: Judged, directions: PairDirections) -> FloatArray:
    """Return 1 where a direction agrees with the solution, 0 where not, NaN where it has no part, (k,)."""
    agreements = np.full(len(directions.pairs), np.nan)
    assessment, rows = placement.assessment, placement.pairs
    agrees = assessment.inliers[rows] | (assessment.residuals_deg[rows] <= _AGREEING_DEG)
    # The first edges of the graph are the usable pairs, in their order.
    agreements[directions.usable()[placement.edges[rows]]] = agrees
    return agreements
