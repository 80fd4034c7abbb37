"""Results that are drawn."""

from dataclasses import replace

import numpy as np

from sfm_shapefit.commands.locate import locate
from sfm_shapefit.commands.map import map_database
from sfm_shapefit.judgement.lens_residuals import lens_fields
from sfm_shapefit.report.charts import residuals_of_states
from sfm_shapefit.report.drawing import PairClass, input_centers
from sfm_shapefit.report.results import draw_result
from tests.drawings import make_drawing
from tests.program import run
from tests.scenes import BUNDLED, FACADE, RING


def test_locate_writes_a_report_unless_told_otherwise(tmp_path):
    result = run("locate", FACADE / "sparse" / "0", tmp_path / "out", "--no-report", code=0)
    assert "report.html" not in result.stdout
    assert not (tmp_path / "out" / "report.html").exists()


def test_what_is_drawn_of_a_result_is_what_its_facts_count():
    found = locate(FACADE / "sparse" / "0")
    drawing, facts = draw_result(found), found.facts
    assert int(drawing.cameras.placed.sum()) == facts.num_placed
    assert int(np.sum(drawing.pairs.classes == PairClass.CONTRADICTS)) == facts.pairs["outlier"]
    assert np.isfinite(drawing.cameras.poses.rotations[drawing.cameras.placed]).all()
    assert len(drawing.points.xyz) > 0


def test_the_residuals_of_a_lens_that_are_drawn_are_those_of_the_verdict_and_of_the_output():
    found = locate(RING / "sparse" / "0", RING / "database.db")
    (drawn,), (anew,) = draw_result(found).fields, lens_fields(found.seed.structure)
    assert drawn is found.evidence.fields[0]
    assert all(np.array_equal(one, other) for one, other in zip(drawn, anew, strict=True))
    assert "fields" not in found.facts.summary()["evidence"]


def test_map_is_not_compared_with_positions_that_no_database_has():
    """Sensors of rigs stand apart in a database, by their offsets."""
    found = map_database(RING / "database.db", points="never").models[0]
    given = np.random.default_rng(1).standard_normal(found.images.frames.centers.shape)
    apart = replace(found.images, frames=replace(found.images.frames, centers=given))
    drawing = draw_result(replace(found, images=apart))
    assert input_centers(drawing) is None
    assert "input" not in residuals_of_states(drawing.pairs)


def test_a_bare_graph_has_its_report_too(tmp_path):
    result = run("place", BUNDLED / "graph40.txt", tmp_path / "out", code=0)
    assert "report.html" in result.stdout
    assert f"see {tmp_path / 'out'}/cameras.csv" in result.stdout
    assert "40 nodes" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


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


def test_every_lens_is_listed_with_what_the_model_has():
    found = locate(FACADE / "sparse" / "0")
    (row,) = draw_result(found).lenses
    (camera,) = found.reconstruction.cameras.values()
    assert (row.id, row.model, row.num_images) == (str(camera.camera_id), camera.model.name, "9")
    assert row.focal_length == ", ".join(f"{camera.params[k]:,.1f}" for k in camera.focal_length_idxs())
