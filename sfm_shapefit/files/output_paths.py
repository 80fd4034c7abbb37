"""Files that are made: none goes over an input, or over what was not asked to be replaced."""

import os
from collections.abc import Iterable
from pathlib import Path

from sfm_shapefit.base.atomic_folder import MAP_MARKER, MARKER
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.paths import refuse_irregular_file
from sfm_shapefit.files.matching_options import SIDECARS

_WRITTEN = {".html", ".glb", ".ply", ".csv", ".json", ".tum", ".txt"}
"""Suffixes of single files that commands write, perhaps into the folder of a model."""
_READ = {
    *(MARKER, MAP_MARKER, "cameras.csv", "pairs.csv", "doubtful_pairs.csv"),
    *(f"{name}.txt" for name in ("cameras", "images", "points3D", "rigs", "frames")),
}
"""Files with such suffixes that are part of a model or of an output."""


def refuse_file(page: Path, *, overwrite: bool, protect: Iterable[Path | str] = ()) -> None:
    """Refuse a file to be made that exists, that an input is or consists of, or whose folder does not exist.

    Args:
        page: the file.
        overwrite: accept an ordinary file in its place, but no link.
        protect: the inputs, files and folders.
    """
    if not page.absolute().parent.is_dir():
        raise InputError(f"the folder of {page} does not exist; make it, or name another")
    if page.is_dir():
        raise InputError(f"{page} is a folder; give the name of a file")
    for source in map(Path, protect):
        if _is_of(page, source):
            raise InputError(f"{page} is or belongs to the input {source}; choose another name")
    if os.path.lexists(page) and not overwrite:
        raise InputError(f"{page} exists already; choose another name, or replace it (overwrite=True)")
    if page.is_symlink():
        raise InputError(f"{page} is a symbolic link; give the file that it stands for")
    refuse_irregular_file(page)


def _is_of(page: Path, source: Path) -> bool:
    """Return whether a file is an input, a companion of one, or a file of a folder that is one."""
    if not source.is_dir():
        names = [source.name + suffix for suffix in ("", *SIDECARS)]
        names += ["tracks.csv"] * (source.suffix.lower() == ".json")  # OpenSfM's
        return any(_is_same(page, source.with_name(name)) for name in names)
    if not page.exists():
        return False
    if Path(os.path.realpath(page)).is_relative_to(os.path.realpath(source)):
        return _is_read(page)
    return any(_is_read(entry) and _is_same(page, entry) for entry in source.iterdir())


def _is_read(member: Path) -> bool:
    """Return whether a file of a folder may be read as an input: pages, meshes and lists in it are not."""
    return member.suffix.lower() not in _WRITTEN or member.name in _READ


def _is_same(page: Path, other: Path) -> bool:
    """Return whether two paths, which may not exist, lead to one file, however they are spelled."""
    try:
        return page.samefile(other)
    except OSError:
        return os.path.realpath(page) == os.path.realpath(other)
