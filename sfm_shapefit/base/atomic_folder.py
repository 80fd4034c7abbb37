"""Folders and files that appear whole or not at all: written in a private folder beside their place, then
renamed.

A rename inside one file system is atomic: nobody ever sees a folder that is half written. With `overwrite`
old and new change places in one step where the system can (Linux: renameat2); elsewhere the old one is moved
aside first.

The private folder `.shapefit-<hash of the name>.partial` is also the claim on a place: its run holds a lock
on it (flock) as long as it lives. A second run into the same place is told so, and a folder whose lock is
free was left by a killed run: the next one that writes to the same parent removes it. A folder that holds
files is replaced only if it has a `locate.json` or `map.json`, as runs leave them.
"""

import ctypes
import errno
import fcntl
import hashlib
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

from sfm_shapefit.base.errors import InputError

MARKER = "locate.json"
"""The file by which an output folder of `locate` and `solve` is recognized."""
MAP_MARKER = "map.json"
"""The file by which an output folder of `map` is recognized."""


def check_output(
    out: Path | str,
    *,
    overwrite: bool = False,
    protect: Sequence[Path | str] = (),
    kept: Sequence[str] = (),
) -> None:
    """Raise InputError, one sentence that says what to do instead, if an output folder may not be written.

    Args:
        out: the folder to be made; missing parents are fine.
        overwrite: accept an earlier output too (it has a marker); an empty folder is accepted anyway.
        protect: files and folders, such as the input, that `out` may neither be nor contain.
        kept: names of files that `out` may hold already, which the new folder has too.
    """
    folder = Path(out)
    _refuse_protected(folder, protect)
    if folder.is_symlink():
        raise InputError(f"{folder} is a symbolic link; give the folder that it stands for")
    if folder.exists():
        _refuse_existing(folder, overwrite=overwrite, kept=kept)
    parents = Path(os.path.abspath(folder)).parents
    parent = next(parent for parent in parents if os.path.lexists(parent))
    if not parent.is_dir():
        raise InputError(f"{folder} cannot be made because {parent} is not a folder; choose another place")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(f"{folder} cannot be made because {parent} is not writable; choose another place")


@contextmanager
def claimed_output(
    out: Path | str,
    *,
    overwrite: bool = False,
    protect: Sequence[Path | str] = (),
    kept: Sequence[str] = (),
) -> Iterator[None]:
    """Hold the place of an output folder, as `check_output` has it, while `atomic_folder` inside writes."""
    check_output(out, overwrite=overwrite, protect=protect, kept=kept)
    with _claim(Path(os.path.abspath(out))) as private:
        token = _claimed.set(private)
        try:
            yield
        finally:
            _claimed.reset(token)


@contextmanager
def atomic_folder(
    out: Path | str,
    *,
    overwrite: bool = False,
    protect: Sequence[Path | str] = (),
    kept: Sequence[str] = (),
) -> Iterator[Path]:
    """Yield a new empty folder that becomes `out` when the block ends, and vanishes if it raises.

    Arguments as of `check_output`, which is called first. The block should only write.

    Raises:
        InputError: from `check_output`, if another run holds the place, if writing fails (permissions, full
            disk: any OSError of the block), or if `out` came into being meanwhile. Any other exception,
            KeyboardInterrupt included, passes through. Neither `out` nor its parents have changed then.
    """
    check_output(out, overwrite=overwrite, protect=protect, kept=kept)
    folder = Path(os.path.abspath(out))
    try:
        with _claim(folder) as private:
            partial = private / folder.name
            try:
                partial.mkdir()
                yield partial
                for name in kept:
                    _copy(folder / name, partial / name)
                _move_into_place(partial, folder, overwrite=overwrite, kept=kept)
            except InputError as error:  # raised by a writer, which names the place where it writes
                raise InputError(str(error).replace(str(partial), str(out))) from error
            finally:
                shutil.rmtree(partial, ignore_errors=True)
    except OSError as error:
        raise InputError(f"{out} cannot be written ({error.strerror}); choose another place") from error


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield the place of a new file that becomes `path`, or takes its place, when the block ends.

    It vanishes if the block raises; `path` has not changed then.

    Raises:
        InputError: if another run is writing it, or it cannot be written: any OSError of the block.
    """
    target = Path(os.path.abspath(path))
    try:
        with _claim(target) as private:
            yield private / target.name
            os.replace(private / target.name, target)
    except OSError as error:
        raise InputError(f"{path} cannot be written ({error.strerror}); choose another place") from error


_PRIVATE_MODE = 0o700  # permission bits; nobody else may look into a result that is half written
_CLAIM_ATTEMPTS = 100  # attempts; each fails only if somebody removed the folder in the same instant
_claimed: ContextVar[Path | None] = ContextVar("_claimed", default=None)
"""The private folder that `claimed_output` holds around the running code."""


@contextmanager
def _claim(folder: Path) -> Iterator[Path]:
    """Yield the private folder of a place, locked and empty; it and the parents made for it vanish."""
    private = folder.parent / f".shapefit-{hashlib.sha256(os.fsencode(folder.name)).hexdigest()[:16]}.partial"
    if _claimed.get() == private:
        yield private
        return
    with ExitStack() as resources:
        for parent in reversed(folder.parents):
            if not os.path.lexists(parent):
                resources.callback(_remove_empty, parent)  # the deepest first
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            remove_abandoned(folder.parent, ".shapefit-*.partial")
            resources.enter_context(locked_folder(private))
        except FileExistsError:
            raise InputError(
                f"another run is writing {folder}; wait until it is done, or remove {private} if none is"
            ) from None
        except OSError as error:
            raise InputError(
                f"{folder} cannot be written ({error.strerror}); choose another place"
            ) from error
        yield private


def _remove_empty(folder: Path) -> None:
    """Remove a folder unless it is missing or holds what somebody put there."""
    with suppress(OSError):
        folder.rmdir()


@contextmanager
def locked_folder(path: Path) -> Iterator[Path]:
    """Make a folder that only this user may enter, hold its lock, and remove it with all it holds.

    Raises FileExistsError if somebody alive holds it, or if a lock cannot show that nobody does.
    """
    try:
        descriptor = _lock(path)
    except KeyboardInterrupt:
        remove_abandoned(path.parent, path.name)
        raise
    try:
        yield path
    finally:
        try:
            _remove(path)
        finally:
            os.close(descriptor)  # only now: an unlocked folder counts as abandoned


def _remove(folder: Path) -> None:
    """Remove a folder with all it holds; an interrupt meanwhile goes on when it is gone."""
    try:
        shutil.rmtree(folder, ignore_errors=True)
    except KeyboardInterrupt:
        shutil.rmtree(folder, ignore_errors=True)
        raise


@contextmanager
def private_folder() -> Iterator[Path]:
    """Make a temporary folder as `locked_folder`; first, remove those that killed runs have left.

    Raises InputError if there is no place for it.
    """
    with ExitStack() as stack:
        try:
            parent = Path(tempfile.gettempdir())
            remove_abandoned(parent, ".shapefit-*.copy")
            folder = stack.enter_context(locked_folder(parent / f".shapefit-{secrets.token_hex(8)}.copy"))
        except OSError as error:
            raise InputError(f"no temporary folder can be made ({error.strerror}); set TMPDIR") from None
        yield folder


def remove_abandoned(parent: Path, pattern: str) -> None:
    """Remove this user's locked folders whose owner is dead; those that are locked, or another's, stay."""
    for path in parent.glob(pattern):
        with suppress(OSError):
            descriptor = _opened(path)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(path, ignore_errors=True)
            finally:
                os.close(descriptor)


def _lock(path: Path) -> int:
    """Make and lock a folder and return the descriptor that holds the lock."""
    for _ in range(_CLAIM_ATTEMPTS):
        path.mkdir(mode=_PRIVATE_MODE)
        with suppress(FileNotFoundError):  # somebody took it for abandoned in this very instant
            descriptor = _opened(path)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(descriptor)
                continue
            except KeyboardInterrupt:
                os.close(descriptor)
                raise
            except OSError:  # a file system without locks: the folder's existence has to do
                return descriptor
            if _is_same(path, descriptor):
                return descriptor
            os.close(descriptor)
    raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))


def _opened(path: Path) -> int:
    """Open a folder, not a link to one, that belongs to this user alone."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    status = os.fstat(descriptor)
    if status.st_uid != os.geteuid() or stat.S_IMODE(status.st_mode) & 0o077:
        os.close(descriptor)
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM), str(path))
    return descriptor


def _is_same(path: Path, descriptor: int) -> bool:
    """Tell whether a path still leads to the folder that was opened."""
    try:
        return os.path.samestat(os.stat(path, follow_symlinks=False), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _refuse_protected(folder: Path, protect: Sequence[Path | str]) -> None:
    """Refuse a folder that is, or contains, one of the protected paths, however they are spelled."""
    real = Path(os.path.realpath(folder))
    for path in protect:
        if Path(os.path.realpath(path)).is_relative_to(real):
            raise InputError(
                f"{folder} is or contains the input {path}; choose another folder for the output"
            )


def _copy(file: Path, target: Path) -> None:
    """Put a file, if there is one, at another place too: by a link, or where none can be made by a copy."""
    if not file.is_file():
        return
    try:
        os.link(file, target)
    except OSError:
        shutil.copy2(file, target)


def _refuse_existing(folder: Path, *, overwrite: bool, kept: Sequence[str] = ()) -> None:
    """Refuse whatever exists at `folder`, unless it has files to keep alone, or may be overwritten."""
    if not folder.is_dir():
        raise InputError(f"{folder} is a file; give the name of a new folder")
    try:
        is_empty = all(path.name in kept for path in folder.iterdir())
    except OSError as error:
        raise InputError(f"{folder} cannot be read ({error.strerror}); choose another folder") from error
    if is_empty:  # users of COLMAP make it first
        return
    is_replaceable = any((folder / marker).is_file() for marker in (MARKER, MAP_MARKER))
    if not overwrite:
        hint = ", or replace it (overwrite=True)" if is_replaceable else ""
        raise InputError(f"{folder} exists already; choose another folder{hint}")
    if not is_replaceable:
        raise InputError(
            f"{folder} holds files but no {MARKER} or {MAP_MARKER}, so it is not overwritten; "
            "choose another folder"
        )


_AT_FDCWD, _NO_REPLACE, _EXCHANGE = -100, 1, 2  # arguments of renameat2; see Linux's fcntl.h and fs.h
_UNSUPPORTED = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP)


def _move_into_place(partial: Path, folder: Path, *, overwrite: bool, kept: Sequence[str] = ()) -> None:
    """Rename `partial` to `folder`; an old folder is where `partial` was afterwards, or as it was before."""
    if not os.path.lexists(folder):
        try:
            if not _renamed_at_once(partial, folder, _NO_REPLACE):
                partial.rename(folder)
        except FileExistsError:
            raise InputError(f"{folder} exists already, made by another program meanwhile") from None
        return
    _refuse_existing(folder, overwrite=overwrite, kept=kept)
    if _renamed_at_once(partial, folder, _EXCHANGE):
        return
    old = partial.with_name(f"{partial.name}.old")
    try:
        folder.rename(old)
        partial.rename(folder)
    except BaseException:
        if old.exists() and not os.path.lexists(folder):
            old.rename(folder)
        raise


def _renamed_at_once(source: Path, target: Path, how: int) -> bool:
    """Rename by Linux's renameat2; False, and nothing is done, where system or file system cannot."""
    renameat2 = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if renameat2 is None:
        return False
    ctypes.set_errno(0)
    if renameat2(_AT_FDCWD, os.fsencode(source), _AT_FDCWD, os.fsencode(target), how) == 0:
        return True
    code = ctypes.get_errno()
    if code in _UNSUPPORTED:
        return False
    raise OSError(code, os.strerror(code), str(target))
