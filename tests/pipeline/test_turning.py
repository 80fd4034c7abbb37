"""Cameras that only turn, and objects that turn before a background that stands still."""

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

import sfm_shapefit
from tests.lens_scene import camera_of_model, write_scene
from tests.program import run, run_refused
from tests.scenes import edit_database

CAMERAS, BACKGROUND = 8, 60
TURNS_ONLY = "cameras that only turn cannot be placed; use images from different places"


def test_a_tripod_is_refused_as_one(tmp_path):
    turns = Rotation.from_euler("yx", [(5.0 * k - 15.0, 3.0 * (k % 2)) for k in range(7)], degrees=True)
    ahead = np.array([0.0, 0.0, 6.0])
    poses = [pycolmap.Rigid3d(pycolmap.Rotation3d(turn), turn @ ahead) for turn in turns.as_matrix()]
    write_scene(tmp_path, [camera_of_model("PINHOLE")], poses=poses)
    assert TURNS_ONLY in run_refused("map", tmp_path / "database.db", tmp_path / "out", code=4)
    assert not (tmp_path / "out").exists()


def background_wins(share):
    """Return an edit that gives a share of the pairs matches of a background that is everywhere the same."""
    pixels = np.random.default_rng(3).uniform(0.0, 480.0, (BACKGROUND, 2)).astype("<f4")

    def edit(connection):
        rows = connection.execute("SELECT image_id, rows, cols, data FROM keypoints").fetchall()
        first = {}
        for image_id, count, columns, data in rows:
            own = np.frombuffer(data, "<f4").reshape(count, columns)
            more = np.zeros((BACKGROUND, columns), "<f4")
            more[:, :2] = pixels + np.random.default_rng(image_id).normal(0.0, 0.3, pixels.shape)
            connection.execute(
                "UPDATE keypoints SET rows = ?, data = ? WHERE image_id = ?",
                (count + BACKGROUND, np.concatenate([own, more]).tobytes(), image_id),
            )
            first[image_id] = count
        pairs = [pair_id for (pair_id,) in connection.execute("SELECT pair_id FROM two_view_geometries")]
        for pair_id in pairs[:: round(1.0 / share)]:
            matches = np.arange(BACKGROUND)[:, None] + [first[i] for i in divmod(pair_id, 2147483647)]
            connection.execute(
                "UPDATE two_view_geometries SET rows = ?, data = ? WHERE pair_id = ?",
                (BACKGROUND, matches.astype("<u4").tobytes(), pair_id),
            )

    return edit


def test_a_turntable_is_placed_where_the_background_wins_some_pairs(tmp_path):
    write_scene(tmp_path, [camera_of_model("PINHOLE")], CAMERAS)
    edit_database(tmp_path / "database.db", background_wins(0.2))
    run("map", tmp_path / "database.db", tmp_path / "out", "-q", code=0)
    found = sfm_shapefit.evaluate(tmp_path / "out/0", tmp_path / "sparse/0")
    assert len(found.missing) <= 2
    assert found.position.max < 0.03


def test_a_turntable_whose_background_wins_all_pairs_is_refused(tmp_path):
    write_scene(tmp_path, [camera_of_model("PINHOLE")], CAMERAS)
    edit_database(tmp_path / "database.db", background_wins(1.0))
    assert TURNS_ONLY in run_refused("map", tmp_path / "database.db", tmp_path / "out", code=4)
