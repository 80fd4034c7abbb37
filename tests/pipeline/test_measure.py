"""What one pass over the matches counts beside the directions."""

from types import SimpleNamespace

import numpy as np
import pytest

from sfm_shapefit.pipeline.measure import MeasureRequest, SideResults
from sfm_shapefit.scene.matches import KeypointMatches

FOUR = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
"""Pairs of four images; keypoint 0 of each sees one point."""


@pytest.mark.parametrize(
    ("wanted", "lone", "usable", "expected"),
    [
        (True, 0, 6, 5.0 / 6.0),  # four observations: 2 x 4 - 3 facts from 6 matches
        (True, 1, 6, 6.0 / 7.0),  # a match of keypoints 1 beside these is one fact
        (True, 0, 1, 1.0),
        (True, 0, 0, 0.0),
        (False, 0, 6, 1.0),
    ],
)
def test_a_track_of_k_keypoints_gives_two_k_less_three_facts(wanted, lone, usable, expected):
    view = SimpleNamespace(num_pairs=6, num_keypoints=np.full(4, 2), num_matches=6 + lone)
    source = SimpleNamespace(view=view, images=SimpleNamespace(num_images=4))
    beside = SideResults(source, 2.0, MeasureRequest(facts=wanted), 1)
    keypoints = np.array([*[(0, 0)] * 6, *[(1, 1)] * lone])
    offsets = np.array([*range(6), len(keypoints)])  # the last pair has the further match
    batch = KeypointMatches(pairs=np.array(FOUR), offsets=offsets, keypoints=keypoints)
    beside.add(batch, SimpleNamespace(usable=lambda: np.arange(usable)))
    if wanted:
        assert beside.facts_per_match() == pytest.approx(expected, rel=1e-12)
