"""Relative rotations of frames from those of their images: exact, joined, and without what contradicts."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.rotations.frames import relative_rotations_of_frames

FRAME_OF_IMAGE = np.array([0, 0, 1, 1, 2, 2])
ROWS = [(0, 1), (0, 2), (0, 3), (1, 3), (1, 4), (2, 5)]


def problem(*, noisy=False, seed=0, frame_of_image=FRAME_OF_IMAGE):
    """Two sensors in each of three frames, pairs of images, and the true rotations of the frames."""
    rng = np.random.default_rng(seed)
    frames = Rotation.random(3, rng).as_matrix()
    sensors = Rotation.random(2, rng).as_matrix()[[0, 1, 0, 1, 0, 1]]
    images = sensors @ frames[frame_of_image]
    i, j = np.array(ROWS).T
    spread = 1e-3 * rng.uniform(0.5, 2.0, (len(ROWS), 3))
    errors = spread * rng.standard_normal(spread.shape) if noisy else np.zeros_like(spread)
    turned = Rotation.from_rotvec(errors).as_matrix()
    relative = RelativeRotations(
        pairs=np.array(ROWS),
        rotations=turned @ images[j] @ images[i].transpose(0, 2, 1),
        information=np.array([np.diag(row**-2.0) for row in spread]),
        num_matches=np.array([100, 50, 60, 70, 80, 90]),
        weight_shares=np.full(len(ROWS), 0.8),
    )
    return relative, sensors, frames


def expected(frames, pairs):
    return frames[pairs[:, 1]] @ frames[pairs[:, 0]].transpose(0, 2, 1)


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0, 1], [2, 1, 0]])
def test_exact_pairs_of_images_give_the_exact_frames_whatever_their_numbers(order):
    numbers = np.array(order)[FRAME_OF_IMAGE]
    relative, sensors, frames = problem(frame_of_image=numbers)
    found = relative_rotations_of_frames(relative, numbers, sensors)
    assert found.pairs.tolist() == [[0, 1], [0, 2], [1, 2]]
    np.testing.assert_allclose(found.rotations, expected(frames, found.pairs), atol=1e-12)
    assert found.num_matches.sum() == 350  # all but those inside a frame


def test_a_pair_that_contradicts_the_richest_has_no_part():
    relative, sensors, frames = problem()
    relative.rotations[2] = relative.rotations[2] @ Rotation.from_rotvec([0.0, 1.0, 0.0]).as_matrix()
    found = relative_rotations_of_frames(relative, FRAME_OF_IMAGE, sensors)
    np.testing.assert_allclose(found.rotations, expected(frames, found.pairs), atol=1e-12)
    assert found.num_matches.tolist() == [120, 80, 90]


def test_joined_pairs_scatter_as_their_information_says():
    squares = []
    for seed in range(200):
        relative, sensors, frames = problem(noisy=True, seed=seed)
        found = relative_rotations_of_frames(relative, FRAME_OF_IMAGE, sensors)
        off = Rotation.from_matrix(
            found.rotations @ expected(frames, found.pairs).transpose(0, 2, 1)
        ).as_rotvec()
        squares.append(np.einsum("ka,kab,kb->k", off, found.information, off))
    # Means of 200 chi squares of three degrees of freedom: 3 +- sqrt(6 / 200).
    np.testing.assert_allclose(np.mean(squares, axis=0), 3.0, atol=4.0 * np.sqrt(6.0 / 200.0))
