"""`report MODEL`: any COLMAP model explained as it stands, and left as it is."""

import numpy as np
import pytest

from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.points import points_of
from sfm_shapefit.judgement.image_quality import image_quality
from sfm_shapefit.pipeline.examine import examine
from sfm_shapefit.report.drawing import PairClass
from sfm_shapefit.report.first_screen import banner
from tests.models import posed
from tests.program import run, run_refused
from tests.scenes import COURTYARD, RING, fingerprint
from tests.structures import pictures_of


def moved(model, name, away):
    """A copy in which one camera stands elsewhere; `away` is in its own axes."""
    return posed(model, lambda other, turn, center: (turn, center - turn.T @ away * (other == name)))


def test_quality_is_that_of_the_models_own_observations():
    model = read_model(RING / "sparse" / "0")
    reconstruction, images = model.reconstruction, model.images
    pictures = pictures_of(reconstruction, images)
    quality = image_quality(points_of(reconstruction, images), images, pictures)
    mean = np.sum(quality.num_points * quality.errors_px) / quality.num_points.sum()
    assert mean == pytest.approx(reconstruction.compute_mean_reprojection_error(), rel=0.05)  # by point there
    image = reconstruction.image(int(model.images.ids[3]))
    seen = [point for point in image.points2D if point.has_point3D()]
    lengths = [reconstruction.points3D[point.point3D_id].track.length() for point in seen]
    assert quality.num_points[3] == len(seen)
    assert quality.track_lengths[3] == np.median(lengths)
    camera = image.camera
    cells = {(int(8 * p.xy[0] / camera.width), int(8 * p.xy[1] / camera.height)) for p in seen}
    assert quality.coverage[3] == pytest.approx(len(cells) / 64)


def test_a_sound_model_is_good_and_a_displaced_camera_is_named(tmp_path):
    drawing, facts = examine(RING / "sparse" / "0")
    assert facts.verdict.statement == "good"
    assert not (drawing.pairs.classes == PairClass.CONTRADICTS).any()
    assert "image_undistorter" in banner(drawing, facts)["command"]

    moved(RING / "sparse" / "0", "0003.jpg", [1.0, 0.0, 0.0]).write(tmp_path)
    drawing, facts = examine(tmp_path, RING / "database.db")
    assert facts.verdict.cameras == ("0003.jpg",)
    row = drawing.cameras.names.index("0003.jpg")
    assert "pairs contradict where it stands" in drawing.cameras.reasons[row]
    assert "its reprojection error is" in drawing.cameras.reasons[row]
    wrong = drawing.pairs.cameras[drawing.pairs.classes == PairClass.CONTRADICTS]
    assert len(wrong) > 0
    assert (wrong == row).any(axis=1).all()
    assert "locate" in banner(drawing, facts)["command"]


def test_the_page_is_written_beside_and_nothing_is_replaced_unasked(tmp_path):
    before = fingerprint(RING)
    page = tmp_path / "ring.html"
    result = run("report", RING / "sparse" / "0", "--write-to", page, code=0)
    assert f"open {page}" in result.output
    assert "Share of the picture in which it sees points" in page.read_text(encoding="utf-8")
    assert "exists already" in run_refused("report", RING / "sparse" / "0", "--write-to", page)
    run("report", RING / "sparse" / "0", "--write-to", page, "--overwrite", code=0)
    assert fingerprint(RING) == before


def test_where_many_pairs_are_wrong_a_camera_is_weak_only_beside_the_others(tmp_path):
    _, facts = examine(COURTYARD / "truth", COURTYARD / "database.db")  # a quarter of its pairs is wrong
    assert len(facts.verdict.cameras) <= 1
    away = 0.002 * 15.5 * np.array([0.6, 0.0, 0.8])  # 0.2 % of the extent
    moved(COURTYARD / "truth", "0008.jpg", away).write(tmp_path)
    drawing, facts = examine(tmp_path, COURTYARD / "database.db")
    assert "0008.jpg" in facts.verdict.cameras
    assert "its reprojection error is" in drawing.cameras.reasons[drawing.cameras.names.index("0008.jpg")]
