"""`convert`: a model of any format that is read, written in any format that is written.

    colmap        a folder, binary            .../            cameras, images, points3D, rigs, frames
    colmap-txt    a folder, text
    nerf          transforms.json             .json           nerfstudio, instant-ngp
    tum           trajectory                  .tum, .txt      evo, SLAM tools
    csv           name, center, rotation      .csv
    mesh          scene of pyramids, points   .glb, .ply      3D viewers; an output's cameras have their trust

Only COLMAP's formats hold all points; a mesh shows as many as `report.html` does.
"""

import os
import secrets
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from sfm_shapefit.base.atomic_folder import MARKER, atomic_folder
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.other_programs import posed_model_of, reconstruction_of
from sfm_shapefit.files.colmap.seed import write_model
from sfm_shapefit.files.nerf import nerf_text
from sfm_shapefit.files.opensfm import read_opensfm
from sfm_shapefit.files.tum import poses_csv, tum_text

if TYPE_CHECKING:
    import pycolmap

    from sfm_shapefit.report.drawing import Drawing

Format = Literal["colmap", "colmap-txt", "nerf", "tum", "csv", "glb", "ply"]

_BY_SUFFIX: dict[str, Format] = {
    **{"": "colmap", ".json": "nerf", ".tum": "tum", ".txt": "tum", ".csv": "csv"},
    **{".glb": "glb", ".ply": "ply"},
}
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
        source: a COLMAP folder, which may be an output, a reconstruction, or OpenSfM's reconstruction.json.
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
    protect = [source] if isinstance(source, Path | str) else []
    if isinstance(source, Path | str) and Path(source).suffix.lower() == ".json":
        source = reconstruction_of(read_opensfm(Path(source)), source)
    if target_format in ("glb", "ply"):
        from sfm_shapefit.report.mesh import mesh_bytes

        _write_file(mesh_bytes(_drawing_of(source), target_format), path, overwrite=overwrite)
        return target_format
    model = read_model(source).reconstruction
    if target_format in _TEXTS:
        text = _TEXTS[target_format](posed_model_of(model))
        _write_file(text.encode(errors="surrogateescape"), path, overwrite=overwrite)
        return target_format
    with atomic_folder(path, protect=protect) as folder:
        write_model(model, folder, text=target_format == "colmap-txt")
    return target_format


def _drawing_of(source: "pycolmap.Reconstruction | Path | str") -> "Drawing":
    """Return what a mesh shows of a model: of an output with the trust of its cameras."""
    from sfm_shapefit.report.read_back import draw_model, read_output

    if not isinstance(source, Path | str) or not (Path(source) / MARKER).is_file():
        return draw_model(read_model(source))
    drawing, _ = read_output(Path(source))
    if drawing.noun == "node":
        raise InputError(f"{source} is of a bare graph and has no model; its report.html has the scene")
    return drawing


def _write_file(content: bytes, path: Path, *, overwrite: bool) -> None:
    """Write a file whole or not at all."""
    if path.is_dir() or (path.exists() and not overwrite):
        raise InputError(f"{path} exists already; choose another name, or replace it with --overwrite")
    partial = path.with_name(f".shapefit-{secrets.token_hex(8)}.partial")
    try:
        partial.write_bytes(content)
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise InputError(f"{path} cannot be written ({error.strerror}); choose another file") from error
