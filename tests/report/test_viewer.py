"""The viewer and the two commands that look at what an earlier run wrote."""

import json
import re
import urllib.request
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sfm_shapefit.report.drawing import PairClass, input_centers
from sfm_shapefit.report.read_back import read_output
from sfm_shapefit.report.viewer import Thresholds, camera_at, scene_radius, select_pairs, serve
from tests.drawings import make_drawing
from tests.program import run, viewing
from tests.scenes import BUNDLED, FACADE

pytest.importorskip("viser", reason="viser is not installed")


@pytest.fixture(scope="module")
def located(tmp_path_factory):
    out = tmp_path_factory.mktemp("located") / "out"
    run("locate", FACADE / "sparse" / "0", out, "--scene", "-q", code=0)
    return out


def test_locate_writes_the_pictures_that_are_asked_for_and_a_folder_is_read_back(located, tmp_path):
    pictures = {"report.html", "scene.glb", "scene.ply"}
    assert pictures <= {path.name for path in located.iterdir()}
    result = run("locate", FACADE / "sparse" / "0", tmp_path / "out", "--no-report", code=0)
    assert "report.html" not in result.stdout
    assert not pictures & {path.name for path in (tmp_path / "out").iterdir()}
    drawing, facts = read_output(located)
    assert facts == json.loads((located / "locate.json").read_text())
    assert int(drawing.cameras.placed.sum()) == facts["num_placed"]
    assert int(np.sum(drawing.pairs.classes == PairClass.CONTRADICTS)) == facts["pairs"]["outlier"]
    assert np.isfinite(drawing.cameras.poses.rotations[drawing.cameras.placed]).all()
    assert len(drawing.points.positions) > 0


def test_a_bare_graph_has_its_report_too_and_a_report_can_be_made_again(located, tmp_path):
    result = run("solve", BUNDLED / "graph40.txt", tmp_path / "out", "--scene", code=0)
    assert all(name in result.stdout for name in ("report.html", "scene.glb", "scene.ply"))
    drawing, _ = read_output(tmp_path / "out")
    assert np.isfinite(drawing.cameras.centers).all()
    for folder, words in ((tmp_path / "out", "40 nodes"), (located, "9 cameras")):
        report = folder / "report.html"
        before = report.read_text(encoding="utf-8")
        assert words in before
        report.unlink()
        run("report", folder, code=0)
        texts = (before, report.read_text(encoding="utf-8"))
        assert len({re.search(r'"summary":(\[.*?\])', text).group(1) for text in texts}) == 1


@pytest.mark.parametrize(
    ("command", "advice"),
    [("report", "holds no COLMAP model"), ("view", "give a folder that locate or place wrote")],
)
def test_folders_of_others_and_damaged_ones_are_refused_in_a_sentence(tmp_path, command, advice):
    result = run(command, tmp_path, code=3)
    assert advice in result.stderr
    (tmp_path / "locate.json").write_text("{}")
    result = run(command, tmp_path, code=3)
    assert "damaged or of another version" in result.stderr
    assert "Traceback" not in result.output
    missing = tmp_path / "missing"
    assert f"{missing} does not exist" in run(command, missing, code=3).stderr


def test_thresholds_decide_which_pairs_are_drawn():
    drawing, _ = make_drawing()
    everything = Thresholds(residual_deg=180.0, min_support=0, min_trust=0.0, camera=None)
    rows, contradicts = select_pairs(drawing, everything)
    placed = drawing.cameras.placed[drawing.pairs.cameras].all(axis=1) & np.isfinite(
        drawing.pairs.residuals_deg
    )
    assert len(rows) == int(placed.sum())
    assert not contradicts.any()

    strict = Thresholds(residual_deg=4.0, min_support=50, min_trust=0.7, camera=3)
    rows, contradicts = select_pairs(drawing, strict)
    assert len(rows) > 0
    assert (drawing.pairs.support[rows] >= 50).all()
    assert (drawing.pairs.cameras[rows] == 3).any(axis=1).all()
    assert (drawing.cameras.trust[drawing.pairs.cameras[rows]] >= 0.7).all()
    np.testing.assert_array_equal(contradicts, drawing.pairs.residuals_deg[rows] > 4.0)


def test_the_inputs_centers_are_brought_into_the_outputs_units_and_a_ray_picks_a_camera():
    drawing, _ = make_drawing()
    cameras, placed = drawing.cameras, drawing.cameras.placed
    for centers, seen in ((100.0 * cameras.centers + 7.0, True), (np.zeros_like(cameras.centers), False)):
        poses = replace(cameras.poses, centers=centers)
        other = replace(drawing, cameras=replace(cameras, poses=poses), input_is_aligned=False)
        found = input_centers(other)
        assert (found is not None) == seen
        if seen:
            np.testing.assert_allclose(found[placed], cameras.centers[placed], atol=1e-6)
    eye = cameras.centers[placed].mean(axis=0) + np.array([3.0, 40.0, 8.0])
    for camera in np.flatnonzero(placed)[:5].tolist():
        assert camera_at(drawing, eye, 7.0 * (cameras.centers[camera] - eye)) == camera
    assert camera_at(drawing, eye, np.array([0.0, 1.0, 0.0])) is None  # away from all


def test_moving_a_control_redraws():
    drawing, facts = make_drawing()
    server = serve(drawing, facts, "127.0.0.1", 8765)
    try:
        controls = {handle.label: handle for handle in server.gui._gui_input_handle_from_uuid.values()}
        before = controls["pairs drawn"].value
        controls["least matches"].value = 100
        assert controls["pairs drawn"].value != before
        before = controls["pairs drawn"].value
        controls["pairs that agree"].value = False
        assert controls["pairs drawn"].value != before
        controls["frustum size"].value = 2.0
        eye = np.array(server.initial_camera.position)
        assert np.linalg.norm(eye) > 2.0 * scene_radius(drawing)
        assert "input's poses (gray)" in controls
        (clicked,) = server.scene._scene_pointer_cb
        middle = np.median(drawing.cameras.centers[drawing.cameras.placed], axis=0)
        towards = drawing.cameras.centers[3] - middle - np.array([50.0, 0.0, 0.0])
        clicked.callback(SimpleNamespace(ray_origin=(50.0, 0.0, 0.0), ray_direction=tuple(towards)))
        assert controls["pairs of"].value.endswith(drawing.cameras.names[3])
    finally:
        server.stop()


def test_it_opens_from_outside_and_verdicts_are_those_of_the_report():
    drawing, _ = make_drawing()
    distances = np.linalg.norm(drawing.cameras.centers[drawing.cameras.placed], axis=1)
    assert scene_radius(drawing) == pytest.approx(np.quantile(distances, 0.95), rel=0.2)
    as_reported = Thresholds(residual_deg=None, min_support=0, min_trust=0.0, camera=None)
    rows, contradicts = select_pairs(drawing, as_reported)
    np.testing.assert_array_equal(contradicts, drawing.pairs.classes[rows] == PairClass.CONTRADICTS)


def test_view_serves_a_page_on_this_machine_only_and_ends_when_told(located):
    with viewing(located, "--port", "8790") as address:
        assert address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(address, timeout=30) as answer:
            assert answer.status == 200
            assert b"<html" in answer.read().lower()
