"""Evidence that can be acted on: a lens is freed, a camera goes where most pairs put it."""

import sqlite3
from contextlib import closing
from dataclasses import replace

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.judgement.evidence import ModelEvidence
from sfm_shapefit.judgement.reasons import Grade
from sfm_shapefit.pipeline.inputs import RunInputs, choose_inputs, open_matches, see_matches
from sfm_shapefit.pipeline.remedies import Remedy, find_remedies
from tests.judgement.made import place_of
from tests.pipeline.test_evidence import with_own_lenses
from tests.scenes import COURTYARD, RING

DATABASE = RING / "database.db"


@pytest.fixture(scope="module")
def truth():
    return pycolmap.Reconstruction(RING / "sparse" / "0")


def test_a_lens_that_is_wrong_is_freed_and_the_cameras_stand_right(truth):
    name = truth.image(5).name
    found = sfm_shapefit.locate(with_own_lenses(truth, {name: 1.1}), DATABASE)
    assert found.verdict.grade is Grade.GOOD
    assert any(
        f"camera {truth.image(5).image_id} ({name}): focal length" in warning for warning in found.warnings
    )
    lens = found.reconstruction.find_image_with_name(name).camera
    assert lens.mean_focal_length() == pytest.approx(truth.image(5).camera.mean_focal_length(), rel=1e-3)
    assert sfm_shapefit.evaluate(found.reconstruction, truth).position.max < 1e-3


def test_map_frees_a_lens_too(truth, tmp_path):
    """The database says that the lens of one image was calibrated, and it is wrong."""
    path = tmp_path / "database.db"
    path.write_bytes(DATABASE.read_bytes())
    with closing(sqlite3.connect(path)) as database, database:
        lens = np.array([1100.0, 1100.0, 600.0, 450.0]).tobytes()
        database.execute("INSERT INTO cameras VALUES (2, 1, 1200, 900, ?, 1)", (lens,))
        database.execute("INSERT INTO rigs VALUES (2, 2, 0)")
        database.execute("UPDATE frames SET rig_id = 2 WHERE frame_id = 5")
        database.execute("UPDATE frame_data SET sensor_id = 2 WHERE frame_id = 5")
        database.execute("UPDATE images SET camera_id = 2 WHERE image_id = 5")
    found = sfm_shapefit.map_database(path)
    (model,) = found.models
    assert found.timings_s["locate"] > 0.9 * sum(model.timings_s.values())  # which are those of its stages
    assert model.reconstruction.camera(2).mean_focal_length() == pytest.approx(1000.0, rel=0.001)
    assert model.verdict.grade is Grade.GOOD


def test_map_starts_again_from_the_guess_where_the_view_graph_is_wrong(tmp_path):
    """Its fundamental matrices are those of a lens twice as long, which nothing else agrees with."""
    path = tmp_path / "database.db"
    path.write_bytes(DATABASE.read_bytes())
    to_true = np.array([[0.5, 0.0, 300.0], [0.0, 0.5, 225.0], [0.0, 0.0, 1.0]])
    with closing(sqlite3.connect(path)) as database, database:
        guess = np.array([850.0, 850.0, 600.0, 450.0]).tobytes()
        database.execute("UPDATE cameras SET params = ?, prior_focal_length = 0", (guess,))
        for pair, matrix in database.execute("SELECT pair_id, F FROM two_view_geometries").fetchall():
            longer = to_true.T @ np.frombuffer(matrix).reshape(3, 3) @ to_true
            row = longer.tobytes(), pair
            database.execute("UPDATE two_view_geometries SET F = ? WHERE pair_id = ?", row)
    found = sfm_shapefit.map_database(path, points="never")
    (model,) = found.models
    assert [warning.split("database's: ")[-1] for warning in found.warnings] == [
        "camera 1 with 850 px, not 2,000"
    ]
    assert model.reconstruction.camera(1).mean_focal_length() == pytest.approx(1000.0, rel=1e-3)
    assert (model.verdict.grade, found.num_placed) == (Grade.GOOD, 8)


def test_a_lens_whose_image_is_left_out_is_found_too():
    """Its rotation is not believed, so that it makes no points."""
    truth = pycolmap.Reconstruction(COURTYARD / "truth")
    name = truth.image(sorted(truth.reg_image_ids())[7]).name
    given = with_own_lenses(truth, {name: 0.6})
    held = sfm_shapefit.locate(given, COURTYARD / "database.db", intrinsics="held")
    assert name in {camera.name for camera in held.cameras if not camera.placed}
    wrong = given.find_image_with_name(name).camera_id
    assert [told.camera for told in held.evidence.lenses] == [wrong]
    assert held.evidence.lenses[0].asked_focal_px == pytest.approx(720.0, rel=0.002)


@pytest.mark.parametrize(("here", "moves"), [(3, True), (4, False)])
def test_a_camera_goes_where_twice_as_many_pairs_put_it(ring_located, here, moves):
    names = ring_located.images.names
    pairs = tuple((names[i], names[j]) for i, j in ((0, 2), (1, 2), (2, 3), (2, 4))[:here])
    place = place_of(names[2], here, pairs_here=pairs)
    found = replace(ring_located, evidence=ModelEvidence(places=(place,)))
    model = read_model(RING / "sparse" / "0")
    inputs = choose_inputs(RING / "sparse" / "0", DATABASE)
    opened, inputs = open_matches(model, inputs)
    with closing(opened) as matches:
        source = see_matches(matches, model.images, inputs)
        remedies = list(find_remedies(found, inputs_of(found), source))
        assert len(remedies) == moves
        for remedy in remedies:
            assert not list(find_remedies(found, replace(remedy.inputs, fixed=np.arange(8) == 6), source))
            assert remedy.source.inputs.left_out == {*pairs}
            assert remedy.source.view.num_pairs == source.view.num_pairs - here
            assert remedy.applied(found).warnings[0].startswith(names[2])


def test_a_remedy_is_better_if_less_speaks_against_it_no_camera_is_lost_and_lenses_are_known(ring_located):
    names = ring_located.images.names
    evidence = ModelEvidence(places=(place_of(names[2], 3),))
    before, after = replace(ring_located, evidence=evidence), ring_located
    moved, freed = (Remedy(None, None, rows, ()) for rows in ({}, {0: 0.1}))
    assert moved.is_better(after, before)
    assert freed.is_better(after, before)
    assert not moved.is_better(after, after)
    assert not moved.is_better(before, after)
    lost = after.kept.copy()
    lost[5] = False  # which counts as much as the place that is gone, ...
    two = replace(before, evidence=ModelEvidence(places=(*evidence.places, *evidence.places)))
    assert not moved.is_better(replace(after, kept=lost), before)
    assert not moved.is_better(replace(after, kept=lost), two)  # ... or less than two
    open_ = replace(after.intrinsics, undetermined=np.ones_like(after.intrinsics.undetermined))
    assert not freed.is_better(replace(after, intrinsics=open_), before)
    assert moved.is_better(replace(after, intrinsics=open_), before)


def inputs_of(found):
    fixed = np.zeros(found.images.num_images, dtype=bool)
    known = {"images": found.images, "intrinsics": found.intrinsics, "fixed": fixed}
    return RunInputs(options=found.options, template=None, pull_rad=None, **known)
