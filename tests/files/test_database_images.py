"""Cameras, images and rigs of a database alone: what is damaged is named, what is incomplete left aside."""

import pytest

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.database_images import read_images
from tests.scenes import RING, copied, edit_database, read_from

UNTYPED = "CREATE TABLE u AS SELECT * FROM {0}; DROP TABLE {0}; ALTER TABLE u RENAME TO {0};"
ENDLESS = (
    "ALTER TABLE cameras RENAME TO c; CREATE VIEW cameras AS WITH RECURSIVE n(x) AS "
    "(VALUES (1) UNION ALL SELECT x + 1 FROM n) SELECT x AS camera_id, 1 AS model, 1 AS width, "
    "1 AS height, x'' AS params, 1 AS prior_focal_length FROM n"
)
DAMAGED = [
    ("UPDATE cameras SET params = x'00'", "camera 1 of the database has 0 parameters, where PINHOLE has 4"),
    ("UPDATE cameras SET model = 99", "has the model 99, which pycolmap does not know"),
    ("UPDATE cameras SET camera_id = 4294967295", "camera with id 4294967295 is damaged"),
    (UNTYPED.format("cameras") + "INSERT INTO cameras SELECT * FROM cameras", "camera 1 appears twice"),
    (UNTYPED.format("images") + "INSERT INTO images SELECT * FROM images", "id 1 appears twice"),
    (UNTYPED.format("images") + "UPDATE images SET camera_id = 'x'", "has 'x' for the number camera_id"),
    (UNTYPED.format("cameras") + "UPDATE cameras SET width = 'x'", "has 'x' for the number width"),
    (
        UNTYPED.format("cameras") + "UPDATE cameras SET prior_focal_length = x'00'",
        r"has b'\\x00' for the number prior_focal_length",
    ),
    (ENDLESS, "its cameras is a view"),
    ("UPDATE images SET camera_id = 7 WHERE image_id = 2", "id 2 has no valid name and camera"),
    ("DELETE FROM images", "has 0 images, but two or more"),
]
DAMAGED_RIGS = [
    (UNTYPED.format("rigs") + "UPDATE rigs SET rig_id = 'x'", "has 'x' for the number rig_id"),
    (UNTYPED.format("frame_data") + "UPDATE frame_data SET data_id = 'x'", "has 'x' for the number data_id"),
    ("UPDATE rig_sensors SET sensor_from_rig = x'00'", "the pose of a sensor in rig 1 is damaged"),
    ("UPDATE rig_sensors SET sensor_id = 99 WHERE sensor_id = 3", "rig 1 refers to camera 99"),
    ("UPDATE rigs SET ref_sensor_id = 77 WHERE rig_id = 1", "rig 1 refers to camera 77"),
    ("UPDATE rigs SET ref_sensor_id = 2 WHERE rig_id = 1", "camera 2 appears twice in rig 1"),
    ("UPDATE frame_data SET sensor_id = 3 WHERE data_id = 2", "frame 1 has image 2 at another camera"),
    ("UPDATE frame_data SET frame_id = 1", "an image of frame 1 appears twice"),
]


@pytest.mark.parametrize(
    ("has_rigs", "statement", "message"),
    [*((False, *row) for row in DAMAGED), *((True, *row) for row in DAMAGED_RIGS)],
)
def test_what_is_damaged_is_named(rig_drive, tmp_path, has_rigs, statement, message):
    path = copied(rig_drive[1] if has_rigs else RING, tmp_path) / "database.db"
    edit_database(path, "PRAGMA foreign_keys = OFF", *statement.split(";"))
    with pytest.raises(InputError, match=message):
        read_from(path, read_images)


def test_a_rig_whose_sensor_has_no_pose_is_left_aside_and_named(rig_drive, tmp_path):
    path = copied(rig_drive[1], tmp_path) / "database.db"
    edit_database(path, "UPDATE rig_sensors SET sensor_from_rig = NULL WHERE sensor_id = 2")
    images = read_from(path, read_images)
    assert images.rigs.incomplete == (1,)
    assert list(images.rigs.rigs) == [2]
    of_second = set(images.model.images.ids[images.model.images.camera_ids > 3].tolist())
    assert set(images.rigs.place_of_image) == of_second
