"""Rigs that are tiny beside their scene, seen through lenses that are guessed."""

import numpy as np
import pycolmap

import sfm_shapefit
from sfm_shapefit.commands.map import map_database
from sfm_shapefit.judgement.reasons import Grade
from tests.scenes import edit_database, real_scene


def test_a_lens_without_distortion_that_is_guessed_is_found_before_the_rig_is_asked_for_a_scale(tmp_path):
    path = tmp_path / "database.db"
    path.write_bytes((real_scene("kerry-park") / "database.db").read_bytes())
    guess = np.array([576.0, 576.0, 240.0, 240.0, 0.0, 0.0, 0.0, 0.0], dtype="<f8").tobytes().hex()
    edit_database(path, f"UPDATE cameras SET params = x'{guess}', prior_focal_length = 0")
    found = map_database(path)
    assert found.reconstruction.num_reg_images() == 48
    focal_px = [camera.mean_focal_length() for camera in found.reconstruction.cameras.values()]
    np.testing.assert_allclose(focal_px, 129.2, rtol=0.02)  # as the maker of the rig has it
    assert any("taken to share one center" in warning for warning in found.models[0].warnings)


def test_without_a_database_check_and_locate_call_a_tiny_rig_good_and_pixels_that_fit_hold_no_second_place():
    model = pycolmap.Reconstruction(real_scene("kerry-park") / "sparse" / "0")
    located = sfm_shapefit.locate(model)
    verdicts = [
        found.verdict for found in (located, *map(sfm_shapefit.check, (model, located.reconstruction)))
    ]
    assert [verdict.grade for verdict in verdicts] == 3 * [Grade.GOOD]
    # The better model of the same matches; `sparse/0` is .17 units, and .36 degrees, from it.
    better = sfm_shapefit.evaluate(located.reconstruction, real_scene("kerry-park") / "global")
    assert better.position.median < 0.1
