"""Cameras as other programs write them: read as the models of COLMAP that they are, and said once."""

import shutil
import struct

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit.files.colmap.camera_variants import read_camera
from sfm_shapefit.files.colmap.model import read_model
from tests.lens_scene import camera_of_model, write_scene
from tests.program import run, run_refused
from tests.scenes import edit_database

SIZE = (1200, 600)
SPHERES = [
    ("SPHERE", (1.0, 600.0, 300.0)),
    ("SPHERE", (0.0, 0.0, 0.0)),
    ("SPHERICAL", (1200.0, 600.0)),
    ("SPHERICAL", (500.0, 600.0, 300.0)),
    ("OPENCV_SPHERICAL", ()),
    ("EQUIRECTANGULAR", (191.0, 600.0, 300.0)),
    *((number, (1.0, 600.0, 300.0)) for number in (11, 12, 16, 17)),
]
FOCAL, MIDDLE = (500.0, 510.0), (320.0, 240.0)
SHORT = [
    ("FULL_OPENCV", (*FOCAL, *MIDDLE, 0.1, 0.2), (*FOCAL, *MIDDLE, 0.1, 0.2, *6 * (0.0,))),
    (
        "FULL_OPENCV",
        (*FOCAL, *MIDDLE, 0.1, 0.2, 0.3, 0.4, 0.5),
        (*FOCAL, *MIDDLE, 0.1, 0.2, 0.3, 0.4, 0.5, *3 * (0.0,)),
    ),
    (
        "FULL_OPENCV",
        (500.0, *MIDDLE, 0.1, 0.2, 0.3),
        (500.0, 500.0, *MIDDLE, 0.1, 0.2, 0.0, 0.0, 0.3, *3 * (0.0,)),
    ),
    (
        "RAD_TAN_THIN_PRISM_FISHEYE",
        (*FOCAL, *MIDDLE, *10 * (0.1,)),
        (*FOCAL, *MIDDLE, *10 * (0.1,), 0.0, 0.0),
    ),
    ("RAD_TAN_THIN_PRISM_FISHEYE", (500.0, *MIDDLE, *12 * (0.1,)), (500.0, 500.0, *MIDDLE, *12 * (0.1,))),
    (6, (*FOCAL, *MIDDLE, 0.1, 0.2), (*FOCAL, *MIDDLE, 0.1, 0.2, *6 * (0.0,))),
]


@pytest.mark.parametrize(("model", "params"), SPHERES)
def test_panoramas_of_other_programs_are_equirectangular(model, params):
    read = read_camera(model, SIZE, params)
    assert (read.model, read.params) == ("EQUIRECTANGULAR", (1200.0, 600.0))
    assert f"with {len(params)} parameters" in read.note


@pytest.mark.parametrize(("model", "params", "whole"), SHORT)
def test_lists_that_end_early_lack_distortion(model, params, whole):
    read = read_camera(model, (640, 480), params)
    assert read.params == whole
    assert f"with {len(params)} parameters instead of {len(whole)}" in read.note


@pytest.mark.parametrize("model", pycolmap.CameraModelId.__members__)
def test_what_colmap_writes_is_what_it_is(model):
    if model != "INVALID":
        params = tuple(camera_of_model(model).params.tolist())
        for name in (model, int(getattr(pycolmap.CameraModelId, model))):
            assert read_camera(name, (640, 480), params) == (model, params, "")


@pytest.mark.parametrize(
    ("model", "params"), [("PINHOLE", (500.0, 320.0, 240.0)), ("FOO", (1.0,)), (99, (1.0,))]
)
def test_what_is_of_no_model_is_none(model, params):
    assert read_camera(model, (640, 480), params) is None


@pytest.mark.parametrize("suffix", [".txt", ".bin"])
def test_models_and_databases_with_such_cameras_are_read_and_that_is_said(tmp_path, suffix):
    truth = write_scene(tmp_path, [camera_of_model("EQUIRECTANGULAR")])
    folder = tmp_path / "sparse/0"
    if suffix == ".txt":
        shutil.rmtree(folder)
        folder.mkdir()
        truth.write_text(folder)
        (folder / "cameras.txt").write_text("# of SphereSfM\n1 SPHERE 1200 600 1 600 300\n", encoding="utf-8")
    else:
        (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ3d", 1, 1, 11, 1200, 600, 1.0, 600.0, 300.0))
    blob = struct.pack("<3d", 1.0, 600.0, 300.0)
    edit_database(
        tmp_path / "database.db", lambda c: c.execute("UPDATE cameras SET model = 11, params = ?", (blob,))
    )
    before = (folder / f"cameras{suffix}").read_bytes()
    model = read_model(folder)
    assert model.images.lenses[0].parameters == (1200.0, 600.0)
    for warnings in (
        sfm_shapefit.locate(folder).warnings,
        sfm_shapefit.check(folder).facts.warnings,
        sfm_shapefit.inspect(folder).warnings,
        sfm_shapefit.evaluate(folder, truth).warnings,
    ):
        said = [warning for warning in warnings if warning.startswith("camera 1 of the model: ")]
        assert len(said) == 1
        assert said[0].endswith("with 3 parameters, read as EQUIRECTANGULAR 1200 600")
    mapped = sfm_shapefit.map_database(tmp_path / "database.db")
    assert [warning.partition(":")[0] for warning in mapped.warnings] == ["camera 1 of the database"]
    assert sfm_shapefit.evaluate(mapped.reconstruction, truth).position.max < 0.02
    run("convert", folder, tmp_path / "own", "-q", code=0)
    assert pycolmap.Reconstruction(tmp_path / "own").camera(1).model_name == "EQUIRECTANGULAR"
    assert (folder / f"cameras{suffix}").read_bytes() == before


def test_a_truncated_file_is_no_variant(tmp_path):
    write_scene(tmp_path, [camera_of_model("SIMPLE_RADIAL")])
    cameras = tmp_path / "sparse/0/cameras.bin"
    for count in (8, 16, 24):
        cameras.write_bytes(cameras.read_bytes()[:-8])
        assert "truncated" in run_refused("convert", tmp_path / "sparse/0", tmp_path / f"out{count}")


@pytest.mark.parametrize("focal", [0.0, -500.0])
def test_each_focal_length_of_a_model_has_to_be_positive(tmp_path, focal):
    model = write_scene(tmp_path, [camera_of_model("PINHOLE")])
    model.camera(1).params = np.array([500.0, focal, 320.0, 240.0])
    model.write(tmp_path / "sparse/0")
    assert "camera 1 has focal length" in run_refused("check", tmp_path / "sparse/0")
