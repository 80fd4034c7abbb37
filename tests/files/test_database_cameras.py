"""Cameras of a database that cannot be: a guess becomes COLMAP's, what was stated is named and left out."""

import struct

import numpy as np
import pytest

import sfm_shapefit
from sfm_shapefit.files.colmap.database_images import read_images
from sfm_shapefit.files.colmap.reconstructions import reconstruction_of
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from tests.lens_scene import camera_of_model, write_scene
from tests.program import run
from tests.scenes import edit_database


def put(path, camera_id, **columns):
    """Change columns of a camera; parameters are given as numbers."""
    for name, value in columns.items():
        blob = struct.pack(f"<{len(value)}d", *value) if isinstance(value, list) else value
        edit_database(
            path,
            lambda c, n=name, b=blob: c.execute(
                f"UPDATE cameras SET {n} = ? WHERE camera_id = ?", (b, camera_id)
            ),
        )


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A scene of ten frames, the first of which has a camera of its own; nobody may change it."""
    folder = tmp_path_factory.mktemp("scene")
    cameras = [camera_of_model("OPENCV", k) for k in range(1, 7)]
    return write_scene(folder, cameras), folder


@pytest.fixture
def database(scene, tmp_path):
    """A copy of its database that a test may damage."""
    path = tmp_path / "database.db"
    path.write_bytes((scene[1] / "database.db").read_bytes())
    return path


def cameras_of(path):
    """Return the cameras of a database that can be used, and what was noted."""
    file = DatabaseFile(path)
    read = read_images(file)
    file.close()
    return read, file.notes


GOOD = camera_of_model("OPENCV").params.tolist()


@pytest.mark.parametrize("focal", [0.0, -500.0, np.nan, np.inf, 0.8, 1e6])
@pytest.mark.parametrize("which", [(0, 1), (0,), (1,)])
def test_a_guessed_focal_length_that_cannot_be_becomes_colmaps_guess(database, focal, which):
    put(database, 3, params=[focal if k in which else x for k, x in enumerate(GOOD)], prior_focal_length=0)
    read, (note,) = cameras_of(database)
    camera = reconstruction_of(read.model).camera(3)
    assert camera.params.tolist() == [768.0, 768.0, *GOOD[2:]]
    assert not camera.has_prior_focal_length
    assert note.startswith("camera 3 of the database: the focal length")
    assert "COLMAP's guess, focal length 768 px" in note
    assert not read.left_out


@pytest.mark.parametrize("focal", [0.0, -500.0, np.nan, np.inf])
def test_images_of_a_stated_focal_length_that_cannot_be_are_left_out(database, focal):
    put(database, 3, params=[500.0, focal, *GOOD[2:]])
    read, (note,) = cameras_of(database)
    assert read.left_out == {"0003.jpg": f"its camera 3 has the focal length {focal:g}"}
    assert "1 image is left out (0003.jpg)" in note
    assert read.images.num_images == 5


IMPOSSIBLE = [
    ({"params": [500.0, 320.0, 240.0]}, "has 3 parameters, where OPENCV has 8"),
    ({"model": 99}, "has the model 99, which pycolmap does not know"),
    ({"params": [*GOOD[:2], np.nan, *GOOD[3:]]}, "has the parameters nan"),
    ({"width": 0, "params": [*GOOD[:2], 0.0, *GOOD[3:]]}, "has no size"),
    ({"params": b"x"}, "has 0 parameters"),
]


@pytest.mark.parametrize(("columns", "reason"), IMPOSSIBLE)
def test_other_cameras_that_cannot_be_are_named_and_their_images_left_out(database, columns, reason):
    put(database, 3, **columns)
    read, (note,) = cameras_of(database)
    assert reason in note
    assert reason in read.left_out["0003.jpg"]
    put(database, 3, prior_focal_length=0)
    if "params" in columns and "width" not in columns:
        assert not cameras_of(database)[0].left_out


@pytest.mark.parametrize(("width", "height"), [(0, 480), (640, -1), (2.5, None), (None, 480)])
def test_a_size_that_is_not_there_is_twice_the_principal_point(database, width, height):
    edit_database(
        database,
        "PRAGMA foreign_keys = OFF",
        "CREATE TABLE c AS SELECT * FROM cameras",
        "DROP TABLE cameras",
        "ALTER TABLE c RENAME TO cameras",
    )
    put(database, 3, width=width, height=height)
    read, (note,) = cameras_of(database)
    camera = reconstruction_of(read.model).camera(3)
    assert (camera.width, camera.height, camera.params.tolist()) == (640, 480, GOOD)
    assert "became 640 x 480" in note


def test_map_goes_on_without_the_images_and_refuses_where_nothing_is_left(database, scene, tmp_path):
    put(database, 3, params=[0.0, 0.0, *GOOD[2:]])
    put(database, 4, params=[np.nan, np.nan, *GOOD[2:]], prior_focal_length=0)
    found = sfm_shapefit.map_database(database)
    assert sfm_shapefit.evaluate(found.reconstruction, scene[0]).position.max < 0.02
    assert found.left_out == {"0003.jpg": "its camera 3 has the focal length 0"}
    assert found.num_images == 6
    assert sum("of the database" in warning for warning in found.warnings) == 2
    assert sfm_shapefit.average_database(database).num_reg_images() == 5
    edit_database(
        database,
        lambda c: c.execute("UPDATE cameras SET params = ?", (struct.pack("<8d", 0.0, 0.0, *GOOD[2:]),)),
        "UPDATE cameras SET prior_focal_length = 1",
    )
    said = run("map", database, tmp_path / "out", code=3).stderr
    assert (
        "cameras 1, 2, 3 and 3 more of the database: each has the focal length 0: 6 images are left out"
        in said
    )
    assert said.count("\n") == 1


def test_locate_and_check_take_a_model_whose_database_has_such_cameras(database, scene):
    for camera_id in range(1, 7):
        put(database, camera_id, params=[0.0, -1.0, *GOOD[2:]], prior_focal_length=0)
    found = sfm_shapefit.locate(scene[1] / "sparse/0", database)
    assert sfm_shapefit.evaluate(found, scene[0]).position.max < 0.02
    assert sfm_shapefit.check(scene[1] / "sparse/0", database).facts.num_placed == 6


def test_a_rig_goes_on_without_a_camera_that_cannot_be(tmp_path):
    truth = write_scene(tmp_path, [camera_of_model("OPENCV", k) for k in (1, 2)], rig=True)
    put(tmp_path / "database.db", 2, params=[0.0, *GOOD[1:]])
    found = sfm_shapefit.map_database(tmp_path / "database.db")
    assert found.reconstruction.num_reg_images() == 6
    assert sfm_shapefit.evaluate(found.reconstruction, truth).position.max < 0.02
    assert len(found.left_out) == 6
