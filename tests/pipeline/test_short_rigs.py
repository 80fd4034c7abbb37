"""Rigs that are tiny beside their scene, seen through lenses that are guessed."""

import numpy as np

from sfm_shapefit.pipeline.map import map_database
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
    assert any("taken to share one center" in warning for warning in found.models[0].located.warnings)
