"""Groups that agree in themselves and stand apart from the rest."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit.judgement.seams import find_cuts, find_seams
from sfm_shapefit.pairs.relative_rotations import RelativeRotations

N, GROUP = 18, np.array([0, 3, 8, 11, 14, 17])
EVERY = np.array([(i, j) for i in range(N) for j in range(i + 1, N)])


def across(pairs):
    return np.isin(pairs, GROUP).sum(axis=1) == 1


def split(num_tied=0):
    """Pairs that agree, and that contradict: all of those across a seam but a few."""
    apart = across(EVERY)
    apart[np.random.default_rng(2).permutation(np.flatnonzero(apart))[:num_tied]] = False
    return EVERY[~apart], EVERY[apart]


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
    k = len(pairs)
    return RelativeRotations(
        pairs=pairs,
        rotations=found,
        information=np.tile(np.eye(3), (k, 1, 1)),
        num_matches=np.full(k, 100),
        weight_shares=np.ones(k),
    )


@pytest.fixture
def rotations():
    return Rotation.random(N, random_state=0).as_matrix()


def test_what_agrees_has_no_cut_and_nor_have_wrong_pairs_at_random():
    assert find_cuts(EVERY, EVERY[:0], N) == ()
    wrong = np.random.default_rng(0).random(len(EVERY)) < 0.3
    assert find_cuts(EVERY[~wrong], EVERY[wrong], N) == ()


def test_a_group_that_nothing_ties_is_a_seam_whatever_rotations_say(rotations):
    (cut,) = find_cuts(*split(), N)
    assert cut.cameras.tolist() == GROUP.tolist()
    assert (cut.num_agreeing, len(cut.contradicting), cut.is_tied) == (0, 72, False)
    (seam,) = find_seams((cut,), rotations_of(EVERY[:0], rotations), rotations)
    assert seam.cameras.tolist() == GROUP.tolist()
    assert (seam.num_agreeing, seam.num_contradicting, seam.num_turned) == (0, 72, 0)


def test_a_tied_group_is_a_seam_if_contradictions_agree_on_one_turn(rotations):
    (cut,) = find_cuts(*split(12), N)
    assert (cut.num_agreeing, len(cut.contradicting), cut.is_tied) == (12, 60, True)
    turn = Rotation.from_rotvec([0.0, 0.0, np.radians(90.0)]).as_matrix()
    (seam,) = find_seams((cut,), rotations_of(EVERY, rotations, turn), rotations)
    assert (seam.num_turned, round(seam.turn_deg, 6)) == (60, 90.0)
    random = rotations_of(EVERY, rotations, at_random=True)
    assert find_seams((cut,), random, rotations) == ()
    few = random.rotations.copy()
    rows = np.flatnonzero([pair in cut.contradicting.tolist() for pair in EVERY.tolist()])[:6]
    few[rows] = rotations_of(EVERY, rotations, turn).rotations[rows]
    assert find_seams((cut,), replace(random, rotations=few), rotations) == ()  # 6 of 60 are chance


def test_a_shifted_group_that_more_than_chance_ties_is_none(rotations):
    for num_tied, found in ((4, 1), (12, 0)):
        cuts = find_cuts(*split(num_tied), N)
        assert [cut.is_tied for cut in cuts] == [True]
        assert len(find_seams(cuts, rotations_of(EVERY, rotations), rotations)) == found


def test_a_group_is_cut_off_only_by_twice_as_many_contradictions_as_agree():
    assert len(find_cuts(*split(22), N)) == 1
    assert find_cuts(*split(26), N) == ()


def test_few_contradictions_and_single_cameras_are_no_seam():
    agreeing, contradicting = split()
    assert find_cuts(agreeing, contradicting[:4], N) == ()
    single = (EVERY == 17).any(axis=1)
    assert find_cuts(EVERY[~single], EVERY[single], N) == ()


def test_a_camera_moves_to_where_its_pairs_agree():
    # Ties of one pair draw a camera of the group to the rest first; most of its pairs agree with the group.
    agreeing, contradicting = split()
    extra = np.tile([[12, 14]], (3, 1))
    (cut,) = find_cuts(np.concatenate([agreeing, extra]), contradicting, N)
    assert cut.cameras.tolist() == GROUP.tolist()
