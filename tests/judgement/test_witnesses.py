"""Two witnesses: pixels that see the points of others confirm a doubted camera, and single pairs do not."""

import numpy as np
import pytest

from sfm_shapefit.judgement.witnesses import are_confirmed
from sfm_shapefit.scene.matches import KeypointMatches
from tests.judgement.test_left_out import FOCAL_PX, NUM_IMAGES, Scene


class KeypointRays(Scene):
    """The same, and where cameras see points."""

    def project(self, _image, positions, **_ahead):
        return FOCAL_PX * positions[:, :2] / positions[:, 2:]


def confirmed(scene, matched, doubted=(3,), num_keypoints=200):
    """Which images are confirmed, where image 3 matches the first keypoints of some others."""
    links = KeypointMatches(
        pairs=np.array([[3, other] for other in matched]),
        offsets=num_keypoints * np.arange(len(matched) + 1),
        keypoints=np.tile(np.arange(num_keypoints)[:, None], (len(matched), 2)),
    )
    asked = np.isin(np.arange(NUM_IMAGES), doubted)
    counts = np.full(NUM_IMAGES, scene.points.num_points)
    found = are_confirmed(scene.structure(), asked, (counts, [links]))
    return np.flatnonzero(found).tolist()


@pytest.mark.parametrize(
    ("matched", "num_keypoints", "sure"),
    [((5, 8), 15, True), ((5, 8), 14, False), ((5,), 200, False)],
)
def test_a_right_camera_is_confirmed_by_fifteen_keypoints_that_match_two_others(matched, num_keypoints, sure):
    assert confirmed(KeypointRays(), matched, num_keypoints=num_keypoints) == ([3] if sure else [])


def test_a_wrong_camera_and_what_matches_only_doubted_ones_is_not_confirmed():
    assert confirmed(KeypointRays(turned=3), (5, 8)) == []
    assert confirmed(KeypointRays(), (5, 8), doubted=(3, 5)) == []
    assert confirmed(KeypointRays(), (5, 8, 9), doubted=(3, 5)) == [3]


def test_of_the_keypoints_that_speak_two_thirds_are_to_fit():
    for num_missing, sure in ((60, [3]), (70, [])):
        scene = KeypointRays()
        scene.plane[3, :num_missing] += 0.1
        assert confirmed(scene, (5, 8)) == sure
