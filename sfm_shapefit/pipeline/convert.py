"""`convert`: a model of any format that is read, written in any format that is written.

Only COLMAP's formats hold all points; a mesh shows as many as `report.html` does, and an output's cameras in
the colors of their trust. A new format is a line of `FORMATS`, and the file of the function that it names.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from sfm_shapefit.base.atomic_folder import MARKER, atomic_file, atomic_folder
from sfm_shapefit.base.errors import InputError

if TYPE_CHECKING:
    from sfm_shapefit.files.colmap.model import ModelSource
    from sfm_shapefit.report.drawing import Drawing


class ExportFormat(NamedTuple):
    """A format in which models are written."""

    help: str
    """What it is, for the help of `convert`."""
    suffixes: tuple[str, ...] = ()
    """Suffixes of files that have this format where none is named."""
    text_of: str = ""
    """Function that makes the text of a file from the posed images, as module:function of `files`."""


FORMATS = {
    "colmap": ExportFormat("a folder", ("",)),
    "colmap-txt": ExportFormat("a folder of text files"),
    "nerf": ExportFormat("transforms.json of nerfstudio and instant-ngp", (".json",), "nerf:nerf_text"),
    "tum": ExportFormat("a trajectory for evo and SLAM tools", (".tum", ".txt"), "tum:tum_text"),
    "csv": ExportFormat("name, center and rotation of each camera", (".csv",), "tum:poses_csv"),
    "glb": ExportFormat("a mesh of cameras and points for 3D viewers", (".glb",)),
    "ply": ExportFormat("the same in the model's own axes", (".ply",)),
}

_FOLDERS = {"colmap", "colmap-txt"}


def convert(
    source: "ModelSource",
    target: Path | str,
    *,
    target_format: str | None = None,
    overwrite: bool = False,
) -> str:
    """Write the posed images of a model in another format.

    Args:
        source: a COLMAP folder, which may be an output, a reconstruction, a result, or OpenSfM's
            reconstruction.json.
        target: the file, or for COLMAP's formats the folder, to be made.
        target_format: one of `FORMATS`; by the suffix of `target` if None.
        overwrite: replace an existing file; folders are never replaced.

    Returns:
        The format that was written.

    Raises:
        InputError: if the source cannot be read, the format cannot hold it, or the target exists already.
    """
    # Here, so that the command line knows the formats without loading pycolmap.
    from sfm_shapefit.files.colmap.model import model_of, read_model
    from sfm_shapefit.files.colmap.other_programs import reconstruction_of
    from sfm_shapefit.files.colmap.seed import write_model
    from sfm_shapefit.files.opensfm import read_opensfm
    from sfm_shapefit.pipeline.write import refuse_file

    path = Path(target)
    name = target_format or _format_of(path)
    if name not in FORMATS:
        raise InputError(f"{name!r} is no format to write; give one of {', '.join(FORMATS)}")
    source = model_of(source)
    protect = [source] if isinstance(source, Path | str) else []
    if name not in _FOLDERS:
        refuse_file(path, overwrite=overwrite, protect=protect)
    if isinstance(source, Path | str) and Path(source).suffix.lower() == ".json":
        source = reconstruction_of(read_opensfm(Path(source)))
    if name in {"glb", "ply"}:
        from sfm_shapefit.report.mesh import mesh_bytes

        content = mesh_bytes(_drawing_of(source), name)
        with atomic_file(path) as partial:
            partial.write_bytes(content)
        return name
    model = read_model(source)
    if FORMATS[name].text_of:
        module, _, function = FORMATS[name].text_of.partition(":")
        text: str = getattr(import_module(f"sfm_shapefit.files.{module}"), function)(model.images)
        with atomic_file(path) as partial:
            partial.write_bytes(text.encode(errors="surrogateescape"))
        return name
    if path.is_dir() and any(path.iterdir()):
        raise InputError(f"{path} is a folder with files, which is never replaced; choose another name")
    with atomic_folder(path, protect=protect) as folder:
        write_model(model.reconstruction, folder, text=name == "colmap-txt")
    return name


def _format_of(path: Path) -> str:
    for name, one in FORMATS.items():
        if path.suffix.lower() in one.suffixes:
            return name
    raise InputError(f"{path} has no known suffix; give the format: {', '.join(FORMATS)}")


def _drawing_of(source: "ModelSource") -> "Drawing":
    """Return what a mesh shows of a model: of an output with the trust of its cameras."""
    from sfm_shapefit.facts.tables import read_trust
    from sfm_shapefit.files.colmap.model import read_model
    from sfm_shapefit.report.results import draw_model

    if not isinstance(source, Path | str) or not (Path(source) / MARKER).is_file():
        return draw_model(read_model(source), {})
    if not any((Path(source) / f"images{suffix}").exists() for suffix in (".bin", ".txt")):
        raise InputError(f"{source} is of a bare graph and has no model; its report.html has the scene")
    return draw_model(read_model(source), read_trust(Path(source) / "cameras.csv"))
