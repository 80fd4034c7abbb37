"""Matches that are missing where two images should both see the same.

A keypoint that is matched with some third image can be found again. Where two images really overlap, most
such keypoints of the overlap are matched between the two, as far as perspective allows. Where only a repeated
thing is matched, a house with its twin, what stands on and around it finds no partner. So of each image

    overlap   what the affine map that fits the pair's matches best takes into the frame of the other image
    share     of the keypoints in it that are matched with any third image, those matched with the other image

and of a pair the mean of its two shares. They fall with the baseline, too: they rank pairs, and are compared
with those of the same scene. Together with the triangles of a pair (`triplets`) they separate wrong pairs
from right ones, .68 to 1.00 of the area under the curve on nine sets; a box around the matched keypoints in
place of the affine map does worse: `scripts/results/notes.md#missing-matches`. Among pairs that turn as much,
a share says more (`arrangements`).

Sources: Zach, Irschara, Bischof, "What can missing correspondences tell us about 3D structure and motion?",
CVPR 2008; Wilson, Snavely, "Network principles for SfM: disambiguating repeated structures with local
context", ICCV 2013.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, distinct
from sfm_shapefit.scene.matches import KeypointMatches

_RANK = 1e-6  # ratio of squared singular values; matches on a line to a thousandth say nothing across it
_SLACK_PX = 1e-6  # pixels; keypoints on the border of an image are in it, whatever is rounded
_NO_TRIANGLE = 0.5  # score of a pair in no triangle; it is as likely as not to be right
_DOUBTFUL_SHARE = 0.05  # share of the median score; a pair below it is doubtful


def count_partners(num_keypoints: Sequence[int], batches: Iterable[KeypointMatches]) -> list[IntArray]:
    """Return in how many pairs each keypoint of each image is matched, from the matches of all pairs."""
    counts = [np.zeros(count, dtype=np.int64) for count in num_keypoints]
    for batch in batches:
        for ends, own in zip(batch.pairs.tolist(), batch.slices(), strict=True):
            for side, image in enumerate(ends):
                counts[image][batch.keypoints[own, side]] += 1  # once, even where it is matched twice
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
    if len(batch.pairs) == 0:
        return np.zeros(0)
    images = {k: _Image.of(pixels[k], sizes[k], partners[k]) for k in distinct(batch.pairs).tolist()}
    own, pairs = np.empty((2, len(batch.keypoints), 2)), batch.pairs.tolist()
    rows = batch.slices()
    for part, ends in zip(rows, pairs, strict=True):
        for side, k in enumerate(ends):
            own[side, part] = pixels[k][batch.keypoints[part, side]]
    sides = np.empty((2, len(pairs)))
    for side, other in ((0, 1), (1, 0)):
        maps = _affine_maps(own[side], own[other], batch.offsets[:-1])
        for k, (part, ends, affine) in enumerate(zip(rows, pairs, maps, strict=True)):
            image, other_image = images[ends[side]], images[ends[other]]
            sides[side, k] = _share(image, batch.keypoints[part, side], affine, other_image.size)
    finite = np.isfinite(sides)  # a side that says nothing leaves it to the other
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(finite, sides, 0.0).sum(axis=0) / finite.sum(axis=0))


class _Image(NamedTuple):
    """Keypoints of an image that are matched at all; other images say nothing of the rest."""

    pixels: FloatArray
    """(2, k)"""
    partners: IntArray
    """(k,) in how many pairs they are matched."""
    place_of: IntArray
    """Place of each keypoint of the image among them."""
    size: FloatArray
    """(2,) width and height of the image."""

    @classmethod
    def of(cls, pixels: FloatArray, size: FloatArray, partners: IntArray) -> "_Image":
        matched = partners > 0
        return cls(np.ascontiguousarray(pixels[matched].T), partners[matched], np.cumsum(matched) - 1, size)


def _share(image: _Image, matched: IntArray, affine: FloatArray, size: FloatArray) -> float:
    """Return the share of the keypoints in the overlap with another image that are `matched` (m,) there."""
    own = np.zeros(len(image.partners), dtype=np.bool_)
    own[image.place_of[matched]] = True
    inside = image.partners > own
    centered = image.pixels - affine[2][:, None]
    for column, middle, end in zip(affine[:2].T, affine[3], size, strict=True):
        there = column[0] * centered[0] + column[1] * centered[1] + middle
        inside &= (there >= -_SLACK_PX) & (there <= end + _SLACK_PX)
    total = np.count_nonzero(inside)
    return np.count_nonzero(inside & own) / total if total else np.nan


def _affine_maps(source: FloatArray, target: FloatArray, starts: IntArray) -> FloatArray:
    """Return the affine map of each pair that takes source to target (m, 2) best, (b, 4, 2).

    The rows of a map are its linear part, two, the middle of the source, and that of the target: it takes x
    to (x - middle) @ linear + target's middle. Where the sources lie on one line, it has the least norm.
    `starts` (b,) has the first match of each pair, which has one or more.
    """
    counts = np.diff(np.append(starts, len(source)))
    both = np.concatenate([source, target], axis=1)
    middles = np.add.reduceat(both, starts, axis=0) / counts[:, None]
    centered = both - np.repeat(middles, counts, axis=0)
    moments = np.add.reduceat(centered[:, :2, None] * centered[:, None, :], starts, axis=0)
    linear = np.linalg.pinv(moments[:, :, :2], rcond=_RANK, hermitian=True) @ moments[:, :, 2:]
    return np.concatenate([linear, middles.reshape(-1, 2, 2)], axis=1)


def score_pairs(triplet_scores: FloatArray, shares: FloatArray) -> FloatArray:
    """Return how little each pair looks like repeated structure, (k,), in [0, 1]; NaN without a share."""
    return np.where(np.isnan(triplet_scores), _NO_TRIANGLE, triplet_scores) * shares


def doubtful_pairs(scores: FloatArray) -> BoolArray:
    """Return which pairs have a far smaller score than is usual among all of them, (k,)."""
    finite = scores[np.isfinite(scores)]
    return np.asarray(scores < _DOUBTFUL_SHARE * float(np.median(finite)) if len(finite) else scores < 0.0)
