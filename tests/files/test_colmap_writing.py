"""Seeded models: what is kept, what is triangulated and filtered; folders appear whole or not at all."""

import contextlib
import os
import resource
from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from sfm_shapefit.adjustment.freedom import Freedom
from sfm_shapefit.base.atomic_folder import atomic_folder
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.geometry import fit_similarity_l1
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.point_colors import read_colors
from sfm_shapefit.files.colmap.points import points2d_of, points_of
from sfm_shapefit.files.colmap.quiet import hear_pycolmap, quiet_stderr
from sfm_shapefit.files.colmap.seed import SeededModel, pick_points, write_model
from sfm_shapefit.files.colmap.template import template_of
from sfm_shapefit.scene.matches import KeypointMatches
from sfm_shapefit.scene.points import number_points
from sfm_shapefit.tracks.structure_options import StructureOptions
from tests.models import arrays, centers_of
from tests.problems import all_pairs
from tests.structures import (
    bundle_adjusted,
    colored,
    copy_without_points,
    filtered,
    matches_between,
    posed_images,
    triangulated,
    with_points,
)

NUM_IMAGES = 8
RADIUS = 6.0


def looking_at_origin(center):
    """cam_from_world of a camera at `center`, z axis towards the origin."""
    forward = -center / np.linalg.norm(center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def ring_centers(n=NUM_IMAGES):
    angle = 2.0 * np.pi * np.arange(n) / n
    return RADIUS * np.stack([np.cos(angle), np.sin(angle), 0.2 * np.sin(3.0 * angle)], axis=1)


def ring_model(noise_px=0.0, num_points=120, seed=0, centers=None):
    """A model whose point p is keypoint p of every image; ids are not consecutive, two cameras differ."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.5, 1.5, size=(num_points, 3))
    colors = rng.integers(20, 255, size=(num_points, 3), dtype=np.uint8)
    model = pycolmap.Reconstruction()
    for camera_id, params in ((3, [800.0, 500.0, 400.0, -0.05]), (7, [650.0, 510.0, 390.0, 0.03])):
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=camera_id, model="SIMPLE_RADIAL", width=1000, height=800, params=params)
        )
    for k, center in enumerate(ring_centers() if centers is None else centers):
        rotation = looking_at_origin(center)
        camera_id = 3 if k % 3 else 7
        xy = model.camera(camera_id).img_from_cam((points - center) @ rotation.T)
        image = pycolmap.Image(
            name=f"view{k}.jpg",
            keypoints=xy + noise_px * rng.normal(size=xy.shape),
            camera_id=camera_id,
            image_id=10 * k + 5,
        )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ center)
        model.add_image_with_trivial_frame(image, pose)
    for point, color in zip(points, colors, strict=True):
        index = model.num_points3D()
        elements = [pycolmap.TrackElement(10 * k + 5, index) for k in range(NUM_IMAGES)]
        model.add_point3D(point, pycolmap.Track(elements), color)
    model.update_point_3d_errors()
    return model, points


def all_matches(num_points=120, n=NUM_IMAGES):
    """Every keypoint matched between every two images, in two batches."""
    pairs = np.array(all_pairs(n))
    return [batch_of(half, num_points) for half in np.array_split(pairs, 2)]


def batch_of(pairs, num_points):
    keypoints = np.tile(np.stack([np.arange(num_points)] * 2, axis=1), (len(pairs), 1))
    offsets = num_points * np.arange(len(pairs) + 1)
    return KeypointMatches(pairs=pairs, offsets=offsets, keypoints=keypoints)


def seeded(reconstruction, centers=None, placed=None, keypoints=None, batches=None):
    """The seed of a reconstruction at the given centers, or its own, and its matches."""
    model = read_model(reconstruction)
    placed = np.ones(model.images.num_images, dtype=bool) if placed is None else placed
    centers = model.images.centers if centers is None else centers
    rows = np.flatnonzero(placed)
    images = model.images.placed(rows, centers[rows])
    seed = SeededModel.of(
        template_of(model), images, number_points([]), None if keypoints is None else keypoints.get
    ).reconstruction
    batches = all_matches() if batches is None else batches
    return seed, matches_between(seed, model.images.ids, batches)


SOURCES = pytest.mark.parametrize("source", ["matches", "tracks"])


def seeded_with(source, original, centers=None):
    """The seed, and what its points are triangulated from: all matches, or the model's own tracks."""
    seed, matches = seeded(original, centers)
    return seed, matches if source == "matches" else original


def dump(reconstruction):
    """Everything in a reconstruction, as bytes that compare equal only if every bit is."""
    lines = []
    for i, camera in sorted(reconstruction.cameras.items()):
        lines.append((i, camera.model.name, camera.width, camera.height, bytes(np.array(camera.params))))
    for i, frame in sorted(reconstruction.frames.items()):
        pose = frame.rig_from_world
        lines.append((i, frame.rig_id, None if pose is None else bytes(np.array(pose.params))))
    for i, image in sorted(reconstruction.images.items()):
        seen = [(bytes(np.array(p.xy)), p.point3D_id) for p in image.points2D]
        lines.append((i, image.name, image.camera_id, image.frame_id, image.has_pose, seen))
    for i, point in sorted(reconstruction.points3D.items()):
        track = sorted((e.image_id, e.point2D_idx) for e in point.track.elements)
        lines.append((i, bytes(np.array(point.xyz)), bytes(np.array(point.color)), point.error, track))
    return [*lines, sorted(reconstruction.reg_image_ids()), sorted(reconstruction.rigs)]


def test_rotations_and_intrinsics_of_a_written_seed_are_the_inputs_bit_by_bit(tmp_path):
    original, _ = ring_model()
    moved = 3.0 * ring_centers() + [100.0, -7.0, 0.5]
    seed, _ = seeded(original, moved)
    write_model(seed, tmp_path)
    written = pycolmap.Reconstruction(tmp_path)
    for i, image in original.images.items():
        ours = written.image(i)
        assert ours.name == image.name
        assert ours.camera_id == image.camera_id
        assert bytes(ours.cam_from_world().rotation.quat) == bytes(image.cam_from_world().rotation.quat)
        assert bytes(np.array(ours.camera.params)) == bytes(np.array(image.camera.params))
    # C = -R^T t undoes t = -R C up to a few roundings of |C| ~ 100 (eps = 2.2e-16)
    np.testing.assert_allclose(centers_of(written), moved, rtol=0.0, atol=1e-12)
    assert written.num_points3D() == 0


def test_the_input_of_every_stage_stays_as_it_was():
    original, _ = ring_model(noise_px=0.3)
    before = dump(original)
    seed, matches = seeded(original, ring_centers() + 0.01)
    seed_before = dump(seed)
    for tracks in (matches, original):
        structure = triangulated(seed, tracks)
        structure_before = dump(structure)
        colored(structure, original)
        filtered(structure, StructureOptions(max_reprojection_error_px=0.1))
        assert dump(structure) == structure_before
        bundle_adjusted(seed, tracks)
    assert dump(seed) == seed_before
    assert dump(original) == before


def test_an_image_that_is_not_placed_is_unregistered_and_the_model_still_loads(tmp_path):
    original, _ = ring_model()
    placed = np.arange(NUM_IMAGES) != 2
    centers = np.where(placed[:, None], ring_centers(), np.nan)
    seed, matches = seeded(original, centers, placed)
    structure = triangulated(seed, matches)
    write_model(structure, tmp_path)
    written = read_model(tmp_path)
    assert written.images.names == tuple(f"view{k}.jpg" for k in range(NUM_IMAGES) if k != 2)
    assert structure.num_points3D() == 120
    assert all(p.track.length() == NUM_IMAGES - 1 for p in structure.points3D.values())
    assert triangulated(seed, original).num_points3D() == 120


def test_images_without_a_pose_stay_so(tmp_path):
    original, _ = ring_model()
    original.deregister_frame(original.image(25).frame_id)
    seed, _ = seeded(original, batches=[])
    write_model(seed, tmp_path)
    assert 25 not in pycolmap.Reconstruction(tmp_path).reg_image_ids()
    assert seed.num_reg_images() == NUM_IMAGES - 1


@pytest.mark.parametrize("missing", [None, np.zeros((0, 2))], ids=["none", "no rows"])
def test_keypoints_of_the_database_replace_the_models_where_there_are_any(missing):
    original, _ = ring_model()
    xy = np.arange(10.0).reshape(5, 2)
    table = {0: xy, 3: xy + 0.5}
    keypoints = {index: table.get(index, missing) for index in range(NUM_IMAGES)}
    seed, _ = seeded(original, keypoints=keypoints, batches=[])
    np.testing.assert_array_equal([p.xy for p in seed.image(5).points2D], xy)
    np.testing.assert_array_equal([p.xy for p in seed.image(35).points2D], xy + 0.5)
    for image_id in (15, 25):
        own = [p.xy for p in original.image(image_id).points2D]
        np.testing.assert_array_equal([p.xy for p in seed.image(image_id).points2D], own)


@SOURCES
def test_exact_data_give_every_point_back_with_its_color(source):
    original, points = ring_model()
    structure = colored(triangulated(*seeded_with(source, original)), original)
    assert structure.num_points3D() == len(points)
    for point in structure.points3D.values():
        truth = original.points3D[original.image(5).point2D(point.track.elements[0].point2D_idx).point3D_id]
        # undistortion is iterated to ~1e-10 px; a pixel spans 6 / 650 = 0.01 units
        np.testing.assert_allclose(point.xyz, truth.xyz, rtol=0.0, atol=1e-9)
        np.testing.assert_array_equal(point.color, truth.color)
        assert point.track.length() == NUM_IMAGES
        assert point.error == pytest.approx(0.0, abs=1e-6)


def test_points_follow_the_new_positions_and_those_of_the_models_own_tracks_keep_their_ids():
    original, points = ring_model()
    for point_id in (3, 50):
        original.delete_point3D(point_id)
    seed, matches = seeded(original, 2.0 * ring_centers() + [1.0, 2.0, 3.0])
    for tracks in (matches, original):
        structure = triangulated(seed, tracks)
        assert structure.num_points3D() == 120 if tracks is matches else 118
        for point_id, point in structure.points3D.items():
            (keypoint,) = {element.point2D_idx for element in point.track.elements}
            assert tracks is matches or keypoint == point_id - 1
            expected = 2.0 * points[keypoint] + [1.0, 2.0, 3.0]
            np.testing.assert_allclose(point.xyz, expected, rtol=0.0, atol=2e-9)
    assert set(structure.point3D_ids()) == set(original.point3D_ids())


def wrong_in_part(share):
    """All matches of the ring, of which a share is of wrong keypoints."""
    rng = np.random.default_rng(1)
    batches = all_matches()
    for batch in batches:
        wrong = rng.random(len(batch.keypoints)) < share
        batch.keypoints[wrong, 1] = rng.integers(0, 120, size=wrong.sum())
    return batches


def test_points_of_matches_are_the_same_bits_whatever_the_blocks(monkeypatch):
    original, _ = ring_model(noise_px=0.3)
    found = []
    for matches in (10**9, 11, 500):
        monkeypatch.setattr("sfm_shapefit.adjustment.sources._MATCHES_A_SLICE", matches)
        found.append(dump(triangulated(*seeded(original, batches=wrong_in_part(0.3)))))
    assert found[0] == found[1] == found[2]


def by_colmap(original, batches):
    """The points that COLMAP's own incremental triangulator makes of matches, at the model's own poses."""
    structure, graph = seeded(original, batches=[])[0], pycolmap.CorrespondenceGraph()
    image_ids = sorted(structure.reg_image_ids())
    for image_id in image_ids:
        graph.add_image(image_id, structure.image(image_id).num_points2D())
    for batch in batches:
        for k, (first, second) in enumerate(batch.pairs.tolist()):
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED.value
            geometry.inlier_matches = batch.keypoints[batch.offsets[k] : batch.offsets[k + 1]].astype(
                np.uint32
            )
            graph.add_two_view_geometry(image_ids[first], image_ids[second], geometry)
    graph.finalize()
    settings = pycolmap.IncrementalTriangulatorOptions()
    manager = pycolmap.ObservationManager(structure, graph)
    triangulator = pycolmap.IncrementalTriangulator(graph, structure, manager)
    for image_id in image_ids:
        triangulator.triangulate_image(settings, image_id)
    triangulator.complete_all_tracks(settings)
    triangulator.merge_all_tracks(settings)
    manager.filter_all_points3D(4.0, 1.5)
    return structure


def test_points_of_matches_are_those_of_colmaps_triangulator():
    original, points = ring_model(noise_px=0.3)
    seen = []
    ours = triangulated(*seeded(original), None, lambda *done: seen.append(done))
    theirs = by_colmap(original, all_matches())
    assert seen[-1] == (len(points), len(points))
    assert ours.num_points3D() == theirs.num_points3D() == len(points)
    assert ours.compute_num_observations() == theirs.compute_num_observations()
    # ours are at the least squares of their observations, up to what lenses make of pixels
    assert ours.compute_mean_reprojection_error() <= 1.01 * theirs.compute_mean_reprojection_error()


def test_a_match_of_two_images_is_kept_if_one_has_another_partner_as_by_colmaps_triangulator():
    original, _ = ring_model()
    further = batch_of(np.array([[1, 2]]), 60)
    further.keypoints[:, 1] = 119 - further.keypoints[:, 1]  # of other points

    batches = [batch_of(np.array([[0, 1]]), 120), further]

    def seeing(structure):
        first = min(structure.images)
        return {
            e.point2D_idx
            for p in structure.points3D.values()
            for e in p.track.elements
            if e.image_id == first
        }

    assert seeing(triangulated(*seeded(original, batches=batches))) == set(range(60))
    assert seeing(by_colmap(original, batches)) == set(range(60))


def test_points_under_a_small_angle_are_made_only_if_it_is_asked_for():
    # baselines of at most 0.12 units at 60 units: 0.11 degrees
    original, _ = ring_model(centers=0.01 * ring_centers() + [60.0, 0.0, 0.0])
    seed, matches = seeded(original)
    for tracks in (matches, original):
        assert triangulated(seed, tracks).num_points3D() == 0
        options = StructureOptions(min_triangulation_angle_deg=0.05)
        assert triangulated(seed, tracks, options).num_points3D() == 120


def reprojection_errors_px(structure):
    return [
        float(np.linalg.norm(image.project_point(point.xyz) - image.point2D(e.point2D_idx).xy))
        for point in structure.points3D.values()
        for e in point.track.elements
        for image in (structure.image(e.image_id),)
    ]


def test_wrong_matches_make_no_point_that_misses_its_observations():
    structure = triangulated(*seeded(ring_model(noise_px=0.3)[0], batches=wrong_in_part(0.3)))
    assert structure.num_points3D() >= 120
    assert max(reprojection_errors_px(structure)) <= 4.0


def test_matches_that_only_two_images_share_are_left_out_unless_asked_for_or_no_more_are_placed():
    seed, matches = seeded(ring_model()[0], batches=[batch_of(np.array([[0, 1]]), 120)])
    assert triangulated(seed, matches).num_points3D() == 0
    both = triangulated(seed, matches, StructureOptions(ignore_two_view_tracks=False))
    assert both.num_points3D() == 120
    seed, matches = seeded(ring_model(noise_px=0.3)[0], placed=np.arange(NUM_IMAGES) < 2)
    assert triangulated(seed, matches).num_points3D() == 120
    assert bundle_adjusted(seed, matches).reconstruction.num_points3D() == 120
    assert triangulated(*seeded(ring_model()[0], batches=[])).num_points3D() == 0


def test_a_point_takes_the_mean_colour_of_the_points_whose_observations_it_shares():
    # every point of the source is split in two of 4 images each, which matches of all images join again
    original, _ = ring_model()
    for point_id in list(original.point3D_ids()):
        half = pycolmap.Track(original.point3D(point_id).track.elements[:4])
        for element in half.elements:
            original.delete_observation(element.image_id, element.point2D_idx)
        original.point3D(point_id).color = np.array([10, 20, 30], dtype=np.uint8)
        original.add_point3D(np.zeros(3), half, np.array([20, 20, 33], dtype=np.uint8))
    seed, matches = seeded(original)
    black = triangulated(seed, matches)
    structure = colored(black, original)
    assert not any(point.color.any() for point in black.points3D.values())
    assert structure.num_points3D() == 120
    for point in structure.points3D.values():
        # means 15, 20 and 31.5; a half is rounded to even
        np.testing.assert_array_equal(point.color, [15, 20, 32])


@pytest.mark.parametrize("step", [1, 10**12], ids=["few gaps", "wide gaps"])
def test_colors_are_those_of_the_points_that_are_seen_whatever_their_ids(step):
    original, _ = ring_model()
    model = copy_without_points(original)
    for point_id, point in original.points3D.items():
        model.add_point3D_with_id(7 + step * point_id, pycolmap.Point3D(point.todict()))
    found = read_colors(arrays(model))
    for image_id, seen in found.images.items():
        points2d = original.image(image_id).points2D
        expected = [original.point3D(points2d[k].point3D_id).color for k in seen.keypoints.tolist()]
        np.testing.assert_array_equal(found.colors[seen.points], expected)
    assert len(found.images) == NUM_IMAGES


def test_colors_come_only_from_images_with_the_same_keypoints_and_only_where_there_are_any():
    original, _ = ring_model()
    moved = [np.array([p.xy for p in original.image(i).points2D]) + 0.25 for i in sorted(original.images)]
    for changed, is_black in ((range(NUM_IMAGES), True), (range(1, NUM_IMAGES), False)):
        seed_and_matches = seeded(original, keypoints={k: moved[k] for k in changed})
        structure = colored(triangulated(*seed_and_matches), original)
        assert structure.num_points3D() == 120
        assert [bool(p.color.any()) for p in structure.points3D.values()] == [not is_black] * 120
    for point in original.points3D.values():
        point.color = np.zeros(3, dtype=np.uint8)
    structure = colored(structure, original)
    assert all(point.color.any() for point in structure.points3D.values())


def with_one_more_point(xyz, image_ids, offset_px=0.0):
    """The exact model plus one point with exact observations (the projection formula also behind cameras)."""
    original, _ = ring_model()
    extra = {}
    for index, image_id in enumerate(sorted(original.images)):
        x = original.image(image_id).cam_from_world() * np.asarray(xyz, dtype=float)
        camera = original.image(image_id).camera
        f, cx, cy = camera.params[:3]
        xy = np.array([cx, cy]) + f * x[:2] / x[2]
        if x[2] > 0.0:
            xy = camera.img_from_cam(x)
        own = np.array([p.xy for p in original.image(image_id).points2D])
        extra[index] = np.vstack([own, xy + np.array([offset_px * (image_id == image_ids[0]), 0.0])])
    seed, _ = seeded(original, keypoints=extra, batches=[])
    for point in original.points3D.values():
        seed.add_point3D(point.xyz, pycolmap.Track(point.track.elements))
    elements = [pycolmap.TrackElement(i, 120) for i in image_ids]
    return seed, seed.add_point3D(np.asarray(xyz, dtype=float), pycolmap.Track(elements))


@pytest.mark.parametrize(
    ("xyz", "image_ids", "why"),
    [
        ([25.0, 0.0, 0.0], [5, 15], "behind cameras 0 and 1"),
        ([-4000.0, 0.0, 0.0], [5, 15, 75], "0.1 degrees of triangulation angle"),
    ],
)
def test_a_point_is_removed_that_is(xyz, image_ids, why):
    seed, point_id = with_one_more_point(xyz, image_ids)
    kept = filtered(seed)
    assert not kept.exists_point3D(point_id), why
    assert kept.num_points3D() == 120


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_point_that_is_not_finite_is_removed(value):
    model, _ = ring_model()
    points = points_of(arrays(model), posed_images(model))
    xyz = points.xyz.copy()
    xyz[7, 0] = value
    kept = with_points(model, replace(points, xyz=xyz))
    assert {*points.ids.tolist()} - {*kept.points3D} == {points.ids[7]}


@pytest.mark.parametrize(("offset_px", "length"), [(3.9, 4), (4.1, 3)])
def test_an_observation_is_removed_beyond_the_threshold_and_its_point_stays(offset_px, length):
    seed, point_id = with_one_more_point([0.3, 0.2, 0.1], [5, 25, 45, 65], offset_px)
    point = filtered(seed).points3D[point_id]
    assert point.track.length() == length
    assert point.error == pytest.approx(offset_px / 4 if length == 4 else 0.0, abs=1e-6)


def test_point_errors_are_those_of_the_observations_that_are_left():
    original, _ = ring_model(noise_px=2.0)
    loose = triangulated(*seeded(original), StructureOptions(max_reprojection_error_px=8.0))
    for point in loose.points3D.values():
        point.xyz, point.error = point.xyz + 0.003, 77.0
    kept = filtered(loose, StructureOptions(max_reprojection_error_px=3.0))
    assert 0 < kept.compute_num_observations() < loose.compute_num_observations()
    lengths = [point.track.length() for point in kept.points3D.values()]
    errors_px = np.split(reprojection_errors_px(kept), np.cumsum(lengths)[:-1])
    # the same sums in another order: roundings of some pixels
    mean_px = [error_px.mean() for error_px in errors_px]
    np.testing.assert_allclose([p.error for p in kept.points3D.values()], mean_px, rtol=1e-12)


@pytest.mark.parametrize(
    ("xyz", "image_ids", "option", "loose", "strict"),
    [
        # Cameras 1 and 7 are 6 sqrt(2) = 8.5 units apart, seen from 4000 units away: 0.12 degrees.
        ([-4000.0, 0.0, 0.0], [15, 75], "min_triangulation_angle_deg", 0.10, 0.14),
        ([0.3, 0.2, 0.1], [5, 25, 45], "min_track_length", 3, 4),
    ],
)
def test_a_point_stays_if_what_is_asked_for_is_less_than_it_has(xyz, image_ids, option, loose, strict):
    seed, point_id = with_one_more_point(xyz, image_ids)
    for value in (loose, strict):
        kept = filtered(seed, StructureOptions(**{option: value}))
        assert kept.exists_point3D(point_id) == (value == loose)
        assert kept.num_points3D() == 120 + (value == loose)


@SOURCES
def test_adjustment_of_a_disturbed_seed_of_exact_data_finds_the_truth(source):
    original, points = ring_model()
    disturbed = ring_centers() + np.random.default_rng(3).normal(scale=0.03 * RADIUS, size=(NUM_IMAGES, 3))
    adjusted = bundle_adjusted(*seeded_with(source, original, disturbed))
    centers, estimate = centers_of(adjusted.reconstruction), adjusted.estimate
    aligned = fit_similarity_l1(centers, ring_centers()).apply(centers)
    # the solver stops when the cost falls by less than 1e-6 of itself; 0.18 units of disturbance before
    assert np.linalg.norm(aligned - ring_centers(), axis=1).max() < 1e-4
    assert estimate.solves.converged
    assert adjusted.reconstruction.compute_mean_reprojection_error() < 0.01 < estimate.solves.initial_error_px
    assert adjusted.reconstruction.num_points3D() == len(points)
    assert adjusted.reconstruction.compute_num_observations() == len(points) * NUM_IMAGES
    for i, camera in original.cameras.items():
        assert bytes(np.array(adjusted.reconstruction.camera(i).params)) == bytes(np.array(camera.params))


def test_intrinsics_stay_what_they_are_unless_they_are_in_doubt():
    original, _ = ring_model()
    camera = original.camera(3)
    camera.params = np.array(camera.params) * [1.01, 1.0, 1.0, 1.0]
    seed, matches = seeded(original)
    fixed = bundle_adjusted(seed, matches)
    assert fixed.reconstruction.camera(3).params[0] == 808.0
    ids = np.array(sorted(original.cameras))
    found = bundle_adjusted(seed, matches, freedom=Freedom(parts=np.outer(ids == 3, [True, False])))
    for camera_id, camera in found.reconstruction.cameras.items():
        if camera_id == 3:
            assert camera.params[0] == pytest.approx(800.0, rel=5e-4)
        else:
            assert camera.params.tolist() == original.camera(camera_id).params.tolist()
    assert found.estimate.is_refined.tolist() == (ids == 3).tolist()
    assert found.estimate.focal_sigmas[ids == 3] < 0.01


def test_adjusted_points_satisfy_the_same_filters():
    original, _ = ring_model(noise_px=1.0)
    seed, matches = seeded(original)
    adjusted = bundle_adjusted(seed, matches, StructureOptions(max_reprojection_error_px=1.5))
    assert 1.0 < max(reprojection_errors_px(adjusted.reconstruction)) <= 1.5


def test_that_no_point_can_be_adjusted_is_told():
    seed, matches = seeded(ring_model(noise_px=0.5)[0], np.zeros((NUM_IMAGES, 3)))
    with pytest.raises(UnsolvableError, match="run with adjust=none"):
        bundle_adjusted(seed, matches)


@pytest.mark.parametrize("quiet", [True, False])
def test_what_pycolmap_says_reaches_the_terminal_only_if_wanted(capfd, quiet):
    with hear_pycolmap(not quiet), quiet_stderr():
        os.write(2, b"W20260101 cholmod: matrix not positive definite")
    said = capfd.readouterr()
    assert said.out == ""
    assert ("not positive definite" in said.err) != quiet
    with contextlib.suppress(KeyError), quiet_stderr():
        os.write(2, b"lost")
        raise KeyError
    os.write(2, b"after")  # it is quiet inside the block only
    assert capfd.readouterr().err == "after"


def seed_with_points():
    """A seed with the points and colors of its input; of two images the database has the keypoints."""
    original, _ = ring_model(noise_px=0.3)
    model = read_model(original)
    images, points = (
        model.images.placed(range(1, NUM_IMAGES), ring_centers()[1:]),
        points_of(model.arrays, model.images),
    )
    points = points.taken((points.images > 0) & ((points.images + points.keypoints) % 4 > 0))
    known = points2d_of(model.arrays, images)
    return SeededModel.of(
        template_of(model), images, points, lambda k: known(k).astype("f4") if k in (2, 5) else None
    )


def test_a_seed_writes_the_bytes_that_pycolmap_writes_of_it(tmp_path, monkeypatch):
    monkeypatch.setattr("sfm_shapefit.files.colmap.seed.AT_ONCE", 50)
    seed = seed_with_points()
    folders = [tmp_path / name for name in ("ours", "theirs")]
    for folder in folders:
        folder.mkdir()
    seed.write(folders[0])
    built = seed.reconstruction
    write_model(built, folders[1])
    for file in folders[1].iterdir():
        assert (folders[0] / file.name).read_bytes() == file.read_bytes(), file.name
    assert len(list(folders[0].iterdir())) == 5
    assert dump(pycolmap.Reconstruction(folders[0])) == dump(pycolmap.Reconstruction(folders[1]))
    assert built.num_points3D() == seed.num_points3D() == 120
    assert built.num_reg_images() == seed.num_reg_images() == NUM_IMAGES - 1
    assert all(point.color.any() for point in built.points3D.values())
    errors = [one.compute_mean_reprojection_error() for one in (built, seed)]
    np.testing.assert_allclose(*errors, rtol=1e-12)
    for ours, theirs in zip(pick_points(seed, 7), pick_points(built, 7), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("limit", [100, 4096, 20000], ids=["no file", "no images", "no points"])
def test_a_full_disk_is_noticed_although_pycolmap_does_not(tmp_path, limit):
    seed = seed_with_points()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    # A longer file cannot be written, as on a full disk.
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    full = pytest.raises(InputError, match="check the free space")
    try:
        with full, atomic_folder(tmp_path / "out") as partial:
            seed.write(partial)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("seed", range(4))
def test_what_is_read_is_written_again_byte_by_byte_and_text_has_the_same_arrays(tmp_path, seed):
    pycolmap.set_random_seed(seed)
    rng, options = np.random.default_rng(seed), pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = (int(n) for n in rng.integers(1, 4, 2))
    options.num_frames_per_rig, options.num_points3D = 3, 15
    options.num_points2D_without_point3D = int(rng.integers(0, 4))
    model = pycolmap.synthesize_dataset(options)
    for point in list(model.points3D.values())[::2]:
        point.color = rng.integers(0, 256, 3).astype(np.uint8)
    model.add_point3D(rng.normal(size=3), pycolmap.Track())  # which nobody observes
    folders = [tmp_path / name for name in ("theirs", "text", "ours", "of text", "of memory")]
    for folder in folders:
        folder.mkdir()
    model.write_binary(folders[0])
    model.write_text(folders[1])
    for source, folder in zip((folders[0], folders[1], model), folders[2:], strict=True):
        write_model(read_model(source).arrays, folder)
        for file in folders[0].iterdir():
            assert (folder / file.name).read_bytes() == file.read_bytes(), file.name


def test_an_unposed_frame_and_a_prior_survive_the_way_through_arrays():
    model, _ = ring_model()
    model.camera(min(model.cameras)).has_prior_focal_length = True
    model.deregister_frame(min(model.frames))
    built = read_model(read_model(model).arrays).reconstruction
    assert dump(built) == dump(model)
    assert built.num_reg_images() == model.num_reg_images() == NUM_IMAGES - 1
    assert [c.has_prior_focal_length for _, c in sorted(built.cameras.items())] == [
        c.has_prior_focal_length for _, c in sorted(model.cameras.items())
    ]
