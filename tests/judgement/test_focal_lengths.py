"""A camera whose focal length is wrong is named, and no other; without an error nobody is."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.judgement.focal_lengths import Lenses, doubt_focal_lengths
from sfm_shapefit.scene.matches import RayMatches
from tests.problems import all_pairs, random_rotations

FOCAL_PX = 900.0
IMAGES = 12


def seen(rng, centers, rotations, pairs, lenses, factors, count):
    """Matches of cameras that see points near the origin, read with focal lengths off by a factor each."""
    read = ([], [])
    for i, j in pairs.tolist():
        points = rng.uniform(-2.0, 2.0, (count, 3))
        for rays, k in zip(read, (i, j), strict=True):
            inside, angular = (points - centers[k]) @ rotations[k].T, lenses.is_angular[k]
            angles = np.arctan2(np.hypot(inside[:, 0], inside[:, 1]), inside[:, 2])
            radius = FOCAL_PX * (angles if angular else np.tan(angles))
            pixels = radius[:, None] * normalized(inside[:, :2]) + 0.3 * rng.standard_normal((count, 2))
            off = np.hypot(*pixels.T) / (FOCAL_PX * factors[lenses.camera_of[k]])
            off = off if angular else np.arctan(off)
            rays.append(np.column_stack([np.sin(off)[:, None] * normalized(pixels), np.cos(off)]))
    given = RayMatches(
        pairs=pairs,
        offsets=count * np.arange(len(pairs) + 1),
        rays_i=np.concatenate(read[0]),
        rays_j=np.concatenate(read[1]),
        pixel_angles=np.full(len(pairs), 1.0 / FOCAL_PX),
    )
    return given, rotations, lenses


def lenses_of(camera_of, factors, angular=False):
    return Lenses(camera_of, FOCAL_PX * np.array(factors)[camera_of], np.full(IMAGES, angular))


def matches(factors, seed, *, angular=False, count=60):
    """Matches of images of three cameras around a scene, read with focal lengths off by factors (3,)."""
    rng = np.random.default_rng(seed)
    centers = 8.0 * normalized(rng.standard_normal((IMAGES, 3)) * [1.0, 1.0, 0.3])
    forward = -normalized(centers + 0.3 * rng.standard_normal((IMAGES, 3)))
    side = normalized(np.cross(forward, random_rotations(rng, IMAGES)[:, 0]))
    rotations = np.stack([side, np.cross(forward, side), forward], axis=1)
    lenses = lenses_of(np.arange(IMAGES) % 3, factors, angular)
    return seen(rng, centers, rotations, np.array(all_pairs(IMAGES)), lenses, factors, count)


@pytest.mark.parametrize("angular", [False, True])
@pytest.mark.parametrize("factor", [0.42, 0.9, 1.1, 1.3, 2.4])
def test_a_camera_with_a_wrong_focal_length_is_named_with_the_right_one(factor, angular):
    found = doubt_focal_lengths(*matches([1.0, factor, 1.0], 1, angular=angular))
    assert [doubt.camera for doubt in found] == [1]
    # The factors that are tried are 5 % apart or less near the best one.
    assert factor * found[0].factor == pytest.approx(1.0, rel=0.06)


def ring_about_an_object(factors, seed, count=30):
    """Matches of images whose optical axes meet: without rotations, two views hardly tell focal lengths."""
    angles = np.linspace(0.0, 2.0 * np.pi, IMAGES, endpoint=False)
    centers = np.stack([8.0 * np.cos(angles), 8.0 * np.sin(angles), np.zeros(IMAGES)], axis=1)
    forward, down = -centers / 8.0, np.tile([0.0, 0.0, -1.0], (IMAGES, 1))
    rotations = np.stack([np.cross(down, forward), down, forward], axis=1)
    pairs = np.array([(i, j) for i, j in all_pairs(IMAGES) if min(j - i, IMAGES - j + i) < 4])
    lenses = lenses_of((np.arange(IMAGES) % 3 == 0).astype(np.int64), factors)
    return seen(np.random.default_rng(seed), centers, rotations, pairs, lenses, factors, count)


@pytest.mark.parametrize(("wrong", "factor"), [(0, 0.9), (1, 0.42), (1, 1.1)])
def test_of_a_ring_about_an_object_the_camera_that_is_wrong_is_named(wrong, factor):
    factors = [1.0, 1.0]
    factors[wrong] = factor
    found = doubt_focal_lengths(*ring_about_an_object(factors, 4))
    assert [doubt.camera for doubt in found] == [wrong]
    assert factor * found[0].factor == pytest.approx(1.0, rel=0.06)


def test_a_wrong_rotation_is_not_taken_for_a_wrong_focal_length():
    """Of a camera that took a single image, and of one that took several."""
    rays, rotations, lenses = ring_about_an_object([1.0, 1.0], 5)
    vectors = np.radians(1.0) * np.random.default_rng(0).standard_normal((IMAGES, 3))
    turned = Rotation.from_rotvec(vectors).as_matrix() @ rotations
    assert doubt_focal_lengths(rays, turned, lenses) == ()
    rotations[4] = turned[4]
    assert doubt_focal_lengths(rays, rotations, lenses._replace(camera_of=np.arange(IMAGES))) == ()


def test_without_an_error_or_for_a_single_camera_nobody_is_named():
    assert doubt_focal_lengths(*matches([1.0, 1.0, 1.0], 3)) == ()
    rays, rotations, lenses = matches([1.2, 1.2, 1.2], 3)
    assert (
        doubt_focal_lengths(rays, rotations, lenses._replace(camera_of=np.zeros(IMAGES, dtype=np.int64)))
        == ()
    )
