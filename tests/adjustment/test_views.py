"""A reconstruction as an adjustment problem and back: every lens, rigs, fixed frames, tracks."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit import InputError
from sfm_shapefit.adjustment import run as adjustment_run
from sfm_shapefit.adjustment.bundle_adjustment import adjust_placement, adjust_thinly
from sfm_shapefit.adjustment.freedom import Freedom, GivenPoses
from sfm_shapefit.adjustment.solve import reprojection_errors_px
from sfm_shapefit.adjustment.sources import collect_matches
from sfm_shapefit.adjustment.views import views_of
from sfm_shapefit.base.geometry import fit_similarity
from sfm_shapefit.files.colmap.points import ModelKeypoints, points2d_of, points_of, structure_of
from sfm_shapefit.scene.images import Sensors
from sfm_shapefit.scene.matches import KeypointMatches
from sfm_shapefit.tracks.structure_options import StructureOptions
from sfm_shapefit.tracks.triangulation import TriangulatedPoints
from tests.models import arrays, centers_of
from tests.scenes import BUNDLED
from tests.structures import (
    adjusted_thinly,
    bundle_adjusted,
    in_doubt,
    links_of,
    matches_between,
    posed_images,
)

DISTORTIONS = {
    "SIMPLE_PINHOLE": [],
    "PINHOLE": [],
    "SIMPLE_RADIAL": [-0.05],
    "RADIAL": [-0.05, 0.01],
    "OPENCV": [-0.05, 0.01, 1e-3, -1e-3],
    "FULL_OPENCV": [-0.05, 0.01, 1e-3, -1e-3, 0.0, 0.01, 0.0, 0.0],
    "FOV": [0.4],
    "SIMPLE_RADIAL_FISHEYE": [-0.02],
    "RADIAL_FISHEYE": [-0.02, 0.005],
    "OPENCV_FISHEYE": [-0.02, 0.005, 1e-3, 0.0],
    "THIN_PRISM_FISHEYE": [-0.02, 0.005, 1e-4, 1e-4, 0.0, 0.0, 1e-4, 1e-4],
    "SIMPLE_FISHEYE": [],
    "SIMPLE_DIVISION": [-0.1],
    "EUCM": [0.6, 1.1],
}


def camera_of(model):
    """A camera of 640 x 480 with focal lengths of 400 and distortion."""
    camera = pycolmap.Camera.create_from_model_id(1, getattr(pycolmap.CameraModelId, model), 400.0, 640, 480)
    if DISTORTIONS[model]:
        camera.params = np.concatenate(
            [camera.params[: len(camera.params) - len(DISTORTIONS[model])], DISTORTIONS[model]]
        )
    return camera


def scene(model="PINHOLE", *, rigs=False, noise_px=0.3, seed=0):
    """A made reconstruction whose images see all points through a lens, with noise on their pixels."""
    pycolmap.set_random_seed(seed)
    made = pycolmap.SyntheticDatasetOptions()
    made.num_rigs, made.num_frames_per_rig, made.num_points3D = (2, 4, 80) if rigs else (1, 7, 80)
    made.num_cameras_per_rig = 2 if rigs else 1
    made.sensor_from_rig_translation_stddev, made.sensor_from_rig_rotation_stddev = 0.2, 5.0
    camera = camera_of(model)
    made.camera_width, made.camera_height = camera.width, camera.height
    made.camera_model_id, made.camera_params = camera.model, camera.params.tolist()
    made.camera_has_prior_focal_length = True
    made.num_points2D_without_point3D = 5
    found = pycolmap.synthesize_dataset(made)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = noise_px
    pycolmap.synthesize_noise(noise, found)
    found.update_point_3d_errors()
    return found


def disturbed(model, size=0.02, seed=1):
    """A copy whose frames and points are moved, and the frames turned."""
    rng, copy = np.random.default_rng(seed), pycolmap.Reconstruction(model)
    for frame_id in sorted(copy.reg_frame_ids()):
        pose = copy.frame(frame_id).rig_from_world
        turn = pycolmap.Rotation3d(0.1 * size * rng.standard_normal(3))
        copy.frame(frame_id).rig_from_world = pycolmap.Rigid3d(
            turn * pose.rotation, pose.translation + size * rng.standard_normal(3)
        )
    for point_id in sorted(copy.point3D_ids()):
        copy.point3D(point_id).xyz = copy.point3D(point_id).xyz + size * rng.standard_normal(3)
    return copy


WITH_RIGS = [*((model, False) for model in DISTORTIONS), ("OPENCV", True), ("OPENCV_FISHEYE", True)]


@pytest.mark.parametrize(("model", "rigs"), WITH_RIGS)
def test_the_errors_are_those_of_pycolmap_through_every_lens(model, rigs):
    given = scene(model, rigs=rigs)
    images, tracks = posed_images(given), links_of(given, given)
    points = points_of(arrays(given), images)
    assert points.ids.tolist() == sorted(given.point3D_ids())
    held = np.zeros(len(images.lenses), dtype=bool)
    found = TriangulatedPoints(
        points=points.xyz, tracks=np.arange(points.num_points), points_seen=points.points_seen()
    )
    problem = views_of(images).problem(images, held, GivenPoses(), tracks, found)
    assert problem.num_observations == given.compute_num_observations()
    errors = reprojection_errors_px(problem)
    sums = np.bincount(problem.points_seen, errors)
    ours = sums / np.bincount(problem.points_seen)
    theirs = np.array([given.point3D(i).error for i in points.ids.tolist()])
    np.testing.assert_allclose(ours, theirs, rtol=1e-9)


@pytest.mark.parametrize(("model", "rigs"), WITH_RIGS)
def test_a_disturbed_model_of_any_lens_is_adjusted_back(model, rigs):
    truth = scene(model, rigs=rigs, noise_px=0.0)
    start = disturbed(truth)
    given = centers_of(start)
    found = sfm_shapefit.bundle_adjust(start, cost_tolerance=0.0)
    assert found.adjusted.converged
    np.testing.assert_array_equal(centers_of(start), given)
    centers, true = centers_of(found.reconstruction), centers_of(truth)
    error = np.abs(fit_similarity(centers, true).apply(centers) - true).max()
    assert (
        error < 1e-6 < np.abs(fit_similarity(centers_of(start), true).apply(centers_of(start)) - true).max()
    )
    assert found.reconstruction.compute_mean_reprojection_error() < 1e-5
    for i, camera in truth.cameras.items():
        assert bytes(found.reconstruction.camera(i).params) == bytes(camera.params)


@pytest.mark.parametrize(("model", "rigs"), [("OPENCV_FISHEYE", True), ("EUCM", False)])
def test_lenses_of_any_model_are_found_where_they_are_free(model, rigs):
    truth = scene(model, rigs=rigs, noise_px=0.0)
    start = disturbed(truth)
    for camera in start.cameras.values():
        camera.params = camera.params * np.repeat([1.03, 1.0], [2, len(camera.params) - 2])
    free = {"free_focal_lengths": True, "free_distortion": True}
    found = sfm_shapefit.bundle_adjust(start, cost_tolerance=0.0, **free).reconstruction
    for i, camera in truth.cameras.items():
        np.testing.assert_allclose(found.camera(i).params, camera.params, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("rigs", [False, True])
def test_fixed_frames_keep_their_bits_and_held_rotations_theirs(rigs):
    start = disturbed(scene(rigs=rigs))
    fixed = sorted(start.reg_frame_ids())[:2]
    found = sfm_shapefit.bundle_adjust(start, fixed_frames=fixed).reconstruction
    held = sfm_shapefit.bundle_adjust(start, hold_rotations=True).reconstruction
    for frame_id in sorted(start.reg_frame_ids()):
        poses = [model.frame(frame_id).rig_from_world for model in (start, found, held)]
        assert (poses[0].matrix() == poses[1].matrix()).all() == (frame_id in fixed)
        np.testing.assert_array_equal(poses[0].rotation.quat, poses[2].rotation.quat)
        assert (poses[0].translation != poses[2].translation).any()


def test_rotations_with_a_standard_deviation_lie_between_held_and_free_ones():
    start = disturbed(scene(noise_px=1.0))

    def turned(**options):
        after = sfm_shapefit.bundle_adjust(start, **options).reconstruction
        images = sorted(start.reg_image_ids())
        pairs = [[m.image(i).cam_from_world().rotation for m in (start, after)] for i in images]
        return sum((a * b.inverse()).angle() for a, b in pairs)

    assert turned(hold_rotations=True) == pytest.approx(0.0, abs=1e-7)
    assert 0.0 < turned(rotation_sigma_deg=1e-3) < 0.2 * turned(rotation_sigma_deg=0.3)
    assert turned(rotation_sigma_deg=0.3) < turned()


def test_free_lenses_are_written_back_and_covariances_given():
    truth = scene("SIMPLE_RADIAL", noise_px=0.0)
    start = disturbed(truth)
    start.camera(1).params = start.camera(1).params * [1.02, 1.0, 1.0, 0.5]
    options = {"free_focal_lengths": True, "free_distortion": True, "cost_tolerance": 0.0}
    found = sfm_shapefit.bundle_adjust(start, **options, covariances=True)
    np.testing.assert_allclose(found.reconstruction.camera(1).params, truth.camera(1).params, rtol=1e-6)
    assert found.covariances.centers.shape == (7, 3, 3)
    assert found.frame_ids == tuple(sorted(start.reg_frame_ids()))
    assert "7 frames adjusted" in repr(found)
    assert found.summary()["converged"]


def test_a_model_without_points_is_refused():
    empty = scene()
    for point_id in list(empty.point3D_ids()):
        empty.delete_point3D(point_id)
    with pytest.raises(InputError, match="nothing to adjust"):
        sfm_shapefit.bundle_adjust(empty)


def matches_of(model, images_of=None):
    """The matches of a model's own tracks, or of those of `images_of` in these images only."""
    images = sorted(model.reg_image_ids())
    seen = [
        {p.point3D_id: k for k, p in enumerate(model.image(i).points2D) if p.has_point3D()} for i in images
    ]
    for image, own in zip(images, seen, strict=True):
        for point, among in (images_of or {}).items():
            if image not in among:
                own.pop(point, None)
    pairs, parts = [], []
    for a, b in itertools.combinations(range(len(images)), 2):
        common = sorted(seen[a].keys() & seen[b].keys())
        if common:
            pairs.append([a, b])
            parts.append(np.array([[seen[a][p], seen[b][p]] for p in common]))
    offsets = np.append(0, np.cumsum([len(part) for part in parts]))
    batch = KeypointMatches(pairs=np.array(pairs), offsets=offsets, keypoints=np.concatenate(parts))
    return matches_between(model, np.array(images), [batch])


def test_the_tracks_of_matches_are_those_of_the_model_they_were_made_of():
    model = scene()
    images = posed_images(model)
    own, matched = links_of(model, model), matches_of(model)
    joined = matched.observed(matched.join(views_of(images).poses(images), 4.0))

    def tracks(found):
        ends = zip(found.offsets[:-1], found.offsets[1:], strict=True)
        return {tuple(zip(found.cameras[a:b], found.keypoints[a:b], strict=True)) for a, b in ends}

    assert tracks(joined) == {track for track in tracks(own) if len(track) > 1}


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_matches_of_several_lenses_are_collected_batch_by_batch_by_any_number_of_threads(threads):
    model = scene()
    images, rng = posed_images(model), np.random.default_rng(0)
    lens = images.lenses[0]
    lenses = lens, replace(lens, id=lens.id + 1, parameters=tuple(1.1 * x for x in lens.parameters))
    lens_of = np.arange(images.num_images) // 2 % 2  # in runs of two images
    images = replace(images, lens_of=lens_of, lenses=lenses, sensors=Sensors.references(2))
    pictures = ModelKeypoints(images, points2d_of(arrays(model), images))
    every = list(itertools.combinations(range(images.num_images), 2))
    own = [rng.permutation(20)[:12].reshape(6, 2) for _ in every]
    batches = [
        KeypointMatches(pairs=np.array([pair]), offsets=np.array([0, 6]), keypoints=keypoints)
        for pair, keypoints in zip(every, own, strict=True)
    ]
    place = np.where(np.arange(images.num_images) == 2, -1, np.arange(images.num_images))
    room = np.empty((6 * len(batches), 2), dtype=np.uint32)
    found = collect_matches(images, pictures, place, batches, room, threads)

    at = np.stack([found.cameras, found.keypoints], axis=1)
    expected = [
        [[i, k], [j, m]] for (i, j), some in zip(every, own, strict=True) for k, m in some if 2 not in (i, j)
    ]
    assert at[found.matches].tolist() == expected
    assert len(np.unique(at, axis=0)) == len(at) == len(np.unique(found.matches))
    for image in range(images.num_images):
        rows = found.cameras == image
        pixels = pictures.pixels(image, found.keypoints[rows])
        np.testing.assert_array_equal(found.pixels[rows], pixels)
        np.testing.assert_array_equal(found.on_plane[rows], pictures.rays(image, pixels)[:, :2])


@pytest.mark.parametrize(("exact", "more"), [(False, 1e-9), (False, 1e60), (True, 0.0)])
def test_pixels_of_matches_are_held_in_32_bits_only_if_these_hold_all_of_them(exact, more):
    model = scene()
    for image in model.images.values():
        for k, point in enumerate(image.points2D):
            wanted = np.float32(point.xy) if exact or image.image_id > 2 or k else point.xy + more
            image.points2D[k].xy = wanted.astype(np.float64)
    found = matches_of(model)
    assert found.pixels.dtype == (np.float32 if exact else np.float64)
    ids = posed_images(model).ids.tolist()
    pixels = [np.array([point.xy for point in model.image(one).points2D]) for one in ids]
    at = [pixels[i][k] for i, k in zip(found.cameras.tolist(), found.keypoints.tolist(), strict=True)]
    np.testing.assert_array_equal(found.pixels, at)
    seen = structure_of(arrays(model), posed_images(model))
    at = [pixels[i][k] for i, k in zip(seen.points.images, seen.points.keypoints, strict=True)]
    np.testing.assert_array_equal(seen.pixels[:], at)


@pytest.mark.parametrize("source", ["matches", "tracks"])
def test_thin_adjustment_straightens_coarse_poses(source):
    truth = pycolmap.Reconstruction(BUNDLED / "courtyard" / "truth")
    start = disturbed(truth, size=0.02)
    found = adjusted_thinly(start, truth if source == "tracks" else matches_of(truth)).reconstruction
    assert found.num_points3D() == 0
    true, before, after = centers_of(truth), centers_of(start), centers_of(found)
    errors = [np.linalg.norm(fit_similarity(x, true).apply(x) - true, axis=1).mean() for x in (before, after)]
    assert errors[1] < 0.2 * errors[0]


@pytest.mark.parametrize(("size", "is_coarse"), [(0.0, False), (0.02, True)])
def test_coarse_poses_are_told_from_fine_ones_and_solved_again_from_the_points_of_the_wide_limit(
    size, is_coarse
):
    truth = scene()
    images, links = posed_images(disturbed(truth, size=size)), links_of(truth, matches_of(truth))
    run = adjustment_run.begin(images, links, StructureOptions(), Freedom(), GivenPoses())
    fine, coarse = adjustment_run.problem_of_poses(run)
    assert (fine is None, coarse is None) == (is_coarse, not is_coarse)
    _, last = adjustment_run.solve_thinly_again(run)
    if is_coarse:
        np.testing.assert_array_equal(last.centers, adjustment_run.solve_twice_thinly(run)[1].centers)


@pytest.mark.parametrize(
    ("num_open", "follows", "others_move", "num_solves"),
    [(1, True, True, 1), (1, True, False, 2), (1, False, True, 2), (2, True, True, 2)],
)
def test_where_lenses_of_few_images_are_left_open_nothing_is_solved_again_if_more_follows(
    num_open, follows, others_move, num_solves
):
    solved, judged = [], iter([np.arange(10) < num_open, np.zeros(10, bool)])
    run = SimpleNamespace(images=SimpleNamespace(lens_of=np.arange(10)), holding=lambda _: run)
    run.judge_lenses, run.frees_more_than_poses = lambda _: (run, next(judged)), others_move

    def solve(run):
        return run, solved.append(run)

    adjustment_run.repeat_with_known_lenses(run, solve, solve, more_follows=follows)
    assert len(solved) == num_solves


@pytest.mark.parametrize("source", ["matches", "tracks"])
def test_thin_adjustment_finds_a_lens_in_doubt_or_gives_back_what_was_given(source):
    truth = scene("RADIAL")
    start = disturbed(truth)
    start.camera(1).params = np.array([460.0, 320.0, 240.0, 0.0, 0.0])
    tracks = start if source == "tracks" else matches_of(truth)
    free = {"parts": np.ones(2, bool)}
    found = adjusted_thinly(start, tracks, **free)
    # 0.3 px on 7 views of 80 points
    assert found.reconstruction.camera(1).params[0] == pytest.approx(400.0, rel=0.005)
    assert not found.estimate.undetermined.any()
    assert 0.0 < found.estimate.focal_sigmas[0] < 0.01
    start.camera(1).params = np.array([400.5, 320.0, 240.0, 0.0, 0.0])
    images, links = posed_images(start), links_of(start, tracks)
    known = images.with_lenses([in_doubt(lens, focal_sigma=2e-3) for lens in images.lenses])
    run = adjustment_run.begin(known, links, StructureOptions(), Freedom(**free))
    held = adjust_thinly(run, lenses_wanted=True)
    assert held.undetermined.all()  # the matches know it no better than it was given
    assert held.freedom.parts.tolist() == [[False, True]]
    assert not held.is_refined.any()
    (given,), (kept,) = (one.lenses for one in (images, held.images))
    assert kept.parameters[:3] == given.parameters[:3]
    assert kept.parameters[3] != 0.0  # the distortion is told, and held no more than its prior does
    again = adjusted_thinly(start, tracks, parts=np.array([False, True]))
    assert tuple(again.reconstruction.camera(1).params[:3]) == given.parameters[:3]


def test_a_placement_is_adjusted_though_its_only_lens_in_doubt_is_left_open():
    start = disturbed(scene("PINHOLE"))
    images, links = posed_images(start), links_of(start, matches_of(scene("PINHOLE")))
    known = images.with_lenses([in_doubt(lens, focal_sigma=1e-4) for lens in images.lenses])
    free = Freedom(parts=np.ones(2, bool))
    found = adjust_placement(adjustment_run.begin(known, links, StructureOptions(), free))
    assert found.undetermined.all()
    assert [lens.parameters for lens in found.images.lenses] == [lens.parameters for lens in images.lenses]


def test_points_of_two_images_hold_cameras_but_are_not_in_the_model():
    truth = scene(noise_px=0.5, seed=1)
    images, points = sorted(truth.reg_image_ids()), sorted(truth.point3D_ids())
    rng = np.random.default_rng(1)
    pairs = {p: rng.choice(images, 2, replace=False).tolist() for p in points[6:]}
    graph, start = matches_of(truth, pairs), disturbed(truth)
    true = centers_of(truth)
    errors = []
    for least in (2, 3):
        options = StructureOptions(min_track_length=least)
        found = bundle_adjusted(start, graph, options).reconstruction
        assert 0 < found.num_points3D() <= 6
        assert all(point.track.length() >= 3 for point in found.points3D.values())
        x = centers_of(found)
        errors.append(np.linalg.norm(fit_similarity(x, true).apply(x) - true, axis=1).mean())
    # 7 images leave 11 residuals of each of 6 points, and 2 images one of each of 74: twice as much in all.
    assert errors[0] < 0.8 * errors[1]
    with_all = bundle_adjusted(start, graph, StructureOptions(ignore_two_view_tracks=False)).reconstruction
    assert with_all.num_points3D() > 40
