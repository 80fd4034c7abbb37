"""Components with averaged rotations, and what is said of the frames that get none."""

import numpy as np
import pytest

from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.pairs.pair_scores import PairScores
from sfm_shapefit.rotations.averaging_options import AveragingOptions
from sfm_shapefit.rotations.components import ComponentAveraging
from tests.problems import made_rotations


def averaged(pairs, weight_shares, **options):
    """The groups of frames that get rotations, and the reasons of the others."""
    rotations = np.tile(np.eye(3), (len(pairs), 1, 1))
    relative = made_rotations(pairs, rotations, weight_shares=np.array(weight_shares))
    reasons: dict[int, str] = {}
    components = ComponentAveraging(AveragingOptions(**options), threads=1, gravity=None)
    found = list(components.average(int(np.max(pairs)) + 1, relative, reasons))
    return [frames.tolist() for frames, _ in found], reasons


SOUND, UNSOUND = 0.9, 0.2
OF_TWO = "a group of 2 images (a frame of a rig counts as one)"


def test_each_frame_of_a_component_too_small_once_averaged_is_told_so():
    groups, reasons = averaged([(0, 1), (1, 2)], [SOUND, UNSOUND])
    assert groups == []
    few = f"pairs that can be believed tie it only into {OF_TWO}; a model needs 3"
    assert (reasons[0], reasons[1]) == (few, few)
    assert reasons[2].startswith("no pair that can be believed ties it to the others")


def test_frames_of_too_few_pairs_are_told_how_few():
    _, reasons = averaged([(0, 1), (2, 3), (3, 4), (2, 4)], [SOUND] * 4)
    few = f"matches tie it only into {OF_TWO}; a model needs 3"
    assert (reasons[0], reasons[1]) == (few, few)


def test_frames_behind_unsound_pairs_are_a_component_of_their_own():
    pairs = [(0, 1), (1, 2), (0, 2), (2, 3), (3, 4), (4, 5), (3, 5)]
    groups, reasons = averaged(pairs, [SOUND, SOUND, SOUND, UNSOUND, SOUND, SOUND, SOUND])
    assert groups == [[0, 1, 2], [3, 4, 5]]
    assert set(reasons) <= {3, 4, 5}  # the caller takes these back once they have a model


def test_a_limit_of_matches_that_no_pair_reaches_is_named():
    _, reasons = averaged([(0, 1), (1, 2), (0, 2)], [SOUND] * 3, min_matches=101)
    assert reasons[0] == "none of 3 pairs has 101 inlier matches; lower min_matches"


def test_a_stage_that_fails_has_taken_its_time():
    clock = Clock()
    with pytest.raises(UnsolvableError), clock("locate"):
        raise UnsolvableError
    assert list(clock.seconds) == ["locate"]


def test_scores_of_pairs_are_found_whatever_the_order_and_unknown_ones_are_nan():
    scores = PairScores(np.array([(3, 4), (0, 2), (1, 2)]), np.array([[0.3, 0.4], [0.0, 0.2], [0.1, np.nan]]))
    found = scores.of(np.array([(0, 2), (4, 3), (0, 1), (1, 2), (2, 9)]))
    unknown = [np.nan, np.nan]
    np.testing.assert_array_equal(found, [[0.0, 0.2], [0.3, 0.4], unknown, [0.1, np.nan], unknown])
    np.testing.assert_array_equal(PairScores().of(np.array([(0, 1)])), [unknown])
    assert PairScores().of(np.zeros((0, 2), dtype=np.int64)).shape == (0, 2)
