"""COLMAP's models and databases are read right, refused in one sentence when bad, and never changed."""

import contextlib
import itertools
import os
import shutil
import sqlite3
import struct
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.executors import in_threads
from sfm_shapefit.base.geometry import angle_between_deg, normalized
from sfm_shapefit.commands.evaluate import evaluate
from sfm_shapefit.files.colmap import model_arrays, sqlite_file
from sfm_shapefit.files.colmap.database import find_database
from sfm_shapefit.files.colmap.database_pairs import MAX_NUM_IMAGES
from sfm_shapefit.files.colmap.lenses import lens_of, rays_of
from sfm_shapefit.files.colmap.model import ColmapModel, read_model
from sfm_shapefit.files.colmap.read_binary import read_folder
from sfm_shapefit.files.colmap.track_matches import TrackMatches
from sfm_shapefit.scene.matches import PLENTY, Reading
from tests.scenes import COURTYARD, edit_database, fingerprint, view_of

EPS = np.finfo(np.float64).eps
MODEL_FILES = ("cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin")
CAMERA_MODELS = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]


def synthesize(seed: int, *database: pycolmap.Database, **settings: object) -> pycolmap.Reconstruction:
    """Make a scene without noise, and its database if one is given."""
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions()
    for name, value in settings.items():
        setattr(options, name, value)
    return pycolmap.synthesize_dataset(options, *database)


@pytest.fixture(scope="module")
def scene() -> pycolmap.Reconstruction:
    """Six posed images of two cameras around twelve points that all of them see, without noise."""
    rigs = {"num_rigs": 2, "num_cameras_per_rig": 1, "num_frames_per_rig": 3}
    return synthesize(1, **rigs, num_points3D=12, num_points2D_without_point3D=2)


@pytest.fixture(scope="module")
def model(scene: pycolmap.Reconstruction) -> ColmapModel:
    return read_model(scene)


@pytest.fixture
def folder(scene: pycolmap.Reconstruction, tmp_path: Path) -> Path:
    """The scene as a binary model."""
    path = tmp_path / "model"
    path.mkdir()
    scene.write_binary(path)
    return path


IDENTITY_POSE = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
NO_POINT = 2**64 - 1


def tiny_model() -> dict[str, list]:
    """A sound model of two images and two points as plain records; tests break one of them."""
    return {
        "cameras": [[1, 1, 640, 480, [500.0, 500.0, 320.0, 240.0]]],
        "images": [
            [1, IDENTITY_POSE, 1, b"a.jpg", [(1.0, 2.0, 7), (3.0, 4.0, NO_POINT)]],
            [2, IDENTITY_POSE, 1, b"b.jpg", [(5.0, 6.0, 7)]],
        ],
        "points3D": [[7, (0.0, 0.0, 4.0), [(1, 0), (2, 0)]], [9, (0.0, 0.0, 5.0), []]],
        "rigs": [[1, [(0, 1)]]],
        "frames": [[1, 1, IDENTITY_POSE, [(0, 1, 1)]], [2, 1, IDENTITY_POSE, [(0, 1, 2)]]],
    }


def write_tiny(folder: Path, records: dict[str, list]) -> Path:
    """Write records in COLMAP's binary layouts."""
    folder.mkdir(parents=True, exist_ok=True)
    packed = {
        "cameras": lambda i, m, w, h, p: struct.pack(f"<IiQQ{len(p)}d", i, m, w, h, *p),
        "images": lambda i, pose, camera, name, points: (
            struct.pack("<I7dI", i, *pose, camera)
            + name
            + b"\0"
            + struct.pack("<Q", len(points))
            + b"".join(struct.pack("<ddQ", *point) for point in points)
        ),
        "points3D": lambda i, xyz, track: (
            struct.pack("<Q3d3BdQ", i, *xyz, 9, 9, 9, 0.5, len(track))
            + b"".join(struct.pack("<II", *element) for element in track)
        ),
        "rigs": lambda i, sensors: (
            struct.pack("<II", i, len(sensors))
            + struct.pack("<iI", *sensors[0])
            + b"".join(struct.pack("<iIB7d", *sensor, 1, *IDENTITY_POSE) for sensor in sensors[1:])
        ),
        "frames": lambda i, rig, pose, data: (
            struct.pack("<II7dI", i, rig, *pose, len(data)) + b"".join(struct.pack("<iIQ", *d) for d in data)
        ),
    }
    for name, rows in records.items():
        body = b"".join(packed[name](*row) for row in rows)
        (folder / f"{name}.bin").write_bytes(struct.pack("<Q", len(rows)) + body)
    return folder


def test_binary_text_and_legacy_models_give_the_same_poses(scene, folder, tmp_path):
    text, legacy = tmp_path / "text", tmp_path / "legacy"
    text.mkdir()
    scene.write_text(text)
    shutil.copytree(folder, legacy)
    (legacy / "rigs.bin").unlink()
    (legacy / "frames.bin").unlink()

    models = [read_model(source) for source in (scene, folder, str(text), legacy)]

    for model in models:
        assert model.images.ids.tolist() == sorted(scene.images)
        assert model.images.names == tuple(scene.image(i).name for i in sorted(scene.images))
        for k, i in enumerate(model.images.ids.tolist()):
            pose = scene.image(i).cam_from_world()
            np.testing.assert_allclose(model.images.rotations[k], pose.rotation.matrix(), atol=8 * EPS)
            np.testing.assert_allclose(
                model.images.centers[k], scene.image(i).projection_center(), atol=64 * EPS * 5.0
            )
            assert model.images.focal_lengths_px[k] == 1280.0


def test_the_tiny_model_of_these_tests_is_sound_and_needs_no_points(tmp_path):
    records = tiny_model()
    model = read_model(write_tiny(tmp_path / "m", records))
    assert model.images.names == ("a.jpg", "b.jpg")
    assert not model.images.centers.any()  # all centers at the origin are fine
    records["points3D"] = []
    for image in records["images"]:
        image[4] = []
    model = read_model(write_tiny(tmp_path / "m", records))
    assert model.images.num_images == 2
    assert track_batches(model) == []


def test_binary_files_win_over_text_files_and_poses_in_frames_over_those_in_images(tmp_path):
    for name in ("cameras", "images", "points3D"):
        (tmp_path / f"{name}.txt").write_text("not a model")
    records = tiny_model()
    records["frames"][0][2] = (0.0, 1.0, 0.0, 0.0, 1.0, 2.0, 3.0)
    model = read_model(write_tiny(tmp_path, records))
    np.testing.assert_array_equal(model.images.rotations[0], np.diag([1.0, -1.0, -1.0]))


def test_images_without_a_pose_are_left_out_and_arrays_are_read_only(scene):
    copy = pycolmap.Reconstruction(scene)
    copy.deregister_frame(copy.image(3).frame_id)
    model = read_model(copy)
    assert 3 not in model.images.ids
    with pytest.raises(ValueError, match="read-only"):
        model.images.frames.rotations[0, 0, 0] = 2.0


def test_reading_changes_neither_a_folder_nor_a_reconstruction_and_prints_nothing(
    scene, folder, tmp_path, capfd
):
    before = fingerprint(folder)
    copy = pycolmap.Reconstruction(scene)
    for source in (folder, copy):
        track_batches(read_model(source))
    (tmp_path / "again").mkdir()
    copy.write_binary(tmp_path / "again")
    assert fingerprint(folder) == before == fingerprint(tmp_path / "again")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", MODEL_FILES)
def test_a_binary_file_cut_at_any_byte_is_refused_at_once(tmp_path, name):
    folder = write_tiny(tmp_path / "m", tiny_model())
    data = (folder / name).read_bytes()
    for length in range(len(data)):
        (folder / name).write_bytes(data[:length])
        with pytest.raises(InputError, match=rf"{name}: the file ends inside .* truncated"):
            read_folder(folder)


@pytest.mark.parametrize("name", MODEL_FILES)
def test_changed_bytes_end_in_a_sound_answer_or_an_input_error(folder, name):
    data = (folder / name).read_bytes()
    rng = np.random.default_rng(MODEL_FILES.index(name))
    refused = 0
    for _ in range(60):
        changed = bytearray(data)
        changed[int(rng.integers(len(data)))] ^= int(rng.integers(1, 256))
        (folder / name).write_bytes(changed)
        try:
            _, notes = read_folder(folder)
            refused += len(notes)  # its points are
        except InputError:
            refused += 1
    assert refused > 5  # most bytes of a model are digits of floats, where a change is a sound model


def test_a_model_that_is_read_in_small_pieces_is_judged_like_one_that_is_read_at_once(folder, monkeypatch):
    def verdict():
        try:
            read, notes = read_folder(folder)
        except InputError:
            return "refused"
        return notes, read.points2d.tobytes(), read.points.tobytes(), read.tracks.tobytes()

    file, verdicts = folder / "points3D.bin", []
    data = file.read_bytes()
    for most in (model_arrays.AT_ONCE, 5):
        monkeypatch.setattr(model_arrays, "AT_ONCE", most)
        rng, found = np.random.default_rng(1), [verdict()]
        for _ in range(40):
            changed = bytearray(data)
            changed[int(rng.integers(len(data)))] ^= int(rng.integers(1, 256))
            file.write_bytes(changed)
            found.append(verdict())
        file.write_bytes(data)
        verdicts.append(found)
    assert verdicts[0] == verdicts[1]
    assert 5 < sum(one == "refused" or len(one[0]) > 0 for one in verdicts[0]) < 40
    assert verdicts[0][0] != "refused"


@pytest.mark.parametrize("name", MODEL_FILES)
def test_an_absurd_count_and_bytes_after_the_last_record_are_refused(folder, name):
    data = (folder / name).read_bytes()
    counted = [(struct.pack("<Q", count) + data[8:], "truncated") for count in (2**63, 2**64 - 1, 10**6)]
    for damaged, reason in [*counted, (data + b"\0", "1 bytes follow")]:
        (folder / name).write_bytes(damaged)
        with pytest.raises(InputError, match=rf"{name}.*{reason}"):
            read_folder(folder)


def _set(*path_and_value):
    """Return a function that sets one nested entry of the tiny model's records."""
    *path, last, value = path_and_value

    def change(records):
        for key in path:
            records = records[key]
        records[last] = value

    return change


def _append(name, record):
    return lambda records: records[name].append(record)


NAN, INF = float("nan"), float("inf")
BROKEN_RECORDS = {
    "unknown camera model": (_set("cameras", 0, 1, 99), "camera 1 has the unknown camera model 99"),
    "NaN parameter": (_set("cameras", 0, 4, [NAN, 1.0, 1.0, 1.0]), "camera 1 has a parameter that is not"),
    "camera twice": (_append("cameras", [1, 0, 9, 9, [1.0, 1.0, 1.0]]), "camera 1 appears twice"),
    "NaN pose": (_set("images", 1, 1, (1.0, NAN, 0, 0, 0, 0, 0)), "image 2 has a pose that is not finite"),
    "zero rotation": (_set("images", 1, 1, (0.0,) * 7), "image 2 has a rotation quaternion of norm 0 "),
    "long rotation": (_set("images", 1, 1, (2.0, *(0.0,) * 6)), "image 2 has a rotation .* of norm 2 "),
    "no camera": (_set("images", 1, 2, 5), "image 2 refers to camera 5"),
    "no name": (_set("images", 1, 3, b""), "image 2 has no name"),
    "name twice": (_set("images", 1, 3, b"a.jpg"), r"image 2 \(a.jpg\) appears twice"),
    "image twice": (_set("images", 1, 0, 1), r"image 1 \(b.jpg\) appears twice"),
    "NaN pixel": (_set("images", 1, 4, [(5.0, NAN, 7)]), "image 2 has a point whose coordinates are not"),
    "NaN point": (_set("points3D", 0, 1, (0.0, NAN, 1.0)), "3D point 7 has coordinates that are not finite"),
    "infinite point": (_set("points3D", 0, 1, (-INF, 0.0, 1.0)), "3D point 7 has coordinates that are not"),
    "huge point": (_set("points3D", 0, 1, (0.0, 1e101, 1.0)), "3D point 7 has coordinates that are not"),
    "point twice": (_append("points3D", [7, (0.0, 0.0, 1.0), []]), "3D point 7 appears twice"),
    "rig of no camera": (_set("rigs", 0, 1, [(0, 4)]), "rig 1 refers to camera 4"),
    "rig twice": (_append("rigs", [1, [(0, 1)]]), "rig 1 appears twice"),
    "sensor twice": (_set("rigs", 0, 1, [(0, 1), (0, 1)]), "rig 1 has a sensor that appears twice"),
    "frame twice": (_set("frames", 1, 0, 1), "frame 1 appears twice"),
    "frame of no rig": (_set("frames", 1, 1, 6), "frame 2 refers to rig 6"),
    "NaN frame": (_set("frames", 1, 2, (1.0, 0, 0, 0, 0, 0, INF)), "frame 2 has a pose that is not finite"),
    "frame of no sensor": (_set("frames", 1, 3, [(0, 3, 2)]), "frame 2 refers to sensor 3"),
    "frame of no image": (_set("frames", 1, 3, [(0, 1, 2), (0, 1, 5)]), "a frame refers to image 5"),
    "image in two frames": (_set("frames", 1, 3, [(0, 1, 2), (0, 1, 1)]), "image 1 is in two frames"),
    "image in no frame": (_set("frames", 1, 3, []), "image 2 of images.bin is in no frame"),
}


@pytest.mark.parametrize("case", BROKEN_RECORDS)
def test_a_broken_record_is_named(tmp_path, case):
    change, message = BROKEN_RECORDS[case]
    records = tiny_model()
    change(records)
    with pytest.raises(InputError, match=message):
        read_model(write_tiny(tmp_path / "m", records))


CONTRADICTIONS = {
    "no such point": (_set("images", 1, 4, [(5.0, 6.0, 8)]), "image 2 observes 3D point 8, which points3D."),
    "track of no image": (_set("points3D", 0, 2, [(1, 0), (9, 0)]), "refers to point 0 of image 9, which"),
    "track of no pixel": (_set("points3D", 0, 2, [(1, 0), (2, 1)]), "refers to point 1 of image 2, which"),
    "other point": (_set("images", 0, 4, 0, (1.0, 2.0, 9)), "point 7 has keypoint 0 of image 1, to which i"),
    "no observations": (_set("images", 0, 4, []), "refers to point 0 of image 1, which images.bin does not"),
}


@pytest.mark.parametrize("case", CONTRADICTIONS)
def test_where_points_and_observations_contradict_the_poses_are_read_and_that_is_said(tmp_path, case):
    change, message = CONTRADICTIONS[case]
    records = tiny_model()
    change(records)
    folder = write_tiny(tmp_path / "m", records)
    before = fingerprint(folder)
    model = read_model(folder)
    assert model.images.names == ("a.jpg", "b.jpg")
    assert model.reconstruction.num_points3D() == 0
    assert track_batches(model) == []
    (note,) = model.notes
    assert message in note
    assert "poses alone are read" in note
    assert fingerprint(folder) == before
    (folder / "points3D.bin").unlink()
    assert "has no points3D.bin" in read_model(folder).notes[0]


TEXT_MODEL = {
    "cameras": "# a comment\n1 PINHOLE 640 480 500 500 320 240\n",
    "images": "1 1 0 0 0 0 0 0 1 a.jpg\n1 2 7 3 4 -1\n2 1 0 0 0 0 0 0 1 b.jpg\n5 6 7\n",
    "points3D": "7 0 0 4 9 9 9 0.5 1 0 2 0\n",
}
BROKEN_LINES = {
    "unknown model": ("cameras", "PINHOLE", "PINHOLA", r"cameras.txt:2: expected"),
    "parameter count": ("cameras", " 240", "", r"cameras.txt:2: PINHOLE has 4 parameters, but 3"),
    "NaN parameter": ("cameras", "320", "nan", r"cameras.txt: camera 1 has a parameter that is not finite"),
    "no name": ("images", " b.jpg", " ", r"images.txt:3: expected IMAGE_ID.*each image has two lines"),
    "zero in a name": ("images", "b.jpg", "b\0.jpg", r"images.txt:3: the name holds a byte that is zero"),
    "NaN pose": (
        "images",
        "2 1 0 0 0 0",
        "2 1 0 0 0 inf",
        r"images.txt: image 2 has a pose that is not finite",
    ),
    "not a number": ("images", "2 1 0 0 0 0", "2 1 0 0 0 x", r"images.txt:3: the pose holds something"),
    "zero rotation": ("images", "2 1 0", "2 0 0", r"images.txt: image 2 has a rotation .* of norm 0"),
    "name twice": ("images", "b.jpg", "a.jpg", r"images.txt: image 2 \(a.jpg\) appears twice"),
    "line missing": ("images", "5 6 7\n", "", r"images.txt:3: the line of its points is missing"),
    "no triples": ("images", "5 6 7", "5 6", r"images.txt:4: expected triples"),
    "NaN pixel": ("images", "5 6 7", "nan 6 7", r"images.txt: image 2 has a point whose coordinates are"),
    "NaN point": ("points3D", "0 0 4", "0 nan 4", r"points3D.txt: 3D point 7 has coordinates that are not f"),
    "odd track": ("points3D", " 2 0", " 2", r"points3D.txt:1: expected"),
    "no whole number": ("images", "2 1 0", "2x 1 0", r"images.txt:3: the image holds .* not a whole number"),
    "large number": ("images", "2 1 0", f"{2**32} 1 0", r"images.txt:3: a number is out of its range"),
    "huge number": ("cameras", "640", "9" * 5000, r"cameras.txt:2: the camera holds .* not a whole number"),
    "unknown camera": ("images", "1 b.jpg", "4 b.jpg", r"images.txt: image 2 refers to camera 4, which cam"),
    "image twice": ("images", "2 1 0", "1 1 0", r"images.txt: image 1 \(b.jpg\) appears twice"),
}


def write_text_model(folder: Path, **changed: str) -> Path:
    folder.mkdir(exist_ok=True)
    for name, text in {**TEXT_MODEL, **changed}.items():
        (folder / f"{name}.txt").write_text(text)
    return folder


@pytest.mark.parametrize("case", BROKEN_LINES)
def test_a_broken_line_of_a_text_model_is_named_and_windows_line_ends_are_read(tmp_path, case):
    windows = {name: text.replace("\n", "\r\n") for name, text in TEXT_MODEL.items()}
    assert read_model(write_text_model(tmp_path / "m", **windows)).images.names == ("a.jpg", "b.jpg")
    name, old, new, message = BROKEN_LINES[case]
    assert old in TEXT_MODEL[name]
    changed = new.join(TEXT_MODEL[name].rsplit(old, 1))
    with pytest.raises(InputError, match=message):
        read_model(write_text_model(tmp_path / "m", **{name: changed}))


def test_a_folder_that_is_no_model_is_refused_with_advice_and_the_one_that_was_meant(folder, tmp_path):
    (folder / "images.bin").rename(tmp_path / "elsewhere")
    (tmp_path / "empty").mkdir()
    write_tiny(tmp_path / "a" / "0", tiny_model())
    write_tiny(tmp_path / "b" / "sparse" / "0", tiny_model())
    for path, message in (
        (folder, r"lacks images\.bin"),
        (tmp_path / "nowhere", "does not exist"),
        (folder / "cameras.bin", "is a file"),
        (tmp_path / "empty", "holds no COLMAP model; give the folder with"),
        (tmp_path / "a", rf"but {tmp_path / 'a' / '0'} does"),
        (tmp_path / "b", rf"but {tmp_path / 'b' / 'sparse' / '0'} does"),
    ):
        with pytest.raises(InputError, match=message):
            read_model(path)


@pytest.mark.parametrize(("there", "missing"), [("rigs", "frames"), ("frames", "rigs")])
def test_rigs_and_frames_come_together(folder, there, missing):
    (folder / f"{missing}.bin").unlink()
    with pytest.raises(InputError, match=rf"has {there}\.bin but no {missing}\.bin"):
        read_model(folder)


def test_a_file_that_cannot_be_read_is_refused(folder):
    reasons = {"Is a directory": lambda file: (file.unlink(), file.mkdir())}
    if os.geteuid() != 0:  # root may read everything
        reasons = {"Permission denied": lambda file: file.chmod(0)} | reasons
    for reason, damage in reasons.items():
        damage(folder / "images.bin")
        with pytest.raises(InputError, match=rf"images\.bin cannot be read: {reason}"):
            read_model(folder)


def test_fewer_than_two_posed_images_are_refused(tmp_path):
    records = tiny_model()
    records |= {"points3D": [], "images": records["images"][:1], "frames": records["frames"][:1]}
    records["images"][0][4] = []
    with pytest.raises(InputError, match="has only one image with a pose"):
        read_model(write_tiny(tmp_path / "one", records))
    with pytest.raises(InputError, match="has no image with a pose"):
        read_model(pycolmap.Reconstruction())


def rigid(qvec, tvec):
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array(qvec)), np.array(tvec))


@pytest.mark.parametrize(
    ("part", "name", "value", "message"),
    [
        ("frame", "rig_from_world", rigid([0.0, 0, 0, 1], [0, INF, 0]), "2 has a pose that is not finite"),
        ("frame", "rig_from_world", rigid([NAN] * 4, [0.0, 0, 0]), "2 has a pose that is not finite"),
        ("point3D", "xyz", [NAN, 0.0, 0.0], "3D point 2 has coordinates that are not finite"),
        ("point2D", "xy", [NAN, 0.0], "image 2 has a point"),
        ("camera", "params", [INF, 1.0, 1.0, 0.0], "camera 2 has a parameter that is not finite"),
        ("camera", "params", [0.0, 1.0, 1.0, 0.0], "camera 2 has focal length 0 px"),
    ],
)
def test_values_that_are_not_finite_are_refused_in_memory(scene, part, name, value, message):
    copy = pycolmap.Reconstruction(scene)
    owner = copy.image(2).points2D[0] if part == "point2D" else getattr(copy, part)(2)
    setattr(owner, name, value if part == "frame" else np.array(value))
    with pytest.raises(InputError, match=message):
        read_model(copy)


def test_a_rig_of_two_cameras_is_read_with_the_poses_of_its_images(tmp_path):
    rig = synthesize(2, num_rigs=1, num_cameras_per_rig=2, num_frames_per_rig=3, num_points3D=5)
    rig.write(tmp_path)
    model = read_model(tmp_path)
    images = [rig.image(i) for i in model.images.ids.tolist()]
    assert len(images) == 6
    assert any(not image.is_ref_in_frame() for image in images)
    assert len(set(model.images.frame_of.tolist())) == len(model.images.frames.ids) == 3
    # roundings of unit rotations times distances of a few units
    np.testing.assert_allclose(model.images.centers, [i.projection_center() for i in images], atol=1e-12)
    errors = evaluate(rig, tmp_path)
    assert len(errors.names) == 6
    assert errors.position.max == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("camera_model", CAMERA_MODELS)
def test_rays_of_every_camera_model_project_back_to_their_pixel(camera_model):
    reconstruction = pycolmap.Reconstruction()
    model_id = pycolmap.CameraModelId.__members__[camera_model]
    camera = pycolmap.Camera.create_from_model_id(1, model_id, 500.0, 640, 480)
    info = [name.strip() for name in camera.params_info.split(",")]
    distortion = {"k", "k1", "k2", "k0", "p1", "p2", "sx1", "s0", "omega"} & set(info)
    camera.params = [
        value + (0.01 if name in distortion else 0.0) for name, value in zip(info, camera.params, strict=True)
    ]
    reconstruction.add_camera_with_trivial_rig(camera)
    rng = np.random.default_rng(CAMERA_MODELS.index(camera_model))
    for i in (1, 2):
        image = pycolmap.Image(name=f"{i}.jpg", camera_id=1, image_id=i)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(normalized(rng.normal(size=4))), rng.normal(size=3))
        reconstruction.add_image_with_trivial_frame(image, pose)
    model = read_model(reconstruction)
    xy = rng.uniform([20.0, 20.0], [620.0, 460.0], size=(50, 2))

    rays = rays_of(model.images.lenses[0], xy)

    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=8 * EPS)
    back = np.array([camera.img_from_cam(ray) for ray in rays])
    np.testing.assert_allclose(back, xy, atol=1e-6)  # undistortion iterates to about 1e-10 of f
    focal_px = 640 / (2 * np.pi) if camera_model == "EQUIRECTANGULAR" else 500.0
    assert model.images.focal_lengths_px[1] == pytest.approx(focal_px)
    assert rays_of(model.images.lenses[0], np.zeros((0, 2))).shape == (0, 3)


def test_rays_that_a_fisheye_folds_back_are_none():
    """A lens of 129 px per radian: 205 px are 85 degrees, and from 217 px on it looks behind itself."""
    focal = [129.15, 129.26, 240.0, 240.0]
    camera = pycolmap.Camera(
        camera_id=1,
        model="OPENCV_FISHEYE",
        width=480,
        height=480,
        params=[*focal, 0.038, -0.008, 0.0083, -0.0027],
    )
    xy = np.array([[240.0 + radius, 240.0] for radius in (100.0, 205.0, 218.0, 230.0)])
    assert np.isfinite(camera.cam_ray_from_img(xy)[:3]).all()  # wrong ones among them
    assert np.isfinite(rays_of(lens_of(camera), xy)).all(axis=1).tolist() == [True, True, False, False]


def track_batches(model, limit=PLENTY.batch):
    """Read all matches of a model's own tracks."""
    return list(TrackMatches(model).at(model.images, reading=Reading(batch=limit)).batches())


def brute_force_tracks(scene: pycolmap.Reconstruction) -> dict[tuple[int, int], set[tuple[int, int]]]:
    """Matches between images (by index) from the tracks, one observation pair at a time."""
    index = {i: k for k, i in enumerate(sorted(scene.images))}
    matches: dict[tuple[int, int], set[tuple[int, int]]] = {}
    for point in scene.points3D.values():
        seen = [(index[e.image_id], e.point2D_idx) for e in point.track.elements]
        once = sorted(o for o in seen if sum(o[0] == other[0] for other in seen) == 1)
        for (i, a), (j, b) in itertools.combinations(once, 2):
            matches.setdefault((i, j), set()).add((a, b))
    return matches


def as_sets(batches) -> dict[tuple[int, int], set[tuple[int, int]]]:
    """Matches of batches by pair; checks that no match and no pair appears twice."""
    found = {}
    for batch in batches:
        assert batch.offsets[0] == 0
        assert batch.offsets[-1] == len(batch.keypoints) == len(batch.rays_i) == len(batch.rays_j)
        for p, (i, j) in enumerate(batch.pairs.tolist()):
            rows = batch.keypoints[batch.offsets[p] : batch.offsets[p + 1]].tolist()
            assert i < j
            assert (i, j) not in found
            found[i, j] = set(map(tuple, rows))
            assert len(found[i, j]) == len(rows)
    return found


def thinned(scene: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A copy whose images see different subsets of the points, one of them twice in image 1."""
    copy = pycolmap.Reconstruction(scene)
    rng = np.random.default_rng(3)
    for point_id in sorted(copy.points3D):
        elements = [(e.image_id, e.point2D_idx) for e in copy.point3D(point_id).track.elements]
        for k in rng.choice(6, size=int(rng.integers(0, 4)), replace=False):
            copy.delete_observation(*elements[k])
    free = next(k for k, p in enumerate(copy.image(1).points2D) if not p.has_point3D())
    twice = next(p.point3D_id for p in copy.image(1).points2D if p.has_point3D())
    copy.add_observation(twice, pycolmap.TrackElement(1, free))
    return copy


@pytest.mark.parametrize("limit", [1, 20, 10**6])
def test_track_matches_are_those_of_a_plain_loop_whatever_the_batch_size(scene, limit):
    copy = thinned(scene)
    expected = brute_force_tracks(copy)
    found = as_sets(track_batches(read_model(copy), limit))
    assert found == expected
    assert list(found) == sorted(found)
    assert len(expected) == 15


def test_track_matches_carry_the_rays_of_their_keypoints(scene, model):
    (batch,) = track_batches(model)
    for p, (i, j) in enumerate(batch.pairs.tolist()):
        rows = slice(batch.offsets[p], batch.offsets[p + 1])
        for side, (image, rays) in enumerate(((i, batch.rays_i), (j, batch.rays_j))):
            points = scene.image(int(model.images.ids[image])).points2D
            ids = [points[int(k)].point3D_id for k in batch.keypoints[rows, side]]
            truth = normalized(np.array([scene.point3D(q).xyz for q in ids]) - model.images.centers[image])
            # exact projections; undistorting the pixel iterates to about 1e-10
            assert angle_between_deg(rays[rows], truth).max() < 1e-6


SCHEMA = """
CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY, model INTEGER, params BLOB);
CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT UNIQUE, camera_id INTEGER);
CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);
CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB,
                                  config INTEGER, F BLOB, E BLOB, H BLOB, qvec BLOB, tvec BLOB);
"""


def pair_id(a: int, b: int) -> int:
    return MAX_NUM_IMAGES * a + b


def write_database(path: Path, scene: pycolmap.Reconstruction, id_of=lambda i: i, cols: int = 6) -> Path:
    """Write the scene's keypoints and matches, with ids renamed by `id_of`."""
    connection = sqlite3.connect(path)
    connection.executescript(SCHEMA)
    for i, image in scene.images.items():
        xy = np.zeros((len(image.points2D), cols), dtype="<f4")
        xy[:, :2] = [p.xy for p in image.points2D]
        connection.execute("INSERT INTO images VALUES (?, ?, 1)", (id_of(i), image.name))
        connection.execute("INSERT INTO keypoints VALUES (?, ?, ?, ?)", (id_of(i), *xy.shape, xy.tobytes()))
    ids = sorted(scene.images, key=id_of)
    for a, b in itertools.combinations(ids, 2):
        of_point = {p.point3D_id: k for k, p in enumerate(scene.image(b).points2D) if p.has_point3D()}
        rows = [
            (k, of_point[p.point3D_id])
            for k, p in enumerate(scene.image(a).points2D)
            if p.has_point3D() and p.point3D_id in of_point
        ]
        add_pair(connection, id_of(a), id_of(b), rows)
    connection.commit()
    connection.close()
    return path


@pytest.fixture
def path(scene: pycolmap.Reconstruction, tmp_path: Path) -> Path:
    """The scene as a database."""
    return write_database(tmp_path / "d.db", scene)


def add_pair(connection, a, b, rows, *, config=2) -> None:
    """Insert or replace one row of two_view_geometries."""
    data = np.array(rows, dtype="<u4").reshape(-1, 2).tobytes()
    connection.execute(
        "INSERT OR REPLACE INTO two_view_geometries VALUES (?, ?, 2, ?, ?, NULL, NULL, NULL, NULL, NULL)",
        (pair_id(a, b), len(rows), data, config),
    )


def read_all(path: Path, model):
    """Read all matches that a database offers."""
    with view_of(path, model.images) as view:
        return as_sets(view.batches())


ID_ORDERS = {"same ids": lambda i: i, "reversed ids": lambda i: 100 - i, "mixed ids": lambda i: i * 5 % 7}


@pytest.mark.parametrize("order", ID_ORDERS)
@pytest.mark.parametrize("cols", [2, 4, 6])
def test_matches_are_found_by_name_whatever_the_ids(scene, tmp_path, order, cols):
    thin = thinned(scene)
    model = read_model(thin)
    path = write_database(tmp_path / "d.db", thin, ID_ORDERS[order], cols)
    with view_of(path, model.images) as view:
        found = as_sets(view.batches())
        assert view.matches.missing_names == ()
        assert view.num_pairs == len(found)
        for k, i in enumerate(model.images.ids.tolist()):
            xy = np.array([p.xy for p in thin.image(i).points2D])
            np.testing.assert_array_equal(view.keypoints(k), xy.astype(np.float32))
    twice = {(i, j) for i, j in found if i == 0}  # image 1 sees one point twice, which a database may say
    expected = brute_force_tracks(thin)
    assert list(found) == sorted(found)
    assert {p: m for p, m in found.items() if p not in twice} == {
        p: m for p, m in expected.items() if p not in twice
    }
    assert all(found[p] >= expected[p] for p in twice)


def test_repeated_matches_count_once_and_thin_pairs_are_left_out(path, model):
    def change(connection):
        add_pair(connection, 1, 2, [(3, 4), (0, 1), (3, 4), (3, 5), (0, 1)])
        add_pair(connection, 1, 3, [(0, 0), (0, 0), (0, 0)])

    with view_of(edit_database(path, change), model.images) as view:
        batch = next(view.batches(3))
    assert batch.pairs[:2].tolist() == [[0, 1], [0, 3]]
    assert batch.keypoints[:3].tolist() == [[0, 1], [3, 4], [3, 5]]  # sorted, whatever the order there


def test_only_configurations_with_verified_matches_are_used(path, model):
    pairs = list(itertools.combinations(range(1, 6), 2))  # ten pairs, one per configuration

    def change(connection):
        connection.execute("DELETE FROM two_view_geometries")
        for config, (a, b) in enumerate(pairs):
            add_pair(connection, a, b, [(0, 0), (1, 1)], config=config)

    matches = read_all(edit_database(path, change), model)
    config_of = {(a - 1, b - 1): config for config, (a, b) in enumerate(pairs)}
    assert [config_of[pair] for pair in matches] == [2, 3, 4, 5, 6, 8, 9]


def test_a_database_of_pycolmap_is_read(tmp_path):
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        scene = synthesize(4, database, num_rigs=1, num_points3D=20, num_frames_per_rig=4)
    matches = read_all(tmp_path / "database.db", read_model(scene))
    # In its database every pair of keypoints is a match of one point; the points2D carry the same order.
    assert matches == brute_force_tracks(scene)


def test_images_that_only_one_side_has_are_named_or_skipped_and_none_in_common_is_explained(path, model):
    edit_database(path, "UPDATE images SET name = 'renamed.png' WHERE image_id IN (2)")
    with view_of(path, model.images) as view:
        assert view.matches.missing_names == (model.images.names[1],)
        assert view.keypoints(1).shape == (0, 2)
        assert not any(1 in pair for pair in as_sets(view.batches()))
        assert view.num_pairs == 10
    edit_database(path, "UPDATE images SET name = 'other_' || name")
    first = model.images.names[0]
    message = rf"has 0 of the model's 6 images: the model's {first} .*database's other_.*not in the model"
    with pytest.raises(InputError, match=message), view_of(path, model.images):
        pass


GEOMETRY, KEYPOINTS = "UPDATE two_view_geometries SET ", "UPDATE keypoints SET "
FIRST = f" WHERE pair_id = {pair_id(1, 2)}"
BROKEN_ROWS = {
    "no matches": (f"{GEOMETRY} data = NULL", "has matches of wrong length; 15 of 15 pairs"),
    "empty matches": (f"{GEOMETRY} data = x''", "has matches of wrong length; 15 of 15 pairs"),
    "three columns": (f"{GEOMETRY} cols = 3", "matches of wrong length"),
    "huge rows": (f"{GEOMETRY} rows = {2**62}", "matches of wrong length"),
    "negative rows": (f"{GEOMETRY} rows = -1", "matches of wrong length"),
    "rows as text": (f"{GEOMETRY} rows = 'many'", "pair camera.* has no number where one belongs"),
    "negative pair": (f"{GEOMETRY} pair_id = -pair_id", r"the pair with id -\d+ is of no two images"),
    "no such configuration": (f"{GEOMETRY} config = 77", "has the unknown configuration 77"),
    "two of fifteen": (f"{GEOMETRY} cols = 3 WHERE pair_id < {pair_id(1, 4)}", r"2 of 15 pairs \(13%\)"),
    "few keypoints": (
        f"{KEYPOINTS} rows = 3, data = substr(data, 1, 72) WHERE image_id = 2",
        "has matches of keypoints that do not exist",
    ),
    "no keypoints": ("DELETE FROM keypoints", "no features were extracted of its 6 images"),
    "short keypoints": ("UPDATE keypoints SET data = substr(data, 2)", "keypoints of image .* are damaged"),
    "three per keypoint": ("UPDATE keypoints SET cols = 3, rows = rows * 2", "keypoints of image .* are dam"),
    "NaN keypoint": (f"{KEYPOINTS} data = CAST(x'0000c07f' || substr(data, 5) AS BLOB)", "not finite"),
    "signaling NaN": (f"{KEYPOINTS} data = CAST(x'0100807f' || substr(data, 5) AS BLOB)", "not finite"),
    "no table": ("DROP TABLE keypoints", "has no table keypoints"),
    "no geometries": ("DROP TABLE two_view_geometries", "has no table two_view_geometries"),
    "no column": ("ALTER TABLE two_view_geometries DROP COLUMN data", "no column data in its table two_"),
    "no images": ("DELETE FROM images", "has no images"),
    "no name": ("UPDATE images SET name = NULL WHERE image_id = 3", "id 3 has no valid id and name"),
    "bad id": (f"UPDATE images SET image_id = {MAX_NUM_IMAGES} WHERE image_id = 3", "no valid id and name"),
}


@pytest.mark.parametrize("case", BROKEN_ROWS)
def test_a_broken_row_is_named(path, model, case):
    statement, message = BROKEN_ROWS[case]
    with pytest.raises(InputError, match=message) as caught:
        read_all(edit_database(path, statement), model)
    assert str(path) in str(caught.value)


ONE_BROKEN_ROW = {
    "short matches": (
        f"{GEOMETRY} data = x'00' {FIRST}",
        "1 of 15 pairs (the pair {0} and {1} has matches of",
    ),
    "rows as text": (
        f"{GEOMETRY} rows = 'many' {FIRST}",
        "1 of 15 pairs (the pair {0} and {1} has no number",
    ),
    "unknown image": (f"{GEOMETRY} pair_id = {pair_id(1, 77)} {FIRST}", "1 of 15 pairs (the pair with id"),
    "own image": (
        f"{GEOMETRY} pair_id = {pair_id(2, 2)} {FIRST}",
        "1 of 15 pairs (the pair {1} and {1} is of",
    ),
    "configuration": (f"{GEOMETRY} config = 77 {FIRST}", "1 of 15 pairs (the pair {0} and {1} has the unkn"),
}
"""What is done to the pair of the first two images, and what is told of it."""


@pytest.mark.parametrize("case", ONE_BROKEN_ROW)
def test_one_broken_row_costs_its_pair_and_is_told_once(path, model, case):
    whole = read_all(path, model)
    statement, told = ONE_BROKEN_ROW[case]
    edit_database(path, statement)
    with view_of(path, model.images) as view:
        assert as_sets(view.batches()) == {pair: found for pair, found in whole.items() if pair != (0, 1)}
        (note,) = view.matches.notes
    assert told.format(*model.images.names) in note


def test_one_match_of_a_missing_keypoint_costs_that_match(path, model):
    whole = read_all(path, model)

    def change(connection):
        add_pair(connection, 1, 2, [*sorted(whole[0, 1])[1:], (0, 10**6)])

    with view_of(edit_database(path, change), model.images) as view:
        found = as_sets(view.batches())
        (note,) = view.matches.notes
    assert found == whole | {(0, 1): whole[0, 1] - {min(whole[0, 1])}}
    assert f"1 of {sum(map(len, whole.values()))} matches (the pair {model.images.names[0]} and" in note


@pytest.mark.parametrize("bits", ["0000c07f", "0100807f", "0000807f"])  # quiet and signaling NaN, infinity
def test_one_keypoint_that_is_not_finite_costs_its_matches(path, model, bits):
    whole = read_all(path, model)
    edit_database(path, f"{KEYPOINTS} data = CAST(x'{bits}' || substr(data, 5) AS BLOB) WHERE image_id = 2")
    with view_of(path, model.images) as view:
        found = as_sets(view.batches())
        (note,) = view.matches.notes
        assert np.isfinite(view.keypoints(1)).all()
        assert view.keypoints(1)[0].tolist() == [0.0, 0.0]
        for part in view.parts(50):  # other processes leave the same aside
            with part.open(model.images) as opened:
                assert found.items() >= as_sets(opened.batches()).items()
    lost = {
        pair: {match for match in found if match[pair.index(1)] == 0}
        for pair, found in whole.items()
        if 1 in pair
    }
    assert any(lost.values())
    assert found == {pair: matches - lost.get(pair, set()) for pair, matches in whole.items()}
    assert f"keypoints (image {model.images.names[1]} has a keypoint that is not finite)" in note


def test_one_image_whose_keypoints_cannot_be_read_is_as_if_it_had_none(path, model):
    whole = read_all(path, model)
    edit_database(path, f"{KEYPOINTS} data = substr(data, 2) WHERE image_id = 3")
    with view_of(path, model.images) as view:
        assert as_sets(view.batches()) == {pair: found for pair, found in whole.items() if 2 not in pair}
        assert len(view.keypoints(2)) == 0
        (note,) = view.matches.notes
    assert f"1 of 6 images (the keypoints of image {model.images.names[2]} are damaged)" in note


def as_old(connection, *, config=True):
    """Make the schema of COLMAP 3.1 and before: inlier_matches in the place of two_view_geometries."""
    columns = "pair_id, rows, cols, data" + ", config" * config
    connection.execute(
        "CREATE TABLE inlier_matches (pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, "
        f"cols INTEGER NOT NULL, data BLOB{', config INTEGER NOT NULL' * config})"
    )
    connection.execute(f"INSERT INTO inlier_matches SELECT {columns} FROM two_view_geometries")


@pytest.mark.parametrize("config", [True, False])
@pytest.mark.parametrize("newer", ["DROP TABLE two_view_geometries", "DELETE FROM two_view_geometries"])
def test_verified_matches_of_an_old_colmap_are_read(path, model, config, newer):
    whole = read_all(path, model)
    edit_database(path, partial(as_old, config=config), newer)
    assert read_all(path, model) == whole


def test_the_newer_table_of_verified_matches_goes_before_the_older(path, model):
    whole = read_all(path, model)
    edit_database(path, as_old, f"DELETE FROM two_view_geometries {FIRST}")
    assert read_all(path, model) == {pair: found for pair, found in whole.items() if pair != (0, 1)}


def test_files_that_are_no_database_are_refused(model, tmp_path):
    (tmp_path / "empty").touch()
    (tmp_path / "garbage").write_bytes(bytes(range(256)) * 40)
    edit_database(tmp_path / "other", "CREATE TABLE songs (title TEXT)")
    for name, message in (
        ("missing", "does not exist"),
        (".", "is a folder"),
        ("empty", "is empty"),
        ("garbage", "is not a COLMAP database"),
        ("other", "is not a COLMAP database: it has no table images"),
    ):
        with pytest.raises(InputError, match=message), view_of(tmp_path / name, model.images):
            pass
    assert sorted(os.listdir(tmp_path)) == ["empty", "garbage", "other"]


def test_a_truncated_database_is_an_input_error_at_any_length(path, model):
    data, cut = path.read_bytes(), path.with_name("cut.db")
    for length in np.linspace(1, len(data) - 1, 60).astype(int).tolist():
        cut.write_bytes(data[:length])
        with pytest.raises(InputError, match=r"cut\.db"):
            read_all(cut, model)


def test_a_locked_database_is_refused_in_seconds(path, model):
    writer = begin_writing(path, "BEGIN EXCLUSIVE")
    with pytest.raises(InputError, match="locked by another program"), view_of(path, model.images):
        pass
    writer.close()


@pytest.mark.parametrize("journal_mode", ["delete", "wal", "persist", "truncate"])
def test_reading_changes_no_byte_and_leaves_no_file(path, model, journal_mode):
    edit_database(path, f"PRAGMA journal_mode = {journal_mode}", "UPDATE images SET camera_id = 2")
    before = fingerprint(path.parent)
    assert len(read_all(path, model)) == 15
    assert fingerprint(path.parent) == before


def begin_writing(path: Path, *statements: str) -> sqlite3.Connection:
    """Return a connection that has run some SQL and stays open."""
    writer = sqlite3.connect(path, isolation_level=None)
    for statement in statements:
        writer.execute(statement)
    return writer


def copy_as_crashed(path: Path, suffix: str) -> Path:
    """Copy a database and one of its companions as a crash would leave them."""
    crashed = path.parent / "crashed"
    crashed.mkdir()
    for name in (path.name, path.name + suffix):
        shutil.copyfile(path.parent / name, crashed / name)
    return crashed / path.name


DELETE_FIRST = f"DELETE FROM two_view_geometries WHERE pair_id = {pair_id(1, 2)}"


def test_rows_that_sit_in_a_wal_file_are_read_with_or_without_its_shm_and_the_file_is_kept(path, model):
    wal = ("PRAGMA journal_mode = wal", "PRAGMA wal_autocheckpoint = 0")
    writer = begin_writing(path, *wal, DELETE_FIRST)
    crashed = copy_as_crashed(path, "-wal")
    for there, files in ((path, {"d.db", "d.db-wal", "d.db-shm"}), (crashed, {"d.db", "d.db-wal"})):
        entries = fingerprint(there.parent).items()
        before = {name: content for name, content in entries if name.startswith("d.db")}
        assert set(before) == files
        matches = read_all(there, model)
        assert (0, 1) not in matches
        assert len(matches) == 14
        assert before.items() <= fingerprint(there.parent).items()
        assert {file.name for file in there.parent.iterdir() if file.is_file()} == files
    writer.close()


def test_a_hot_journal_is_rolled_back_in_a_copy_only(path, model):
    spilling = ("PRAGMA cache_size = 1", "PRAGMA cache_spill = 1", "BEGIN")  # the transaction, into the file
    changes = ("DELETE FROM two_view_geometries", "UPDATE keypoints SET data = zeroblob(50000)")
    writer = begin_writing(path, *spilling, *changes)
    crashed = copy_as_crashed(path, "-journal")
    writer.execute("ROLLBACK")
    writer.close()
    assert crashed.read_bytes() != path.read_bytes()
    before = fingerprint(crashed.parent)

    assert len(read_all(crashed, model)) == 15
    assert fingerprint(crashed.parent) == before


def test_paths_that_mean_something_in_a_uri_are_read(scene, model, tmp_path):
    folder = tmp_path / "50%41 of #1? & Fotos für=alle"
    folder.mkdir()
    path = write_database(folder / "d?mode=rwc.db", scene)
    assert len(read_all(path, model)) == 15
    assert os.listdir(folder) == [path.name]


def test_the_database_is_found_beside_above_or_two_above_the_model(tmp_path, monkeypatch):
    model = tmp_path / "work" / "sparse" / "0"
    model.mkdir(parents=True)
    assert find_database(model) is None
    for folder in (tmp_path / "work", model.parent, model):
        (folder / "database.db").touch()
        assert find_database(model) == folder / "database.db"
    monkeypatch.chdir(model)
    (model / "database.db").unlink()
    assert find_database(Path(".")) == model.parent / "database.db"
    assert find_database(Path("../../sparse/0")) == model.parent / "database.db"


def test_images_observe_what_pycolmap_says():
    model, theirs = read_model(COURTYARD / "truth").arrays, pycolmap.Reconstruction(COURTYARD / "truth")
    for row, image_id in enumerate(model.images.ids.tolist()):
        image, (keypoints, points) = theirs.image(image_id), model.observed(row)
        assert keypoints.tolist() == list(image.get_observation_point2D_idxs())
        assert points.tolist() == [point.point3D_id for point in image.get_observation_points2D()]


def test_rows_are_looked_up_in_the_order_of_their_ids(tmp_path):
    rowids = np.random.default_rng(0).permutation(1800).tolist()
    with contextlib.closing(sqlite3.connect(tmp_path / "database.db")) as written:
        written.execute("CREATE TABLE squares (id INTEGER PRIMARY KEY, square INTEGER)")
        written.executemany("INSERT INTO squares VALUES (?, ?)", ((k, k * k) for k in range(len(rowids))))
        written.commit()
    with contextlib.closing(sqlite_file.DatabaseFile(tmp_path / "database.db")) as file:
        for found in in_threads(3, lambda k: file.look_up("squares", "square", rowids[k:]), range(9)):
            assert found == [k * k for k in rowids[-len(found) :]]


@pytest.mark.parametrize("kind", ["memory", "bin", "txt"])
def test_quaternions_of_norm_1_01_are_normalized_with_one_warning_and_those_of_the_user_stay(
    tmp_path, scene, kind
):
    model = pycolmap.Reconstruction(scene)
    frame = model.frame(min(model.frames))
    pose = frame.rig_from_world
    unit = pose.rotation.quat.copy()
    frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(1.01 * unit), pose.translation)
    if kind != "memory":
        (model.write_binary if kind == "bin" else model.write_text)(tmp_path)
    found = read_model(model if kind == "memory" else tmp_path)
    (note,) = found.notes
    assert note.startswith("1 rotation quaternion is normalized, the worst of norm 1.01")
    own = found.reconstruction.frame(frame.frame_id).rig_from_world
    assert own.rotation.norm() == pytest.approx(1.0, abs=1e-15)
    np.testing.assert_allclose(own.rotation.quat, unit, atol=1e-15)
    assert frame.rig_from_world.rotation.norm() == pytest.approx(1.01)
