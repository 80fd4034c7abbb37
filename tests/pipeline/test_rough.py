"""Rough rotations: corrected by the matches, wrong ones named, and as little tried as they allow."""

import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sfm_shapefit
from sfm_shapefit.base.paths import from_here
from sfm_shapefit.commands.convert import convert
from sfm_shapefit.facts.warnings import rotation_warnings, wrong_rotations
from tests.models import posed
from tests.scenes import BUNDLED, COURTYARD, PHOTOGRAPHED, RING, edit_database

DATABASE, TRUTH = COURTYARD / "database.db", COURTYARD / "truth"
WRONG = ("0003.jpg", "0011.jpg")


@pytest.fixture(scope="module")
def spoiled():
    """The truth, rotations 2 degrees off about each axis, two by anything, centers anywhere."""
    rng = np.random.default_rng(2)

    def change(name, rotation, center):
        turn = Rotation.from_rotvec(np.radians(2.0) * rng.standard_normal(3))
        turn = Rotation.from_euler("x", 120, degrees=True) if name in WRONG else turn
        return turn.as_matrix() @ rotation, rng.standard_normal(3)

    return posed(TRUTH, change)


@pytest.fixture(scope="module")
def found(spoiled):
    return sfm_shapefit.locate(spoiled, DATABASE, rotations=2.0)


def test_rough_rotations_lead_to_the_model_of_map(found, courtyard_mapped):
    mapped = courtyard_mapped.models[0]
    errors = [sfm_shapefit.evaluate(one, TRUTH).position.mean for one in (found, mapped)]
    assert found.reconstruction.num_reg_images() == mapped.reconstruction.num_reg_images()
    assert errors[0] <= 1.05 * errors[1]


def test_what_was_wrong_is_told_per_camera(found):
    names = [found.images.names[k] for k in wrong_rotations(found.turned_deg, 2.0).tolist()]
    assert set(names) == set(WRONG)
    assert found.warnings[0].startswith("2 given rotations are wrong and corrected: ")
    table = found.table("cameras")
    turned = dict(zip(table["name"], table["turned_deg"], strict=True))
    assert all(turned[name] == pytest.approx(120.0, abs=6.0) for name in WRONG)
    assert 1.0 < np.median(list(turned.values())) < 5.0
    assert np.isfinite(table["moved"]).all()


@pytest.mark.parametrize("sigma_deg", [0.1, 1.0])
def test_known_rotations_decide_where_houses_look_the_same(sigma_deg):
    """By the matches alone, two cameras may as well be turned by 90 degrees."""
    found = sfm_shapefit.locate(PHOTOGRAPHED / "truth", rotations=sigma_deg)
    assert found.verdict.statement == "good"
    assert found.warnings == ()


@pytest.fixture(scope="module")
def guessed(tmp_path_factory):
    """The photographs' database with a guessed focal length and no distortion, and what `map` makes of it."""
    database = tmp_path_factory.mktemp("guessed") / "database.db"
    shutil.copyfile(PHOTOGRAPHED / "database.db", database)
    guess = np.array([1.05 * 480.0, 320.0, 240.0, 0.0, 0.0], dtype="<f8").tobytes().hex()
    edit_database(database, f"UPDATE cameras SET params = x'{guess}', prior_focal_length = 0")
    return database, sfm_shapefit.map_database(database).models[0]


def test_lists_with_focal_lengths_off_and_no_distortion_lead_to_the_model_of_map(guessed, tmp_path):
    (database, mapped), poses = guessed, tmp_path / "transforms.json"
    rng = np.random.default_rng(1)

    def change(_name, rotation, _center):
        turn = Rotation.from_rotvec(np.radians(2.0) * rng.standard_normal(3))
        return turn.as_matrix() @ rotation, rng.standard_normal(3)

    spoilt = posed(PHOTOGRAPHED / "truth", change)
    for camera in spoilt.cameras.values():
        camera.params = [0.95 * 480.0, 320.0, 240.0, 0.0, 0.0]
    convert(spoilt, poses)
    found = sfm_shapefit.locate(poses, database, rotations=2.0)
    errors = [sfm_shapefit.evaluate(one, PHOTOGRAPHED / "truth").position.mean for one in (found, mapped)]
    assert found.reconstruction.num_reg_images() == 16
    assert errors[0] <= 1.01 * errors[1]


def test_poses_of_another_scene_are_doubted(tmp_path):
    """Those of the ring beside the matches of the courtyard: names are common, nothing else."""
    found = sfm_shapefit.locate(BUNDLED / "ring8/sparse/0", DATABASE, rotations=2.0, min_trust=0.0)
    assert found.verdict.grade != "good"
    assert "is this the model's database?" in found.verdict.statement
    command = f"sfm-shapefit locate {from_here(str(BUNDLED))}/ring8/sparse/0 {{out}} --overwrite"
    assert found.facts.next_step.command == f"{command} --database ITS_DATABASE --rotations 2"


def test_moved_is_not_told_where_the_given_centers_are_no_places(spoiled):
    flat = posed(spoiled, lambda _, rotation, center: (rotation, 0.0 * center))
    found = sfm_shapefit.locate(flat, DATABASE, rotations=2.0)
    assert found.moved is None
    assert np.isnan(found.table("cameras")["moved"]).all()


def test_fixed_images_go_the_usual_way(tmp_path):
    (tmp_path / "names.txt").write_text("0001.jpg\n0002.jpg\n")
    found = sfm_shapefit.locate(RING / "sparse/0", rotations=2.0, fix=str(tmp_path / "names.txt"))
    assert found.warnings[0].startswith("rough rotations beside fixed images are not corrected")


def test_rotations_without_outliers_are_not_called_wrong():
    turned = np.linalg.norm(np.random.default_rng(0).standard_normal((1000, 100, 3)), axis=2)
    names = [str(k) for k in range(100)]
    # Of 1,000 rotations that are normal about each axis one is off by more than four deviations by chance.
    assert sum(len(wrong_rotations(row, 1.0)) for row in turned) < 2.0 * 1e-3 * turned.size
    assert list(rotation_warnings(1e-9 * turned[0], names, 1.0)) == []  # less than was said is no error
    gross = np.append(turned[0, :98], [40.0, np.nan])
    assert wrong_rotations(gross, 1.0)[0] == 98
