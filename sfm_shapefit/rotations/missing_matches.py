"""Matches that are missing where two images should both see the same.

A keypoint that is matched with some third image can be found again. Where two images really overlap, most
such keypoints of the overlap are matched between the two, as far as perspective allows. Where only a repeated
thing is matched, a house with its twin, what stands on and around it finds no partner. So of each image

    overlap   what the affine map that fits the pair's matches best takes into the frame of the other image
    share     of the keypoints in it that are matched with any third image, those matched with the other image

and of a pair the mean of its two shares. They fall with the baseline, too: they rank pairs, and are compared
with those of the same scene. Together with the triangles of a pair (`triplets`) they tell wrong pairs from
right ones: area under the curve

    set, wrong pairs of all                          triangles   share   product
    rendered tower, 3 of 8 sides alike                   .62       .70      .68
    rendered courtyard, 6 of 12 houses alike             .81       .87      .88
    rendered drive, half of the houses alike             .99       .84      .98
    rendered facade, half of the houses alike           1.00       .91     1.00
    castle-P30                                          1.00       .98     1.00
    castle-P19                                          1.00       .99     1.00
    lego100                                              .99       .89      .99
    liberty-calibrated                                   .73       .70      .74
    bundled photographed                                 .92       .88      .93

Right is what is within 5 degrees of the truth. With the box around the matched keypoints for the overlap,
shares told less: .57 on the tower, .78 on the courtyard, .74 on the drive, .82 on lego100. Among pairs that
turn as much, a share tells more (`arrangements`).

Sources: Zach, Irschara, Bischof, "What can missing correspondences tell us about 3D structure and motion?",
CVPR 2008; Wilson, Snavely, "Network principles for SfM: disambiguating repeated structures with local
context", ICCV 2013.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.directions.matches import KeypointMatches

# Of squared singular values: where matches are on a line to a thousandth, nothing is known across it.
_RANK = 1e-6
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
    pixels: Sequence[FloatArray], sizes: FloatArray, partners: Sequence[IntArray], batch: KeypointMatches
) -> FloatArray:
    """Return the share of a pair's overlap that is matched, for the pairs of a batch, (b,), in [0, 1].

    NaN where no keypoint of the overlap, in either image, is matched with a third image.

    Args:
        pixels: (k, 2) the keypoints of each image.
        sizes: (n, 2) width and height of each image.
        partners: (k,) in how many pairs each of them is matched, see `count_partners`.
        batch: some pairs.
    """
    shares = np.empty(len(batch.pairs))
    for k, (i, j) in enumerate(batch.pairs.tolist()):
        in_i, in_j = batch.keypoints[batch.offsets[k] : batch.offsets[k + 1]].T
        sides = np.array(
            [
                _share(pixels[i], partners[i], in_i, pixels[j][in_j], sizes[j]),
                _share(pixels[j], partners[j], in_j, pixels[i][in_i], sizes[i]),
            ]
        )
        known = np.isfinite(sides)  # a side that says nothing leaves it to the other
        shares[k] = sides[known].mean() if known.any() else np.nan
    return shares


def _share(
    pixels: FloatArray, partners: IntArray, matched: IntArray, found: FloatArray, size: FloatArray
) -> float:
    """Return the share of one image's overlap with another that is matched.

    Args:
        pixels, partners: of the keypoints of the image.
        matched: (m,) which of them are matched.
        found: (m, 2) where in the other image.
        size: (2,) of the other image.
    """
    own = _marked(partners, matched)
    others = partners > own
    there = _affine_images(pixels[others], pixels[matched], found)
    inside = np.all((there >= 0.0) & (there <= size), axis=1)
    total = int(inside.sum())
    return float((inside & own[others]).sum() / total) if total else np.nan


def _affine_images(points: FloatArray, source: FloatArray, target: FloatArray) -> FloatArray:
    """Return where the affine map takes points, (p, 2), that takes source to target (m, 2) best.

    The one of least norm, if the sources lie on one line.
    """
    middle, aim = source.mean(axis=0), target.mean(axis=0)
    centered = source - middle
    linear = np.linalg.lstsq(centered.T @ centered, centered.T @ (target - aim), rcond=_RANK)[0]
    return np.asarray((points - middle) @ linear + aim)


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
