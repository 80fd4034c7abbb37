"""What crosses between two groups of cameras, and whether it checks how they stand to one another."""

import numpy as np
import pytest

from sfm_shapefit.judgement import ties
from sfm_shapefit.judgement.ties import (
    NodeLinks,
    Rays,
    find_groups,
    find_hanging,
    links_of_pairs,
    rigid_groups,
)

RIVAL_SHARE = 6
N = 2 * RIVAL_SHARE
INNER = 40


def rays_of(*seen, misses=(), by=range(RIVAL_SHARE, N)):
    """Rays of points, each seen by a tuple of cameras; those of some points miss in some cameras."""
    points, nodes = np.repeat(np.arange(len(seen)), [len(each) for each in seen]), np.concatenate(seen)
    return Rays(points, nodes, ~(np.isin(nodes, by) & np.isin(points, list(misses)))).of_three()


def halves():
    """Points that three neighbors of each half see."""
    return [
        tuple(side + (k + step) % RIVAL_SHARE for step in range(3))
        for side in (0, RIVAL_SHARE)
        for k in range(RIVAL_SHARE)
        for _ in range(INNER)
    ]


def names_of(inside):
    return tuple(map(str, np.flatnonzero(inside).tolist()))


def found(*crossing, agreeing=(), contradicting=(), known=(), inside=None, misses=(), threads=1, **more):
    """The groups of two halves that points, and pairs, cross."""
    points = halves() if inside is None else inside
    rays = rays_of(*points, *crossing, misses=[len(points) + k for k in misses], **more)
    sides = (np.array(side, dtype=int).reshape(-1, 2) for side in (agreeing, contradicting))
    group = rigid_groups(N, rays, np.array(known, dtype=int).reshape(-1, 2), threads)
    return find_groups(group, rays, links_of_pairs(*sides), names_of)


FROM_BOTH = (0, 1, 7, 8)
"""Cameras that see a point: two of either half."""


def test_halves_that_nothing_crosses_are_two_groups_of_which_the_further_one_is_loose():
    group, (half,) = found()
    assert len(set(group[:RIVAL_SHARE])) == len(set(group[RIVAL_SHARE:])) == 1
    assert group[0] != group[RIVAL_SHARE]
    assert half.images == tuple(map(str, range(RIVAL_SHARE, N)))
    assert (half.num_agreeing, half.num_contradicting, half.num_points, half.is_loose) == (0, 0, 0, True)


@pytest.mark.parametrize(("count", "misses", "ties"), [(15, 7, True), (14, 0, False), (15, 8, False)])
def test_fifteen_points_tie_two_groups_if_at_most_half_as_many_miss(count, misses, ties):
    group, groups = found(*[FROM_BOTH] * (count + misses), misses=range(misses))
    told = [(one.num_points, one.is_loose) for one in groups]
    assert told == ([] if ties else [(count, misses > count / 2)])
    assert len(set(group)) == 1 + (misses > count / 2)  # what is unchecked is not apart


def test_points_of_two_images_tie_nothing_and_nor_do_those_of_three_if_one_misses():
    (half,) = found(*[(0, 7)] * 100)[1]
    assert (half.num_points, half.is_loose) == (0, True)
    (half,) = found(*[(0, 7, 8), (1, 9, 8)] * 20, misses=range(40), by=[8])[1]
    assert (half.num_points, half.is_loose) == (0, True)


def test_two_cameras_alone_are_no_group():
    inside = [tuple((k + step) % 4 for step in range(3)) for k in range(4) for _ in range(INNER)]
    inside += [tuple(8 + one for one in seen) for seen in inside]
    between = [(6, 7, other) for other in (0, 0, 1, 1, 2, 2, 3, 3, 8, 8, 9, 9, 10, 10, 11)]
    _, groups = found(*between, inside=inside)
    assert [group.images for group in groups] == [("8", "9", "10", "11")]


def test_points_that_one_camera_sees_of_the_other_half_say_where_that_stands_but_not_how_large_the_half_is():
    _, (half,) = found(*[(0, 7, 8)] * 100)
    assert {*map(int, half.images)} - {0} in ({*range(1, RIVAL_SHARE)}, {*range(RIVAL_SHARE, N)})
    assert half.is_loose
    tied, groups = found(*[(0, 7, 8)] * 100, *[(1, 7, 8)] * 15)
    assert (len(set(tied)), groups) == (1, ())


@pytest.mark.parametrize(
    ("agreeing", "num_against", "ties", "is_loose"),
    [
        ([(0, 6), (1, 7), (2, 8)], 6, True, False),
        ([(0, 6), (1, 7), (2, 8)], 7, False, True),
        ([(0, 6), (1, 7)], 0, False, False),
        ([(0, 6)], 0, False, True),
        ([(0, 6), (0, 7), (0, 8)], 0, False, True),
        ([(0, 6), (0, 7), (1, 8)], 0, False, False),
        ([(0, 6), (0, 7), (1, 8), (2, 9)], 0, True, False),
    ],
)
def test_three_pairs_tie_two_groups_if_two_are_left_without_any_camera(agreeing, num_against, ties, is_loose):
    against = [(k // RIVAL_SHARE, RIVAL_SHARE + k % RIVAL_SHARE) for k in range(num_against)]
    group, groups = found(agreeing=agreeing, contradicting=against)
    assert len(set(group)) == 1 + is_loose
    told = [(one.num_agreeing, one.num_contradicting, one.is_loose) for one in groups]
    assert told == ([] if ties else [(len(agreeing), num_against, is_loose)])


def test_facts_add_up_one_pair_and_one_point_say_as_much_as_a_similarity_has_unknowns():
    (half,) = found(FROM_BOTH, agreeing=[(2, 9)])[1]
    assert not half.is_loose
    assert found(FROM_BOTH, FROM_BOTH, FROM_BOTH)[1][0].is_loose
    assert not found(FROM_BOTH, FROM_BOTH, FROM_BOTH, FROM_BOTH)[1][0].is_loose


def test_groups_that_are_known_to_be_right_need_no_link():
    strip = [(3, 8), (4, 8), (4, 9)]
    assert found(known=strip)[1] == ()
    assert len(found(known=strip[:1])[1]) == 1


def test_a_chain_is_one_group_and_single_cameras_are_none():
    chain = [(k, k + 1, k + 2) for k in range(N - 2) for _ in range(15)]
    assert len(set(found(inside=chain)[0])) == 1
    group, groups = found(inside=[seen for seen in chain if N - 1 not in seen])
    assert (len(set(group)), groups) == (2, ())
    few = [seen for k, seen in enumerate(chain) if k % 15]
    assert found(inside=few)[1] == ()


def test_all_points_are_asked_between_groups_that_a_share_of_them_leaves_apart():
    many = [seen for seen in halves() for _ in range(40)]
    assert len(set(found(*[FROM_BOTH] * 15, inside=many)[0])) == 1


def test_points_are_counted_some_at_a_time_with_the_same_groups(monkeypatch):
    crossing = [FROM_BOTH] * 16
    at_once = found(*crossing, misses=range(7))[0]
    monkeypatch.setattr(ties, "_LINKS_A_BLOCK", 10)
    assert len(list(rays_of(*halves()).blocks())) > 100
    for threads in (1, 3):
        assert np.array_equal(found(*crossing, misses=range(7), threads=threads)[0], at_once)
    assert len(found(*crossing, misses=range(9))[1]) == 1


def test_nothing_links_nothing():
    none = Rays(np.zeros(0, dtype=int), np.zeros(0, dtype=int), np.zeros(0, dtype=bool))
    links = NodeLinks(np.zeros(0, dtype=int), np.zeros((0, 2), dtype=int), np.zeros(0, dtype=bool))
    group, groups = find_groups(rigid_groups(3, none, np.zeros((0, 2), dtype=int)), none, links, names_of)
    assert (group.tolist(), groups) == ([0, 1, 2], ())


def test_a_camera_that_no_point_holds_is_in_no_piece_until_pairs_tie_it_to_one():
    chain = [(k, k + 1, k + 2) for k in range(1, N - 2) for _ in range(15)]
    group, _ = found(inside=chain)
    assert len(set(group[1:])) == 1
    assert group[0] != group[1]
    assert len(set(found(inside=chain, agreeing=[(0, 4), (0, 5), (0, 6)])[0])) == 1
    assert len(set(found(inside=chain, agreeing=[(0, 4), (0, 5)])[0])) == 2


@pytest.mark.parametrize(
    ("seen", "known", "hangs"),
    [(0, (), True), (15, (), False), (14, (), True), (0, [(1, 7), (2, 8), (0, 7)], False)],
)
def test_a_group_that_a_single_pair_holds_hangs_on_the_rest(seen, known, hangs):
    inner = [
        (i, j) for half in (range(RIVAL_SHARE), range(RIVAL_SHARE, 9)) for i in half for j in half if i < j
    ]
    pairs = links_of_pairs(np.array([*inner, (0, 6)]), np.zeros((0, 2), dtype=int))
    rays = rays_of(*[(1, 2, 7, 8)] * max(seen, 1), misses=() if seen else [0], by=range(N))
    held = np.array(known, dtype=int).reshape(-1, 2)
    told = [
        (one.images, one.num_agreeing, one.is_loose) for one in find_hanging(9, rays, pairs, held, names_of)
    ]
    assert told == ([(("6", "7", "8"), 1, False)] if hangs else [])
