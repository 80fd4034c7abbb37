"""Poses of pairs from rays: right within what their information says, and never NaN."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from sfm_shapefit.base.geometry import angle_between_deg, normalized, rotation_angles_deg
from sfm_shapefit.pairs.two_view_poses import refine_two_view_poses
from sfm_shapefit.scene.matches import RayMatches

PIXEL = 1e-3
ROTATION = Rotation.from_rotvec([0.1, -0.3, 0.05]).as_matrix()
TRANSLATION = normalized(np.array([1.0, 0.2, 0.1]))


def made(num_pairs, num_matches, noise_px=0.0, num_false=0, seed=0, baseline=1.0, depths=(4.0, 9.0)):
    """Matches of pairs that all have one pose; the first matches of a pair are false."""
    rng = np.random.default_rng(seed)
    shape = (num_pairs, num_matches)
    points = np.dstack([rng.uniform(-0.5, 0.5, (*shape, 2)), np.ones(shape)])
    points *= rng.uniform(*depths, (*shape, 1))
    rays = [normalized(x) for x in (points, points @ ROTATION.T + baseline * TRANSLATION)]
    rays = [normalized(x + noise_px * PIXEL * rng.normal(size=x.shape)) for x in rays]
    rays[1][:, :num_false] = np.roll(rays[1][:, :num_false], 1, axis=1)
    return matches_of(*rays)


FIELDS = ("rotations", "translations", "information", "weight_shares", "num_matches")


def matches_of(rays_i, rays_j):
    """Matches of pairs from rays (k, n, 3)."""
    k, n, _ = rays_i.shape
    return RayMatches(
        pairs=np.tile([0, 1], (k, 1)),
        offsets=np.arange(k + 1) * n,
        rays_i=rays_i.reshape(-1, 3),
        rays_j=rays_j.reshape(-1, 3),
        pixel_angles=np.full(k, PIXEL),
    )


def refine(matches, turn_deg=0.0, swing_deg=0.0, **settings):
    """Refine from a start that is so far off."""
    k = len(matches.pairs)
    turn = Rotation.from_rotvec(np.radians(turn_deg) * normalized(np.array([1.0, -1.0, 2.0]))).as_matrix()
    swing = Rotation.from_rotvec(np.radians(swing_deg) * np.array([0.0, 0.0, 1.0])).as_matrix()
    start = np.tile(turn @ ROTATION, (k, 1, 1)), np.tile(swing @ TRANSLATION, (k, 1))
    return refine_two_view_poses(matches, *start, **settings)


def squared_lengths(poses):
    """The squared Mahalanobis lengths of the errors of rotations."""
    errors = Rotation.from_matrix(poses.rotations @ ROTATION.T).as_rotvec()
    return errors, np.einsum("ki,kij,kj->k", errors, poses.information, errors)


def test_exact_matches_give_the_exact_pose():
    poses = refine(made(3, 40), turn_deg=2.0, swing_deg=10.0)
    assert rotation_angles_deg(poses.rotations @ ROTATION.T).max() < 1e-8
    assert angle_between_deg(poses.translations, TRANSLATION).max() < 1e-7
    np.testing.assert_allclose(poses.weight_shares, 1.0, atol=1e-12)
    np.testing.assert_allclose(
        poses.rotations @ poses.rotations.transpose(0, 2, 1), [np.eye(3)] * 3, atol=1e-14
    )


@pytest.mark.parametrize("num_false", [0, 20])
def test_rotations_are_within_what_their_information_says(num_false):
    poses = refine(made(300, 100, noise_px=0.5, num_false=num_false), turn_deg=0.1, swing_deg=2.0)
    _, lengths = squared_lengths(poses)
    # One in a million for each pair, and twice that for what 100 matches do not tell of the noise, or for a
    # false match that happens to lie on its line.
    assert lengths.max() < 2.0 * chdtri(3, 1e-6)
    assert np.median(lengths) < 1.1 * chdtri(3, 0.5)
    # A false match has weight 0 unless it happens to lie on its line.
    expected = 0.85 * (1.0 - num_false / 100)
    assert expected - 0.05 < poses.weight_shares.mean() < expected + 0.05


def test_the_information_is_the_inverse_of_the_covariance():
    poses = refine(made(2000, 100, noise_px=0.5))
    errors, lengths = squared_lengths(poses)
    said = np.median(poses.information, axis=0)
    ratios = np.linalg.eigvals(said @ errors.T @ errors).real / len(errors)
    # The standard deviation of each is sqrt(2 / 2000) = .03; the median noise is a little too large.
    assert 0.85 < ratios.min() < ratios.max() < 1.1
    assert lengths.mean() / 3.0 == pytest.approx(1.0, abs=0.1)
    # A mean of 2000 errors has the standard deviation of one over sqrt(2000): there is no bias.
    assert np.abs(errors.mean(axis=0) / errors.std(axis=0)).max() < 4.0 / np.sqrt(len(errors))


def test_a_descent_ends_where_no_small_change_lowers_the_residuals():
    """Differences of a pose in any direction, against the Sampson errors by their formula."""
    matches, rng = made(6, 40, noise_px=0.2, seed=3), np.random.default_rng(4)
    poses = refine(matches, turn_deg=1.0, swing_deg=5.0)

    def cost(pair, rotation, translation):
        rows = slice(matches.offsets[pair], matches.offsets[pair + 1])
        x, b = matches.rays_i[rows] @ rotation.T, matches.rays_j[rows]
        ends = np.sum(np.cross(x, translation) ** 2, axis=1) + np.sum(np.cross(b, translation) ** 2, axis=1)
        return np.sum((np.cross(x, b) @ translation) ** 2 / ends)

    for pair, (rotation, translation) in enumerate(zip(poses.rotations, poses.translations, strict=True)):
        for size in (3e-3, 1e-2):  # radians; the robust weights move the minimum by less
            turn = Rotation.from_rotvec(size * normalized(rng.normal(size=(20, 3)))).as_matrix()
            moved = normalized(translation + size * rng.normal(size=(20, 3)))
            least = min(cost(pair, t @ rotation, m) for t, m in zip(turn, moved, strict=True))
            assert cost(pair, rotation, translation) < least


def test_neither_threads_nor_batches_change_a_bit():
    matches = made(7, 50, noise_px=0.5, num_false=10)
    whole, shared = refine(matches, 1.0, 5.0), refine(matches, 1.0, 5.0, threads=3)
    single = [
        refine(
            matches_of(*(r.reshape(7, 50, 3)[k : k + 1] for r in (matches.rays_i, matches.rays_j))), 1.0, 5.0
        )
        for k in range(7)
    ]
    for name in FIELDS:
        found, parts = getattr(whole, name), [getattr(pose, name) for pose in single]
        np.testing.assert_array_equal(found, getattr(shared, name), err_msg=name)
        np.testing.assert_array_equal(found, np.concatenate(parts), err_msg=name)


def degenerate():
    """Matches that leave something undetermined, by name."""
    some = made(4, 30, noise_px=0.5)
    along = np.tile(TRANSLATION, (4, 30, 1))
    a, b = some.rays_i.reshape(4, 30, 3), some.rays_j.reshape(4, 30, 3)
    return {
        "pure rotation": made(4, 30, baseline=0.0),
        "noisy pure rotation": made(4, 30, noise_px=0.5, baseline=0.0),
        "plane": made(4, 30, noise_px=0.5, depths=(6.0, 6.0)),
        "eight": made(4, 8, noise_px=0.5),
        "five": made(4, 5, noise_px=0.5),
        "one": made(4, 1),
        "none": made(4, 0),
        "no pairs": made(0, 30),
        "one ray": matches_of(np.repeat(a[:, :1], 30, axis=1), np.repeat(b[:, :1], 30, axis=1)),
        "one ray and many": matches_of(np.repeat(a[:, :1], 30, axis=1), b),
        "along the baseline": matches_of(along @ ROTATION, along),
        "opposite": matches_of(a, -a),
        "random": matches_of(a, np.roll(b, 7, axis=1)),
    }


@pytest.mark.parametrize("case", degenerate())
def test_degenerate_matches_give_finite_answers(case):
    poses = refine(degenerate()[case], turn_deg=1.0, swing_deg=5.0)
    for name in FIELDS:
        assert np.isfinite(getattr(poses, name)).all()
    unit = poses.rotations @ poses.rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(unit, np.broadcast_to(np.eye(3), unit.shape), atol=1e-13)
    np.testing.assert_allclose(np.linalg.norm(poses.translations, axis=1), 1.0, atol=1e-14)
    assert (np.linalg.eigvalsh(poses.information) > 0.99).all()  # (1 rad)^-2, and rounding
    assert (poses.weight_shares >= 0.0).all()
    assert (poses.weight_shares <= 1.0).all()


def test_a_pure_rotation_is_determined_though_its_translation_is_not():
    poses = refine(made(50, 100, noise_px=0.5, baseline=0.0), turn_deg=0.2)
    _, lengths = squared_lengths(poses)
    assert np.median(lengths) < 2.0 * chdtri(3, 0.5)
    # A pixel is 0.06 degrees; the translation takes the part of most matches that tells of two axes.
    assert np.median(rotation_angles_deg(poses.rotations @ ROTATION.T)) < 0.06


def test_information_stays_positive_where_it_is_rounding_and_where_it_is_huge():
    # One match, repeated, determines nothing once the translation is eliminated, and rounding is left.
    rays = np.random.default_rng(0).normal(size=(2, 20, 1, 3))
    matches = matches_of(*normalized(np.repeat(rays, 30, axis=2)))
    sharp = dataclasses.replace(matches, pixel_angles=np.full(20, 1e-9))
    assert (np.linalg.eigvalsh(refine(sharp).information) > 0.0).all()
    # Matches that fit, so that their weights are not 0.
    exact = dataclasses.replace(made(20, 30), pixel_angles=np.full(20, 1e-9))
    values = np.linalg.eigvalsh(refine(exact).information)
    assert values.max() > 1e18
    assert (values > 0.0).all()
