"""AUC of relative poses, ATE and RPE: exact answers of small cases."""

import numpy as np
import pytest

from sfm_shapefit.scene import pose_errors
from sfm_shapefit.scene.evaluation import evaluate_poses
from sfm_shapefit.scene.pose_errors import (
    NamedPoses,
    area_under_recall,
    relative_pose_errors,
    trajectory_errors,
)
from tests.problems import random_rotations, turn


def numbered(rotations: np.ndarray, centers: np.ndarray) -> NamedPoses:
    return NamedPoses(tuple(f"{k}.jpg" for k in range(len(centers))), rotations, centers)


def poses(seed: int, n: int) -> NamedPoses:
    rng = np.random.default_rng(seed)
    return numbered(random_rotations(rng, n), rng.normal(size=(n, 3)))


def test_the_area_under_the_recall_is_that_of_its_trapezoids():
    # Recall of four: 1/4 from error 1 on, 1/2 from 3 on, and never more, for two are missing.
    assert area_under_recall(np.array([3.0, 1.0]), 2, (4.0, 2.0, 0.5)) == pytest.approx(
        [(0.125 + 0.75 + 0.5) / 4.0, (0.125 + 0.25) / 2.0, 0.0], rel=1e-15
    )
    assert area_under_recall(np.zeros(5), 0, (1.0,)) == [1.0]
    assert area_under_recall(np.zeros(3), 3, (1.0,)) == [0.5]


def test_a_turned_camera_spoils_its_own_pairs_by_its_angle_in_any_world():
    truth = poses(0, 6)
    rotations = truth.rotations.copy()
    rotations[2] = turn(np.array([1.0, 2.0, 3.0]), 12.5) @ rotations[2]
    world = random_rotations(np.random.default_rng(1), 1)[0]
    model = numbered(rotations @ world.T, 7.0 * truth.centers @ world.T + 3.0)
    errors = relative_pose_errors(model, truth, extent=3.0)
    first, second = np.triu_indices(6, 1)
    own = (first == 2) | (second == 2)
    np.testing.assert_allclose(errors[own], 12.5, atol=1e-9)
    np.testing.assert_allclose(errors[~own], 0.0, atol=1e-6)


def test_the_direction_counts_where_it_is_the_larger_and_not_between_cameras_at_one_place():
    rotations = np.tile(np.eye(3), (3, 1, 1))
    truth = numbered(rotations, np.array([[0.0, 0, 0], [1.0, 0, 0], [0.0, 0, 0]]))
    model = numbered(rotations, np.array([[0.0, 0, 0], [1.0, 1.0, 0], [0.0, 0, 5.0]]))
    errors = relative_pose_errors(model, truth, extent=1.0)
    between_1_and_2 = np.degrees(np.arccos(1.0 / np.sqrt(27.0)))  # (-1, -1, 5) against (-1, 0, 0)
    np.testing.assert_allclose(errors, [45.0, 0.0, between_1_and_2], atol=1e-12)
    collapsed = numbered(rotations, np.zeros((3, 3)))
    assert relative_pose_errors(collapsed, truth, extent=1.0).tolist() == [180.0, 0.0, 180.0]


def test_missing_cameras_fail_in_all_their_pairs():
    truth = poses(3, 10)
    found = evaluate_poses(truth.taken(np.arange(6)), truth)
    for auc in found.relative_pose_aucs:
        assert auc.auc == pytest.approx(15 / 45, abs=1e-6)
    assert [auc.threshold_deg for auc in found.relative_pose_aucs] == [0.5, 1.0, 5.0, 10.0]
    assert found.recalls[0].auc == pytest.approx(0.6, abs=1e-9)
    assert found.trajectory is None


def test_of_many_cameras_so_many_pairs_are_drawn_with_the_same_area(monkeypatch):
    truth = poses(4, 60)
    rotations = truth.rotations.copy()
    rotations[:6] = turn(np.array([0.0, 0.0, 1.0]), 90.0) @ rotations[:6]
    model = numbered(rotations, truth.centers)
    all_pairs = relative_pose_errors(model, truth, extent=5.0)
    monkeypatch.setattr(pose_errors, "MOST_COMPARED_PAIRS", 1000)
    some = relative_pose_errors(model, truth, extent=5.0)
    assert len(all_pairs) == 1770
    assert len(some) == 1000
    # A share of 0.19 of 1,000 draws has a standard deviation of 0.012.
    assert np.mean(some > 1.0) == pytest.approx(np.mean(all_pairs > 1.0), abs=0.05)


def test_ate_and_rpe_of_a_bent_square_are_those_computed_by_hand():
    """Corners of a square, up and down by 1 in turn: by least squares the scale is 2/3, nothing is turned."""
    square = np.array([[1.0, 1, 0], [-1.0, 1, 0], [-1.0, -1, 0], [1.0, -1, 0]])
    bend = np.array([[0.0, 0, 1], [0.0, 0, -1], [0.0, 0, 1], [0.0, 0, -1]])
    rotations = random_rotations(np.random.default_rng(2), 4)
    turned = rotations.copy()
    turned[3] = turn(np.array([1.0, 0.0, 0.0]), 10.0) @ turned[3]
    world = random_rotations(np.random.default_rng(5), 1)[0]
    model = numbered(turned @ world.T, 4.0 * (square + bend) @ world.T - 8.0)
    found = trajectory_errors(model, numbered(rotations, square))
    assert found.ate.rms == pytest.approx(np.sqrt(2.0 / 3.0), abs=1e-12)
    assert found.ate.max == pytest.approx(found.ate.median, abs=1e-12)
    # A side of 2 became 4/3 long and rises by 4/3.
    assert found.rpe.rms == pytest.approx(np.sqrt((2.0 / 3.0) ** 2 + (4.0 / 3.0) ** 2), abs=1e-12)
    assert found.rpe_rotation_deg.max == pytest.approx(10.0, abs=1e-9)
    assert found.rpe_rotation_deg.median == pytest.approx(0.0, abs=1e-9)


def test_a_trajectory_follows_the_names_whatever_the_order_of_the_cameras():
    line = np.arange(5.0)[:, None] * [1.0, 0.2, 0.0] + [[0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 2, 0], [0, 0, 3]]
    rotations = np.tile(np.eye(3), (5, 1, 1))
    names = np.array([f"{k}.jpg" for k in range(5)])
    moved = line.copy()
    moved[2] += [0.0, 0.5, 0.0]
    order = np.array([3, 0, 4, 2, 1])
    found = [
        evaluate_poses(
            NamedPoses(names.tolist(), rotations, moved),
            NamedPoses(names[o].tolist(), rotations[o], line[o]),
            trajectory=True,
        ).trajectory
        for o in (np.arange(5), order)
    ]
    assert found[0].rpe.rms == pytest.approx(found[1].rpe.rms, rel=1e-12)
    assert found[0].rpe.rms > 0.1
