"""A command opens the database once, whatever it reads of it: images, matches, priors, intrinsics."""

import pytest

import sfm_shapefit
from sfm_shapefit.files.colmap import sqlite_file
from sfm_shapefit.pipeline.examine import examine
from tests.pipeline.test_map import FAST, changed, keep_few_matches
from tests.scenes import RING

MODEL, DATABASE = RING / "sparse" / "0", RING / "database.db"


def map_and_join(folder):
    """Map a database of two components, which are joined."""
    found = sfm_shapefit.map_database(changed(RING, folder, keep_few_matches(False)), **FAST)
    assert found.joined


COMMANDS = {
    "locate": lambda _: sfm_shapefit.locate(MODEL, DATABASE),
    "locate from tracks": lambda _: sfm_shapefit.locate(MODEL, directions="tracks"),
    "map": map_and_join,
    "inspect": lambda _: sfm_shapefit.inspect(MODEL, DATABASE),
    "examine": lambda _: examine(MODEL, DATABASE),
    "relative rotations": lambda _: sfm_shapefit.relative_rotations(DATABASE),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_opens_the_database_once(command, tmp_path, monkeypatch):
    opened, connect = [], sqlite_file._readonly_connection
    monkeypatch.setattr(
        sqlite_file, "_readonly_connection", lambda path: opened.append(path) or connect(path)
    )
    COMMANDS[command](tmp_path)
    assert len(opened) == (command != "locate from tracks")
