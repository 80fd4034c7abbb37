"""`map IMAGES OUT`: photographs become a database, and the database a model."""

import itertools
import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import time

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.judgement.chosen_pairs import alike_pairs
from tests.program import run, run_refused
from tests.scenes import fingerprint


def survey(database):
    """Lenses, the lens of each image, pairs, and the first keypoint of each image of a database."""
    with pycolmap.Database.open(database) as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.name)
        pairs, _ = opened.read_two_view_geometries()
        return {
            "num_cameras": opened.num_cameras(),
            "cameras": {image.name: image.camera_id for image in images},
            "priors": {camera.has_prior_focal_length for camera in opened.read_all_cameras()},
            "pairs": len(pairs),
            "keypoints": {image.name: opened.read_keypoints(image.image_id)[0].tolist() for image in images},
        }


@pytest.fixture(scope="module")
def told(drawn):
    """Few features, and the lens of the photographs: their row of houses is too flat to tell it."""
    with pycolmap.Database.open(drawn[1] / "database.db") as opened:
        (camera,) = opened.read_all_cameras()
    params = ",".join(map(repr, camera.params.tolist()))
    return "--max-num-features", "600", "--camera-model", camera.model.name, "--camera-params", params


@pytest.fixture(scope="module")
def mapped(drawn, told, tmp_path_factory):
    """What `map` makes of eight photographs."""
    _, folder = drawn
    out = tmp_path_factory.mktemp("photographs") / "out"
    result = run("map", folder / "images", out, *told, code=0)
    return out, result


def test_photographs_become_a_model_with_the_database_beside_it(drawn, mapped):
    scene, folder = drawn
    out, result = mapped
    errors = sfm_shapefit.evaluate(out / "0", folder / "sparse" / "0")
    assert pycolmap.Reconstruction(out / "0").num_reg_images() == scene.num_images
    assert errors.position.median < 0.01 * np.ptp(scene.centers, axis=0).max()  # 600 features of 400 pixels
    assert {"0", "database.db", "matching.json", "map.json"} == set(os.listdir(out))
    assert f"matches: {out / 'database.db'}" in result.output
    assert str(folder / "images") in result.output  # the next command knows the folder
    assert json.loads((out / "map.json").read_text())["inputs"]["database"] == str(out / "database.db")


def test_pictures_without_exif_data_share_a_lens_unless_said(drawn, tmp_path):
    _, folder = drawn
    nested = tmp_path / "images"
    names = sorted(os.listdir(folder / "images"))[:3]
    for sub, name in zip("aab", names, strict=True):
        (nested / sub).mkdir(parents=True, exist_ok=True)
        shutil.copy(folder / "images" / name, nested / sub / name)
    counts = {}
    for name in ("IMG_1.HEIC", ".IMG_2.HEIC", "IMG_1.MOV", "bad.jpg", "notes.txt"):
        (nested / name).write_text("no picture")
    unread = f"cannot read them: 1 .heic, 1 .mov, bad.jpg in {nested}"
    for mode in ("auto", "single", "per-folder", "per-image"):
        with pytest.warns(UserWarning, match=unread):
            made = sfm_shapefit.match_images(
                nested, tmp_path / f"{mode}.d" / "database.db", camera_mode=mode, max_image_size=100
            )
        counts[mode] = survey(made)["num_cameras"]
    assert counts == {"auto": 2, "single": 1, "per-folder": 2, "per-image": 3}


def with_exif(picture, model, focal_35_mm, latitude_deg):
    """The picture with the APP1 segment of a device, its focal length, and a place at 11 deg east.

    Little-endian TIFF: IFD 0, the EXIF IFD and the GPS IFD; after each, what does not fit into its rows.
    """

    def directory(begin, *entries):
        rows, after = b"", b""
        place = begin + 2 + 12 * len(entries) + 4
        for tag, kind, count, value in entries:
            at = struct.pack("<I", place + len(after)) if len(value) > 4 else value.ljust(4, b"\0")
            after += value if len(value) > 4 else b""
            rows += struct.pack("<HHI", tag, kind, count) + at
        return struct.pack("<H", len(entries)) + rows + bytes(4) + after

    name = model.encode().ljust(7, b"\0") + b"\0"
    degrees = [struct.pack("<6I", value, 1, 0, 1, 0, 1) for value in (latitude_deg, 11)]

    def tiff(exif, gps):
        first = directory(
            8,
            (0x010F, 2, 8, b"Makers.\0"),
            (0x0110, 2, 8, name),
            (0x8769, 4, 1, struct.pack("<I", exif)),
            (0x8825, 4, 1, struct.pack("<I", gps)),
        )
        second = directory(exif, (0xA405, 3, 1, struct.pack("<H", focal_35_mm)))
        third = directory(gps, (1, 2, 2, b"N"), (2, 5, 3, degrees[0]), (3, 2, 2, b"E"), (4, 5, 3, degrees[1]))
        return first, second, third

    first, second, _ = tiff(0, 0)
    exif = 8 + len(first)
    body = b"II*\0" + struct.pack("<I", 8) + b"".join(tiff(exif, exif + len(second)))
    return picture[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 8) + b"Exif\0\0" + body + picture[2:]


def test_pictures_of_one_device_and_focal_length_share_a_lens_and_positions_become_priors(drawn, tmp_path):
    _, folder = drawn
    picture = (folder / "images" / sorted(os.listdir(folder / "images"))[0]).read_bytes()
    for name, told in {
        "a/1.jpg": ("Phone 1", 28, 48),
        "a/2.jpg": ("Phone 1", 56, 48),
        "b/3.jpg": ("Phone 1", 28, 49),
        "b/4.jpg": ("Phone 2", 28, 48),
    }.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(with_exif(picture, *told))
    made = sfm_shapefit.match_images(tmp_path, tmp_path / "database.db", max_image_size=100)
    found = survey(made)["cameras"]
    assert found["a/1.jpg"] == found["b/3.jpg"]
    assert len(set(found.values())) == 3
    with pycolmap.Database.open(made) as opened:
        assert {camera.has_prior_focal_length for camera in opened.read_all_cameras()} == {True}
        (second,) = (one.image_id for one in opened.read_all_images() if one.name == "b/3.jpg")
        prior = next(one for one in opened.read_all_pose_priors() if one.corr_data_id.id == second)
    np.testing.assert_allclose(prior.position[:2], [49.0, 11.0])
    assert prior.coordinate_system == pycolmap.PosePriorCoordinateSystem.WGS84


def test_a_lens_that_is_known_is_held_as_calibrated(drawn, tmp_path):
    _, folder = drawn
    known = {"camera_model": "PINHOLE", "camera_params": "350,350,200,150", "max_num_features": 100}
    made = sfm_shapefit.match_images(folder / "images", tmp_path / "database.db", **known)
    with pycolmap.Database.open(made) as opened:
        (camera,) = opened.read_all_cameras()
    assert camera.params.tolist() == [350.0, 350.0, 200.0, 150.0]
    assert camera.has_prior_focal_length
    with pytest.raises(InputError, match="must be 4 numbers"):
        sfm_shapefit.match_images(folder / "images", tmp_path / "b.db", **(known | {"camera_params": "350"}))
    with pytest.raises(InputError, match="did you mean PINHOLE"):
        sfm_shapefit.match_images(folder / "images", tmp_path / "b.db", camera_model="pinhole")


def test_a_run_that_was_interrupted_goes_on_and_ends_as_one_that_was_not(drawn, told, mapped, tmp_path):
    _, folder = drawn
    out, _ = mapped
    begun = tmp_path / "out"
    command = [sys.executable, "-m", "sfm_shapefit", "map", folder / "images", begun, *told, "-q"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    while process.poll() is None and not (begun / "database.db").exists():
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    said = process.communicate()[1]
    assert process.returncode == 130
    assert f"the same command goes on with {begun / 'database.db'}" in said
    assert set(os.listdir(begun)) <= {"database.db", "database.db-wal", "database.db-shm", "matching.json"}
    other = run_refused("map", folder / "images", begun, "--camera-mode", "single", code=3)
    assert "was begun with camera_mode='auto'" in other
    assert run("map", folder / "images", begun, *told, "-q", code=0).output == ""
    assert survey(begun / "database.db") == survey(out / "database.db")
    for name in ("images.bin", "points3D.bin"):
        assert (begun / "0" / name).read_bytes() == (out / "0" / name).read_bytes()


@pytest.mark.parametrize("stage", ["images", "features", "matches"])
def test_a_stage_that_is_interrupted_leaves_the_lenses_as_they_would_be(drawn, stage, tmp_path):
    """Four images are read but for two, or a later stage begins; a fifth is added before the second run."""

    def interrupt(name, done, _total):
        if name == stage and (done == 2 or stage != "images"):
            raise KeyboardInterrupt

    _, folder = drawn
    names = sorted(os.listdir(folder / "images"))[:5]
    images, few = tmp_path / "images", {"max_num_features": 100}
    images.mkdir()
    for name in names[:4]:
        shutil.copy(folder / "images" / name, images)
    with pytest.raises(KeyboardInterrupt):
        sfm_shapefit.match_images(images, tmp_path / "database.db", progress=interrupt, **few)
    shutil.copy(folder / "images" / names[4], images)
    made = sfm_shapefit.match_images(images, tmp_path / "database.db", **few)
    found = survey(made)
    assert found["cameras"] == dict.fromkeys(names, 1)
    assert found["pairs"] == 10
    with pycolmap.Database.open(made) as opened:
        assert (opened.num_frames(), opened.num_rigs()) == (5, 1)


def test_a_second_run_keeps_the_matches(drawn, told, mapped):
    _, folder = drawn
    out, _ = mapped
    before = (out / "database.db").stat().st_ino, survey(out / "database.db")
    assert "exists already" in run_refused("map", folder / "images", out, *told, code=3)
    unread = folder / "images" / "IMG_1.HEIC"
    unread.write_text("no picture")
    said = run("map", folder / "images", out, *told, "--overwrite", "--no-report", code=0).stdout
    unread.unlink()
    assert "cannot read them: 1 .heic in" in said
    assert ((out / "database.db").stat().st_ino, survey(out / "database.db")) == before
    assert not (out / "0" / "report.html").exists()


def rigs_of(database):
    """Sensors of each rig by their cameras, and the names of the images of each frame."""
    with pycolmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        rigs = [
            sorted([rig.ref_sensor_id.id, *(sensor.id for sensor in rig.non_ref_sensors)])
            for rig in opened.read_all_rigs()
        ]
        frames = [sorted(names[one.id] for one in frame.image_ids) for frame in opened.read_all_frames()]
    return sorted(rigs), sorted(frames)


def test_images_become_sensors_of_the_rigs_of_a_file_also_those_that_are_added(drawn, tmp_path):
    """One device takes left and right, as its EXIF data say; each side has a lens of its own all the same."""
    _, folder = drawn
    names = sorted(os.listdir(folder / "images"))[:7]
    images, few = tmp_path / "images", {"max_num_features": 100}
    images.mkdir()

    def take(*places):
        for place in places:
            picture = (folder / "images" / names.pop()).read_bytes()
            (images / place).write_bytes(with_exif(picture, "Phone 1", 28, 48))

    config = tmp_path / "rigs.json"
    sensors = [
        {"image_prefix": "left_", "ref_sensor": True},
        {
            "image_prefix": "right_",
            "cam_from_rig_rotation": [1, 0, 0, 0],
            "cam_from_rig_translation": [-0.5, 0, 0],
        },
    ]
    config.write_text(json.dumps([{"cameras": sensors}]))
    take("alone.jpg", "left_1.jpg", "right_1.jpg", "left_2.jpg", "right_2.jpg")
    made = tmp_path / "database.db"
    for added in ((), ("left_3.jpg", "right_3.jpg")):
        take(*added)
        sfm_shapefit.match_images(images, made, rig_config_path=str(config), **few)
    assert rigs_of(made) == (
        [[1], [2, 3]],
        [["alone.jpg"], *(sorted([f"left_{k}.jpg", f"right_{k}.jpg"]) for k in (1, 2, 3))],
    )
    with pycolmap.Database.open(made) as opened:
        (pose,) = [pose for rig in opened.read_all_rigs() for pose in rig.non_ref_sensors.values()]
    np.testing.assert_array_equal(pose.translation, [-0.5, 0.0, 0.0])
    config.write_text(json.dumps([{"cameras": [sensors[0], {"image_prefix": "right_"}]}]))
    unknown = sfm_shapefit.match_images(images, tmp_path / "b.db", rig_config_path=str(config), **few)
    assert rigs_of(unknown) == rigs_of(made)
    with pycolmap.Database.open(unknown) as opened:
        assert [pose for rig in opened.read_all_rigs() for pose in rig.non_ref_sensors.values()] == [None]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[{", "no file of rigs as COLMAP's rig_configurator takes"),
        ('[{"cameras": [{"image_prefix": "0"}]}]', "must have one reference sensor"),
        ('[{"cameras": [{"image_prefix": "b/", "ref_sensor": true}]}]', "no image begins with b/"),
    ],
)
def test_rigs_that_the_images_cannot_be_are_refused(drawn, tmp_path, text, why):
    _, folder = drawn
    config = tmp_path / "rigs.json"
    config.write_text(text)
    told = ("--rig-config-path", config)
    assert why in run_refused("map", folder / "images", tmp_path / "out", *told, code=3)
    assert not (tmp_path / "out").exists()


def test_images_are_matched_with_those_next_in_order_and_those_that_look_alike(drawn, tmp_path):
    scene, folder = drawn
    few = {"max_num_features": 300}
    made = sfm_shapefit.match_images(
        folder / "images", tmp_path / "a.db", pairing="sequential", overlap=1, **few
    )
    with pycolmap.Database.open(made) as opened:
        ids = [image.image_id for image in opened.read_all_images()]
        assert all(opened.exists_two_view_geometry(i, i + 1) for i in ids[:-1])
        descriptors = [opened.read_descriptors(i).data.astype(np.int64) for i in ids]
    alike = alike_pairs(descriptors, 1)
    distances = np.linalg.norm(scene.centers[alike[:, 0]] - scene.centers[alike[:, 1]], axis=1)
    assert np.median(distances) <= 2.0 * np.linalg.norm(np.diff(scene.centers, axis=0), axis=1).max()


def test_images_are_matched_with_those_nearest_by_position_whatever_their_order(drawn, tmp_path):
    """They stand on a circle in another order than that of their names; the last one has no position."""
    _, folder = drawn
    names = sorted(os.listdir(folder / "images"))
    order = [0, 5, 2, 7, 4, 1, 6, 3]
    turns = 2.0 * np.pi * np.argsort(order) / len(order)
    positions = np.column_stack(
        [np.cos(turns), np.sin(turns), np.arange(8) % 2 * 100.0]
    )  # heights say nothing
    table = tmp_path / "gps.txt"
    lines = [f"{name} {x} {y} {z}\n" for name, (x, y, z) in zip(names, positions.tolist(), strict=True)]
    table.write_text("name x_m y_m z_m\n" + "".join(lines[:-1]))
    told = {"pairing": "spatial", "overlap": 1, "max_num_features": 50}
    with pytest.raises(InputError, match="no position prior of the model's images"):
        sfm_shapefit.match_images(folder / "images", tmp_path / "a" / "database.db", **told)
    made = sfm_shapefit.match_images(folder / "images", tmp_path / "b" / "database.db", priors=table, **told)
    with pycolmap.Database.open(made) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        near = [(names[i], names[j]) for i, j in itertools.pairwise([*order, order[0]]) if 7 not in (i, j)]
        assert all(opened.exists_two_view_geometry(ids[a], ids[b]) for a, b in near)
        assert opened.num_verified_image_pairs() < 28
        last = [opened.exists_two_view_geometry(ids[names[-1]], ids[name]) for name in names[:-1]]
        assert any(last)  # without a position, it is matched with those that look alike


def test_alike_images_whose_names_have_spaces_are_refused_with_a_way_out(drawn, tmp_path):
    _, folder = drawn
    spaced = tmp_path / "images"
    spaced.mkdir()
    for k, name in enumerate(sorted(os.listdir(folder / "images"))[:3]):
        shutil.copy(folder / "images" / name, spaced / f"IMG {k}.jpg")
    few = {"max_num_features": 100}
    with pytest.raises(InputError, match=r"have spaces.*pairing=exhaustive"):
        sfm_shapefit.match_images(spaced, tmp_path / "a" / "database.db", pairing="retrieval", **few)
    made = sfm_shapefit.match_images(spaced, tmp_path / "b" / "database.db", **few)
    assert survey(made)["pairs"] == 3


@pytest.mark.parametrize(
    ("option", "text", "why"),
    [
        ("--control-points", "local\n1 2\n", "line 2: expected x y z"),
        ("--scale-bars", "1 2\n", "line 1: expected the length"),
        ("--gravity", "a.jpg 1 2\n", "line 1: expected the name"),
        ("--without", "a.jpg\n", "line 1"),
        ("--priors", "elsewhere.jpg 1 2 3\n", "no position prior of the model's images"),
        ("--priors", None, "no position prior of the model's images"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_before_features(drawn, tmp_path, option, text, why):
    _, folder = drawn
    file = "database" if text is None else tmp_path / "file.txt"
    if text is not None:
        file.write_text(text)
    out = tmp_path / "out"
    assert why in run_refused("map", folder / "images", out, option, file, code=3)
    with pycolmap.Database.open(out / "database.db") as opened:
        assert opened.num_images()
        assert not opened.num_keypoints()


def test_what_holds_no_images_is_refused_and_nothing_is_made(drawn, tmp_path):
    _, folder = drawn
    empty, out = tmp_path / "empty", tmp_path / "out"
    empty.mkdir()
    assert "holds no image" in run_refused("map", empty, out, code=3)
    (empty / "IMG_1.HEIC").write_bytes(b"")
    assert "but 1 .heic; convert these to .jpg first" in run_refused("map", empty, out, code=3)
    (empty / "tour.mov").write_bytes(b"")
    assert "take frames, as with `ffmpeg" in run_refused("map", empty, out, code=3)
    for name in ("a.jpg", "b.jpg"):
        (empty / name).write_bytes(b"no picture")
    assert "no two images that pycolmap can read" in run_refused("map", empty, out, code=3)
    database = folder / "database.db"
    refused = run("map", database, out, "--camera-mode", "single", code=2).stderr
    assert "is for a folder of images" in refused
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    shutil.copy(database, theirs / "database.db")
    before = fingerprint(theirs)
    refused = run_refused("map", folder / "images", theirs, code=3)
    assert "was not made of images by this program" in refused
    assert fingerprint(theirs) == before
