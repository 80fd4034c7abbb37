"""Ways to damage a COLMAP database: its schema, its rows, its blobs, its pages and its companions.

Each takes the path of a private copy and a generator, and says whether the answer must stay as it was.
"""

import sqlite3
import struct
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
from numpy.random import Generator

from abuse.mutations import BROKEN_NAMES, HOSTILE_NAMES, change_bytes, pick

READ_TABLES = ("images", "keypoints", "two_view_geometries")
_COLUMNS = {
    "images": ("image_id", "name", "camera_id"),
    "keypoints": ("image_id", "rows", "cols", "data"),
    "two_view_geometries": ("pair_id", "rows", "cols", "data", "config", "qvec", "tvec"),
}
ODD_VALUES = (
    *(None, -1, 0, 1, 2**31, 2**62, 2**63 - 1, -(2**63), 0.5, 2.0, 1e308, float("inf")),
    *("", "x", "2", b"", b"\0"),
)

# Which columns two_view_geometries had in which release; all have been read in the wild.
_OLD_GEOMETRIES = {
    "3.5": "pair_id, rows, cols, data, config",
    "3.6": "pair_id, rows, cols, data, config, F, E, H",
    "3.8": "pair_id, rows, cols, data, config, F, E, H, qvec, tvec",
}
_VERSIONS = (0, 3600, 3700, 3800, 3900, 31000, 31200, 4000000, 4020100, 99999999, -1, 2**31 - 1)


def foreign_version(path: Path, rng: Generator) -> bool:
    """Make the schema that of another release; every one from 3.6 to 4.2 is to be read."""
    columns = str(pick(rng, sorted(_OLD_GEOMETRIES.values())))
    with _edit(path) as connection:
        connection.execute(f"PRAGMA user_version = {int(pick(rng, _VERSIONS))}")
        connection.execute(f"CREATE TABLE old AS SELECT {columns} FROM two_view_geometries")
        connection.execute("DROP TABLE two_view_geometries")
        declared = columns.replace("pair_id", "pair_id INTEGER PRIMARY KEY NOT NULL").replace(
            "data", "data BLOB"
        )
        connection.execute(f"CREATE TABLE two_view_geometries ({declared})")
        connection.execute(f"INSERT INTO two_view_geometries SELECT {columns} FROM old")
        connection.execute("DROP TABLE old")
        for table in ("rigs", "rig_sensors", "frames", "frame_data", "pose_priors")[: int(rng.integers(6))]:
            connection.execute(f"DROP TABLE {table}")
        if rng.random() < 0.3:  # what a later release may add
            connection.execute("ALTER TABLE images ADD COLUMN from_the_future BLOB")
    return True


def missing_part(path: Path, rng: Generator) -> bool:
    """Drop or rename a table or a column, or empty a table."""
    table = str(pick(rng, READ_TABLES))
    column = str(pick(rng, _COLUMNS[table]))
    statement = pick(
        rng,
        (
            f"DROP TABLE {table}",
            f"ALTER TABLE {table} RENAME TO lost",
            f"ALTER TABLE {table} RENAME COLUMN {column} TO lost",
            f"DELETE FROM {table}",
            f"DELETE FROM {table} WHERE rowid % 2",
        ),
    )
    with _edit(path) as connection:
        connection.execute(str(statement))
    return False


def impostor(path: Path, rng: Generator) -> bool:
    """Put a view, a virtual, a generated or an untyped table in the place of a table."""
    table = str(pick(rng, READ_TABLES))
    columns = _COLUMNS[table]
    listed = ", ".join(columns)
    endless = "WITH RECURSIVE n(x) AS (VALUES (1) UNION ALL SELECT x + 1 FROM n) SELECT "
    computed = {
        "same rows": f"SELECT {listed} FROM real",
        "endless": endless + ", ".join(f"x AS {name}" for name in columns) + " FROM n",
        "huge blobs": "SELECT "
        + ", ".join(f"zeroblob(900000000) AS {name}" for name in columns)
        + " FROM real",
        "function": f"SELECT {', '.join(f'load_extension(1) AS {name}' for name in columns)} FROM real",
        "file": f"SELECT {', '.join(f'readfile(1) AS {name}' for name in columns)} FROM real",
    }
    kind = str(pick(rng, (*computed, "virtual", "generated", "untyped", "without rowid", "trigger")))
    with _edit(path) as connection:
        if kind == "trigger":
            connection.execute(f"CREATE TRIGGER t AFTER UPDATE ON {table} BEGIN DELETE FROM {table}; END")
            return True
        connection.execute("PRAGMA legacy_alter_table = ON")
        connection.execute(f"ALTER TABLE {table} RENAME TO real")
        if kind in computed:
            connection.execute(f"CREATE VIEW {table} AS {computed[kind]}")
        elif kind == "virtual":
            connection.execute(f"CREATE VIRTUAL TABLE {table} USING fts5({listed.replace('rows', 'r0ws')})")
        elif kind == "generated":
            ordinary = ", ".join(columns[:-1])
            made = f"{columns[-1]} BLOB GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL"
            connection.execute(f"CREATE TABLE {table} ({ordinary}, {made})")
            connection.execute(f"INSERT INTO {table} ({ordinary}) SELECT {ordinary} FROM real")
        elif kind == "untyped":
            connection.execute(f"CREATE TABLE {table} ({listed})")
            connection.execute(f"INSERT INTO {table} SELECT {listed} FROM real")
            return True
        else:
            key = columns[0]
            declared = listed.replace(key, f"{key} INTEGER PRIMARY KEY")
            connection.execute(f"CREATE TABLE {table} ({declared}) WITHOUT ROWID")
            connection.execute(f"INSERT INTO {table} SELECT {listed} FROM real")
    return False


def odd_values(path: Path, rng: Generator) -> bool:
    """Write values of wrong type or size into untyped copies of the tables, where sqlite lets them be."""
    table = str(pick(rng, READ_TABLES))
    listed = ", ".join(_COLUMNS[table])
    with _edit(path) as connection:
        connection.execute(f"CREATE TABLE untyped ({listed})")
        connection.execute(f"INSERT INTO untyped SELECT {listed} FROM {table}")
        connection.execute(f"DROP TABLE {table}")
        connection.execute(f"ALTER TABLE untyped RENAME TO {table}")
        for _ in range(int(rng.integers(1, 4))):
            column, value = str(pick(rng, _COLUMNS[table])), pick(rng, ODD_VALUES)
            only = pick(rng, ("", " WHERE rowid % 2", f" WHERE rowid = {int(rng.integers(1, 7))}"))
            connection.execute(f"UPDATE {table} SET {column} = ?{only}", (value,))
        if rng.random() < 0.3:
            connection.execute(f"INSERT INTO {table} SELECT * FROM {table} LIMIT {int(rng.integers(1, 4))}")
    return False


def odd_blobs(path: Path, rng: Generator) -> bool:
    """Change numbers inside keypoints, matches and poses, or the length of their blobs."""
    table, column = pick(
        rng,
        (
            *[("keypoints", "data"), ("two_view_geometries", "data")] * 2,
            *(("two_view_geometries", "qvec"), ("two_view_geometries", "tvec")),
        ),
    )
    with _edit(path) as connection:
        rows = connection.execute(f"SELECT rowid, {column} FROM {table}").fetchall()
        for rowid, data in rows if rng.random() < 0.3 else [pick(rng, rows)]:
            changed = _change_blob(data or bytes(32), str(column), table == "keypoints", rng)
            connection.execute(f"UPDATE {table} SET {column} = ? WHERE rowid = ?", (changed, rowid))
    return False


def _change_blob(data: bytes, column: str, is_float: bool, rng: Generator) -> bytes:
    match int(rng.integers(4)):
        case 0:
            return data[: int(rng.integers(len(data) + 1))]
        case 1:
            return data + rng.bytes(int(rng.integers(1, 40)))
        case 2:
            return change_bytes(data, rng)
        case _:
            layout = "<f4" if is_float else "<u4" if column == "data" else "<f8"
            floats = (np.nan, np.inf, -np.inf, 3e38, -3e38, 0.0)
            odd = floats if layout != "<u4" else (0, 2**31, 2**32 - 1, 10**6)
            values = np.frombuffer(data[: len(data) // 8 * 8], dtype=layout).copy()
            values[rng.random(len(values)) < pick(rng, (0.01, 0.3, 1.0))] = pick(rng, odd)
            return values.tobytes()


def odd_names(path: Path, rng: Generator) -> bool:
    """Give images of the database names that their model does not have, or that are no text."""
    with _edit(path) as connection:
        for image_id in range(1, int(rng.integers(2, 5))):
            raw = bytes(pick(rng, (*HOSTILE_NAMES, *BROKEN_NAMES)))
            kind = pick(rng, ("CAST(? AS TEXT)", "CAST(? AS TEXT)", "?"))
            connection.execute(
                f"UPDATE OR REPLACE images SET name = {kind} WHERE image_id = ?", (raw, image_id)
            )
    return False


def odd_pages(path: Path, rng: Generator) -> bool:
    """Change bytes of the file itself: of its header, of one page, or where it ends."""
    data = path.read_bytes()
    match int(rng.integers(4)):
        case 0:
            path.write_bytes(change_bytes(data[:100], rng) + data[100:])
        case 1:
            page = int(rng.integers(len(data) // 4096)) * 4096
            path.write_bytes(data[:page] + change_bytes(data[page : page + 64], rng)[:64] + data[page + 64 :])
        case 2:
            path.write_bytes(data[: int(rng.integers(len(data)))])
        case _:
            path.write_bytes(change_bytes(data, rng))
    return False


def companions(path: Path, rng: Generator) -> bool:
    """Put a -wal, a -journal or a -shm file beside the database: garbage, or that of another."""
    suffix = str(pick(rng, ("-wal", "-journal", "-shm")))
    magic = {"-wal": struct.pack(">II", 0x377F0682, 3007000), "-journal": bytes.fromhex("d9d505f920a163d7")}
    contents = pick(rng, (b"", b"\0" * 512, magic.get(suffix, b"") + rng.bytes(2000), rng.bytes(8192)))
    path.with_name(path.name + suffix).write_bytes(contents)
    if rng.random() < 0.5:
        data = bytearray(path.read_bytes())
        data[18:20] = b"\2\2"  # as if in WAL mode
        path.write_bytes(data)
    return False


WAYS: tuple[Callable[[Path, Generator], bool], ...] = (
    *(foreign_version, missing_part, impostor, odd_values, odd_values),
    *(odd_blobs, odd_blobs, odd_names, odd_pages, companions),
)


@contextmanager
def _edit(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a private copy for writing; text may hold any bytes."""
    with closing(sqlite3.connect(path)) as connection:
        connection.text_factory = bytes
        yield connection
        connection.commit()
