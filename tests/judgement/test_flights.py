"""Cameras that fly off or leap are named, and no others, whatever way the photographer went."""

import numpy as np
import pytest

from sfm_shapefit.judgement.flights import find_flights
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import Lens

SEEDS = range(12)
COUNT = 60


def walk(rng, count=COUNT):
    """Steps of about one, in directions that change slowly."""
    heading = np.cumsum(rng.normal(0.0, 0.15, count))
    return np.cumsum(np.c_[np.cos(heading), np.sin(heading), rng.normal(0.0, 0.1, count)], axis=0)


def extent(centers):
    return np.linalg.norm(np.ptp(centers, axis=0))


def flights(centers, names=None):
    """What is named, and what is said."""
    count = len(centers)
    names = [f"frame{k:04}.jpg" for k in range(count)] if names is None else names
    turns = np.tile(np.eye(3), (count, 1, 1))
    lens = Lens("SIMPLE_PINHOLE", (800.0, 500.0, 400.0), width=1000, height=800)
    images = Images.listed(names, (turns, centers), [0] * count, [lens])
    found = list(find_flights(images))
    return sorted(names.index(name) for one in found for name in one.images), " ".join(
        one.what for one in found
    )


def unit(rng):
    direction = rng.normal(size=3)
    return direction / np.linalg.norm(direction)


@pytest.mark.parametrize("num", [1, 2])
def test_images_of_a_video_that_leap_are_named_and_no_others(num):
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        centers = walk(rng)
        first = int(rng.integers(5, COUNT - 5))
        centers[first : first + num] += 0.4 * extent(centers) * unit(rng)
        assert flights(centers)[0] == list(range(first, first + num))


def sound_ways(rng):
    """Orders of images that are no single path, or a path with pauses and jumps one way."""
    clip, other = walk(rng), walk(rng) + rng.normal(0.0, 30.0, 3)
    turns = np.linspace(0.0, 2.0 * np.pi, COUNT, endpoint=False)
    strips = np.array([[x, y, 0.0] for x in range(8) for y in range(10)])
    yield clip
    yield clip[rng.permutation(COUNT)]
    yield rng.uniform(-1.0, 1.0, (COUNT, 3))
    yield np.concatenate([clip, other])
    yield np.stack(
        [clip, clip + np.array([0.0, 0.0, 5.0]), clip - np.array([0.0, 0.0, 9.0])], axis=1
    ).reshape(-1, 3)
    yield np.concatenate([rng.normal(0.0, 0.02, (COUNT, 3)), clip])  # on the spot, then away
    yield np.c_[np.cos(turns), np.sin(turns), np.zeros(COUNT)]
    yield strips + rng.normal(0.0, 0.05, strips.shape)


def test_no_sound_way_of_taking_pictures_is_a_leap_or_a_flight():
    for seed in SEEDS:
        for centers in sound_ways(np.random.default_rng(seed)):
            assert flights(centers) == ([], "")


def test_frames_that_are_missing_between_two_explain_a_long_way():
    out = np.c_[np.arange(21.0), np.zeros((21, 2))]
    there_and_back = np.concatenate([out, [[30.0, 0.0, 0.0]], out[::-1]])
    slow, fast = ([*range(21), 20 + gap, *range(20 + 2 * gap, 41 + 2 * gap)] for gap in (10, 1))
    assert flights(there_and_back, [f"{k:05}.png" for k in slow])[0] == []
    assert flights(there_and_back, [f"{k:05}.png" for k in fast])[0] == [21]


def test_a_camera_at_rest_in_a_large_scene_does_not_leap():
    rng = np.random.default_rng(5)
    rest = rng.normal(0.0, 1e-4, (20, 3))
    rest[7] += 0.02
    names = [f"a/{k:02}.jpg" for k in range(20)] + [f"b/{k:02}.jpg" for k in range(COUNT)]
    assert flights(np.concatenate([rest, walk(rng)]), names)[0] == []


def test_cameras_that_fly_off_are_named_with_how_far():
    centers = walk(np.random.default_rng(6))
    spread = np.median(np.linalg.norm(centers - np.median(centers, axis=0), axis=1))
    centers[[4, 9]] += [[479.0 * spread, 0.0, 0.0], [0.0, 1e9 * spread, 0.0]]
    named, said = flights(centers, [f"{chr(97 + k % 26)}{chr(97 + k // 26)}.jpg" for k in range(COUNT)])
    assert named == [4, 9]
    # The two hardly move the median and the median distance; from where it walked, it is one spread or two.
    assert 470.0 < float(said.split()[2]) < 485.0
