"""Matches that are missing where two images should both see the same.

A keypoint that is matched with some third image can be found again. Where two images really overlap, most
such keypoints of the overlap are matched between the two, as far as perspective allows. Where only a repeated
thing is matched, a house with its twin, what stands on and around it finds no partner. So of each image

    overlap   the box around the pair's matched keypoints, without the outermost 2 % along each axis
    share     of the keypoints in it that are matched with any third image, those matched with the other image

and of a pair the smaller of its two shares. They fall with the baseline, too: they rank pairs, and are
compared with those of the same scene. Together with the triangles of a pair (`triplets`) they tell wrong
pairs from right ones: area under the curve

    set, wrong pairs of all            triangles   share   product
    facade, 6 of 10 houses alike          .92       .87      .98
    courtyard, the same                   .84       .86      .88
    drive, the same                       .76       .74      .82
    bundled courtyard                     .49      1.00     1.00
    castle-P30                           1.00       .98     1.00
    lego100                               .99       .82      .99
    liberty-calibrated                    .93       .78      .93
    tower, half of its sides alike        .62       .58      .64
    facade, all houses alike              .63       .55      .61

The first seven chose the form; the last two show where nothing in the matches of a pair tells.

Sources: Zach, Irschara, Bischof, "What can missing correspondences tell us about 3D structure and motion?",
CVPR 2008; Wilson, Snavely, "Network principles for SfM: disambiguating repeated structures with local
context", ICCV 2013.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.directions.matches import KeypointMatches

# Of the matched keypoints along an axis, the quantiles that bound the overlap.
_BOX = (0.02, 0.98)
# A pair in no triangle is as likely as not to be right.
_NO_TRIANGLE = 0.5
# A pair is doubtful whose score is a smaller share of the median score.
_DOUBTFUL_SHARE = 0.05


def count_partners(num_keypoints: Sequence[int], batches: Iterable[KeypointMatches]) -> list[IntArray]:
    """Return in how many pairs each keypoint of each image is matched.

    Args:
        num_keypoints: of each image.
        batches: the matches of all pairs.
    """
    counts = [np.zeros(count, dtype=np.int64) for count in num_keypoints]
    for batch in batches:
        for k, ends in enumerate(batch.pairs.tolist()):
            matched = batch.keypoints[batch.offsets[k] : batch.offsets[k + 1]]
            for side, image in enumerate(ends):
                counts[image][matched[:, side]] += 1  # once, even where it is matched twice
    return counts


def matched_shares(
    pixels: Sequence[FloatArray], partners: Sequence[IntArray], batch: KeypointMatches
) -> FloatArray:
    """Return the share of a pair's overlap that is matched, for the pairs of a batch, (b,), in [0, 1].

    NaN where no keypoint of the overlap, in either image, is matched with a third image.

    Args:
        pixels: (k, 2) the keypoints of each image.
        partners: (k,) in how many pairs each of them is matched, see `count_partners`.
        batch: some pairs.
    """
    shares = np.empty(len(batch.pairs))
    for k, ends in enumerate(batch.pairs.tolist()):
        matched = batch.keypoints[batch.offsets[k] : batch.offsets[k + 1]]
        sides = [_share(pixels[image], partners[image], matched[:, side]) for side, image in enumerate(ends)]
        shares[k] = np.fmin(sides[0], sides[1])  # a side that says nothing leaves it to the other
    return shares


def _share(pixels: FloatArray, partners: IntArray, matched: IntArray) -> float:
    """Return the share of one image's overlap with another that is matched."""
    ranks = [round(share * (len(matched) - 1)) for share in _BOX]
    (left, top), (right, bottom) = np.partition(pixels[matched], ranks, axis=0)[ranks]
    x, y = pixels.T
    own = _marked(partners, matched)
    findable = (x >= left) & (x <= right) & (y >= top) & (y <= bottom) & (partners > own)
    total = int(findable.sum())
    return float((findable & own).sum() / total) if total else np.nan


def _marked(keypoints: IntArray, matched: IntArray) -> BoolArray:
    """Return which keypoints of an image are among the matched ones."""
    own = np.zeros(len(keypoints), dtype=np.bool_)
    own[matched] = True
    return own


def score_pairs(triplet_scores: FloatArray, shares: FloatArray) -> FloatArray:
    """Return how little each pair looks like repeated structure, (k,), in [0, 1]; NaN without a share."""
    return np.where(np.isnan(triplet_scores), _NO_TRIANGLE, triplet_scores) * shares


def doubtful_pairs(scores: FloatArray) -> BoolArray:
    """Return which pairs have a far smaller score than is usual among all of them, (k,)."""
    known = scores[np.isfinite(scores)]
    return np.asarray(scores < _DOUBTFUL_SHARE * float(np.median(known)) if len(known) else scores < 0.0)
