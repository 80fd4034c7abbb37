"""COLMAP's databases as files of sqlite, opened so that nothing of them changes, whoever made them.

Opening a database with pycolmap would migrate it in place, and a mere read by sqlite3 creates -shm and -wal
files beside a database in WAL mode. So a database is read

    where it is, as immutable   if it is in WAL mode and has no -wal file: nobody has it open,
    where it is, with mode=ro   if it is in another mode and has no -journal file,
    from a private copy         if it has a -wal or a -journal: the copy is recovered, the original kept.
"""

import os
import shutil
import sqlite3
import struct
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from threading import Lock
from typing import Any
from urllib.parse import quote

from sfm_shapefit.base.atomic_folder import private_folder
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.paths import PICTURES, TAKE_FRAMES, VIDEOS, refuse_irregular_file

DATABASE_NAMES = ("database.db", "colmap.db")
"""What COLMAP's own tools, and instant-ngp's, call their databases."""

_SIDECARS = ("-wal", "-journal")
_WAL_VERSION = 2  # bytes 18 and 19 of the header; they are 2 where the file has a write-ahead log
_LOCK_TIMEOUT_S = 2.0  # seconds; another program that writes is waited for so long
_AT_ONCE = 500  # rows that are looked up by one statement; four times faster than one by one
_COPY_ATTEMPTS = 3  # copies; a file that changes during each of them is in use

_MOST_SHOWN = 40  # letters of a wrong value in a message; a blob may have millions
_NUMBERS = {
    "cameras": frozenset({"camera_id", "model", "width", "height", "prior_focal_length"}),
    "images": frozenset({"image_id", "camera_id"}),
    "rigs": frozenset({"rig_id", "ref_sensor_id", "ref_sensor_type"}),
    "rig_sensors": frozenset({"rig_id", "sensor_id", "sensor_type"}),
    "frames": frozenset({"frame_id", "rig_id"}),
    "frame_data": frozenset({"frame_id", "data_id", "sensor_id", "sensor_type"}),
    "pose_priors": frozenset({"image_id", "corr_data_id", "corr_sensor_type", "coordinate_system"}),
}
"""Columns that hold numbers; those of pairs and keypoints are looked at row by row."""

# A database may come from anywhere: what no query of ours needs is not allowed.
_LIMITS = {
    sqlite3.SQLITE_LIMIT_LENGTH: 2**29,  # bytes of a value or a row; 20 million keypoints, 67 million matches
    sqlite3.SQLITE_LIMIT_SQL_LENGTH: 100_000,  # bytes of a statement; those of the schema count
    sqlite3.SQLITE_LIMIT_COLUMN: 100,
    sqlite3.SQLITE_LIMIT_EXPR_DEPTH: 20,
    sqlite3.SQLITE_LIMIT_COMPOUND_SELECT: 3,
    sqlite3.SQLITE_LIMIT_VDBE_OP: 10_000,
    sqlite3.SQLITE_LIMIT_FUNCTION_ARG: 10,
    sqlite3.SQLITE_LIMIT_ATTACHED: 0,
    sqlite3.SQLITE_LIMIT_LIKE_PATTERN_LENGTH: 100,
    sqlite3.SQLITE_LIMIT_TRIGGER_DEPTH: 1,
    sqlite3.SQLITE_LIMIT_WORKER_THREADS: 0,
}


def is_between(value: object, least: int, bound: int) -> bool:
    """Return whether a value of a row is an integer from `least` to below `bound`."""
    return isinstance(value, int) and least <= value < bound


def database_in(path: Path) -> Path:
    """Return the database of a folder, see `database_beside`; any other path is that of a database.

    Raises:
        InputError: if the folder has none.
    """
    if not path.is_dir():
        return path
    beside = database_beside(path)
    if beside is None:
        raise InputError(
            f"{path} is a folder without a {DATABASE_NAMES[0]}; give the database file itself, or make one "
            "of images with `match_images`"
        )
    return beside


def database_beside(folder: Path) -> Path | None:
    """Return the database that a folder has by a usual name; None if it has none."""
    paths = (folder / name for name in DATABASE_NAMES)
    return next((path for path in paths if os.path.isfile(path)), None)  # False where none may be read


class DatabaseFile:
    """An open database; neither the file nor its folder is changed."""

    def __init__(self, path: Path | str) -> None:
        """Open a database.

        Raises:
            InputError: if the file is missing, is no sqlite database, or is locked or damaged.
        """
        self.path, self._stack, self._turn = Path(path), ExitStack(), Lock()
        self.notes: list[str] = []
        """What was read otherwise than it stands in the file, a sentence each."""
        with _sqlite_errors(self.path):
            self.connection = self._stack.enter_context(_readonly_connection(self.path))

    def close(self) -> None:
        """Close the database; nothing is read after that."""
        self._stack.close()

    def query(self, statement: str, *values: int | str) -> list[tuple[Any, ...]]:
        """Return the rows of a statement.

        Raises:
            InputError: if the file is locked or damaged.
        """
        with self._turn, _sqlite_errors(self.path):
            return self.connection.execute(statement, values).fetchall()

    def look_up(self, table: str, column: str, rowids: Sequence[int]) -> list[Any]:
        """Return a column of rows that a table has, in the order of their ids; errors as of `query`."""
        found = dict[int, Any]()
        for first in range(0, len(rowids), _AT_ONCE):
            some = ", ".join(map(str, rowids[first : first + _AT_ONCE]))
            found.update(self.query(f"SELECT rowid, {column} FROM {table} WHERE rowid IN ({some})"))
        return [found[rowid] for rowid in rowids]

    def rows(self, table: str, queries: dict[tuple[str, ...], str]) -> list[tuple[Any, ...]]:
        """Return the rows of the first query whose columns `table` has; none if it fits none of them.

        Args:
            table: whose columns decide, for schemas differ from version to version.
            queries: what to select, by the columns of `table` that it needs.

        Raises:
            InputError: as `query`, and if rows of the table, or of images, which queries join, are computed
                or have text in the place of a number.
        """
        for stored in (table, "images"):
            self.refuse_computed(stored)
            self.refuse_mistyped(stored)
        columns = self.columns(table)
        return next(
            (self.query(query) for needed, query in queries.items() if columns.issuperset(needed)), []
        )

    def columns(self, table: str) -> set[str]:
        """Return the names of a table's columns, none if there is no such table."""
        return {row[0] for row in self.query("SELECT name FROM pragma_table_info(?)", table)}

    def refuse_computed(self, table: str) -> None:
        """Refuse a table that is none, or whose rows are computed."""
        kinds = self.query(
            "SELECT type, rootpage FROM sqlite_master WHERE type IN ('table', 'view') AND lower(name) = ?",
            table,
        )
        what = f"{self.path} is not a COLMAP database: its {table}"
        if any(kind != "table" or not page for kind, page in kinds):  # a virtual table has no page of its own
            raise InputError(f"{what} is a view or a virtual table, not a table")
        hidden = self.query("SELECT name FROM pragma_table_xinfo(?) WHERE hidden != 0", table)
        if hidden:
            raise InputError(f"{what} has a computed column {hidden[0][0]!r}")

    def refuse_mistyped(self, table: str) -> None:
        """Refuse text and blobs where numbers belong: sqlite takes any type in the place of any other."""
        for column in sorted(self.columns(table) & _NUMBERS.get(table, frozenset())):
            is_wrong = f"typeof({column}) IN ('text', 'blob')"
            if wrong := self.query(f"SELECT {column} FROM {table} WHERE {is_wrong} LIMIT 1"):
                shown = repr(wrong[0][0])[:_MOST_SHOWN]
                raise InputError(
                    f"{self.path} is damaged: its table {table} has {shown} for the number {column}; extract "
                    "features again"
                )


@contextmanager
def _sqlite_errors(path: Path) -> Iterator[None]:
    """Turn sqlite's errors into one sentence that names the database."""
    try:
        yield
    except sqlite3.Error as error:
        if "locked" in str(error) or "busy" in str(error):
            raise InputError(f"the database {path} is locked by another program; close it first") from error
        raise InputError(f"the database {path} cannot be read: {error}") from error


@contextmanager
def _readonly_connection(path: Path) -> Iterator[sqlite3.Connection]:
    """Connect to a database so that no file of it changes and none appears; see the module's header."""
    header = _read_header(path)
    with ExitStack() as stack:
        if any(_fingerprint(sidecar)[0] for sidecar in _sidecars(path)):
            target, mode = _private_copy(path, stack), "mode=rw"
        else:
            _refuse_truncated(path, header)
            in_wal_mode = _WAL_VERSION in header[18:20]
            target, mode = path, "mode=ro&immutable=1" if in_wal_mode else "mode=ro"
        uri = f"file://{quote(os.fsencode(target.absolute()))}?{mode}"
        how: dict[str, Any] = {"isolation_level": None, "check_same_thread": False}  # threads take turns
        connection = stack.enter_context(
            closing(sqlite3.connect(uri, uri=True, timeout=_LOCK_TIMEOUT_S, **how))
        )
        connection.text_factory = lambda raw: raw.decode("utf-8", "surrogateescape")
        for limit, value in _LIMITS.items():
            connection.setlimit(limit, value)
        connection.execute("PRAGMA trusted_schema = OFF")
        connection.execute("PRAGMA cell_size_check = ON")
        connection.execute("PRAGMA query_only = ON")
        yield connection


def is_blob(data: object, rows: object, cols: int, *, itemsize: int) -> bool:
    """Return whether `data` is a blob of rows x cols items."""
    if not (isinstance(data, bytes) and isinstance(rows, int) and isinstance(cols, int)):
        return False
    return len(data) == rows * cols * itemsize


def _read_header(path: Path) -> bytes:
    """Return the first 100 bytes of a database, or refuse a file that is none."""
    if path.is_dir():
        raise InputError(f"{path} is a folder; give the database file itself")
    refuse_irregular_file(path)
    try:
        with path.open("rb") as stream:
            header = stream.read(100)
    except FileNotFoundError:
        raise InputError(f"the database {path} does not exist") from None
    except OSError as error:
        raise InputError(f"the database {path} cannot be read: {error.strerror}") from None
    if path.suffix.lower() in VIDEOS:
        raise InputError(f"{path} is a video; {TAKE_FRAMES}")
    if path.suffix.lower() in PICTURES:
        raise InputError(f"{path} is an image; give the folder of all images")
    if not header:
        raise InputError(f"the database {path} is empty; run COLMAP's feature extraction and matching first")
    if len(header) < 100 or not header.startswith(b"SQLite format 3\0"):
        raise InputError(f"{path} is not a COLMAP database; give the database.db that COLMAP wrote")
    return header


def _refuse_truncated(path: Path, header: bytes) -> None:
    """Refuse a file that is shorter than its header says; sqlite notices only when it reads a lost page.

    Header (https://sqlite.org/fileformat.html): page size at 16, where 1 means 65536, change counter at
    24, size in pages at 28, and at 92 the change counter for which that size holds.
    """
    page_size, change_counter, num_pages = struct.unpack_from(">H6xII", header, 16)
    (size_valid_for,) = struct.unpack_from(">I", header, 92)
    size = num_pages * (65536 if page_size == 1 else page_size)
    there, _ = _fingerprint(path)
    if change_counter == size_valid_for and there < size:
        raise InputError(f"the database {path} is truncated: it has {there} of {size} bytes; copy it again")


def _sidecars(path: Path) -> list[Path]:
    """Return the paths of a database's -wal and -journal files."""
    return [path.with_name(path.name + suffix) for suffix in _SIDECARS]


def _fingerprint(path: Path) -> tuple[int, int]:
    """Return size and modification time of a file, zeros if it does not exist."""
    try:
        stat = path.stat()
    except FileNotFoundError:
        return 0, 0
    return stat.st_size, stat.st_mtime_ns


def _private_copy(path: Path, stack: ExitStack) -> Path:
    """Copy a database with its -wal or -journal, and try again if a writer changed them meanwhile."""
    files = [path, *_sidecars(path)]
    for _ in range(_COPY_ATTEMPTS):
        fingerprints, folder = [_fingerprint(file) for file in files], stack.enter_context(private_folder())
        try:
            for file in filter(Path.exists, files):
                shutil.copyfile(file, folder / file.name)
        except OSError as error:
            raise InputError(
                f"the database {path} has unfinished changes and cannot be copied to a temporary folder "
                f"({error.strerror}); close the program that uses it, or make room"
            ) from None
        if fingerprints == [_fingerprint(file) for file in files]:
            return folder / path.name
    raise InputError(f"the database {path} is being written by another program; wait until it is done")
