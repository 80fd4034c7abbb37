"""Rotation averaging: exact where the pairs allow it, robust to wrong ones, silent about nobody."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.rotations.rotation_averaging import average_rotations


def problem(n=20, p=0.9, wrong=0.0, seed=3):
    """Random true rotations, pairs, and relative rotations, a share of them random."""
    rng = np.random.default_rng(seed)
    truth = Rotation.random(n, random_state=rng).as_matrix()
    i, j = np.triu_indices(n, 1)
    kept = rng.random(len(i)) < p
    pairs = np.column_stack([i, j])[kept]
    rotations = truth[pairs[:, 1]] @ truth[pairs[:, 0]].swapaxes(1, 2)
    bad = rng.random(len(pairs)) < wrong
    rotations[bad] = Rotation.random(int(bad.sum()), random_state=rng).as_matrix()
    return truth, pairs, rotations


def errors_deg(found, truth):
    """Angle of each rotation to the truth, after the world is turned as the first one says."""
    common = found[0].T @ truth[0]
    return np.degrees(Rotation.from_matrix((found @ common) @ truth.swapaxes(1, 2)).magnitude())


@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_rotations_are_recovered_up_to_one_of_the_world(wrong):
    truth, pairs, rotations = problem(wrong=wrong)
    found, registered = average_rotations(20, pairs, rotations)
    assert registered.all()
    # The steps end at 1e-3 rad; wrong pairs keep a small weight in Geman-McClure.
    assert errors_deg(found, truth).max() < (0.01 if wrong == 0.0 else 0.5)


def test_the_same_input_gives_the_same_rotations():
    _, pairs, rotations = problem(wrong=0.3)
    one, two = (average_rotations(20, pairs, rotations, np.arange(len(pairs)))[0] for _ in range(2))
    np.testing.assert_array_equal(one, two)


def test_a_camera_that_no_pair_ties_has_no_rotation_and_what_cannot_be_averaged_is_refused():
    _, pairs, rotations = problem()
    found, registered = average_rotations(22, pairs, rotations)
    assert registered.tolist() == [True] * 20 + [False] * 2
    np.testing.assert_array_equal(found[20:], np.tile(np.eye(3), (2, 1, 1)))
    with pytest.raises(InputError, match="without relative rotations"):
        average_rotations(20, pairs[:0], rotations[:0])
    with pytest.raises(InputError, match=r"outside 0\.\.9"):
        average_rotations(10, pairs, rotations)
