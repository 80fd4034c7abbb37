"""Triplets: pairs whose triangles close score 1, false ones 0, and pairs in no triangle have no score."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.pairs.triplets import score_triplets


def relative_of(pairs, rotations):
    k = len(pairs)
    return RelativeRotations(
        pairs=np.asarray(pairs, dtype=np.int64).reshape(-1, 2),
        rotations=np.asarray(rotations).reshape(-1, 3, 3),
        information=np.tile(np.eye(3), (k, 1, 1)),
        num_matches=np.full(k, 100),
        weight_shares=np.ones(k),
    )


def made(n, share, num_false, seed=0, noise_deg=0.5):
    """A random graph of noisy pairs in random order, and which of them are false."""
    rng = np.random.default_rng(seed)
    truth = Rotation.random(n, random_state=rng).as_matrix()
    pairs = np.column_stack(np.triu_indices(n, 1))
    pairs = rng.permutation(pairs[rng.random(len(pairs)) < share])
    noise = Rotation.from_rotvec(np.radians(noise_deg) * rng.normal(size=(len(pairs), 3))).as_matrix()
    rotations = noise @ truth[pairs[:, 1]] @ truth[pairs[:, 0]].transpose(0, 2, 1)
    false = np.arange(len(pairs)) < num_false
    rotations[false] = Rotation.random(num_false, random_state=rng).as_matrix()
    return relative_of(pairs, rotations), false


def plain_scores(n, relative):
    """The same by its definition, over all triples of images."""
    row = {tuple(pair): k for k, pair in enumerate(relative.pairs.tolist())}
    scores = np.ones(len(row))
    for _ in range(5):
        closing, total = np.zeros(len(row)), np.zeros(len(row))
        for i in range(n):
            for j in range(i + 1, n):
                for k in range(j + 1, n):
                    if not {(i, j), (j, k), (i, k)} <= set(row):
                        continue
                    ij, jk, ik = row[i, j], row[j, k], row[i, k]
                    around = relative.rotations[jk] @ relative.rotations[ij] @ relative.rotations[ik].T
                    closes = np.degrees(Rotation.from_matrix(around).magnitude()) <= 5.0
                    for own, a, b in ((ij, jk, ik), (jk, ij, ik), (ik, ij, jk)):
                        weight = max(scores[a] * scores[b], 1e-6)
                        closing[own] += weight * closes
                        total[own] += weight
        scores = np.where(total > 0.0, closing / np.where(total > 0.0, total, 1.0), 1.0)
    return np.where(total > 0.0, scores, np.nan)


def test_false_pairs_are_told_from_right_ones():
    relative, false = made(30, 0.8, num_false=60)
    scores = score_triplets(30, relative)
    assert scores[false].max() < 0.05
    assert scores[~false].min() > 0.95


def test_scores_are_those_of_the_definition():
    relative, _ = made(12, 0.4, num_false=8, seed=2, noise_deg=2.0)
    expected = plain_scores(12, relative)
    assert np.isnan(expected).any()
    np.testing.assert_allclose(score_triplets(12, relative), expected, rtol=1e-12)


@pytest.mark.parametrize("pairs", [[], [(0, 1)], [(0, 1), (1, 2), (2, 3), (0, 3)]])
def test_without_triangles_there_are_no_scores(pairs):
    scores = score_triplets(5, relative_of(pairs, np.tile(np.eye(3), (len(pairs), 1, 1))))
    assert scores.shape == (len(pairs),)
    assert np.isnan(scores).all()


def test_a_triangle_closes_up_to_five_degrees():
    pairs = [(0, 1), (0, 2), (1, 2)]
    for angle_deg, expected in ((4.999, 1.0), (5.001, 0.0)):
        rotations = np.tile(np.eye(3), (3, 1, 1))
        rotations[1] = Rotation.from_rotvec([0.0, np.radians(angle_deg), 0.0]).as_matrix()
        np.testing.assert_array_equal(score_triplets(3, relative_of(pairs, rotations)), expected)
