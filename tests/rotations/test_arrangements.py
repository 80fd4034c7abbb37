"""Two arrangements of a scene that repeats itself: the one whose pairs lack no matches is taken."""

import numpy as np

from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.rotations.arrangements import choose_arrangement, evidence_of
from sfm_shapefit.rotations.average import average_relative_rotations

NUM = 24
TURN = 360.0 / NUM


def about_z(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    zero, one = np.zeros_like(c), np.ones_like(c)
    return np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=-1).reshape(*np.shape(c), 3, 3)


def ring(false_share):
    """Cameras round a tower whose opposite sides are alike: false pairs say that they stand together.

    The false pairs have more matches, and share only so much of what they should.
    """
    pairs, turns, counts, shares = [], [], [], []
    for i in range(NUM):
        for j in range(i + 1, NUM):
            apart = (j - i + NUM // 2) % NUM - NUM // 2
            folded = (apart + NUM // 4) % (NUM // 2) - NUM // 4
            for lag, is_true in ((apart, True), (folded, False)):
                if abs(lag) <= 3 and (is_true or folded != apart):
                    pairs.append((i, j))
                    turns.append(lag * TURN)
                    counts.append(100 if is_true else 300)
                    shares.append((1.0 - 0.2 * abs(lag)) * (1.0 if is_true else false_share))
    relative = RelativeRotations(
        pairs=np.array(pairs),
        rotations=about_z(np.array(turns)),
        information=np.tile(1e6 * np.eye(3), (len(pairs), 1, 1)),
        num_matches=np.array(counts),
        weight_shares=np.ones(len(pairs)),
    )
    return relative, np.array(shares)


def choose(relative, shares):
    def average(some):
        return average_relative_rotations(NUM, some)

    return choose_arrangement(relative, evidence_of(relative, shares), average(relative), average)


def largest_error(averaged):
    truth = about_z(TURN * np.arange(NUM))
    off = averaged.rotations @ truth.transpose(0, 2, 1)
    off = off[0].T @ off
    return np.degrees(np.arccos(np.clip((np.trace(off, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0))).max()


def test_pairs_that_lack_matches_do_not_fold_a_tower():
    relative, shares = ring(false_share=0.4)
    assert largest_error(average_relative_rotations(NUM, relative)) > 90.0
    chosen = choose(relative, shares)
    assert largest_error(chosen.averaged) < 1e-6
    assert chosen.refused.any()
    assert np.all(relative.num_matches[chosen.refused] == 300)
    assert not chosen.rival.any()


def test_where_no_pair_lacks_matches_most_matches_decide():
    relative, shares = ring(false_share=1.0)
    chosen = choose(relative, shares)
    assert largest_error(chosen.averaged) > 90.0
    assert not chosen.refused.any()


def test_another_arrangement_that_loses_images_is_not_taken():
    relative, shares = ring(false_share=0.4)
    of_one = (relative.pairs == 0).any(axis=1)
    chosen = choose(relative, np.where(of_one, 0.3 * shares, shares))
    assert not chosen.refused.any()


def test_an_arrangement_that_cannot_be_averaged_is_none():
    relative, shares = ring(false_share=0.4)
    plain = average_relative_rotations(NUM, relative)

    def refuse(some):
        raise UnsolvableError("no")

    chosen = choose_arrangement(relative, evidence_of(relative, shares), plain, refuse)
    assert chosen.averaged is plain


def test_the_evidence_compares_pairs_that_turn_as_much():
    relative, shares = ring(false_share=0.4)
    evidence = evidence_of(relative, shares)
    true = relative.num_matches == 100
    assert evidence[true].min() > 0.0 > evidence[~true].max()
    assert np.all(evidence_of(relative, np.full(len(shares), np.nan)) == 0.0)
    some = np.where(np.arange(len(shares)) == 0, np.nan, shares)
    assert evidence_of(relative, some)[0] == 0.0
