"""Matches that are missing: what share of an overlap is matched, and how pairs are ranked by it."""

import numpy as np

from sfm_shapefit.pairs.missing_matches import (
    count_partners,
    doubtful_pairs,
    matched_shares,
    score_pairs,
)
from sfm_shapefit.scene.matches import MatchBatch

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


def shares_of(matches, pixels=(GRID,) * 4):
    batch = batch_of(matches)
    partners = count_partners([NUM] * 4, [batch])
    return matched_shares(pixels, np.full((4, 2), 10.0), partners, batch)


def test_what_third_images_find_in_the_overlap_must_be_matched():
    every, half = np.arange(NUM), np.flatnonzero(GRID.sum(axis=1) % 2 == 0)
    shares = shares_of({(0, 1): every, (0, 2): half, (1, 2): every})
    assert shares[0] == shares[2] == 1.0
    assert shares[1] == len(half) / NUM


def test_the_overlap_is_what_the_matches_take_into_the_other_image():
    half = np.flatnonzero(GRID[:, 0] <= 4)
    every = {(0, 1): np.arange(NUM), (0, 2): half, (1, 2): half}
    # Images of one view: the third finds all that it has in the first, which has the right half besides.
    assert shares_of(every)[1] == (1.0 + len(half) / NUM) / 2.0
    # The third image is moved by six pixels: five columns of the others are in it, and all of them are found;
    # of its own, all that are matched anywhere are.
    assert shares_of(every, (GRID, GRID, GRID + np.array([6.0, 0.0]), GRID))[1] == 1.0


def test_keypoints_that_no_third_image_finds_do_not_count():
    assert np.isnan(shares_of({(0, 1): np.arange(NUM)})).all()
    some = np.arange(0, NUM, 3)
    assert shares_of({(0, 1): some, (0, 2): some, (1, 2): some}).tolist() == [1.0, 1.0, 1.0]


def test_scores_join_triangles_and_shares_and_the_lowest_are_doubtful():
    scores = score_pairs(np.array([1.0, np.nan, 0.01, 1.0]), np.array([0.5, 0.5, 0.5, np.nan]))
    np.testing.assert_allclose(scores, [0.5, 0.25, 0.005, np.nan])
    assert doubtful_pairs(scores).tolist() == [False, False, True, False]
    assert not doubtful_pairs(np.full(3, np.nan)).any()
