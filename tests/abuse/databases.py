"""Ways to damage a COLMAP database: its schema, its rows, its blobs, its pages and its companions.

Each takes the path of a private copy and a generator, and says whether the answer must stay as it was.
"""

import struct

import numpy as np

from tests.abuse.mutations import BROKEN_NAMES, DOUBLES, HOSTILE_NAMES, change_bytes, pick
from tests.scenes import edit_database

_READ_TABLES = ("images", "keypoints", "two_view_geometries")
_COLUMNS = {
    "images": ("image_id", "name", "camera_id"),
    "keypoints": ("image_id", "rows", "cols", "data"),
    "two_view_geometries": ("pair_id", "rows", "cols", "data", "config", "qvec", "tvec"),
    "cameras": ("camera_id", "model", "width", "height", "params", "prior_focal_length"),
    "rigs": ("rig_id", "ref_sensor_id", "ref_sensor_type"),
    "frames": ("frame_id", "rig_id"),
    "frame_data": ("frame_id", "data_id", "sensor_id", "sensor_type"),
}
_CONTENTS = {
    "images": ("name",),
    "keypoints": ("data", "data"),
    "two_view_geometries": ("data", "data", "qvec", "tvec"),
    "cameras": ("params", "params"),
    **dict.fromkeys(("rigs", "frames", "frame_data"), ()),
}
"""Columns whose contents are changed more often than others."""
_ODD_VALUES = (
    *(None, -1, 0, 1, 2**31, 2**62, 2**63 - 1, -(2**63), 0.5, 2.0, 1e308, float("inf")),
    *("", "x", "2", b"", b"\0"),
)
_OLD_GEOMETRIES = (
    "pair_id, rows, cols, data, config",
    "pair_id, rows, cols, data, config, F, E, H",
    "pair_id, rows, cols, data, config, F, E, H, qvec, tvec",
)
"""The columns of two_view_geometries in releases 3.5, 3.6 and 3.8; all have been read in the wild."""
_ENDLESS = "WITH RECURSIVE n(x) AS (VALUES (1) UNION ALL SELECT x + 1 FROM n)"
_VERSIONS = (0, 3600, 3700, 3800, 3900, 31000, 31200, 4000000, 4020100, 99999999, -1, 2**31 - 1)
_LATER_TABLES = ("rigs", "rig_sensors", "frames", "frame_data", "pose_priors")


def _copied(table, declared, listed):
    """Return statements that put a copy of some columns, declared anew, in the place of a table."""
    return (
        f"CREATE TABLE made ({declared})",
        f"INSERT INTO made SELECT {listed} FROM {table}",
        f"DROP TABLE {table}",
        f"ALTER TABLE made RENAME TO {table}",
    )


def _untyped(table):
    """The same with untyped columns, where sqlite lets values of any type be."""
    listed = ", ".join(_COLUMNS[table])
    return _copied(table, listed, listed)


def foreign_version(path, rng):
    """The schema of another release: every one from 3.6 to 4.2 is to be read, and what later ones may add."""
    columns = pick(rng, _OLD_GEOMETRIES)
    declared = columns.replace("pair_id", "pair_id INTEGER PRIMARY KEY NOT NULL").replace("data", "data BLOB")
    edit_database(
        path,
        f"PRAGMA user_version = {pick(rng, _VERSIONS)}",
        *_copied("two_view_geometries", declared, columns),
        *(f"DROP TABLE {table}" for table in _LATER_TABLES[: int(rng.integers(6))]),
        *(["ALTER TABLE images ADD COLUMN from_the_future BLOB"] if rng.random() < 0.3 else []),
        *(["ALTER TABLE two_view_geometries RENAME TO inlier_matches"] if rng.random() < 0.3 else []),
    )
    return True


def missing_part(path, rng):
    """Drop or rename a table or a column, or empty a table."""
    table = pick(rng, _READ_TABLES)
    ways = (
        f"DROP TABLE {table}",
        f"ALTER TABLE {table} RENAME TO lost",
        f"ALTER TABLE {table} RENAME COLUMN {pick(rng, _COLUMNS[table])} TO lost",
        f"DELETE FROM {table}",
        f"DELETE FROM {table} WHERE rowid % 2",
    )
    edit_database(path, pick(rng, ways))
    return False


def impostor(path, rng):
    """Put a view, a virtual, a generated or an untyped table in the place of a table, or a trigger on it."""
    table = pick(rng, _READ_TABLES)
    columns = _COLUMNS[table]
    listed, ordinary, last = ", ".join(columns), ", ".join(columns[:-1]), columns[-1]

    def every(value, source="FROM real"):
        return f"{', '.join(f'{value} AS {name}' for name in columns)} {source}"

    views = {
        "same rows": f"SELECT {listed} FROM real",
        "endless": f"{_ENDLESS} SELECT {every('x', 'FROM n')}",
        "huge blobs": f"SELECT {every('zeroblob(900000000)')}",
        "function": f"SELECT {every('load_extension(1)')}",
        "file": f"SELECT {every('readfile(1)')}",
    }
    tables = {
        "virtual": (f"CREATE VIRTUAL TABLE {table} USING fts5({listed.replace('rows', 'r0ws')})",),
        "generated": (
            f"CREATE TABLE {table} ({ordinary}, {last} BLOB AS (zeroblob(900000000)) VIRTUAL)",
            f"INSERT INTO {table} ({ordinary}) SELECT {ordinary} FROM real",
        ),
        "without rowid": (
            f"CREATE TABLE {table} ({listed.replace('_id', '_id INTEGER PRIMARY KEY', 1)}) WITHOUT ROWID",
            f"INSERT INTO {table} SELECT {listed} FROM real",
        ),
    }
    sound = {
        "untyped": _untyped(table),
        "trigger": (f"CREATE TRIGGER t AFTER UPDATE ON {table} BEGIN DELETE FROM {table}; END",),
    }
    kind = pick(rng, (*views, *tables, *sound))
    if kind in sound:
        edit_database(path, *sound[kind])
        return True
    made = (f"CREATE VIEW {table} AS {views[kind]}",) if kind in views else tables[kind]
    edit_database(path, "PRAGMA legacy_alter_table = ON", f"ALTER TABLE {table} RENAME TO real", *made)
    return False


def odd_cells(path, rng, tables=_READ_TABLES):
    """Write values of wrong type, size or content where sqlite lets them be, and repeat rows."""
    table = pick(rng, tables)
    edit_database(path, *_untyped(table))
    for _ in range(int(rng.integers(1, 4))):
        column = pick(rng, (*_COLUMNS[table], *_CONTENTS[table]))
        rows = _rows(path, f"SELECT rowid, {column} FROM {table}")
        for rowid, old in [pick(rng, rows)] if rows and rng.random() < 0.7 else rows:
            new = _odd_value(column, old, table == "keypoints", rng)
            set_values(path, table, column, new, f"rowid = {rowid}")
    if rng.random() < 0.2:
        edit_database(path, f"INSERT INTO {table} SELECT * FROM {table} LIMIT {int(rng.integers(1, 4))}")
    return False


def odd_cameras(path, rng):
    """The same with the intrinsics, rigs and frames."""
    return odd_cells(path, rng, ("cameras", "cameras", "rigs", "frames", "frame_data"))


def one_place(path, rng):
    """Put the keypoints of one image, or of all, at one place, perhaps a far one, or on a line."""
    value, line = pick(rng, (0.0, 100.0, -1e6, 1e15, 3e38)), rng.random() < 0.3
    rows = _rows(path, "SELECT image_id, rows, cols, data FROM keypoints")
    for image_id, number, cols, data in rows if rng.random() < 0.3 else [pick(rng, rows)]:
        changed = np.frombuffer(data, dtype="<f4").reshape(number, cols).copy()
        changed[:, int(line) : 2] = value
        set_values(path, "keypoints", "data", changed.tobytes(), f"image_id = {image_id}")
    return False


def unfinished(path, rng):
    """Leave out what one of COLMAP's steps makes: features, matches, geometries."""
    tables = ("two_view_geometries", "matches", "keypoints", "cameras", "images")
    for table in tables[: int(rng.integers(1, 6))]:
        edit_database(path, "PRAGMA foreign_keys = OFF", f"DELETE FROM {table}")
    return False


def _rows(path, query):
    found = []

    def read(connection):
        connection.text_factory = bytes  # names may be no text any more
        found.extend(connection.execute(query))

    edit_database(path, read)
    return found


def set_values(path, table, column, value, where):
    """Write a value into some rows of a table; bytes in the place of a name are text, a memoryview a blob."""
    cast = "CAST(? AS TEXT)" if column == "name" and isinstance(value, bytes) else "?"
    command = f"UPDATE OR REPLACE {table} SET {column} = {cast} WHERE {where}"
    edit_database(path, lambda connection: connection.execute(command, (value,)))


def _odd_value(column, old, is_float, rng):
    """Return what to write in the place of a value: most often what it could be, but should not."""
    if column == "name" and rng.random() < 0.7:
        name = pick(rng, (*HOSTILE_NAMES, *BROKEN_NAMES))
        return pick(rng, (name, name, memoryview(name)))
    if column in ("data", "params", "qvec", "tvec") and rng.random() < 0.7:
        layout = "<f4" if is_float else "<u4" if column == "data" else "<f8"
        return _change_blob(old if isinstance(old, bytes) and old else bytes(32), layout, rng)
    return pick(rng, _ODD_VALUES)


def _change_blob(data, layout, rng):
    """Change the length of a blob, any of its bytes, or some of its numbers."""
    values = np.frombuffer(data[: len(data) // 8 * 8], dtype=layout).copy()
    odd = (0, 2**31, 2**32 - 1, 10**6) if layout == "<u4" else (*DOUBLES, 3e38, -3e38)
    with np.errstate(over="ignore"):
        values[rng.random(len(values)) < pick(rng, (0.01, 0.3, 1.0))] = pick(rng, odd)
    shorter, longer = data[: int(rng.integers(len(data) + 1))], data + rng.bytes(int(rng.integers(1, 40)))
    return pick(rng, (shorter, longer, change_bytes(data, rng), values.tobytes()))


def odd_pages(path, rng):
    """Change bytes of the file itself: of its header, of one page, or where it ends."""
    data = path.read_bytes()
    page = 4096 * int(rng.integers(len(data) // 4096))
    ways = (
        lambda: change_bytes(data[:100], rng) + data[100:],
        lambda: data[:page] + change_bytes(data[page : page + 64], rng)[:64] + data[page + 64 :],
        lambda: data[: int(rng.integers(len(data)))],
        lambda: change_bytes(data, rng),
    )
    path.write_bytes(pick(rng, ways)())
    return False


def companions(path, rng):
    """Put a -wal, a -journal or a -shm file beside the database: garbage, or that of another."""
    suffix = pick(rng, ("-wal", "-journal", "-shm"))
    magic = {"-wal": struct.pack(">II", 0x377F0682, 3007000), "-journal": bytes.fromhex("d9d505f920a163d7")}
    contents = (b"", b"\0" * 512, magic.get(suffix, b"") + rng.bytes(2000), rng.bytes(8192))
    path.with_name(path.name + suffix).write_bytes(pick(rng, contents))
    if rng.random() < 0.5:
        data = path.read_bytes()
        path.write_bytes(data[:18] + b"\2\2" + data[20:])  # as if in WAL mode
    return False


WAYS = (
    *(foreign_version, missing_part, impostor, odd_pages, companions, one_place, unfinished),
    *(odd_cells, odd_cells, odd_cells, odd_cells, odd_cells),
)
