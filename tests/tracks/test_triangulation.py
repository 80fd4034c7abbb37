"""Tracks joined from matches, triangulated in spite of wrong observations, and few of them chosen."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from sfm_shapefit.adjustment.solve import adjust, choose_loss_scale_px
from sfm_shapefit.base.row_file import RowFile
from sfm_shapefit.tracks.joining import list_trees
from sfm_shapefit.tracks.links import CameraPoses, MatchedKeypoints, ObservedTracks
from sfm_shapefit.tracks.thin_tracks import choose_thin_tracks
from sfm_shapefit.tracks.triangulation import (
    PointLimits,
    joining_limits_px,
    triangulate_matches,
    triangulate_tracks,
)
from tests.adjustment.made import disturb, ring_problem

LIMITS = PointLimits(max_error_px=4.0, min_angle_deg=1.5, min_length=3)
FOCAL = 500.0


def made(noise_px=0.0, num_points=200, share=0.5, seed=0):
    """Tracks of a ring of cameras, their poses and the true points."""
    rng = np.random.default_rng(seed)
    problem = ring_problem(rng, num_points=num_points, noise_px=noise_px, share=share)
    order = np.lexsort((problem.cameras_seeing, problem.points_seen))
    pixels = problem.pixels[order]
    lengths = np.bincount(problem.points_seen, minlength=num_points)
    tracks = ObservedTracks(
        offsets=np.concatenate([[0], np.cumsum(lengths)]),
        cameras=problem.cameras_seeing[order],
        keypoints=problem.points_seen[order],
        pixels=pixels,
        on_plane=(pixels - [320.0, 240.0]) / FOCAL,
        ids=np.arange(num_points),
    )
    poses = CameraPoses(
        rotations=problem.rotations,
        centers=problem.centers,
        focal_lengths_px=np.full(problem.num_cameras, FOCAL),
        images=np.arange(problem.num_cameras),
    )
    return tracks, poses, problem.points


def with_wrong(tracks, share, seed=1, off_px=100.0):
    """The tracks with a share of their observations elsewhere, and which."""
    rng = np.random.default_rng(seed)
    wrong = rng.random(len(tracks.cameras)) < share
    turns = rng.uniform(0.0, 2.0 * np.pi, len(wrong))
    shifts = off_px / FOCAL * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    return replace(tracks, on_plane=tracks.on_plane + shifts * wrong[:, None]), wrong


def test_exact_tracks_give_their_points():
    tracks, poses, points = made()
    found = triangulate_tracks(tracks, poses, LIMITS)
    np.testing.assert_array_equal(found.tracks, np.flatnonzero(tracks.lengths() >= 3))
    np.testing.assert_allclose(found.points, points[found.tracks], atol=1e-12)
    expected = np.repeat(tracks.lengths() >= 3, tracks.lengths())
    np.testing.assert_array_equal(found.points_seen >= 0, expected)


def test_the_point_minimizes_the_squared_errors_of_its_observations():
    tracks, poses, _ = made(noise_px=0.5)
    found = triangulate_tracks(tracks, poses, LIMITS)

    def cost(points):
        used = found.points_seen >= 0
        at, camera = points[found.points_seen[used]], tracks.cameras[used]
        x = np.einsum("mab,mb->ma", poses.rotations[camera], at - poses.centers[camera])
        squares = np.sum((x[:, :2] / x[:, 2:] - tracks.on_plane[used]) ** 2, axis=1)
        return np.bincount(found.points_seen[used], squares)

    least = cost(found.points)
    for axis in np.eye(3):
        for step in (1e-4, -1e-4):
            assert (cost(found.points + step * axis) > least).all()


@pytest.mark.parametrize("seed", range(3))
def test_a_fifth_of_wrong_observations_is_left_out(seed):
    tracks, poses, points = made(noise_px=0.3, share=0.9, seed=seed)
    damaged, wrong = with_wrong(tracks, 0.2, seed)
    found = triangulate_tracks(replace(damaged, may_split=False), poses, LIMITS)
    assert len(found.points) >= 0.99 * len(points)
    np.testing.assert_allclose(found.points, points[found.tracks], atol=0.02)
    of_point = found.points_seen >= 0
    assert not (of_point & wrong).any()
    assert np.mean(of_point[~wrong]) > 0.99


def test_a_track_of_two_points_is_split_only_where_it_may_be():
    tracks, poses, points = made(num_points=2, share=1.0)
    rows = np.lexsort((tracks.keypoints, tracks.cameras))
    both = replace(
        tracks,
        offsets=np.array([0, len(rows)]),
        cameras=tracks.cameras[rows],
        keypoints=tracks.keypoints[rows],
        pixels=tracks.pixels[rows],
        on_plane=tracks.on_plane[rows],
        ids=np.array([7]),
    )
    found = triangulate_tracks(both, poses, LIMITS)
    assert len(found.points) == 2
    np.testing.assert_allclose(found.points[np.argsort(found.points[:, 0])], points[np.argsort(points[:, 0])])
    for point in range(2):
        assert len(set(both.keypoints[found.points_seen == point])) == 1
    assert len(triangulate_tracks(replace(both, may_split=False), poses, LIMITS).points) == 1


def test_of_two_observations_of_one_image_the_better_one_counts():
    tracks, poses, points = made(num_points=1, share=1.0)
    doubled = replace(
        tracks,
        offsets=np.array([0, len(tracks.cameras) + 1]),
        cameras=np.insert(tracks.cameras, 3, 3),
        keypoints=np.insert(tracks.keypoints, 3, 9),
        pixels=np.insert(tracks.pixels, 3, 0.0, axis=0),
        on_plane=np.insert(tracks.on_plane, 3, tracks.on_plane[3] + 2.0 / FOCAL, axis=0),
    )
    found = triangulate_tracks(doubled, poses, LIMITS)
    assert np.flatnonzero(found.points_seen < 0).tolist() == [3]
    np.testing.assert_allclose(found.points, points, atol=0.05)


@pytest.mark.parametrize("what", ["behind", "narrow", "no ray", "far off"])
def test_what_cannot_be_a_point_is_none(what):
    tracks, poses, _ = made(num_points=20, share=1.0)
    limits = replace(LIMITS, min_length=4)
    if what == "behind":
        poses = replace(poses, rotations=poses.rotations * np.array([-1.0, 1.0, -1.0])[:, None])
        tracks = replace(tracks, on_plane=tracks.on_plane * [-1.0, 1.0])
    elif what == "narrow":  # two cameras 30 degrees apart on their ring, seen from near its center
        limits = replace(LIMITS, min_length=2, min_angle_deg=60.0)
        tracks = replace(tracks, on_plane=np.where(tracks.cameras[:, None] < 2, tracks.on_plane, np.nan))
        assert len(triangulate_tracks(tracks, poses, replace(limits, min_angle_deg=10.0)).points) == 20
    elif what == "no ray":
        tracks = replace(tracks, on_plane=np.full_like(tracks.on_plane, np.nan))
    else:
        tracks, _ = with_wrong(tracks, 1.0)
    found = triangulate_tracks(tracks, poses, limits)
    assert len(found.points) <= (3 if what == "far off" else 0)
    assert (found.points_seen < len(found.points)).all()


def test_threads_and_neighbors_change_no_bit():
    tracks, poses, _ = made(noise_px=0.5)
    without_rays = tracks.list_of_rows()[:, None] % 5 == 0  # of these there are no points
    tracks = replace(tracks, on_plane=np.where(without_rays, np.nan, tracks.on_plane))
    whole = triangulate_tracks(tracks, poses, LIMITS)
    for threads in (2, 3, 7):
        shared = triangulate_tracks(tracks, poses, LIMITS, threads)
        np.testing.assert_array_equal(whole.points, shared.points)
        np.testing.assert_array_equal(whole.points_seen, shared.points_seen)
    part = triangulate_tracks(tracks.subset(np.arange(100, 200)), poses, LIMITS)
    np.testing.assert_array_equal(part.points, whole.points[whole.tracks >= 100])
    assert len(triangulate_tracks(tracks.subset(np.arange(0)), poses, LIMITS).points) == 0


def matched(tracks, extra=()):
    """Matches of each observation with the next of its track, and further ones."""
    order = np.lexsort((tracks.keypoints, tracks.cameras))
    place = np.argsort(order)
    same = np.repeat(np.arange(tracks.num_tracks), tracks.lengths())
    next_one = np.flatnonzero(same[1:] == same[:-1])
    matches = place[np.stack([next_one, next_one + 1], axis=1)]
    return MatchedKeypoints(
        cameras=tracks.cameras[order],
        keypoints=tracks.keypoints[order],
        pixels=tracks.pixels[order],
        on_plane=tracks.on_plane[order],
        matches=np.concatenate([matches, np.array(extra, dtype=np.int64).reshape(-1, 2)]),
    )


def test_wrong_matches_do_not_join_tracks():
    tracks, poses, _ = made(noise_px=0.3, num_points=300)
    rng = np.random.default_rng(5)
    wrong = rng.integers(0, len(tracks.cameras), (400, 2))
    found = matched(tracks, wrong[tracks.cameras[wrong[:, 0]] != tracks.cameras[wrong[:, 1]]])
    joined = found.observed(found.join(poses, 4.0))
    mixed = [len(set(joined.keypoints[a:b])) > 1 for a, b in itertools.pairwise(joined.offsets)]
    assert np.mean(mixed) < 0.05
    one = found.observed(found.join(poses, 1e9))  # without the check, most are one track
    assert one.lengths().max() > 0.5 * len(tracks.cameras)
    placed = triangulate_tracks(joined, poses, LIMITS)
    assert len(placed.points) >= 0.95 * np.sum(tracks.lengths() >= 3)


def test_what_agrees_best_is_joined_first_so_that_wrong_matches_make_no_chains_of_all():
    tracks, poses, points = made(noise_px=0.3, num_points=300)
    rng = np.random.default_rng(5)
    wrong = rng.integers(0, len(tracks.cameras), (3000, 2))
    found = matched(tracks, wrong[tracks.cameras[wrong[:, 0]] != tracks.cameras[wrong[:, 1]]])
    wide = replace(LIMITS, max_error_px=16.0)
    at_once = triangulate_tracks(found.observed(found.join(poses, 16.0)), poses, wide)
    joined, in_turn = triangulate_matches(found, poses, wide, 4.0)
    long = tracks.lengths() >= 3
    of_long = np.sum(tracks.lengths()[long])
    assert np.sum(at_once.points_seen >= 0) < 0.8 * of_long
    assert np.sum(in_turn.points_seen >= 0) > 0.95 * of_long
    # each track is of one point, and nearly all are of one keypoint of the problem, at its place
    np.testing.assert_array_equal(in_turn.points_seen, np.repeat(in_turn.tracks, joined.lengths()))
    assert len(set(zip(joined.cameras, joined.keypoints, strict=True))) == len(joined.cameras)
    pure = [
        k
        for k, (a, b) in enumerate(itertools.pairwise(joined.offsets))
        if len(set(joined.keypoints[a:b])) == 1
    ]
    assert len(pure) > 0.9 * np.sum(long)
    truth = points[joined.keypoints[joined.offsets[pure]]]
    distances = np.linalg.norm(in_turn.points[pure] - truth, axis=1)
    assert np.median(distances) < 0.01 * np.ptp(points, axis=0).max()


def test_without_chains_matches_are_joined_once():
    tracks, poses, _ = made(noise_px=0.3)
    found = matched(tracks)
    joined, in_turn = triangulate_matches(found, poses, replace(LIMITS, max_error_px=16.0), 4.0)
    at_once = found.observed(found.join(poses, 16.0))
    expected = triangulate_tracks(at_once, poses, replace(LIMITS, max_error_px=16.0))
    np.testing.assert_array_equal(in_turn.points, expected.points)
    of_points = at_once.of_points(expected.points_seen)
    for name in ("offsets", "cameras", "keypoints", "pixels", "ids"):
        np.testing.assert_array_equal(getattr(joined, name)[:], getattr(of_points, name))


def test_matches_in_a_file_join_the_same_tracks_and_no_observation_is_copied():
    tracks, poses, _ = made(noise_px=0.3, num_points=300)
    rng = np.random.default_rng(5)
    wrong = rng.integers(0, len(tracks.cameras), (3000, 2))  # so that there are chains to join anew
    found = matched(tracks, wrong[tracks.cameras[wrong[:, 0]] != tracks.cameras[wrong[:, 1]]])
    file = RowFile(found.matches.shape, dtype=found.matches.dtype)
    file[0 : len(found.matches)] = found.matches
    in_file, wide = replace(found, matches=file), replace(LIMITS, max_error_px=16.0)
    np.testing.assert_array_equal(in_file.count_partners(), found.count_partners())
    (joined, expected), (other, placed) = (
        triangulate_matches(one, poses, wide, 4.0) for one in (found, in_file)
    )
    assert joined.matched is found
    assert joined.rows.dtype == np.int32
    np.testing.assert_array_equal(other.rows, joined.rows)
    np.testing.assert_array_equal(other.offsets, joined.offsets)
    np.testing.assert_array_equal(placed.points, expected.points)
    # tracks of the points that are seen, some of their observations left out, as of copies
    seen = np.where(rng.random(len(joined.rows)) < 0.2, -1, expected.points_seen)
    few, copied = joined.of_points(seen), found.observed(joined).of_points(seen)
    for name in ("offsets", "cameras", "keypoints", "pixels", "ids"):
        np.testing.assert_array_equal(getattr(few, name)[:], getattr(copied, name))


def test_joined_keypoints_are_the_components_of_their_forest():
    parents = np.array([0, 0, 2, 1, 2, 5, 4], dtype=np.int32)
    assert [own.tolist() for own in list_trees(parents)] == [[0, 1, 3], [2, 4, 6]]
    assert len(list_trees(np.arange(3, dtype=np.int32)).rows) == 0


def test_tracks_of_points_are_the_rows_that_see_each():
    tracks = made()[0].subset(np.array([2, 0]))
    own = np.repeat([0, 1], tracks.lengths())
    assert tracks.of_points(own).pixels is tracks.pixels  # nothing is copied
    assert tracks.of_points(own).ids.tolist() == [0, 1]
    swapped = tracks.of_points(1 - own)
    np.testing.assert_array_equal(swapped.pixels, tracks.subset(np.array([1, 0])).pixels)
    assert swapped.ids.tolist() == [0, 1]


@pytest.mark.parametrize(("widest_px", "expected"), [(4.0, [2.0, 4.0]), (16.0, [2.0, 4.0, 8.0, 16.0])])
def test_matches_join_within_half_the_threshold_and_then_within_twice_as_much(widest_px, expected):
    assert list(joining_limits_px(4.0, widest_px)) == expected


def test_thin_tracks_give_every_image_its_share_and_do_not_depend_on_the_order():
    tracks, _, _ = made(noise_px=0.5, num_points=60_000, share=0.4)
    chosen = choose_thin_tracks(tracks.offsets, tracks.cameras, tracks.pixels, 12)
    seen = np.bincount(tracks.subset(chosen).cameras)
    wanted = 20_000 // 12
    assert wanted / 3 <= seen.min()
    assert seen.max() < 2 * wanted
    assert tracks.lengths()[chosen].mean() > tracks.lengths().mean()
    shuffled = np.random.default_rng(0).permutation(tracks.num_tracks)
    other = tracks.subset(shuffled)
    again = choose_thin_tracks(other.offsets, other.cameras, other.pixels, 12)
    np.testing.assert_array_equal(np.sort(shuffled[again]), chosen)


def test_thin_tracks_are_all_where_there_are_few():
    tracks, _, _ = made(num_points=50)
    chosen = choose_thin_tracks(tracks.offsets, tracks.cameras, tracks.pixels, 12)
    assert chosen.tolist() == np.flatnonzero(tracks.lengths() > 0).tolist()


def test_a_track_that_wrong_matches_joined_of_many_is_no_thin_track():
    def choose(longest):
        lengths = [longest, 101, *[20] * 20]  # 100 may always be, and 101 is more than four times 20
        offsets = np.cumsum([0, *lengths])
        images = np.concatenate([np.arange(length) for length in lengths])
        pixels = np.random.default_rng(0).uniform(0.0, 1000.0, (len(images), 2))
        return choose_thin_tracks(offsets, images, pixels, 600).tolist()

    assert choose(600) == list(range(2, 22))
    assert choose(100) == [0, *range(2, 22)]
    # Where a fifth of all are as long, none is far longer than the others.
    offsets = np.array([0, 600, 1200, *range(1203, 1224, 3)])
    images = np.concatenate([np.tile(np.arange(600), 2), np.tile(np.arange(3), 7)])
    pixels = np.random.default_rng(0).uniform(0.0, 1000.0, (len(images), 2))
    assert {0, 1} <= set(choose_thin_tracks(offsets, images, pixels, 600).tolist())


@pytest.mark.parametrize(("heavy", "scale_px"), [(False, 1.0), (True, 0.25)])
def test_normal_errors_call_for_a_wide_loss_and_sharp_ones_with_a_tail_for_a_narrow_one(heavy, scale_px):
    rng = np.random.default_rng(0)
    problem = ring_problem(rng, num_points=400, noise_px=0.0 if heavy else 0.5)
    if heavy:
        spread = np.where(rng.random(problem.num_observations) < 0.7, 0.1, 1.0)
        noise = spread[:, None] * rng.standard_normal(problem.pixels.shape)
        problem = replace(problem, pixels=problem.pixels + noise)
    start = adjust(disturb(problem, rng), loss_scale_px=1.0).problem
    assert choose_loss_scale_px(start, (0.25, 0.5, 1.0)) == scale_px
    errors = {
        c: np.linalg.norm(adjust(start, loss_scale_px=c).problem.centers - problem.centers)
        for c in (0.25, 1.0)
    }
    assert errors[scale_px] == min(errors.values())


def test_points_that_follow_their_own_observations_do_not_pretend_small_errors():
    # Three views of a point leave half of the squares. Taken for all, 0.7 px would be 0.5.
    problem = ring_problem(np.random.default_rng(1), num_points=1500, noise_px=0.5, share=0.25)
    lengths = np.bincount(problem.points_seen, minlength=problem.num_points)
    start = adjust(problem.of_points(lengths == 3), loss_scale_px=1.0).problem
    assert choose_loss_scale_px(start, (0.5, 0.7)) == 0.7


def test_points_of_two_images_do_not_choose_the_loss_unless_there_are_no_others():
    problem = ring_problem(np.random.default_rng(0), num_points=400, noise_px=0.5)
    two = ring_problem(np.random.default_rng(2), num_points=2000, noise_px=0.02, share=0.1)
    two = two.of_points(np.bincount(two.points_seen, minlength=2000) == 2)
    both = replace(
        problem,
        points=np.concatenate([problem.points, two.points]),
        cameras_seeing=np.concatenate([problem.cameras_seeing, two.cameras_seeing]),
        points_seen=np.concatenate([problem.points_seen, two.points_seen + problem.num_points]),
        pixels=np.concatenate([problem.pixels, two.pixels]),
    )
    assert two.num_observations > 0.3 * problem.num_observations
    scales = (0.0625, 0.25, 1.0)
    assert choose_loss_scale_px(both, scales) == choose_loss_scale_px(problem, scales) == 1.0
    assert choose_loss_scale_px(two, scales) < 1.0


def test_points_are_chosen_by_their_length():
    tracks, poses, _ = made(noise_px=0.5, num_points=200)
    found = triangulate_tracks(tracks, poses, LIMITS)
    lengths = np.bincount(found.points_seen[found.points_seen >= 0])
    long = found.of_length(5)
    np.testing.assert_array_equal(long.points, found.points[lengths >= 5])
    np.testing.assert_array_equal(long.tracks, found.tracks[lengths >= 5])
    is_long = (found.points_seen >= 0) & (lengths[found.points_seen] >= 5)
    assert 0 < is_long.sum() < np.sum(found.points_seen >= 0)
    np.testing.assert_array_equal(long.points_seen >= 0, is_long)
    seen = long.points[long.points_seen[is_long]]
    np.testing.assert_array_equal(seen, found.points[found.points_seen[is_long]])


def test_very_many_matches_are_joined_and_chosen_alike_by_any_number_of_threads():
    rng, num_cameras, num_keypoints, num_matches = np.random.default_rng(0), 300, 3000, 600_000
    first, steps = rng.integers(0, 7, num_matches), rng.integers(1, 7, num_matches)
    ends = rng.integers(0, 400, num_matches) + 400 * np.stack([first, (first + steps) % 7])
    matched = MatchedKeypoints(
        cameras=np.arange(num_keypoints, dtype=np.int32) // 10,
        keypoints=np.arange(num_keypoints, dtype=np.int32) % 10,
        pixels=rng.uniform(0.0, 100.0, (num_keypoints, 2)),
        on_plane=rng.uniform(-0.5, 0.5, (num_keypoints, 2)),
        matches=ends.T.astype(np.uint32),
    )
    poses = CameraPoses(
        rotations=np.tile(np.eye(3), (num_cameras, 1, 1)),
        centers=rng.uniform(-1.0, 1.0, (num_cameras, 3)),
        focal_lengths_px=np.full(num_cameras, 100.0),
        images=np.arange(num_cameras),
    )
    chosen = rng.random(num_keypoints) < 0.5
    kept = chosen[matched.matches].all(axis=1)
    for threads in (1, 2, 3):
        joined, among = matched.join(poses, 1e9, threads), matched.among(chosen, threads)
        assert [rows.tolist() for rows in joined] == [list(range(k, 2800, 400)) for k in range(400)]
        np.testing.assert_array_equal(np.flatnonzero(chosen)[among.matches], matched.matches[kept])
        for name in ("cameras", "keypoints", "pixels", "on_plane"):
            np.testing.assert_array_equal(getattr(among, name), getattr(matched, name)[chosen])
