"""Panoramas cut into faces: rigs whose sensors share one center, or nearly so. Their scale is open."""

import itertools
from typing import NamedTuple

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

import sfm_shapefit
from sfm_shapefit.base.geometry import fit_similarity
from tests.models import centers_of

FOCAL, SIZE = 500.0, 1000  # pixels; 90 degrees of view
TURNS = [("y", 0.0), ("y", 90.0), ("y", 180.0), ("y", 270.0), ("x", 90.0), ("x", -90.0)]


class Shots(NamedTuple):
    """What was taken: a frame of one rig, with the faces that it has."""

    rig: int
    faces: tuple[int, ...]


def write_scene(folder, rigs, shots, seed, num_points=500):
    """Write database.db, of points on the walls of a room seen with half a pixel of noise, and their truth.

    `rigs` are lists of (rotation, center) of sensors in their rig, the first one the identity at the origin.
    """
    rng = np.random.default_rng(seed)
    points = rng.uniform([-10, -7, -3], [10, 7, 3], (num_points, 3))
    wall = rng.integers(0, 6, num_points)
    for side in range(6):
        points[wall == side, side % 3] = (1 if side > 2 else -1) * np.array([10, 7, 3])[side % 3]
    truth, names, seen = pycolmap.Reconstruction(), [], []
    cameras = [[_camera(r, s, rigs) for s in range(len(rig))] for r, rig in enumerate(rigs)]
    for r, rig in enumerate(rigs):
        for camera in cameras[r]:
            truth.add_camera(camera)
        model = pycolmap.Rig(rig_id=r + 1)
        model.add_ref_sensor(cameras[r][0].sensor_id)
        for camera, (turn, center) in list(zip(cameras[r], rig, strict=True))[1:]:
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -turn @ center)
            model.add_sensor(camera.sensor_id, pose)
        truth.add_rig(model)
    axes = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    for k, shot in enumerate(shots):
        angle = 2.0 * np.pi * (k + 0.5 * rng.random()) / len(shots)
        center = np.array([6.0 * np.cos(angle), 4.0 * np.sin(angle), 0.4 * rng.normal()])
        turn = Rotation.from_euler("z", rng.uniform(0, 360), degrees=True).as_matrix() @ axes
        turn = Rotation.from_rotvec(0.05 * rng.normal(size=3)).as_matrix() @ turn
        turn = (
            turn
            if shot.rig == 0
            else Rotation.from_euler("y", 90.0 - np.degrees(angle), degrees=True).as_matrix() @ axes
        )
        frame, images = pycolmap.Frame(frame_id=k + 1, rig_id=shot.rig + 1), []
        for face in shot.faces:
            own, offset = rigs[shot.rig][face]
            camera = cameras[shot.rig][face]
            inside = (points - center - turn.T @ offset) @ (own @ turn).T
            pixels = FOCAL * inside[:, :2] / inside[:, 2:] + SIZE / 2 + rng.normal(0.0, 0.5, (num_points, 2))
            there = (inside[:, 2] > 0.1) & (pixels > 0).all(axis=1) & (pixels < SIZE).all(axis=1)
            names.append(f"rig{shot.rig}/face{face}/{k:03d}.jpg")
            seen.append((pixels[there], np.flatnonzero(there)))
            images.append(pycolmap.Image(name=names[-1], camera_id=camera.camera_id, image_id=len(names)))
            frame.add_data_id(images[-1].data_id)
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -turn @ center)
        truth.add_frame(frame)
        for image in images:
            image.frame_id = k + 1
            truth.add_image(image)
        truth.register_frame(k + 1)
    _write_database(folder / "database.db", truth, seen)
    (folder / "truth").mkdir()
    truth.write(folder / "truth")
    return truth


def _camera(rig, sensor, rigs):
    number = 1 + sensor + sum(len(other) for other in rigs[:rig])
    camera = pycolmap.Camera.create_from_model_name(number, "PINHOLE", FOCAL, SIZE, SIZE)
    camera.has_prior_focal_length = True
    return camera


def _write_database(path, truth, seen):
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for camera in truth.cameras.values():
            database.write_camera(camera, use_camera_id=True)
        for rig in truth.rigs.values():
            database.write_rig(rig, use_rig_id=True)
        for image_id in range(1, len(seen) + 1):
            own = truth.image(image_id)
            image = pycolmap.Image(name=own.name, camera_id=own.camera_id, image_id=image_id)
            database.write_image(image, use_image_id=True)
            database.write_keypoints(image_id, seen[image_id - 1][0].astype(np.float32))
        for frame in truth.frames.values():
            database.write_frame(frame, use_frame_id=True)
        for i, j in itertools.combinations(range(len(seen)), 2):
            _, first, second = np.intersect1d(seen[i][1], seen[j][1], return_indices=True)
            if len(first) >= 15:
                matches = np.stack([first, second], axis=1).astype(np.uint32)
                geometry = pycolmap.TwoViewGeometry()
                geometry.config, geometry.inlier_matches = (
                    pycolmap.TwoViewGeometryConfiguration.CALIBRATED,
                    matches,
                )
                database.write_matches(i + 1, j + 1, matches)
                database.write_two_view_geometry(i + 1, j + 1, geometry)


def cube(count=6, offset=0.0, seed=0):
    """Faces of a cube, whose centers are `offset` from that of the first."""
    turns = [Rotation.from_euler(axis, angle, degrees=True).as_matrix() for axis, angle in TURNS[:count]]
    aside = np.random.default_rng(seed).normal(size=(count, 3))
    aside *= offset / np.linalg.norm(aside, axis=1, keepdims=True)
    aside[0] = 0.0
    return list(zip(turns, aside, strict=True))


ONE = [(np.eye(3), np.zeros(3))]
STEREO = [(np.eye(3), np.zeros(3)), (np.eye(3), np.array([0.5, 0.0, 0.0]))]


def assert_right(model, truth, most=0.004, *, metric=False):
    """Half a pixel at 10 m is 0.01 in one match; a camera has hundreds, and is right to a tenth of that."""
    names = {image.name for image in truth.images.values()}
    there = {model.image(i).name for i in model.reg_image_ids()}
    assert there == names
    fit = fit_similarity(centers_of(model), centers_of(truth))
    off = np.linalg.norm(fit.apply(centers_of(model)) - centers_of(truth), axis=1)
    assert np.median(off) < most
    assert (abs(fit.scale - 1.0) < 0.02) == metric


def assert_at_one_center(model):
    for frame in model.frames.values():
        own = np.array([model.image(data.id).projection_center() for data in frame.image_ids])
        np.testing.assert_allclose(
            own, np.broadcast_to(own[0], own.shape), atol=1e-12 * (1.0 + np.abs(own).max())
        )


@pytest.fixture(scope="module")
def six(tmp_path_factory):
    """Seven panoramas of six faces."""
    folder = tmp_path_factory.mktemp("six")
    truth = write_scene(folder, [cube()], [Shots(0, tuple(range(6)))] * 7, seed=1)
    return folder, truth


@pytest.fixture(scope="module")
def mapped(six):
    return sfm_shapefit.map_database(six[0] / "database.db").models[0]


def test_map_places_faces_that_share_a_center_as_frames_in_an_open_scale(six, mapped):
    assert_right(mapped.reconstruction, six[1])
    assert_at_one_center(mapped.reconstruction)
    assert mapped.gauge.scale == "unit"
    assert mapped.verdict.grade == "good"
    assert mapped.warnings == ()


def test_locate_takes_the_scale_of_the_input_and_its_own_tracks_serve_as_well(six, mapped):
    folder, truth = six
    found = sfm_shapefit.locate(folder / "truth", folder / "database.db")
    assert found.gauge.scale == "input"
    assert_right(found.reconstruction, truth, metric=True)
    assert_right(sfm_shapefit.locate(mapped.reconstruction).reconstruction, truth)


def test_scenes_of_missing_faces_single_images_and_a_rig_with_a_baseline(tmp_path):
    shots = [Shots(0, (0, 1, 2, 3)), Shots(0, (1, 3)), Shots(0, (2,)), Shots(0, (0, 1, 2)), Shots(1, (0,))]
    for folder, rigs, more, metric in (
        (tmp_path / "open", [cube(4), ONE], [Shots(1, (0,)), Shots(0, (0, 3))], False),
        (tmp_path / "metric", [cube(4), STEREO], [Shots(1, (0, 1))] * 4, True),
    ):
        folder.mkdir()
        truth = write_scene(folder, rigs, [*shots, *more, *[Shots(0, (0, 1, 2, 3))] * 2], seed=3)
        found = sfm_shapefit.map_database(folder / "database.db").models[0]
        assert found.gauge.scale == ("rig" if metric else "unit")
        assert_right(found.reconstruction, truth, most=0.01, metric=metric)


@pytest.mark.parametrize("offset", [1e-12, 1e-5])
def test_offsets_too_short_to_tell_the_scale_leave_it_open_and_that_is_said(tmp_path, offset):
    truth = write_scene(tmp_path, [cube(5, offset)], [Shots(0, tuple(range(5)))] * 6, seed=2)
    mapped = sfm_shapefit.map_database(tmp_path / "database.db").models[0]
    located = sfm_shapefit.locate(tmp_path / "truth", tmp_path / "database.db")
    for found, scale in ((mapped, "unit"), (located, "input")):
        assert_right(found.reconstruction, truth, metric=scale == "input")
        assert_at_one_center(found.reconstruction)
        assert found.gauge.scale == scale
        assert ["are too short for this scene to tell its scale" in said for said in found.warnings] == [True]


@pytest.mark.parametrize(
    ("turn_deg", "center", "told"),
    [
        (0.0, (0.0, 0.0, 0.5), "matches inside its frame contradict by 9"),  # degrees
        (0.0, (-0.5, 0.0, 0.0), "matches inside its frame contradict by 1"),
        (90.0, (0.5, 0.0, 0.0), "turn camera 3 by 90 degrees from where the rig has it"),
    ],
)
def test_map_follows_the_matches_that_contradict_a_rig_and_says_so(tmp_path, turn_deg, center, told):
    truth = write_scene(tmp_path, [ONE, STEREO], [Shots(1, (0, 1))] * 8, seed=3)
    turn = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        (rig,) = (one for one in database.read_all_rigs() if one.num_sensors() == 2)
        ((sensor, _),) = rig.non_ref_sensors.items()
        rig.set_sensor_from_rig(sensor, pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -turn @ center))
        database.update_rig(rig)
    (found,) = sfm_shapefit.map_database(tmp_path / "database.db").models
    (finding,) = found.verdict.findings
    assert told in finding.sentence
    assert found.verdict.grade == "look"
    assert_right(found.reconstruction, truth, most=0.01, metric=True)


def test_sensors_that_share_a_center_turn_but_stay_there_if_rigs_are_free(six):
    found = sfm_shapefit.map_database(six[0] / "database.db", rigs="free").models[0]
    assert_right(found.reconstruction, six[1])
    assert_at_one_center(found.reconstruction)
    turned = [pose.rotation.angle() for pose in found.reconstruction.rig(1).non_ref_sensors.values()]
    assert any(turned)


def test_a_fixed_panorama_stays_and_priors_place_the_rest(six, tmp_path):
    folder, truth = six
    names = sorted(image.name for image in truth.images.values() if image.frame_id == 3)
    (tmp_path / "fixed.txt").write_text("\n".join(names))
    found = sfm_shapefit.locate(folder / "truth", folder / "database.db", fix=str(tmp_path / "fixed.txt"))
    assert_right(found.reconstruction, truth, metric=True)
    for image in truth.images.values():
        if image.frame_id == 3:
            np.testing.assert_array_equal(
                found.reconstruction.image(image.image_id).cam_from_world().matrix(),
                image.cam_from_world().matrix(),
            )
    table = tmp_path / "priors.txt"
    where = {image.name: 3.0 * image.projection_center() + 100.0 for image in truth.images.values()}
    table.write_text("".join(f"{name} {x} {y} {z}\n" for name, (x, y, z) in where.items()))
    found = sfm_shapefit.map_database(folder / "database.db", priors=table).models[0]
    own = {
        found.reconstruction.image(i).name: found.reconstruction.image(i).projection_center()
        for i in found.reconstruction.reg_image_ids()
    }
    assert np.median([np.linalg.norm(own[name] - where[name]) for name in where]) < 3 * 0.004
