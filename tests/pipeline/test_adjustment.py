"""Placed cameras adjusted to the pixels, with the given rotations held, weighted or free."""

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

import sfm_shapefit
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.files.colmap.images import images_of
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.judgement.reasons import Grade
from tests.models import arrays, posed
from tests.scenes import COURTYARD, RING, copied, edit_database

DATABASE, TRUTH = COURTYARD / "database.db", COURTYARD / "truth"


def turned(model, sigma_deg, seed=4):
    """The posed model with rotations that are off by sigma per axis, but for the first camera's."""
    rng = np.random.default_rng(seed)

    def turn(name, rotation, center):
        error = Rotation.from_rotvec(np.radians(sigma_deg) * rng.standard_normal(3))
        return (rotation if name == "0001.jpg" else error.as_matrix() @ rotation), center

    return posed(model, turn)


def rotations_of(found):
    model = found.reconstruction
    return {i: model.image(i).cam_from_world().rotation.quat for i in model.reg_image_ids()}


@pytest.fixture(scope="module")
def placed():
    return sfm_shapefit.locate(COURTYARD / "sparse" / "0", adjust="none")


@pytest.fixture(scope="module")
def off():
    """The courtyard with rotations off by 0.2 degrees."""
    return turned(COURTYARD / "sparse" / "0", 0.2)


@pytest.fixture(scope="module")
def adjusted(off):
    return sfm_shapefit.locate(off, DATABASE)


def error(found):
    return sfm_shapefit.evaluate(found.reconstruction, TRUTH)


def test_exact_rotations_are_held_to_the_bit_and_centers_gain(placed, courtyard_located):
    found = courtyard_located
    assert found.adjustment.freedom.holds_rotations
    assert "held" in found.adjustment.statement
    assert error(found).position.mean < 0.8 * error(placed).position.mean
    given = pycolmap.Reconstruction(COURTYARD / "sparse" / "0")
    for image_id, quat in rotations_of(found).items():
        np.testing.assert_array_equal(quat, given.image(image_id).cam_from_world().rotation.quat)
    told = found.summary()["adjustment"]
    assert (told["rotations"], told["rotation_sigma_deg"]) == ("held", None)
    assert found.summary()["rotation_refinement"]["num_updated"] == 0
    assert placed.adjustment is None
    assert placed.summary()["adjustment"] is placed.summary()["lens_errors"] is None


def test_rotations_that_are_off_are_weighted_by_about_how_much_and_end_nearer_to_the_truth(off, adjusted):
    plain = sfm_shapefit.locate(off, DATABASE, adjust="none")
    told = adjusted.summary()["adjustment"]
    assert told["rotations"] == "weighted"
    # The root mean square of 24 x 3 normal numbers is within 4 / sqrt(144) = 33 % of sigma.
    assert told["rotation_sigma_deg"] == pytest.approx(0.2, rel=0.33)
    assert error(adjusted).position.median < 0.3 * error(plain).position.median
    assert error(adjusted).rotation_deg.median < 0.3 * error(plain).rotation_deg.median
    assert adjusted.kept.sum() >= plain.kept.sum()
    assert adjusted.summary()["rotation_refinement"]["num_updated"] > 20


def test_bundle_adjustment_obeys_the_same_choice(placed):
    found = sfm_shapefit.locate(COURTYARD / "sparse" / "0", adjust="full")
    assert found.adjusted.solves.converged
    assert found.adjusted.solves.final_error_px < found.adjusted.solves.initial_error_px
    assert error(found).position.mean < error(placed).position.mean
    assert error(found).rotation_deg.max < 1e-5  # exact ones, which free ones leave


def test_an_optimum_that_was_asked_for_is_delivered_as_it_is():
    for option in ({"objective": "shapefit"}, {"refine": False}):
        assert sfm_shapefit.locate(RING / "sparse" / "0", **option).adjustment is None


def test_frames_turn_about_their_centers_and_the_input_stays_as_it_is():
    model = read_model(RING / "sparse" / "0")
    other = turned(model.reconstruction, 1.0)
    found = model.images.turned(images_of(arrays(other)))
    theirs = [other.image(i).cam_from_world().rotation.matrix() for i in model.images.ids.tolist()]
    np.testing.assert_allclose(found.rotations, theirs, atol=1e-14)
    np.testing.assert_allclose(found.centers, model.images.centers, atol=1e-13)
    again = read_model(RING / "sparse" / "0")
    np.testing.assert_array_equal(model.images.rotations, again.images.rotations)


def test_a_focal_length_that_is_the_databases_guess_is_found(tmp_path):
    guess = np.array([1150.0, 1150.0, 600.0, 450.0])
    change = f"UPDATE cameras SET params = x'{guess.astype('<f8').tobytes().hex()}', prior_focal_length = 0"
    path = edit_database(copied(RING, tmp_path) / "database.db", change)
    model = pycolmap.Reconstruction(RING / "sparse" / "0")
    model.camera(1).params = guess
    found = sfm_shapefit.locate(model, path)
    (row,) = found.summary()["intrinsics"]
    assert row["decided_by"] == "adjusted"
    assert row["focal_px"] == pytest.approx(1000.0, rel=1e-3)
    errors = sfm_shapefit.evaluate(found.reconstruction, RING / "sparse" / "0")
    assert errors.position.max < 1e-3 * errors.extent
    assert not any("focal" in warning for warning in found.warnings)


def test_an_adjustment_that_fails_is_a_warning_and_no_model_without_it_is_good(monkeypatch, ring_located):
    def fail(*_):
        raise UnsolvableError("no 3D point can be triangulated")

    assert ring_located.verdict.grade is Grade.GOOD
    monkeypatch.setattr("sfm_shapefit.pipeline.stages.adjust_placed", fail)
    found = sfm_shapefit.locate(RING / "sparse" / "0")
    said = "its cameras are not adjusted to the pixels: no 3D point can be triangulated"
    assert said in found.warnings
    assert found.verdict.grade is Grade.LOOK
    assert said in found.verdict.reasons
