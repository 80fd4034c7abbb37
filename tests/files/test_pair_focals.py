"""Focal lengths that COLMAP keeps with the pairs it verified: what agrees starts guessed lenses."""

from contextlib import closing

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit.files.colmap.database import open_database
from sfm_shapefit.files.colmap.database_images import read_images
from sfm_shapefit.files.colmap.pair_focals import read_pair_focals
from sfm_shapefit.pipeline import intrinsics
from tests.lens_scene import camera_of_model, write_scene
from tests.scenes import edit_database, read_from

GUESSED, GUESS_PX = (2, 4, 6), 768.0


def with_lenses_of_pairs(path, focal_of):
    """Let pycolmap keep a lens for each pair of a guessed camera and a calibrated one.

    `focal_of` has its focal length, by the number of the pair.
    """
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for camera_id in GUESSED:
            camera = database.read_camera(camera_id)
            camera.params = [GUESS_PX, *camera.params[1:]]
            camera.has_prior_focal_length = False
            database.update_camera(camera)
        pairs = database.read_two_view_geometries()
        database.clear_two_view_geometries()
        for number, (pair_id, found) in enumerate(zip(*pairs, strict=True)):
            ends = pycolmap.pair_id_to_image_pair(pair_id)
            guessed = [end in GUESSED for end in ends]
            if sum(guessed) == 1:
                camera = database.read_camera(ends[guessed.index(True)])
                camera.params = [focal_of(number), *camera.params[1:]]
                setattr(found, f"camera{1 + guessed.index(True)}", camera)
            database.write_two_view_geometry(*ends, found)


@pytest.fixture
def scene(tmp_path):
    """A scene of eight cameras, three of which are to be guesses."""
    truth = write_scene(tmp_path, [camera_of_model("SIMPLE_RADIAL", k) for k in range(1, 9)], 8)
    return tmp_path / "database.db", truth


def test_pairs_that_agree_tell_the_focal_length_whatever_others_say(scene):
    with_lenses_of_pairs(scene[0], lambda number: 60_000.0 if number % 5 == 0 else 500.0 + number % 3)
    found = read_from(scene[0], read_pair_focals, GUESSED)
    assert set(found) == {*GUESSED}
    for one in found.values():
        assert one.factor * GUESS_PX == pytest.approx(501.0, abs=1.0)
        assert one.is_one_sided
    assert not read_from(scene[0], read_pair_focals, (1, 3, 5))


def test_pairs_that_do_not_agree_or_are_few_or_damaged_tell_nothing(scene):
    with_lenses_of_pairs(scene[0], lambda number: 300.0 * 1.2**number)
    assert not read_from(scene[0], read_pair_focals, GUESSED)
    edit_database(scene[0], "UPDATE two_view_geometries SET camera1 = x'00', camera2 = 'text'")
    assert not read_from(scene[0], read_pair_focals, GUESSED)


def test_map_starts_from_them_and_tells_where_a_guess_that_is_held_contradicts_them(scene):
    with_lenses_of_pairs(scene[0], lambda number: 500.0 + np.sin(number))
    found = sfm_shapefit.map_database(scene[0])
    assert sfm_shapefit.evaluate(found.reconstruction, scene[1]).position.max < 0.04
    assert not found.warnings
    held = sfm_shapefit.map_database(scene[0], intrinsics="held", min_trust=0.0)
    assert any("of camera 2 with 50" in w and "not 768" in w for w in held.warnings)
    assert any(w.endswith("; intrinsics=auto lets these change") for w in held.warnings)


def test_they_outweigh_the_view_graph_where_they_differ_from_it_by_more_than_their_scatter(
    scene, monkeypatch
):
    with_lenses_of_pairs(scene[0], lambda _: 500.0)
    asked = {2: 600.0, 4: 510.0}  # of camera 6 the view graph says nothing
    monkeypatch.setattr(
        intrinsics, "calibrate_view_graph", lambda *_: {i: px / GUESS_PX for i, px in asked.items()}
    )
    given = read_from(scene[0], read_images).images
    with closing(open_database(scene[0], given.names)) as matches:
        images, _ = intrinsics.choose_intrinsics(given, matches, "auto")
    found = [lens.focal_px for lens in images.lenses if lens.id in GUESSED]
    assert found == pytest.approx([500.0, 510.0, 500.0])
