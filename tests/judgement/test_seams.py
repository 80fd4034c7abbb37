"""Groups that agree in themselves and stand apart from the rest."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit.graph.rigidity import parallel_rigid_pieces
from sfm_shapefit.judgement.seams import find_cuts, find_seams
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import Lens
from sfm_shapefit.scene.matches import is_among
from tests.problems import made_rotations

N, GROUP = 18, np.array([0, 3, 8, 11, 14, 17])
EVERY = np.array([(i, j) for i in range(N) for j in range(i + 1, N)])


def across(pairs):
    return np.isin(pairs, GROUP).sum(axis=1) == 1


def split(num_tied=0):
    """Pairs that agree, and that contradict: all of those across a seam but a few."""
    apart = across(EVERY)
    apart[np.random.default_rng(2).permutation(np.flatnonzero(apart))[:num_tied]] = False
    return EVERY[~apart], EVERY[apart]


def cut_of(agreeing, contradicting):
    """The cuts where the pairs that agree alone hold the cameras in one group."""
    group = np.arange(1, N + 1)
    if len(agreeing):
        group[agreeing[parallel_rigid_pieces(N, agreeing, 3) == 0]] = 0
    return find_cuts(agreeing, contradicting, group)


def rotations_of(pairs, rotations, turn=None, at_random=False):
    """Relative rotations of pairs, those across as if the group were turned in the world."""
    i, j = pairs.T
    true = np.where(
        np.isin(np.arange(N), GROUP)[:, None, None],
        rotations @ (np.eye(3) if turn is None else turn),
        rotations,
    )
    found = true[j] @ true[i].transpose(0, 2, 1)
    if at_random:
        found = Rotation.random(len(pairs), random_state=1).as_matrix()
    return made_rotations(pairs, found)


@pytest.fixture
def rotations():
    return Rotation.random(N, random_state=0).as_matrix()


def turned_to(rotations):
    """Images 0, 1, ... with some rotations."""
    lens = Lens("SIMPLE_PINHOLE", (800.0, 500.0, 400.0), width=1000, height=800)
    return Images.listed([str(k) for k in range(N)], (rotations, np.zeros((N, 3))), [0] * N, [lens])


def test_what_agrees_has_no_cut_and_nor_have_wrong_pairs_at_random():
    assert cut_of(EVERY, EVERY[:0]) == ()
    wrong = np.random.default_rng(0).random(len(EVERY)) < 0.3
    assert cut_of(EVERY[~wrong], EVERY[wrong]) == ()


def test_a_group_that_nothing_ties_is_a_seam_whatever_rotations_say(rotations):
    (cut,) = cut_of(*split())
    assert cut.cameras.tolist() == GROUP.tolist()
    assert (cut.num_agreeing, len(cut.contradicting), cut.is_tied) == (0, 72, False)
    (seam,) = find_seams((cut,), rotations_of(EVERY[:0], rotations), turned_to(rotations))
    assert seam.images == tuple(map(str, GROUP))
    assert (seam.num_agreeing, seam.num_contradicting, seam.num_turned) == (0, 72, 0)


def test_a_tied_group_is_a_seam_if_contradictions_agree_on_one_turn(rotations):
    (cut,) = cut_of(*split(12))
    assert (cut.num_agreeing, len(cut.contradicting), cut.is_tied) == (12, 60, True)
    turn = Rotation.from_rotvec([0.0, 0.0, np.radians(90.0)]).as_matrix()
    images = turned_to(rotations)
    (seam,) = find_seams((cut,), rotations_of(EVERY, rotations, turn), images)
    assert (seam.num_turned, round(seam.turn_deg, 6), seam.is_rival) == (60, 90.0, False)
    random = rotations_of(EVERY, rotations, at_random=True)
    assert find_seams((cut,), random, images) == ()
    few = random.rotations.copy()
    rows = np.flatnonzero([pair in cut.contradicting.tolist() for pair in EVERY.tolist()])[:6]
    few[rows] = rotations_of(EVERY, rotations, turn).rotations[rows]
    assert find_seams((cut,), replace(random, rotations=few), images) == ()  # 6 of 60 are chance


def test_a_group_is_a_rival_if_fewer_contradictions_have_a_sound_pose_than_pairs_agree(rotations):
    """Houses that look alike make such pairs; matches that fit no pose say nothing of the turn."""
    (cut,) = cut_of(*split(12))
    turn = Rotation.from_rotvec([0.0, 0.0, np.radians(90.0)]).as_matrix()
    every = rotations_of(EVERY, rotations, turn)
    across = np.flatnonzero(is_among(EVERY, cut.contradicting))
    for sound, is_rival in ((across[:11], True), (across[:12], False)):
        (seam,) = find_seams((cut,), every.subset(sound), turned_to(rotations))
        assert (seam.num_turned, seam.num_contradicting, seam.is_rival) == (len(sound), 60, is_rival)
        assert ("may stand apart" in seam.statement) == is_rival


def test_a_group_without_a_turn_is_a_seam_if_it_is_tied_to_nothing_that_most_of_the_rest_is_in(rotations):
    agreeing, contradicting = split(12)
    group = np.isin(np.arange(N), GROUP).astype(int)
    for few, found in (([], 1), (GROUP[:3], 0), (GROUP[:2], 1)):
        tied = np.where(np.isin(np.arange(N), few), 0, group)
        cuts = find_cuts(agreeing, contradicting, tied)
        assert [cut.is_tied for cut in cuts] == [not found]
        assert len(find_seams(cuts, rotations_of(EVERY, rotations), turned_to(rotations))) == found


def test_a_group_is_cut_off_only_by_twice_as_many_contradictions_as_agree():
    assert len(cut_of(*split(22))) == 1
    assert cut_of(*split(26)) == ()


def test_few_contradictions_and_single_cameras_are_no_seam():
    agreeing, contradicting = split()
    assert cut_of(agreeing, contradicting[:2]) == ()
    single = (EVERY == 17).any(axis=1)
    assert cut_of(EVERY[~single], EVERY[single]) == ()


def test_a_camera_moves_to_where_its_pairs_agree():
    # Ties of one pair draw a camera of the group to the rest first; most of its pairs agree with the group.
    agreeing, contradicting = split()
    extra = np.tile([[12, 14]], (3, 1))
    (cut,) = cut_of(np.concatenate([agreeing, extra]), contradicting)
    assert cut.cameras.tolist() == GROUP.tolist()


def test_cuts_of_a_hand_made_graph_are_all_that_is_cut_off_largest_first():
    """Bodies 0..5, 6..8 and 9..10 agree in themselves; 11 is alone, 12 has no pair."""
    bodies = [range(6), range(6, 9), range(9, 11)]
    inside = [(i, j) for body in bodies for i in body for j in body if i < j]
    apart = [(0, 9), (1, 9), (6, 10), (2, 6), (3, 7), (4, 8), (5, 8), (0, 11), (1, 11), (2, 11)]
    group = np.array([*6 * [0], 0, 0, 1, *4 * [1]])
    first, second = find_cuts(np.array([*inside, (0, 6)]), np.array(apart), group)
    assert (first.cameras.tolist(), first.num_agreeing, first.is_tied) == ([6, 7, 8], 1, True)
    assert first.contradicting.tolist() == [[6, 10], [2, 6], [3, 7], [4, 8], [5, 8]]
    assert (second.cameras.tolist(), second.num_agreeing, second.is_tied) == ([9, 10], 0, False)
    assert second.contradicting.tolist() == [[0, 9], [1, 9], [6, 10]]
