"""Every camera model that pycolmap has, through every command, from a database and from a model."""

import json
import shutil

import pycolmap
import pytest

import sfm_shapefit
from tests.lens_scene import MODELS, camera_of_model, write_scene
from tests.models import only
from tests.program import run

# Units; the cameras stand 6 from the middle, where a pixel of a panorama is 6 / 191. Noise of 0.3 pixels in
# some 100 points moves a camera by a tenth of that, and the worst of six by thrice as much.
MOST_OFF = 0.02
WITHOUT_NERF = {
    *("FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION", "EUCM"),
    "FULL_OPENCV",  # with k4, k5, k6
}

# Models that take the same ways through the package as others of the enumeration do.
ALIKE = {
    *(
        "SIMPLE_PINHOLE",
        "SIMPLE_RADIAL",
        "RADIAL",
        "OPENCV",
        "SIMPLE_RADIAL_FISHEYE",
        "RADIAL_FISHEYE",
        "FISHEYE",
    ),
    *(
        "SIMPLE_FISHEYE",
        "THIN_PRISM_FISHEYE",
        "RAD_TAN_THIN_PRISM_FISHEYE",
        "SIMPLE_DIVISION",
        "DIVISION",
        "FOV",
    ),
}
LENSES = [pytest.param(name, marks=[pytest.mark.slow] if name in ALIKE else []) for name in MODELS]


def most_off(model, truth):
    """Return the largest position error of a model that has all cameras of another."""
    found = sfm_shapefit.evaluate(model, truth)
    assert not found.missing
    return found.position.max


def told(*command):
    """Return what a command prints as JSON."""
    return json.loads(run(*command, "--json", code=0).stdout)


@pytest.mark.parametrize("name", LENSES)
def test_every_command_takes_every_lens(name, tmp_path):
    truth, database = tmp_path / "scene/sparse/0", tmp_path / "scene/database.db"
    model = write_scene(tmp_path / "scene", [camera_of_model(name)])
    run("map", database, tmp_path / "mapped", "-q", code=0)
    run("locate", truth, tmp_path / "located", "-q", code=0)
    shutil.copytree(truth, tmp_path / "model/without/database")
    run("locate", tmp_path / "model/without/database", tmp_path / "by_tracks", "-q", code=0)
    for made in ("mapped/0", "located", "by_tracks"):
        assert told("evaluate", tmp_path / made, truth)["position_error"]["max"] < MOST_OFF
    assert told("check", truth, "--strict")["verdict"]["grade"] == "good"
    assert [piece["num_cameras"] for piece in told("inspect", truth)["diagnosis"]["pieces"]] == [6]
    for part, images in (("first", (1, 2, 3, 4)), ("second", (3, 4, 5, 6))):
        (tmp_path / part).mkdir()
        only(model, images).write(tmp_path / part)
    parts = tmp_path / "first", tmp_path / "second"
    run("join", *parts, tmp_path / "joined", "--database", database, "-q", code=0)
    assert most_off(tmp_path / "joined", truth) < MOST_OFF
    for target in ("copy", "scene.glb", "scene.ply", "list.tum"):
        run("convert", truth, tmp_path / target, "-q", code=0)
    assert (
        pycolmap.Reconstruction(tmp_path / "copy").camera(1).params.tolist()
        == model.camera(1).params.tolist()
    )
    run("locate", tmp_path / "list.tum", tmp_path / "listed", "--database", database, "-q", code=0)
    assert most_off(tmp_path / "listed", truth) < MOST_OFF
    if name in WITHOUT_NERF:
        assert "transforms.json" in run("convert", truth, tmp_path / "transforms.json", code=3).stderr
    else:
        run("convert", truth, tmp_path / "transforms.json", "-q", code=0)
        assert most_off(tmp_path / "transforms.json", truth) < 1e-9
