"""Videos and their loops: what names and matches tell, and which loops the chain of frames believes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.rotations.sequences import confirm_videos, find_videos, judge_loops, loop_pairs

FRAMES = 60
NAMES = [f"video/{frame:04d}.png" for frame in range(FRAMES)]


def frames(*times):
    return tuple(NAMES[time] for time in times)


def measured(pairs, wrong=(), rng=None):
    """Relative rotations along a turning path; some pairs are turned by 40 degrees about the vertical."""
    rng = rng or np.random.default_rng(5)
    ends = np.sort(np.array(pairs), axis=1)
    world = Rotation.from_euler("y", 6.0 * np.arange(FRAMES)[:, None], degrees=True).as_matrix()
    rotations = world[ends[:, 1]] @ world[ends[:, 0]].transpose(0, 2, 1)
    noise = Rotation.from_rotvec(np.radians(0.05) * rng.standard_normal((len(ends), 3))).as_matrix()
    rotations = noise @ rotations
    false = np.array([tuple(pair) in set(wrong) for pair in ends.tolist()])
    rotations[false] = Rotation.from_euler("y", 40.0, degrees=True).as_matrix() @ rotations[false]
    counts = np.where(ends[:, 1] - ends[:, 0] <= 5, 400 // (ends[:, 1] - ends[:, 0]), 300)
    return RelativeRotations(
        pairs=ends,
        rotations=rotations,
        information=np.tile(np.eye(3) / np.radians(0.05) ** 2, (len(ends), 1, 1)),
        num_matches=counts,
        weight_shares=np.full(len(ends), 0.9),
    )


def neighbors(reach=5):
    return [(i, j) for i in range(FRAMES) for j in range(i + 1, min(i + 1 + reach, FRAMES))]


def visit(a, b, width=3):
    return [(a + i, b + j) for i in range(width) for j in range(width)]


def test_names_with_a_running_number_make_videos_in_their_order():
    names = ["b10.png", *(f"a{k}.png" for k in (2, 10, 1, 3, 4, 5, 6, 7, 8, 9)), "readme.png"]
    videos = find_videos(names)
    assert (videos.num_videos, videos.num_frames) == (1, 10)
    assert videos.time_of[1:11].tolist() == [1, 9, 0, 2, 3, 4, 5, 6, 7, 8]
    assert videos.video_of[[0, 11]].tolist() == [-1, -1]


def test_numbers_of_any_length_are_read():
    long = [f"{'7' * 5000}{k:02d}.png" for k in range(10)]
    assert find_videos(long[::-1]).time_of.tolist() == list(range(9, -1, -1))
    nanoseconds = [f"{1403636579763555584 + 50_000_000 * k}.png" for k in range(10)]
    assert find_videos(nanoseconds).time_of.tolist() == list(range(10))


def test_photographs_with_numbers_are_no_video_unless_their_matches_say_so():
    given, videos = measured(neighbors() + visit(0, 40)), find_videos(NAMES)
    assert confirm_videos(videos, given).num_frames == FRAMES
    shuffled = np.random.default_rng(1).permutation(FRAMES)[given.pairs]
    other = replace(given, pairs=np.sort(shuffled, axis=1))
    assert confirm_videos(videos, other).num_frames == 0


def test_reach_ends_at_a_gap_and_doubles_without_one():
    doubling = [(0, lag) for lag in (1, 2, 4, 8, 16, 32)]
    given = measured([*neighbors(1), *doubling, (10, 50)])
    loops = given.pairs[loop_pairs(find_videos(NAMES), given)]
    assert loops.tolist() == [[10, 50]]


def test_weak_pairs_at_every_distance_do_not_extend_the_reach():
    given = measured(neighbors() + [(0, lag) for lag in range(6, FRAMES)])
    weak = replace(given, num_matches=np.where(given.num_matches == 300, 30, given.num_matches))
    assert not loop_pairs(find_videos(NAMES), given).any()
    loops = weak.pairs[loop_pairs(find_videos(NAMES), weak)]
    assert loops.tolist() == [[0, lag] for lag in range(16, FRAMES)]


def test_loops_are_taken_where_the_chain_says_the_same_and_refused_where_not():
    right, wrong = visit(0, 30), visit(10, 50)
    given = measured(neighbors() + right + wrong, wrong)
    found = judge_loops(find_videos(NAMES), NAMES, given)
    assert {tuple(pair) for pair in given.pairs[found.refused].tolist()} == set(wrong)
    taken, refused = found.loops
    assert (taken.first, taken.second) == (frames(0, 2), frames(30, 32))
    assert taken.num_refused < taken.num_pairs
    assert (refused.first, refused.second, refused.num_refused) == (frames(10, 12), frames(50, 52), 9)
    assert refused.angle_deg == pytest.approx(40.0, abs=0.5)
    assert taken.angle_deg < 0.5 < taken.tolerance_deg


def test_visits_come_by_their_time_whatever_the_order_of_the_images():
    given = measured(neighbors() + visit(0, 30) + visit(10, 50))
    found = judge_loops(find_videos(NAMES[::-1]), NAMES[::-1], given)
    told = [(one.first, one.second) for one in found.loops]
    assert told == [(frames(7, 9), frames(47, 49)), (frames(27, 29), frames(57, 59))]


def test_a_visit_most_of_which_is_false_is_refused_as_a_whole():
    loop = visit(5, 45)
    given = measured(neighbors() + loop, loop[:6])
    assert len(judge_loops(find_videos(NAMES), NAMES, given).refused) == len(loop)
    given = measured(neighbors() + loop, loop[:2])
    refused = given.pairs[judge_loops(find_videos(NAMES), NAMES, given).refused]
    assert sorted(map(tuple, refused.tolist())) == sorted(loop[:2])


def test_what_no_chain_joins_is_not_judged():
    broken = [(i, j) for i, j in neighbors() if (i < 30) == (j < 30)]
    loop = visit(5, 45)
    found = judge_loops(find_videos(NAMES), NAMES, measured(broken + loop, loop))
    assert (found.loops, len(found.refused)) == ((), 0)
