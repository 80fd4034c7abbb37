"""A database beside a model: used where it can be, and left aside with a sentence where it cannot."""

import sqlite3

import pytest

from sfm_shapefit.commands.locate import locate
from sfm_shapefit.commands.map import map_database
from sfm_shapefit.files.colmap.database_pairs import MAX_NUM_IMAGES
from tests.program import run, run_refused
from tests.scenes import RING, copied, edit_database

UNTYPED = ("CREATE TABLE u AS SELECT * FROM cameras", "DROP TABLE cameras", "ALTER TABLE u RENAME TO cameras")
UNUSABLE = {
    "text": (None, "is not a COLMAP database"),
    "no table": (("DROP TABLE images",), "has no table images"),
    "no image": (("DELETE FROM images",), "has no images"),
    "no features": (
        ("DELETE FROM keypoints", "DELETE FROM two_view_geometries"),
        "no features were extracted of its 8 images; run colmap feature_extractor",
    ),
    "no matches": (
        ("DELETE FROM matches", "DELETE FROM two_view_geometries"),
        "has features but no matches; match the images and verify them",
    ),
    "no geometries": (
        ("DELETE FROM two_view_geometries",),
        "has matches but no two-view geometries; match the images and verify them",
    ),
    "watermarks": (
        ("UPDATE two_view_geometries SET config = 7",),
        "has no verified matches, but 16 pairs WATERMARK; match the images and verify them geometrically",
    ),
    "another scene": (("UPDATE images SET name = 'other_' || name",), "has 0 of the model's 8 images"),
    "text as width": ((*UNTYPED, "UPDATE cameras SET width = 'x'"), "has 'x' for the number width"),
    "a camera twice": ((*UNTYPED, "INSERT INTO cameras SELECT * FROM cameras"), "camera 1 appears twice"),
    "no such keypoints": (
        ("UPDATE keypoints SET rows = 3, data = substr(data, 1, 12 * cols)",),
        "has matches of keypoints that do not exist",
    ),
    "cut blobs": (("UPDATE two_view_geometries SET data = substr(data, 2)",), "has matches of wrong length"),
}


@pytest.fixture
def scene(tmp_path):
    return copied(RING, tmp_path)


def spoil(scene, how):
    """Make the database of a scene unusable, and return it and what is said of it."""
    statements, told = UNUSABLE[how]
    path = scene / "database.db"
    if statements is None:
        path.write_bytes(b"no database at all" * 100)
    else:
        edit_database(path, "PRAGMA foreign_keys = OFF", *statements)
    return path, told


@pytest.mark.parametrize("how", UNUSABLE)
def test_a_database_that_cannot_be_used_stops_no_command_that_found_it(scene, tmp_path, how):
    path, told = spoil(scene, how)
    alone = locate(RING / "sparse/0", directions="tracks")
    found = locate(scene / "sparse/0")
    assert told in found.inputs.statement
    assert found.inputs.database is None
    assert [row.center for row in found.cameras] == [row.center for row in alone.cameras]
    said = run("check", scene / "sparse/0", code=0).stdout
    assert f"the model's own tracks; the database that was found cannot be used: {path}" in said
    assert "verdict: good" in said
    assert told[:20] in " ".join(run("inspect", scene / "sparse/0", code=0).stdout.replace("│", "").split())


@pytest.mark.parametrize("how", UNUSABLE)
def test_a_database_that_is_named_and_cannot_be_used_is_refused(scene, tmp_path, how):
    path, told = spoil(scene, how)
    code = 4 if how in ("no matches", "no geometries", "watermarks") else 3
    for command in (("locate", scene / "sparse/0", tmp_path / "out"), ("check", scene / "sparse/0")):
        assert told in run_refused(*command, "--database", path, code=code)


@pytest.mark.parametrize("how", sorted(UNUSABLE.keys() - {"another scene", "text", "no image"}))
def test_map_says_what_a_database_lacks(scene, tmp_path, how):
    path, told = spoil(scene, how)
    code = 4 if how in ("no matches", "no geometries", "watermarks") else 3
    assert told in run_refused("map", path, tmp_path / "out", code=code)


def test_a_database_of_images_without_cameras_has_no_features(scene, tmp_path):
    tables = ("cameras", "keypoints", "matches", "two_view_geometries", "rigs", "frames", "frame_data")
    path = scene / "database.db"
    edit_database(path, "PRAGMA foreign_keys = OFF", *(f"DELETE FROM {table}" for table in tables))
    assert "no features were extracted of its 8 images" in run_refused("map", path, tmp_path / "out")
    edit_database(path, "DELETE FROM images")
    assert "no features were extracted of its 0 images" in run_refused("map", path, tmp_path / "out")


def test_a_second_opinion_that_the_database_cannot_give_is_left_out_and_told(scene):
    edit_database(
        scene / "database.db",
        "PRAGMA foreign_keys = OFF",
        "UPDATE images SET camera_id = 99 WHERE image_id = 1",
    )
    said = run("check", scene / "sparse/0", code=0).stdout
    assert "warning: there is no second opinion: " in said
    assert "id 1 has no valid name and camera" in said
    assert "verdict: good" in said
    named = run_refused("check", scene / "sparse/0", "--database", scene / "database.db")
    assert "id 1 has no valid name and camera" in named


def one_bad_index(path):
    """Let the first match of one pair be of a keypoint that is not there."""

    def change(connection):
        query = "SELECT pair_id, data FROM two_view_geometries WHERE rows > 0 ORDER BY pair_id LIMIT 1"
        (pair_id, data), *_ = connection.execute(query)
        wrong = (10**6).to_bytes(4, "little") + data[4:]
        connection.execute("UPDATE two_view_geometries SET data = ? WHERE pair_id = ?", (wrong, pair_id))

    return edit_database(path, change)


def one_bad_keypoint(path):
    data = "CAST(x'0000c07f' || substr(data, 5) AS BLOB)"
    return edit_database(path, f"UPDATE keypoints SET data = {data} WHERE image_id = 2")


@pytest.mark.parametrize("damage", [one_bad_index, one_bad_keypoint])
def test_one_bad_row_costs_no_image_and_every_command_tells_it(scene, tmp_path, damage):
    path, model = damage(scene / "database.db"), scene / "sparse/0"
    mapped = map_database(path)
    assert mapped.num_placed == 8
    (note,) = mapped.warnings
    assert note.startswith(f"{path} is damaged; left aside: 1 of ")
    assert ("0001.jpg and 0002.jpg has" in note) or ("image 0002.jpg has a keypoint" in note)
    found = locate(model, path)
    assert found.placed.num_images == 8
    assert list(found.warnings).count(note) == 1
    assert run("check", model, "--database", path, code=0).stdout.count(f"warning: {note}") == 1
    assert "is damaged; left aside:" in run("inspect", model, "--database", path, "--json", code=0).stdout
    found.write(tmp_path / "out")
    assert "verdict: good" in run("check", tmp_path / "out", code=0).stdout


def test_ids_that_no_image_has_and_a_newer_schema_beside_an_older_are_no_obstacle(scene):
    """COLMAP 3.8 and before: priors in the table of images, no rigs, no poses of pairs; ids with gaps."""
    far = MAX_NUM_IMAGES - 2

    def change(connection):
        connection.execute("PRAGMA foreign_keys = OFF")
        for name in ("rigs", "rig_sensors", "frames", "frame_data", "pose_priors"):
            connection.execute(f"DROP TABLE IF EXISTS {name}")
        connection.execute("ALTER TABLE images ADD COLUMN prior_qw REAL")
        rows = connection.execute(
            "SELECT pair_id, rows, cols, data, config FROM two_view_geometries"
        ).fetchall()
        connection.execute("DROP TABLE two_view_geometries")
        connection.execute(
            "CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, "
            "cols INTEGER NOT NULL, data BLOB, config INTEGER NOT NULL)"
        )
        moved = {8: far}
        for pair_id, *rest in rows:
            a, b = (moved.get(i, i) for i in divmod(pair_id, MAX_NUM_IMAGES))
            connection.execute(
                "INSERT INTO two_view_geometries VALUES (?, ?, ?, ?, ?)", (MAX_NUM_IMAGES * a + b, *rest)
            )
        for table in ("images", "keypoints"):
            connection.execute(f"UPDATE {table} SET image_id = {far} WHERE image_id = 8")

    path = edit_database(scene / "database.db", change)
    assert sqlite3.connect(path).execute("SELECT max(image_id) FROM images").fetchone() == (far,)
    assert map_database(path).num_placed == 8
