"""Which cameras are turned, by the rotations of their pairs: alone, in groups, in symmetric scenes."""

import numpy as np
import pytest

from sfm_shapefit.judgement.turns import Doubt, PairTurns, find_turned, weigh_pairs
from sfm_shapefit.pairs.pair_directions import DirectionStatus
from tests.problems import all_pairs, made_directions, made_rotations, random_rotations, turn

SIGMA_RAD = np.radians(0.2)


def small_turn(rng, sigma_rad):
    axis = rng.standard_normal(3)
    return turn(axis / np.linalg.norm(axis), float(np.degrees(sigma_rad) * rng.standard_normal()))


def measured_turns(turns, seed, pairs=None, sigma_rad=SIGMA_RAD):
    """What the pairs of cameras with errors T say: E = T_j^T T_i and noise, placed where that is nearly 0."""
    rng = np.random.default_rng(seed)
    pairs = np.array(all_pairs(len(turns)) if pairs is None else pairs)
    noise = np.array([small_turn(rng, sigma_rad) for _ in pairs])
    relative = noise @ turns[pairs[:, 1]].transpose(0, 2, 1) @ turns[pairs[:, 0]]
    cosines = (np.trace(relative, axis1=1, axis2=2) - 1.0) / 2.0
    placed = (np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))) < 1.0).astype(np.float64)
    count = len(pairs)
    return PairTurns(pairs, relative, np.full(count, sigma_rad), np.full(count, 100.0), placed)


@pytest.mark.parametrize("angle_deg", [2.0, 5.0, 20.0, 180.0])
def test_a_turned_camera_and_a_turned_group_are_found_with_their_angle_and_nobody_else(angle_deg):
    for turned in ([4], [2, 3, 5, 7]):
        turns = np.tile(np.eye(3), (12, 1, 1))
        turns[turned] = turn(np.array([0.6, 0.0, 0.8]), angle_deg)
        found = find_turned(measured_turns(turns, 1), np.arange(12))
        kinds = [Doubt.TURNED if k in turned else Doubt.RIGHT for k in range(12)]
        assert list(found.kinds) == kinds
        np.testing.assert_allclose(found.angles_deg[turned], angle_deg, atol=0.3)
        assert found.members(turned[0]).tolist() == turned


def test_cameras_turned_each_its_own_way_are_all_found():
    rng = np.random.default_rng(2)
    turns = np.tile(np.eye(3), (15, 1, 1))
    turns[:5] = random_rotations(rng, 5)
    found = find_turned(measured_turns(turns, 2), np.arange(15))
    assert [kind is Doubt.TURNED for kind in found.kinds] == [True] * 5 + [False] * 10


def test_false_pairs_that_agree_on_nothing_blame_nobody():
    rng = np.random.default_rng(3)
    pairs = measured_turns(np.tile(np.eye(3), (14, 1, 1)), 3)
    false = rng.random(len(pairs.pairs)) < 0.4
    pairs.turns[false] = random_rotations(rng, int(false.sum()))
    pairs.placed[false] = 0.0
    assert set(find_turned(pairs, np.arange(14)).kinds) == {Doubt.RIGHT}


def test_where_as_many_pairs_speak_for_a_turn_as_against_it_nothing_is_decided():
    pairs = measured_turns(np.tile(np.eye(3), (12, 1, 1)), 4)
    body = np.isin(pairs.pairs, [0, 1, 2])
    crossing = np.flatnonzero(body[:, 0] != body[:, 1])
    crossing = crossing[np.arange(len(crossing)) % 5 < 3]
    quarter = turn(np.array([0.0, 1.0, 0.0]), 90.0)
    first = body[crossing, 0]
    pairs.turns[crossing] = np.where(first[:, None, None], quarter, quarter.T)
    pairs.placed[crossing] = 0.0
    found = find_turned(pairs, np.arange(12))
    assert {found.kinds[k] for k in (0, 1, 2)} == {Doubt.AMBIGUOUS}
    assert Doubt.TURNED not in found.kinds


def test_a_camera_without_an_agreeing_pair_is_unsupported_and_one_without_pairs_unknown():
    rng = np.random.default_rng(5)
    pairs = measured_turns(np.tile(np.eye(3), (9, 1, 1)), 5, all_pairs(8))
    own = (pairs.pairs == 3).any(axis=1)
    pairs.turns[own] = random_rotations(rng, int(own.sum()))
    pairs.placed[own] = 0.0
    kinds = find_turned(pairs, np.arange(9)).kinds
    assert kinds[3] is Doubt.UNSUPPORTED
    assert kinds[8] is Doubt.UNKNOWN
    assert set(np.delete(np.array(kinds, dtype=object), [3, 8])) == {Doubt.RIGHT}


def test_the_cameras_of_a_frame_are_judged_together():
    turns = np.tile(np.eye(3), (12, 1, 1))
    turns[[0, 6]] = turn(np.array([0.0, 0.0, 1.0]), 10.0)
    pairs = [pair for pair in all_pairs(12) if not {0, 6} & set(pair) or 0 in pair]  # none of camera 6
    found = find_turned(measured_turns(turns, 6, pairs), np.arange(12) % 6)
    assert [k for k, kind in enumerate(found.kinds) if kind is Doubt.TURNED] == [0, 6]


def test_a_majority_is_not_turned_for_the_sake_of_a_few_even_if_these_share_no_pairs():
    turns = np.tile(np.eye(3), (10, 1, 1))
    turns[6:] = turn(np.array([1.0, 0.0, 0.0]), 30.0)
    pairs = [pair for pair in all_pairs(10) if min(pair) < 6]
    kinds = find_turned(measured_turns(turns, 7, pairs), np.arange(10)).kinds
    assert kinds == (Doubt.RIGHT,) * 6 + (Doubt.TURNED,) * 4


def test_who_sees_only_turned_cameras_is_right_once_these_are_turned_back():
    turns = np.tile(np.eye(3), (12, 1, 1))
    turns[[2, 3, 5, 7]] = turn(np.array([0.0, 0.6, 0.8]), 20.0)
    # Cameras 0 and 11: one is the first of its pairs, one the second.
    pairs = [(i, j) for i, j in all_pairs(12) if (i > 0 and j < 11) or {i, j} & {2, 3, 5, 7}]
    kinds = find_turned(measured_turns(turns, 9, pairs), np.arange(12)).kinds
    assert kinds[0] is kinds[11] is Doubt.RIGHT
    assert [k for k, kind in enumerate(kinds) if kind is Doubt.TURNED] == [2, 3, 5, 7]


def test_pairs_are_weighed_by_rotation_fit_and_direction():
    """Five pairs with camera 0, of which R_0 is 10 degrees off: what speaks for it, and what does not."""
    rng = np.random.default_rng(8)
    rotations = random_rotations(rng, 6)
    pairs = np.array([(0, k) for k in range(1, 6)])
    wrong = turn(np.array([0.0, 1.0, 0.0]), 10.0)
    true = rotations[pairs[:, 1]] @ rotations[0].T
    own = true.copy()
    own[:2] = rotations[pairs[:2, 1]] @ wrong @ rotations[0].T  # so that E is the turn
    directions = made_directions(
        pairs,
        np.tile([1.0, 0.0, 0.0], (5, 1)),
        status=[DirectionStatus.LOW_INLIER_RATIO, *[DirectionStatus.USABLE] * 4],
        num_inliers=np.array([20, 100, 100, 100, 100]),
    )
    relative = made_rotations(pairs[:4], own[:4])
    agreements = np.array([np.nan, 1.0, 1.0, 0.0, 1.0])
    found = weigh_pairs(directions, agreements, relative, rotations)
    np.testing.assert_allclose(found.turns[0], wrong, atol=1e-12)
    np.testing.assert_allclose(found.turns[2], np.eye(3), atol=1e-12)
    # Contradicted; fits by its direction alone; agrees; off; not asked, so as its direction says.
    np.testing.assert_allclose(found.placed, [0.0, 0.5, 1.0, 0.0, 1.0])
    assert np.isinf(found.sigmas_rad[4])
    # The information of 20 matches of 100, and 0.1 degrees.
    np.testing.assert_allclose(found.sigmas_rad[0], np.hypot(np.sqrt(5e-8), np.radians(0.1)))


@pytest.mark.parametrize(("parallax_deg", "votes"), [(12.0, False), (40.0, True)])
def test_a_pair_does_not_take_its_parallax_for_a_turn(parallax_deg, votes):
    """A patch seen under 12 degrees of parallax along the baseline may as well be turned by 10."""
    rotations, pairs = random_rotations(np.random.default_rng(9), 2), np.array([(0, 1)])
    wrong = turn(np.array([0.0, 1.0, 0.0]), 10.0)
    own = rotations[1:] @ wrong @ rotations[0].T
    directions = made_directions(pairs, np.array([[1.0, 0.0, 0.0]]), parallax_deg=np.array([parallax_deg]))
    found = weigh_pairs(directions, np.ones(1), made_rotations(pairs, own), rotations)
    assert np.isfinite(found.sigmas_rad[0]) == votes
