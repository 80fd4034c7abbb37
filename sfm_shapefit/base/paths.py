"""What a path may be before it is opened: an ordinary file, a folder, an image inside one."""

import os
import stat
from pathlib import Path

from sfm_shapefit.base.errors import InputError

OF_DATABASE = "database"
"""In place of a table or folder: what the database itself has."""
SOLVED = "solved"
"""In place of a file of names of images: those that observe a 3D point."""
MASKS = "that of the masks, NAME.png for image NAME"
PICTURES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"})
"""Suffixes of the images that pycolmap reads."""
VIDEOS = frozenset({".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".insv", ".360"})
TAKE_FRAMES = "take frames, as with `ffmpeg -i VIDEO -vf fps=2 -qscale:v 2 FRAMES/%05d.jpg`, and map FRAMES"
"""What to do with a video."""


def refuse_irregular_file(path: Path) -> None:
    """Refuse what is neither a file nor missing: reading a pipe waits for ever, and a device may have no end.

    Raises:
        InputError: if `path` is, or links to, a folder, a pipe, a socket or a device.
    """
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return  # whoever opens it says why it cannot be read
    if stat.S_ISDIR(mode):
        raise InputError(f"{path} cannot be read: Is a directory")
    if not stat.S_ISREG(mode):
        raise InputError(f"{path} cannot be read: it is a pipe or a device; give an ordinary file")


def refuse_absent(*paths: Path | None) -> None:
    """Refuse inputs that are not there, which whoever reads them says too late for who has to wait.

    Raises:
        InputError: for the first of them; None passes.
    """
    for path in paths:
        if path is not None and not os.path.exists(path):
            raise InputError(f"{path} does not exist")


def refuse_no_folder(
    folder: Path, wanted: str = "the one to which the names of the images are relative"
) -> None:
    """Refuse what is no folder, of images unless something else is wanted.

    Raises:
        InputError: a sentence that says so.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; give {wanted}")


def from_here(path: str) -> str:
    """Return a path as it is typed in the working folder."""
    return path.removeprefix(f"{Path.cwd()}/")


def file_of(folder: Path, name: str) -> Path | None:
    """Return the file of an image, if there is one inside the folder."""
    try:
        path, root = (folder / name).resolve(), folder.resolve()
        return path if path.is_relative_to(root) and path.is_file() else None
    except (OSError, ValueError, RuntimeError):  # the last for links that go round in circles
        return None
