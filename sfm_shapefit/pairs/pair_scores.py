"""Scores of pairs with a relative rotation, by which those of repeated structure are told from others."""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.pairs.direction_options import LEAST_MATCHES
from sfm_shapefit.pairs.missing_matches import count_partners, matched_shares
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.pairs.triplets import score_triplets
from sfm_shapefit.scene.matches import View, rows_of_pairs

MOST_SCORED_PAIRS = 20_000  # pairs; scores of more are not worth 0.2 ms a pair and 16 bytes a match


class PairScores(NamedTuple):
    """Scores of pairs with a relative rotation, by which those of repeated structure are told."""

    pairs: IntArray = np.zeros((0, 2), dtype=np.int64)
    """(m, 2)"""
    values: FloatArray = np.zeros((0, 2))
    """(m, 2) by triangles, and the matched share of their overlap; NaN where unknown."""

    def of(self, pairs: IntArray) -> FloatArray:
        """Return those of some pairs (k, 2), (k, 2)."""
        return np.vstack([self.values, [np.nan, np.nan]])[rows_of_pairs(pairs, self.pairs)]


def score_repetition(num_images: int, relative: RelativeRotations, view: View | None = None) -> PairScores:
    """Return the scores of all pairs of images with a relative rotation, by the matches of a view too.

    Without a view, of very many pairs, they are scored by their triangles alone.
    """
    scores = np.full((len(relative.pairs), 2), np.nan)
    scores[:, 0] = score_triplets(num_images, relative)
    if view is not None:
        pixels = [view.keypoints(k) for k in range(num_images)]
        batches = list(view.links(LEAST_MATCHES))  # both look at all of them
        partners = count_partners([len(image_pixels) for image_pixels in pixels], batches)
        for batch in batches:
            rows = rows_of_pairs(batch.pairs, relative.pairs)
            shares = matched_shares(pixels, view.images.sizes_px, partners, batch)
            scores[rows[rows >= 0], 1] = shares[rows >= 0]
    return PairScores(relative.pairs, scores)
