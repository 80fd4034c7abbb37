"""Where the scenes are, and how their files are watched."""

import csv
import hashlib
import shutil
import sqlite3
import stat
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from sfm_shapefit.files.colmap.database import open_database
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import View

ROOT = Path(__file__).parents[1]
BUNDLED = ROOT / "data_synthetic"
COURTYARD, RING, FACADE = BUNDLED / "courtyard", BUNDLED / "ring8", BUNDLED / "facade9"
PHOTOGRAPHED = BUNDLED / "photographed"
SHARED = ROOT.parent / "shared" / "data"


def real_scene(name: str) -> Path:
    """Return a real scene's folder, or skip the test: these scenes are not part of the project."""
    if not (SHARED / name).is_dir():
        pytest.skip(f"the real scene {name} is not at hand (../shared/data)")
    return SHARED / name


def copied(scene: Path, folder: Path) -> Path:
    """Return a private copy of a scene that a test may damage."""
    return Path(shutil.copytree(scene, folder / scene.name))


def edit_database(path: Path, *statements: str | Callable[[sqlite3.Connection], object]) -> Path:
    """Run SQL, or functions of the connection, on a database that a test owns."""
    with closing(sqlite3.connect(path)) as connection, connection:
        for statement in statements:
            statement(connection) if callable(statement) else connection.execute(statement)
    return path


def read_from(path: Path, read: Callable[..., Any], *given: Any) -> Any:
    """Return what a function reads of a database, which is open for that long."""
    with closing(DatabaseFile(path)) as file:
        return read(file, *given)


@contextmanager
def view_of(path: Path, images: Images, **how: Any) -> Iterator[View]:
    """Open a database for the matches of images."""
    with closing(open_database(path, images.names)) as matches:
        yield matches.at(images, **how)


def fingerprint(folder: Path) -> dict[str, str]:
    """Return what every entry below a folder is: the hash of a file, the target of a link, or its kind."""
    return {str(path.relative_to(folder)): _content(path) for path in sorted(folder.rglob("*"))}


def _content(path: Path) -> str:
    mode = path.lstat().st_mode
    if stat.S_ISREG(mode):
        return hashlib.sha256(path.read_bytes()).hexdigest()
    return f"-> {path.readlink()}" if stat.S_ISLNK(mode) else f"kind {stat.S_IFMT(mode):o}"


def rows_of(path: Path) -> list[dict[str, str]]:
    """Return the rows of a table that was written."""
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))
