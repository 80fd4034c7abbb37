"""Output folders that are read again, to be drawn."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from sfm_shapefit.report.drawing import PairClass, input_centers
from sfm_shapefit.report.read_back import read_output
from tests.drawings import make_drawing
from tests.program import run
from tests.scenes import BUNDLED, FACADE


@pytest.fixture(scope="module")
def located(tmp_path_factory):
    out = tmp_path_factory.mktemp("located") / "out"
    run("locate", FACADE / "sparse" / "0", out, "-q", code=0)
    return out


def test_locate_writes_a_report_unless_told_otherwise_and_a_folder_is_read_back(located, tmp_path):
    assert (located / "report.html").is_file()
    result = run("locate", FACADE / "sparse" / "0", tmp_path / "out", "--no-report", code=0)
    assert "report.html" not in result.stdout
    assert not (tmp_path / "out" / "report.html").exists()
    drawing, facts = read_output(located)
    assert facts == json.loads((located / "locate.json").read_text())
    assert int(drawing.cameras.placed.sum()) == facts["num_placed"]
    assert int(np.sum(drawing.pairs.classes == PairClass.CONTRADICTS)) == facts["pairs"]["outlier"]
    assert np.isfinite(drawing.cameras.poses.rotations[drawing.cameras.placed]).all()
    assert len(drawing.points.positions) > 0


def test_a_bare_graph_has_its_report_too_and_a_report_can_be_made_again(located, tmp_path):
    result = run("solve", BUNDLED / "graph40.txt", tmp_path / "out", code=0)
    assert "report.html" in result.stdout
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


def test_folders_of_others_and_damaged_ones_are_refused_in_a_sentence(tmp_path):
    assert "holds no COLMAP model" in run("report", tmp_path, code=3).stderr
    (tmp_path / "locate.json").write_text("{}")
    result = run("report", tmp_path, code=3)
    assert "damaged or of another version" in result.stderr
    assert "Traceback" not in result.output
    missing = tmp_path / "missing"
    assert f"{missing} does not exist" in run("report", missing, code=3).stderr


def test_the_inputs_centers_are_brought_into_the_outputs_units():
    drawing, _ = make_drawing()
    cameras, placed = drawing.cameras, drawing.cameras.placed
    for centers, seen in ((100.0 * cameras.centers + 7.0, True), (np.zeros_like(cameras.centers), False)):
        poses = replace(cameras.poses, centers=centers)
        other = replace(drawing, cameras=replace(cameras, poses=poses), input_is_aligned=False)
        found = input_centers(other)
        assert (found is not None) == seen
        if seen:
            np.testing.assert_allclose(found[placed], cameras.centers[placed], atol=1e-6)
