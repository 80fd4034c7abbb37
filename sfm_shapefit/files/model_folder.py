"""What a folder must have to be a COLMAP model; to ask that takes none of the libraries that read one."""

import itertools
from pathlib import Path

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.lines import refuse_database

REQUIRED_FILES = ("cameras", "images")
"""Files without which there are no poses; one of points3D is part of a model all the same."""


def refuse_no_model(path: Path | None) -> None:
    """Refuse a folder without a model, before what reads models is loaded; other paths pass.

    Raises:
        InputError: as `model_suffix`.
    """
    if path is not None and path.is_dir():
        model_suffix(path)


def model_folders(folder: Path) -> list[Path]:
    """Return the models in a folder that has none itself, by the numbers that COLMAP's mapper gives."""
    try:
        inner = [entry for entry in folder.iterdir() if entry.name.isdecimal()]
        has_own = any((folder / f"images{suffix}").exists() for suffix in (".bin", ".txt"))
        models = [one for one in inner if any((one / f"images{s}").is_file() for s in (".bin", ".txt"))]
    except OSError:  # what cannot be read is refused as a model
        return []
    return [] if has_own else sorted(models, key=lambda one: int(one.name))


def model_suffix(folder: Path) -> str:
    """Return ".bin" or ".txt": the format in which pycolmap would read the model in `folder`.

    Raises:
        InputError: if `folder` is not a readable folder with a complete model in one of the two formats.
    """
    try:
        if folder.exists() and not folder.is_dir():
            refuse_database(folder)
            raise InputError(
                f"{folder} is a file; give the folder that holds cameras, images and points3D "
                "(`convert` makes one of OpenSfM's reconstruction.json; `locate` takes transforms.json)"
            )
        present = {entry.name for entry in folder.iterdir()}
    except FileNotFoundError:
        raise InputError(f"the model folder {folder} does not exist") from None
    except OSError as error:
        raise InputError(f"the model folder {folder} cannot be read: {error.strerror}") from None

    for names in ((*REQUIRED_FILES, "points3D"), REQUIRED_FILES):
        for suffix in (".bin", ".txt"):
            if all(name + suffix in present for name in names):
                return suffix
    raise InputError(_missing_files_message(folder, present))


def _missing_files_message(folder: Path, present: set[str]) -> str:
    """Return the sentence about a folder without a complete model, with the likely folder if there is one."""
    for suffix in (".bin", ".txt"):
        missing = [name + suffix for name in REQUIRED_FILES if name + suffix not in present]
        if len(missing) < len(REQUIRED_FILES):
            needs = "a COLMAP model needs cameras, images and points3D, all .bin or all .txt"
            return f"{folder} lacks {' and '.join(missing)}; {needs}"
    for inner, suffix in itertools.product(("0", "sparse/0", "sparse"), (".bin", ".txt")):
        if all((folder / inner / (name + suffix)).is_file() for name in REQUIRED_FILES):
            return f"{folder} holds no COLMAP model, but {folder / inner} does; give that folder"
    return f"{folder} holds no COLMAP model; give the folder with cameras, images and points3D (.bin or .txt)"
