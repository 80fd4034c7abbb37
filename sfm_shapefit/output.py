"""Folders that appear whole or not at all: written beside their place under a hidden name, then renamed.

A rename inside one file system is atomic: nobody ever sees a folder that is half written. With `overwrite`
the old folder is moved aside, the new one moved in, and only then is the old one removed.

The folder of a `locate` run is known by its `locate.json`, that of `map` by its `map.json`; nothing else
that holds files is ever replaced.
"""

import os
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from sfm_shapefit.errors import InputError

MARKER = "locate.json"
"""The file by which an output folder of `locate` and `solve` is recognised."""
MAP_MARKER = "map.json"
"""The file by which an output folder of `map` is recognised."""


def check_output(out: Path | str, *, overwrite: bool = False, protect: Sequence[Path | str] = ()) -> None:
    """Refuse an output folder that cannot or must not be written; call it before long work.

    Args:
        out: the folder to be made. Missing parents are fine.
        overwrite: accept an existing folder if it is empty or an earlier output (it has a marker).
        protect: files and folders that must survive, such as the input model and its database: `out` may
            neither be one of them nor contain one.

    Raises:
        InputError: one sentence that names the folder and says what to do instead.
    """
    folder = Path(out)
    _refuse_protected(folder, protect)
    if folder.is_symlink():
        raise InputError(f"{folder} is a symbolic link; give the folder that it stands for")
    if folder.exists():
        _refuse_existing(folder, overwrite=overwrite)
    parent = _nearest_existing_parent(folder)
    if not parent.is_dir():
        raise InputError(f"{folder} cannot be made because {parent} is not a folder; choose another place")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(f"{folder} cannot be made because {parent} is not writable; choose another place")


@contextmanager
def atomic_folder(
    out: Path | str, *, overwrite: bool = False, protect: Sequence[Path | str] = ()
) -> Iterator[Path]:
    """Yield a new empty folder that becomes `out` when the block ends, and vanishes if it raises.

    The block should only write: an OSError inside it is reported as "cannot be written".

    Args:
        out, overwrite, protect: see `check_output`, which is called first.

    Raises:
        InputError: from `check_output`, if writing fails (permissions, full disk), or if `out` came into
            being meanwhile. Any other exception of the block, KeyboardInterrupt included, passes through;
            in all of these cases neither `out` nor its parents have changed.
    """
    check_output(out, overwrite=overwrite, protect=protect)
    folder = Path(os.path.abspath(out))
    made_parents = _missing_parents(folder)
    partial = folder.parent / f".shapefit-{secrets.token_hex(8)}.partial"
    try:
        partial.mkdir(parents=True)
        yield partial
        _move_into_place(partial, folder, overwrite=overwrite)
    except BaseException as error:
        shutil.rmtree(partial, ignore_errors=True)
        for parent in made_parents:
            with suppress(OSError):  # it may be missing, or hold what somebody else put there
                parent.rmdir()
        if isinstance(error, OSError):
            raise InputError(f"{out} cannot be written ({error.strerror}); choose another place") from error
        raise


def _refuse_protected(folder: Path, protect: Sequence[Path | str]) -> None:
    """Refuse a folder that is, or contains, one of the protected paths, however they are spelled."""
    real = Path(os.path.realpath(folder))
    for path in protect:
        kept = Path(os.path.realpath(path))
        if real == kept or real in kept.parents:
            raise InputError(
                f"{folder} is or contains the input {path}; choose another folder for the output"
            )


def _refuse_existing(folder: Path, *, overwrite: bool) -> None:
    """Refuse whatever exists at `folder`, except a folder that may be overwritten."""
    if not folder.is_dir():
        raise InputError(f"{folder} is a file; give the name of a new folder")
    if not overwrite:
        raise InputError(f"{folder} exists already; choose another folder or allow overwriting")
    try:
        is_empty = not any(folder.iterdir())
    except OSError as error:
        raise InputError(f"{folder} cannot be read ({error.strerror}); choose another folder") from error
    if not is_empty and not any((folder / marker).is_file() for marker in (MARKER, MAP_MARKER)):
        raise InputError(
            f"{folder} holds files but no {MARKER} or {MAP_MARKER}, so it is not overwritten; "
            "choose another folder"
        )


def _nearest_existing_parent(folder: Path) -> Path:
    """Return the closest ancestor that exists."""
    return next(parent for parent in Path(os.path.abspath(folder)).parents if os.path.lexists(parent))


def _missing_parents(folder: Path) -> list[Path]:
    """Return the ancestors that do not exist yet, the deepest first."""
    return [parent for parent in folder.parents if not os.path.lexists(parent)]


def _move_into_place(partial: Path, folder: Path, *, overwrite: bool) -> None:
    """Rename `partial` to `folder`; an old folder is put back if that fails, removed if it succeeds."""
    if not os.path.lexists(folder):
        partial.rename(folder)
        return
    _refuse_existing(folder, overwrite=overwrite)
    old = partial.with_suffix(".old")
    try:
        folder.rename(old)
        partial.rename(folder)
    except BaseException:
        if old.exists() and not os.path.lexists(folder):
            old.rename(folder)
        raise
    shutil.rmtree(old, ignore_errors=True)
