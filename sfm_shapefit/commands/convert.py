"""`convert`: a model of any format that is read, written in any format that is written.

COLMAP's formats and .ply hold all points, .glb as many as `report.html` shows; meshes have an output's
cameras in the colors of their trust. A new format is a line of `FORMATS`, and the file of the function that
it names.
"""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sfm_shapefit.base.atomic_folder import MARKER, atomic_file, atomic_folder
from sfm_shapefit.base.errors import InputError

if TYPE_CHECKING:
    from sfm_shapefit.files.colmap.model import ColmapModel, ModelSource
    from sfm_shapefit.files.colmap.world import World

_POINTS = "_points.ply"  # behind the stem of a transforms.json


class ExportFormat(NamedTuple):
    """A format in which models are written."""

    help: str
    """What it is, for the help of `convert`."""
    step: str
    """What to do with OUT next."""
    suffixes: tuple[str, ...] = ()
    """Suffixes of files that have this format where none is named."""
    text_of: str = ""
    """Function that makes the text of a file from the posed images, as module:function of `files`."""
    is_exact: bool = False
    """Whether places go to another system of coordinates each for itself, not as one model; see `World`."""


FORMATS = {
    "colmap": ExportFormat("a folder", "sfm-shapefit check {out}", ("",)),
    "colmap-txt": ExportFormat("a folder of text files", "sfm-shapefit check {out}"),
    "nerf": ExportFormat(
        "transforms.json of nerfstudio and instant-ngp",
        "put the images into images/ beside {out}, and train on it with nerfstudio or instant-ngp",
        (".json",),
        "nerf:nerf_text",
    ),
    "tum": ExportFormat(
        "a trajectory for evo and SLAM tools",
        "sfm-shapefit evaluate {out} REF",
        (".tum", ".txt"),
        "tum:tum_text",
        is_exact=True,
    ),
    "csv": ExportFormat(
        "name, center and rotation of each camera",
        "read {out} with pandas or a spreadsheet",
        (".csv",),
        "tum:poses_csv",
        is_exact=True,
    ),
    "glb": ExportFormat(
        "a mesh of cameras and points for 3D viewers", "open {out} in a 3D viewer", (".glb",)
    ),
    "ply": ExportFormat(
        "all points, and cameras in a second file",
        "open {out} in a viewer of point clouds",
        (".ply",),
        is_exact=True,
    ),
    "covariances": ExportFormat(
        "CSV of the centers' 3 x 3 covariances in an output",
        "read {out} with pandas or a spreadsheet",
        is_exact=True,
    ),
}

_FOLDERS = {"colmap", "colmap-txt"}
_SUFFIXES = ", ".join(
    f"{' or '.join(one.suffixes)} ({name})" for name, one in FORMATS.items() if any(one.suffixes)
)


def convert(
    source: "ModelSource",
    target: Path | str,
    *,
    target_format: str | None = None,
    overwrite: bool = False,
    crs: str = "",
    offset: str = "",
) -> Path:
    """Write the posed images of a model in another format.

    Args:
        source: a COLMAP folder, which may be an output, a reconstruction, a result, OpenSfM's
            reconstruction.json, or a list of poses: transforms.json, a trajectory.
        target: the file, or for COLMAP's formats the folder, to be made. Beside a .ply with the points stands
            one with the cameras, *_cameras.ply; beside a transforms.json one with the points, *_points.ply,
            and it looks for the images in images/ there.
        target_format: one of `FORMATS`; by the suffix of `target` if None.
        overwrite: replace an existing file; folders are never replaced.
        crs: system of coordinates on Earth, "utm" or a code of `files.colmap.earth`; empty: the model's own.
        offset: three numbers with commas that are subtracted from all coordinates, or "auto"; they stand in
            *_offset.xyz beside the file, in offset.xyz in a folder.

    Returns:
        The file or folder that was made; others stand beside it.

    Raises:
        InputError: if the source cannot be read, the format cannot hold it, the target exists already, or
            the model cannot be brought to the system.
    """
    return write_converted(source, Path(target), target_format, overwrite, (crs, offset)).files[0]


class Converted(NamedTuple):
    """What was written."""

    format: str
    files: tuple[Path, ...]
    """The file or folder, and files beside it."""
    statement: str
    """System and offset of the coordinates, and what they lack; empty for the model's own."""


def write_converted(
    source: "ModelSource",
    path: Path,
    target_format: str | None,
    overwrite: bool,
    coordinates: tuple[str, str],
) -> Converted:
    """Write a model in another format, in a system and with an offset; `convert` raises the same."""
    # Here, so that the command line knows the formats without loading pycolmap.
    from sfm_shapefit.base.paths import refuse_absent
    from sfm_shapefit.facts.tables import model_datum
    from sfm_shapefit.files.colmap.listed_poses import read_by_itself
    from sfm_shapefit.files.colmap.model import model_of, read_model
    from sfm_shapefit.files.colmap.reconstructions import transform_model
    from sfm_shapefit.files.colmap.world import is_too_far, world_of
    from sfm_shapefit.files.output_paths import refuse_file

    name = target_format or _format_of(path)
    if name not in FORMATS:
        raise InputError(f"{name!r} is no format to write; give one of {', '.join(FORMATS)}")
    protect = [Path(source)] if isinstance(source, Path | str) else []
    refuse_absent(*protect)
    if name not in _FOLDERS:
        refuse_file(path, overwrite=overwrite, protect=protect)
    given, source = source, model_of(source)
    trust = _trust_of(source) if name in {"glb", "ply"} else {}
    model = read_by_itself(source, with_lenses=name not in {"tum", "csv"})
    notes = model.notes
    centers = model.images.centers
    world = world_of(model_datum(given) if coordinates[0] else None, centers, *coordinates)
    statement = world.statement
    if not (world.is_own or FORMATS[name].is_exact):
        model = read_model(transform_model(model.reconstruction, world.similarity(centers)))
        statement += world.bend_statement(centers)
    if name == "nerf" and is_too_far(model.images.centers):  # its readers take float32
        notes = (*notes, "too far from the origin for float32; give offset=auto")
    statement = "; ".join(filter(None, [statement, *notes]))
    if name in _FOLDERS:
        _write_folder(model, path, name, world, protect)
        return Converted(name, (path,), statement)
    contents = _contents(name, _Scene(source, model, world, trust, path.stem))
    files = {
        path.with_name(path.stem + (tail if "." in tail else tail + path.suffix)): one
        for tail, one in contents.items()
    }
    if world.offset_line:
        files[path.with_name(f"{path.stem}_offset.xyz")] = world.offset_line
    for file in files:  # before the first is written
        refuse_file(file, overwrite=overwrite, protect=protect)
    with ExitStack() as whole:  # all are written before the first is in its place
        for file, content in files.items():
            whole.enter_context(atomic_file(file)).write_bytes(content)
    return Converted(name, tuple(files), statement)


class _Scene(NamedTuple):
    source: "ModelSource"
    model: "ColmapModel"
    world: "World"
    trust: Mapping[str, float]
    """By the names of images."""
    stem: str
    """Name of the target without its suffix."""


def _contents(name: str, scene: _Scene) -> dict[str, bytes]:
    """Return the content of each file, by what its name has behind the target's stem: also another suffix."""
    images, world = scene.model.images, scene.world
    if name == "nerf" and scene.model.num_points:
        from sfm_shapefit.report.mesh import nerf_files

        beside = f"{scene.stem}{_POINTS}"
        return dict(zip(("", _POINTS), nerf_files(scene.model, beside), strict=True))
    if name == "ply":
        return _points_and_cameras(scene)
    if name == "glb":
        from sfm_shapefit.report.mesh import glb_bytes
        from sfm_shapefit.report.results import draw_model

        return {"": glb_bytes(draw_model(scene.model, scene.trust))}
    if name == "covariances":
        return {"": _covariances(scene).encode(errors="backslashreplace")}
    module, _, function = FORMATS[name].text_of.partition(":")
    text_of = getattr(import_module(f"sfm_shapefit.files.{module}"), function)
    text: str = text_of(world.poses(images) if FORMATS[name].is_exact else images)
    return {"": text.encode(errors="backslashreplace")}


def _points_and_cameras(scene: _Scene) -> dict[str, bytes]:
    """Return all points of a model as a PLY, as COLMAP writes them, and its cameras as pyramids."""
    from sfm_shapefit.files.colmap.seed import pick_points
    from sfm_shapefit.report.mesh import camera_mesh, ply_bytes
    from sfm_shapefit.report.results import draw_model

    world = scene.world
    points = pick_points(scene.model.arrays, scene.model.num_points)
    vertices, faces, colors = camera_mesh(draw_model(scene.model, scene.trust))
    how: Any = {"comment": world.statement, "fine": not world.is_own}
    return {
        "": ply_bytes(world.places(points.xyz), points.colors, **how),
        "_cameras": ply_bytes(world.places(vertices), colors, faces, **how),
    }


def _covariances(scene: _Scene) -> str:
    from sfm_shapefit.facts.rows import covariances_text, read_covariances

    if not isinstance(scene.source, Path | str):
        raise InputError("covariances are those of the folder that locate or map wrote; give that")
    images = scene.model.images
    covariances = read_covariances(Path(scene.source) / "covariances.csv")
    slopes = dict(zip(images.names, scene.world.slopes(images.centers), strict=True))
    return covariances_text(
        {k: slopes[k] @ one @ slopes[k].T for k, one in covariances.items() if k in slopes}
    )


def _write_folder(
    model: "ColmapModel", path: Path, name: str, world: "World", protect: Sequence[Path | str]
) -> None:
    from sfm_shapefit.files.colmap.seed import write_model

    if path.is_dir() and any(path.iterdir()):
        raise InputError(f"{path} is a folder with files, which is never replaced; choose another name")
    with atomic_folder(path, protect=protect) as folder:
        write_model(model.arrays, folder, text=name == "colmap-txt")
        if world.offset_line:
            (folder / "offset.xyz").write_bytes(world.offset_line)


def _format_of(path: Path) -> str:
    for name, one in FORMATS.items():
        if path.suffix.lower() in one.suffixes:
            return name
    raise InputError(
        f"no format has the suffix of {path}; name it {_SUFFIXES}, or a folder, or name the format"
    )


def _trust_of(source: "ModelSource") -> dict[str, float]:
    """Return the trust of an output's cameras, by name; nothing of other models."""
    from sfm_shapefit.facts.tables import read_trust

    if not isinstance(source, Path | str) or not (Path(source) / MARKER).is_file():
        return {}
    if not any((Path(source) / f"images{suffix}").exists() for suffix in (".bin", ".txt")):
        raise InputError(f"{source} is of a bare graph and has no model; its report.html has the scene")
    return read_trust(Path(source) / "cameras.csv")
