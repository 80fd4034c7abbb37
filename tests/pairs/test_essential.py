"""Relative rotations of pairs: right, the same in any batches, and none where there can be none."""

import dataclasses

import numpy as np
import pytest

from sfm_shapefit.base.geometry import normalized, rotation_angles_deg
from sfm_shapefit.files.colmap.database_images import read_images
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.pairs.essential import (
    LikelyPoses,
    concatenate_rotations,
    estimate_relative_rotations,
    have_many_pairs,
)
from sfm_shapefit.scene.matches import MatchBatch, Reading
from tests.problems import turn
from tests.scenes import COURTYARD, read_from, real_scene, view_of

MOVE, FORWARD = np.array([1.0, 0.2, 0.0]), np.array([0.0, 0.0, 1.0])


def unposed(path):
    return read_from(path, read_images).images.apart()


def batches(path, max_matches=2_000_000):
    model = unposed(path)
    with view_of(path, model, reading=Reading(batch=max_matches)) as view:
        return model, list(view.batches(15))


def errors_deg(found, truth):
    i, j = found.pairs.T
    true = truth[j] @ truth[i].transpose(0, 2, 1)
    return rotation_angles_deg(found.rotations.transpose(0, 2, 1) @ true)


def assert_same_bits(a, b):
    for field in dataclasses.fields(a):
        np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name), err_msg=field.name)


def batch_of(rays_i, rays_j, pixel_angle=1e-3):
    """A batch of pairs from rays (k, n, 3)."""
    k, n, _ = rays_i.shape
    return MatchBatch(
        pairs=np.column_stack([np.zeros(k, dtype=np.int64), np.arange(1, k + 1)]),
        offsets=np.arange(k + 1) * n,
        rays_i=rays_i.reshape(-1, 3),
        rays_j=rays_j.reshape(-1, 3),
        pixel_angles=np.full(k, pixel_angle),
        keypoints=np.zeros((k * n, 2), dtype=np.int64),
    )


def test_rotations_of_the_courtyard_are_right():
    model, (batch,) = batches(COURTYARD / "database.db")
    truth = read_model(COURTYARD / "sparse" / "0").images
    assert truth.names == model.names
    found = estimate_relative_rotations(batch)
    np.testing.assert_array_equal(found.pairs, batch.pairs)
    np.testing.assert_array_equal(found.num_matches, np.diff(batch.offsets))
    errors = errors_deg(found, truth.rotations)
    sound = found.are_sound()
    assert sound.mean() > 0.9
    # Half a pixel of noise is 0.03 degrees and more, over the square root of at least 15 matches.
    assert np.median(errors[sound]) < 0.1
    assert np.mean(errors[sound] < 5.0) > 0.97


def test_neither_threads_nor_batches_change_a_bit():
    path = COURTYARD / "database.db"
    _, (whole,) = batches(path)
    found = estimate_relative_rotations(whole)
    assert len(found.pairs) > 2 * 64  # slices
    assert_same_bits(estimate_relative_rotations(whole, threads=3), found)
    _, parts = batches(path, max_matches=3000)
    assert len(parts) > 5
    assert_same_bits(concatenate_rotations([estimate_relative_rotations(part) for part in parts]), found)


def test_each_of_many_pairs_is_tried_less_often_and_is_right_all_the_same():
    truth = read_model(COURTYARD / "sparse" / "0").images
    _, (batch,) = batches(COURTYARD / "database.db")
    rng = np.random.default_rng(0)
    wrong = np.flatnonzero(rng.random(len(batch.rays_j)) < 0.3)  # 0.7^5: a trial in six is without
    batch.rays_j[wrong] = batch.rays_j[rng.permutation(wrong)]
    usual = estimate_relative_rotations(batch)
    found = estimate_relative_rotations(batch, are_many=True)
    right, before = (errors_deg(one, truth.rotations) < 5.0 for one in (found, usual))
    assert right.sum() > 0.97 * before.sum()
    assert (found.rotations != usual.rotations).any()  # else no trial was saved


@pytest.mark.parametrize(
    ("num_images", "num_pairs", "are_many"),
    [
        (10_000, 20_000, False),
        (10_000, 20_001, True),
        (363, 9_075, False),
        (363, 9_076, True),
        (51, 1_275, False),
    ],
)
def test_pairs_are_many_in_all_or_by_fifty_an_image(num_images, num_pairs, are_many):
    assert have_many_pairs(num_images, num_pairs) == are_many


def test_where_matches_fit_a_likely_pose_there_are_no_trials_and_elsewhere_it_changes_no_bit():
    truth = read_model(COURTYARD / "truth").images
    _, (batch,) = batches(COURTYARD / "database.db")
    i, j = batch.pairs.T
    offsets = truth.centers[i] - truth.centers[j]
    rotations = truth.rotations[j] @ truth.rotations[i].transpose(0, 2, 1)
    translations = normalized(np.einsum("kab,kb->ka", truth.rotations[j], offsets))
    rotations[1::3] = rotations[1::3] @ turn(np.array([0.0, 1.0, 0.0]), 20.0)
    translations[2::3] = np.nan
    without = estimate_relative_rotations(batch)
    likely = LikelyPoses(rotations, translations, np.full(len(rotations), 0.6))
    found = estimate_relative_rotations(batch, likely=likely)
    # A descent from the likely pose ends with other last digits than one from a trial's.
    is_tried = (found.rotations == without.rotations).all(axis=(1, 2))
    assert is_tried[2::3].all()
    assert is_tried[1::3].any()  # the others come back to their matches
    assert is_tried[::3].mean() < 0.2  # false pairs
    assert_same_bits(found.subset(is_tried), without.subset(is_tried))
    # Both ways end at the minimum, within what a last step may move.
    close = rotation_angles_deg(found.rotations.transpose(0, 2, 1) @ without.rotations)
    assert np.quantile(close[~is_tried], 0.95) < 1e-3
    assert_same_bits(estimate_relative_rotations(batch, threads=3, likely=likely), found)


@pytest.mark.parametrize("field_deg", [60.0, 170.0, 300.0])
def test_rays_to_any_side_are_used(field_deg):
    rng = np.random.default_rng(1)
    angles = np.radians(field_deg / 2.0) * np.sqrt(rng.random((4, 80)))
    turns = rng.uniform(0.0, 2.0 * np.pi, (4, 80))
    rays = np.stack([np.sin(angles) * np.cos(turns), np.sin(angles) * np.sin(turns), np.cos(angles)], axis=2)
    points = rays * rng.uniform(3.0, 6.0, (4, 80, 1))
    found = estimate_relative_rotations(batch_of(rays, normalized(points + MOVE)))
    assert len(found.pairs) == 4
    assert rotation_angles_deg(found.rotations).max() < 1e-6
    np.testing.assert_allclose(found.weight_shares, 1.0, atol=1e-9)


def test_pairs_without_a_pose_are_left_out_and_no_other():
    rng = np.random.default_rng(2)
    points = rng.uniform(-1.0, 1.0, (5, 40, 3)) + 4.0 * FORWARD
    rays_i, rays_j = normalized(points), normalized(points + MOVE)
    rays_i[1], rays_j[1] = rays_i[1, 0], rays_j[1, 0]  # one and the same match
    rays_j[3] = rays_i[3]  # a camera that stays as it is
    found = estimate_relative_rotations(batch_of(rays_i, rays_j))
    assert found.pairs[:, 1].tolist() == [1, 3, 4, 5]
    assert rotation_angles_deg(found.rotations).max() < 1e-6
    for field in dataclasses.fields(found):
        assert np.isfinite(getattr(found, field.name)).all()


@pytest.mark.parametrize(("num_pairs", "num_matches"), [(0, 20), (3, 0), (3, 4)])
def test_where_nothing_can_be_estimated_there_are_no_pairs(num_pairs, num_matches):
    rays = normalized(np.random.default_rng(0).normal(size=(num_pairs, num_matches, 3)))
    found = estimate_relative_rotations(batch_of(rays, rays))
    assert found.rotations.shape == (0, 3, 3)
    assert found.information.shape == (0, 3, 3)
    assert found.are_sound().shape == (0,)


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "least_right"), [("castle-P30", 229), ("lego100", 715)])
def test_pairs_of_real_scenes_are_right(scene, least_right):
    """Measured: 230 and 727 pairs within 5 degrees of the truth."""
    folder = real_scene(scene)
    model, (batch,) = batches(folder / "database.db")
    truth = read_model(folder / "gt").images
    assert truth.names == model.names
    errors = errors_deg(estimate_relative_rotations(batch), truth.rotations)
    assert (errors < 5.0).sum() >= least_right
