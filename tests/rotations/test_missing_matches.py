"""Matches that are missing: what share of an overlap is matched, and how pairs are ranked by it."""

import numpy as np

from sfm_shapefit.directions.matches import MatchBatch
from sfm_shapefit.rotations.missing_matches import (
    count_partners,
    doubtful_pairs,
    matched_shares,
    score_pairs,
)

NUM = 121
GRID = np.stack(np.meshgrid(np.arange(11.0), np.arange(11.0)), axis=-1).reshape(-1, 2)


def batch_of(matches):
    """A batch of pairs that are matched at the same keypoints of both images."""
    offsets = np.append(0, np.cumsum([len(rows) for rows in matches.values()]))
    rows = np.concatenate([np.asarray(rows) for rows in matches.values()])
    nothing = np.zeros((len(rows), 3))
    return MatchBatch(
        pairs=np.array(list(matches)),
        offsets=offsets,
        keypoints=np.stack([rows, rows], axis=1),
        rays_i=nothing,
        rays_j=nothing,
        pixel_angles=np.ones(len(matches)),
    )


def shares_of(matches):
    batch = batch_of(matches)
    partners = count_partners([NUM] * 4, [batch])
    return matched_shares([GRID] * 4, partners, batch)


def test_what_third_images_find_in_the_overlap_must_be_matched():
    every, half = np.arange(NUM), np.flatnonzero(GRID.sum(axis=1) % 2 == 0)
    shares = shares_of({(0, 1): every, (0, 2): half, (1, 2): every})
    assert shares[0] == shares[2] == 1.0
    assert shares[1] == len(half) / NUM


def test_the_overlap_ends_at_the_matches():
    left = np.flatnonzero(GRID[:, 0] <= 4)
    shares = shares_of({(0, 1): np.arange(NUM), (0, 2): left, (1, 2): left})
    assert shares[1] == shares[2] == 1.0
    assert shares[0] == 1.0


def test_keypoints_that_no_third_image_finds_do_not_count():
    assert np.isnan(shares_of({(0, 1): np.arange(NUM)})).all()
    some = np.arange(0, NUM, 3)
    assert shares_of({(0, 1): some, (0, 2): some, (1, 2): some}).tolist() == [1.0, 1.0, 1.0]


def test_scores_join_triangles_and_shares_and_the_lowest_are_doubtful():
    scores = score_pairs(np.array([1.0, np.nan, 0.01, 1.0]), np.array([0.5, 0.5, 0.5, np.nan]))
    np.testing.assert_allclose(scores, [0.5, 0.25, 0.005, np.nan])
    assert doubtful_pairs(scores).tolist() == [False, False, True, False]
    assert not doubtful_pairs(np.full(3, np.nan)).any()
