#!/usr/bin/env bash
# pycolmap 4.2.1, `with DatabaseTransaction(database):`.
#
# Guess: where the block raises, nothing of it is in the database, as with sqlite3's own `with connection:`.
# Seen: what was written before the exception is committed. A run that is interrupted leaves images without the frames
#   or priors that would have followed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -r "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q pycolmap==4.2.1 numpy==2.4.6
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import sqlite3

import pycolmap

with pycolmap.Database.open("colmap.db") as database:
    try:
        with pycolmap.DatabaseTransaction(database):
            database.write_camera(pycolmap.Camera.create_from_model_name(0, "PINHOLE", 500.0, 640, 480))
            raise RuntimeError("the second write fails")
    except RuntimeError:
        pass
with pycolmap.Database.open("colmap.db") as database:
    kept = database.num_cameras()

connection = sqlite3.connect("python.db")
connection.execute("CREATE TABLE cameras (id INTEGER)")
try:
    with connection:
        connection.execute("INSERT INTO cameras VALUES (1)")
        raise RuntimeError("the second write fails")
except RuntimeError:
    pass
(kept_by_sqlite3,) = connection.execute("SELECT COUNT(*) FROM cameras").fetchone()

print(f"cameras written before the exception that are in the database: pycolmap {kept}, sqlite3 {kept_by_sqlite3}")
assert (kept, kept_by_sqlite3) == (1, 0)
PYTHON
