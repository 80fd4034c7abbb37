"""`convert`: a model of any format that is read, written in any format that is written.

    colmap        a folder, binary            .../            cameras, images, points3D, rigs, frames
    colmap-txt    a folder, text
    nerf          transforms.json             .json           nerfstudio, instant-ngp
    tum           trajectory                  .tum, .txt      evo, SLAM tools
    csv           name, center, rotation      .csv

Only the COLMAP formats hold points.
"""

import os
import secrets
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from sfm_shapefit.base.atomic_folder import atomic_folder
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.other_programs import posed_model_of
from sfm_shapefit.files.colmap.seed import write_model
from sfm_shapefit.files.nerf import nerf_text
from sfm_shapefit.files.tum import poses_csv, tum_text

if TYPE_CHECKING:
    import pycolmap

Format = Literal["colmap", "colmap-txt", "nerf", "tum", "csv"]

_BY_SUFFIX: dict[str, Format] = {"": "colmap", ".json": "nerf", ".tum": "tum", ".txt": "tum", ".csv": "csv"}
_TEXTS = {"nerf": nerf_text, "tum": tum_text, "csv": poses_csv}


def convert(
    source: "pycolmap.Reconstruction | Path | str",
    target: Path | str,
    *,
    target_format: Format | None = None,
    overwrite: bool = False,
) -> Format:
    """Write the posed images of a model in another format.

    Args:
        source: a COLMAP folder, a model file of Bundler, openMVG or OpenSfM, or a reconstruction.
        target: the file, or for COLMAP's formats the folder, to be made.
        target_format: by the suffix of `target` if None.
        overwrite: replace an existing file; folders are never replaced.

    Returns:
        The format that was written.

    Raises:
        InputError: if the source cannot be read, the format cannot hold it, or the target exists already.
    """
    path = Path(target)
    if target_format is None:
        if path.suffix.lower() not in _BY_SUFFIX:
            raise InputError(f"{path} has no known suffix; give the format: {', '.join(get_args(Format))}")
        target_format = _BY_SUFFIX[path.suffix.lower()]
    model = read_model(source).reconstruction
    if target_format in _TEXTS:
        _write_text(_TEXTS[target_format](posed_model_of(model)), path, overwrite=overwrite)
        return target_format
    protect = [source] if isinstance(source, Path | str) else []
    with atomic_folder(path, protect=protect) as folder:
        write_model(model, folder, text=target_format == "colmap-txt")
    return target_format


def _write_text(text: str, path: Path, *, overwrite: bool) -> None:
    """Write a file whole or not at all."""
    if path.is_dir() or (path.exists() and not overwrite):
        raise InputError(f"{path} exists already; choose another name, or replace it with --overwrite")
    partial = path.with_name(f".shapefit-{secrets.token_hex(8)}.partial")
    try:
        partial.write_text(text, encoding="utf-8", errors="surrogateescape")
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise InputError(f"{path} cannot be written ({error.strerror}); choose another file") from error
