"""What the matches of all pairs together say against any answer: pairs of two directions, or of none."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

import sfm_shapefit
from sfm_shapefit.facts.map_warnings import map_warnings
from sfm_shapefit.facts.warnings import match_warnings
from sfm_shapefit.pairs.direction_options import DirectionOptions
from sfm_shapefit.pairs.estimate import estimate_directions
from sfm_shapefit.pairs.pair_directions import DirectionStatus
from sfm_shapefit.scene.matches import RayMatches
from sfm_shapefit.synthetic import SceneOptions, make_scene
from sfm_shapefit.synthetic.scenes import project_points
from sfm_shapefit.synthetic.workspace import write_workspace

NO_DIRECTION = DirectionOptions(min_inliers=200)
PERIOD = np.array([2.0, 0.0, 0.0])  # along the wall, in meters


def statuses(**counts):
    """The outcome of so many pairs, each with the status of that name."""
    rays = np.tile([[0.0, 0.0, 1.0]], (sum(counts.values()), 1))
    pairs = np.column_stack([np.arange(len(rays)), np.arange(len(rays)) + 1])
    matches = RayMatches(
        pairs=pairs,
        offsets=np.arange(len(rays) + 1),
        rays_i=rays,
        rays_j=rays,
        pixel_angles=np.full(len(rays), 1e-3),
    )
    none = estimate_directions(matches, NO_DIRECTION)
    return replace(none, status=[DirectionStatus[name] for name in Counter(counts).elements()])


def half_repeated(scene, pairs):
    """The scene, with half of the matches of some pairs one period farther along the wall in image j.

    It is as if camera j stood one period back: these matches agree on that baseline to the pixel.
    """
    keypoints, points = list(scene.keypoints), list(scene.keypoint_points)
    matches = scene.matches.copy()
    for e in pairs:
        i, j = scene.pairs[e]
        rows = np.arange(scene.match_offsets[e], scene.match_offsets[e + 1])[::2]
        shown = scene.points[points[i][matches[rows, 0]]]
        xy = project_points(shown + PERIOD, scene.rotations[j], scene.centers[j], scene.calibration)
        matches[rows, 1] = len(keypoints[j]) + np.arange(len(rows))
        keypoints[j] = np.concatenate([keypoints[j], xy])
        points[j] = np.concatenate([points[j], np.full(len(rows), -1)])
    return replace(scene, keypoints=tuple(keypoints), keypoint_points=tuple(points), matches=matches)


@pytest.mark.parametrize("num_repeated", [0, 6])
def test_a_wall_that_repeats_inside_pairs_is_warned_of_and_any_other_wall_is_not(tmp_path, num_repeated):
    scene = make_scene(SceneOptions(shape="facade", num_images=9, num_points=400, max_pairs_per_image=5))
    inner = np.flatnonzero(np.diff(scene.match_offsets) > 100)[:num_repeated]
    assert len(inner) == num_repeated
    write_workspace(half_repeated(scene, inner), tmp_path / "wall")
    found = sfm_shapefit.locate(tmp_path / "wall" / "sparse" / "0")
    repeated = [warning for warning in found.warnings if "agree on two directions" in warning]
    assert len(repeated) == (num_repeated > 0)
    assert found.directions.counts().get(DirectionStatus.TWO_MOTIONS, 0) == num_repeated


@pytest.mark.parametrize(
    ("counts", "said"),
    [
        ({"USABLE": 94, "TWO_MOTIONS": 6}, ["of 6 pairs agree on two directions each, those of 94 on one"]),
        ({"USABLE": 96, "TWO_MOTIONS": 4}, []),
        ({"USABLE": 8, "TWO_MOTIONS": 2}, []),
        ({"USABLE": 8, "TWO_MOTIONS": 3}, ["of 3 pairs agree on two directions each, those of 8 on one"]),
        ({"USABLE": 4, "LOW_INLIER_RATIO": 5}, ["or the matches are those of another scene"]),
        ({"USABLE": 5, "LOW_INLIER_RATIO": 5}, []),
        ({"USABLE": 1, "TOO_FEW_MATCHES": 99}, []),
    ],
)
def test_warnings_need_a_share_of_the_pairs_and_more_than_one_or_two_and_give_numbers(counts, said):
    for warning, words in zip(match_warnings(statuses(**counts), may_repeat=True), said, strict=True):
        assert words in warning


def test_own_tracks_repeat_nothing():
    assert not list(match_warnings(statuses(USABLE=8, TWO_MOTIONS=3), may_repeat=False))
    (warning,) = match_warnings(statuses(USABLE=4, LOW_INLIER_RATIO=5), may_repeat=False)
    assert "repeats" not in warning


@pytest.mark.parametrize(
    ("rigs", "told"), [((4,), "rig 4 of the database is not used"), ((4, 7), "2 rigs, rig 4 of the database")]
)
def test_rigs_that_are_not_calibrated_are_counted_and_the_cure_is_told(rigs, told):
    (warning,) = map_warnings(rigs, [])
    assert warning.startswith(told)
    assert "colmap rig_configurator" in warning
