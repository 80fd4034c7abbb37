"""Which format a model file has: known by its content."""

from pathlib import Path

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.bundler import is_bundler, read_bundler
from sfm_shapefit.files.json_node import read_json
from sfm_shapefit.files.openmvg import is_openmvg, read_openmvg
from sfm_shapefit.files.opensfm import is_opensfm, read_opensfm
from sfm_shapefit.scene.posed_model import PosedModelFile

_SUFFIXES = (".json", ".out")


def is_model_file(path: Path | str) -> bool:
    """Return whether a path is a file that could be a model: Bundler's, openMVG's or OpenSfM's."""
    file = Path(path)
    return file.is_file() and (file.suffix.lower() in _SUFFIXES or is_bundler(file))


def read_model_file(path: Path | str) -> PosedModelFile:
    """Read a model file of Bundler, openMVG or OpenSfM.

    Raises:
        InputError: if it is none of them, or malformed; the message names line or key.
    """
    file = Path(path)
    if is_bundler(file):
        return read_bundler(file)
    if file.suffix.lower() == ".json":
        content = read_json(file)
        if is_openmvg(content):
            return read_openmvg(file, content)
        if is_opensfm(content):
            return read_opensfm(file, content)
    raise InputError(
        f"{file} is no model: give a COLMAP folder, Bundler's .out, openMVG's sfm_data.json or OpenSfM's "
        "reconstruction.json"
    )
