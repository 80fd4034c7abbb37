"""Tracks from matches, covering sets of them, and points as nodes of the view graph."""

import dataclasses

import numpy as np
import pytest

from sfm_shapefit.base.forests import connected_components
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.pairs.estimate import estimate_directions
from sfm_shapefit.scene.matches import MatchBatch
from sfm_shapefit.tracks.node_tracks import TrackJoiner, Tracks, covering_set, join_points

PIXEL = 1e-3  # rad
NUM_POINTS = 60
KEYPOINTS = np.full(6, NUM_POINTS)


def scene(cameras=6, seed=0, noise=0.0, wrong=0.0):
    """Cameras that all see all points, keypoint k of every image point k; centers, points and matches."""
    rng = np.random.default_rng(seed)
    centers = rng.standard_normal((cameras, 3))
    points = rng.standard_normal((NUM_POINTS, 3)) + np.array([0.0, 0.0, 8.0])
    rays = normalized(points[None] - centers[:, None] + noise * rng.standard_normal((cameras, NUM_POINTS, 3)))
    pairs = np.stack(np.triu_indices(cameras, k=1), axis=1)
    other = np.tile(np.arange(NUM_POINTS), (len(pairs), 1))
    swapped = rng.random(other.shape) < wrong
    other[swapped] = rng.integers(NUM_POINTS, size=int(swapped.sum()))
    first = np.tile(np.arange(NUM_POINTS), len(pairs))
    i, j = np.repeat(pairs, NUM_POINTS, axis=0).T
    batch = MatchBatch(
        pairs=pairs,
        offsets=np.arange(len(pairs) + 1) * NUM_POINTS,
        keypoints=np.stack([first, other.ravel()], axis=1),
        rays_i=rays[i, first],
        rays_j=rays[j, other.ravel()],
        pixel_angles=np.full(len(pairs), PIXEL),
    )
    return centers, points, batch


def build_tracks(batches, **options):
    joiner = TrackJoiner(2.0, KEYPOINTS, sum(len(batch.keypoints) for batch in batches), **options)
    for batch in batches:
        joiner.add(batch, estimate_directions(batch))
    return joiner.tracks()


def checked_tracks_of(batch):
    joiner = TrackJoiner(2.0, KEYPOINTS)
    joiner.add(batch, estimate_directions(batch))
    return joiner.checked_tracks()


def tracks_of(batch, **options):
    return build_tracks([batch], **options)


def reordered(batch, order):
    counts = np.diff(batch.offsets)
    rows = np.concatenate([np.arange(batch.offsets[p], batch.offsets[p + 1]) for p in order])
    return MatchBatch(
        pairs=batch.pairs[order],
        offsets=np.concatenate([[0], np.cumsum(counts[order])]),
        keypoints=batch.keypoints[rows],
        rays_i=batch.rays_i[rows],
        rays_j=batch.rays_j[rows],
        pixel_angles=batch.pixel_angles[order],
    )


def test_exact_matches_give_one_track_per_point_with_its_rays():
    centers, points, batch = scene()
    tracks = tracks_of(batch)
    assert tracks.num_tracks == NUM_POINTS
    assert (tracks.lengths() == 6).all()
    for p in range(NUM_POINTS):
        rows = slice(tracks.offsets[p], tracks.offsets[p + 1])
        np.testing.assert_array_equal(tracks.cameras[rows], np.arange(6))
        np.testing.assert_allclose(tracks.rays[rows], normalized(points[p] - centers), atol=1e-12)


def test_tracks_do_not_depend_on_the_order_of_pairs_or_on_batches():
    _, _, batch = scene(noise=1e-3, wrong=0.2)
    order = np.random.default_rng(1).permutation(len(batch.pairs))
    shuffled = reordered(batch, order)
    one, other = tracks_of(batch), tracks_of(shuffled)
    halves = [reordered(shuffled, half) for half in np.array_split(np.arange(len(order)), 2)]
    split = build_tracks(halves)
    for again in (other, split):
        np.testing.assert_array_equal(again.offsets, one.offsets)
        np.testing.assert_array_equal(again.cameras, one.cameras)
        np.testing.assert_array_equal(again.rays, one.rays)


def test_a_track_that_meets_an_image_twice_is_dropped():
    _, _, batch = scene()
    keypoints = batch.keypoints.copy()
    keypoints[7, 1] = 8  # of image 0 it now matches keypoint 8 of image 1, at the ray that fits its direction
    assert tracks_of(dataclasses.replace(batch, keypoints=keypoints)).num_tracks == NUM_POINTS - 2


def test_a_single_match_joins_no_checked_tracks():
    _, _, batch = scene()
    keypoints = batch.keypoints.copy()
    keypoints[7, 1] = 8
    batch = dataclasses.replace(batch, keypoints=keypoints)
    assert tracks_of(batch).num_tracks == NUM_POINTS - 2
    assert checked_tracks_of(batch).lengths().tolist() == [6] * NUM_POINTS


def test_checked_tracks_are_what_no_single_match_holds_together():
    rng = np.random.default_rng(3)
    num_cut = 0
    for seed in range(20):
        _, _, batch = scene(cameras=6, seed=seed)
        kept = np.sort(rng.permutation(len(batch.pairs))[:7])
        tracks = checked_tracks_of(reordered(batch, kept))
        pairs = batch.pairs[kept]
        bridges = [
            connected_components(6, np.delete(pairs, k, axis=0)).max() > connected_components(6, pairs).max()
            for k in range(len(pairs))
        ]
        parts = connected_components(6, pairs[~np.array(bridges)])
        wanted = sorted(np.flatnonzero(parts == k).tolist() for k in range(6) if np.sum(parts == k) > 2)
        found = [
            tracks.cameras[tracks.offsets[p] : tracks.offsets[p + 1]].tolist()
            for p in range(tracks.num_tracks)
        ]
        assert sorted(found) == sorted(NUM_POINTS * wanted)
        num_cut += any(bridges)
    assert 5 < num_cut < 20


def test_with_too_many_matches_whole_stars_of_a_share_of_the_keypoints_are_kept():
    _, _, batch = scene()
    tracks, again = (tracks_of(batch, max_matches=len(batch.keypoints) // 2) for _ in range(2))
    np.testing.assert_array_equal(again.rays, tracks.rays)
    kept = sum(length * (length - 1) // 2 for length in tracks.lengths().tolist())
    assert 0 < kept < len(batch.keypoints)
    assert tracks_of(batch, max_matches=len(batch.keypoints) // 50).num_tracks < tracks.num_tracks


def test_matches_that_contradict_their_direction_join_no_track():
    _, points, batch = scene(wrong=0.15, seed=3)
    tracks = tracks_of(batch)
    assert tracks.num_tracks > 0
    for p in range(tracks.num_tracks):  # rays of one track meet in a point
        rows = slice(tracks.offsets[p], tracks.offsets[p + 1])
        centers = scene(seed=3)[0][tracks.cameras[rows]]
        projectors = np.eye(3) - tracks.rays[rows][:, :, None] * tracks.rays[rows][:, None, :]
        met = np.linalg.solve(projectors.sum(axis=0), np.einsum("kab,kb->a", projectors, centers))
        off = normalized(met - centers) - tracks.rays[rows]
        assert np.linalg.norm(off, axis=1).max() < 20 * PIXEL
    assert len(points) == NUM_POINTS


def test_two_views_and_no_matches_are_no_track():
    _, _, batch = scene(cameras=2)
    none = build_tracks([])
    assert tracks_of(batch).num_tracks == none.num_tracks == 0
    assert len(covering_set(none, 6)) == 0


def random_tracks(rng, lengths, num_cameras):
    cameras = np.concatenate([rng.choice(num_cameras, size=size, replace=False) for size in lengths])
    rays = normalized(rng.standard_normal((len(cameras), 3)))
    return Tracks(offsets=np.concatenate([[0], np.cumsum(lengths)]), cameras=cameras, rays=rays)


def test_a_covering_set_shows_every_camera_enough_points_or_all_there_are():
    rng = np.random.default_rng(5)
    tracks = random_tracks(rng, rng.integers(3, 7, size=300), 20)
    tracks.cameras[tracks.cameras == 19] = 18  # camera 19 sees nothing
    chosen = covering_set(tracks, 20, per_camera=8)
    seen = np.bincount(tracks.subset(chosen).cameras, minlength=20)
    assert (seen[:19] >= 8).all()
    assert seen[19] == 0
    assert len(chosen) < 120  # and no more than it needs
    assert (np.diff(chosen) > 0).all()


@pytest.mark.parametrize(("num_cameras", "least"), [(8, 60), (30, 26), (200, 20)])
def test_small_scenes_take_more_points_per_camera(num_cameras, least):
    tracks = random_tracks(np.random.default_rng(0), [4] * 60 * num_cameras, num_cameras)
    seen = np.bincount(tracks.subset(covering_set(tracks, num_cameras)).cameras, minlength=num_cameras)
    assert seen.min() >= least


def test_beyond_half_a_radian_the_number_of_views_decides_between_tracks():
    def fan(count, widest):
        angles = np.linspace(0.0, widest, count)
        return np.stack([np.sin(angles), np.zeros(count), np.cos(angles)], axis=1)

    tracks = Tracks(
        offsets=np.array([0, 3, 9]),
        cameras=np.array([0, 1, 2, 0, 1, 2, 3, 4, 5]),
        rays=np.concatenate([fan(3, 2.5), fan(6, 0.5)]),
    )
    assert covering_set(tracks, 6, per_camera=1).tolist() == [1]  # shows all; the wider one, only three


def test_joined_points_carry_the_rays_turned_round_and_their_noise():
    centers, points, batch = scene()
    directions = estimate_directions(batch)
    graph = ViewGraph(6, batch.pairs, directions.directions, names=[f"{k}.jpg" for k in range(6)])
    joint = join_points(graph, directions.covariance, tracks_of(batch), np.full(6, PIXEL), noise_px=2.0)
    assert joint.num_points == NUM_POINTS
    edges = joint.graph.edges[len(batch.pairs) :]
    truth = normalized(np.concatenate([centers, points])[edges[:, 0]] - points[edges[:, 1] - 6])
    np.testing.assert_allclose(joint.graph.directions[len(batch.pairs) :], truth, atol=1e-12)
    np.testing.assert_allclose(joint.covariance[-1], (2.0 * PIXEL) ** 2 * np.eye(2))
    assert joint.graph.names[6] == "point 0"
