"""A command opens the database once, whatever it reads of it: images, matches, priors, intrinsics."""

import pytest

import sfm_shapefit
from sfm_shapefit.files.colmap import sqlite_file
from sfm_shapefit.pipeline.examine import examine
from tests.scenes import COURTYARD, RING

MODEL, DATABASE = RING / "sparse" / "0", RING / "database.db"
COMMANDS = {
    "locate": lambda: sfm_shapefit.locate(MODEL, DATABASE),
    "locate from tracks": lambda: sfm_shapefit.locate(MODEL, directions="tracks"),
    "map": lambda: sfm_shapefit.map_database(COURTYARD / "database.db"),
    "inspect": lambda: sfm_shapefit.inspect(MODEL, DATABASE),
    "examine": lambda: examine(MODEL, DATABASE),
    "relative rotations": lambda: sfm_shapefit.relative_rotations(DATABASE),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_opens_the_database_once(command, monkeypatch):
    opened, connect = [], sqlite_file._readonly_connection
    monkeypatch.setattr(
        sqlite_file, "_readonly_connection", lambda path: opened.append(path) or connect(path)
    )
    COMMANDS[command]()
    assert len(opened) == (command != "locate from tracks")
