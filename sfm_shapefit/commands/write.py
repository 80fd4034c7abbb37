"""OUT on disk: the seeded model, `locate.json`, `cameras.csv`, `pairs.csv`, `report.html`.

Further parallel-rigid pieces stand in `pieces/1`, `pieces/2`, ...: a seeded model and a `cameras.csv` each. A
bare graph has no model. `map` has such a folder per model, `0`, `1`, ..., and `map.json` beside them; models
that were joined stand in `joined_0` in one world too.
"""

import os
from collections.abc import Collection, Iterable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from sfm_shapefit.base.atomic_folder import MAP_MARKER, MARKER, atomic_file, atomic_folder
from sfm_shapefit.base.display import Reported, Writers
from sfm_shapefit.base.errors import InputError, ShapeFitError
from sfm_shapefit.base.paths import file_of, refuse_irregular_file, refuse_no_folder
from sfm_shapefit.base.record import write_json
from sfm_shapefit.base.settings import Settings, explained, merge_options, option
from sfm_shapefit.base.threads import count_threads
from sfm_shapefit.base.wording import counted, first_of
from sfm_shapefit.facts.map_result import JoinedModel, MapResult
from sfm_shapefit.facts.placed import IN_MEMORY, folder_of
from sfm_shapefit.facts.result import GraphResult, LocateResult
from sfm_shapefit.facts.rows import covariances_of, covariances_text, own_camera_rows
from sfm_shapefit.facts.tables import CameraRow, Table, write_rows
from sfm_shapefit.files.colmap.database import open_database
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.picture_colors import PictureFolder, color_model
from sfm_shapefit.files.colmap.seed import pick_points, write_model
from sfm_shapefit.files.colmap.track_matches import TrackMatches
from sfm_shapefit.files.matching_options import MADE_FIRST, SIDECARS
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import Matches
from sfm_shapefit.tracks.structure_options import StructureOptions

if TYPE_CHECKING:
    from sfm_shapefit.report.drawing import Drawing
    from sfm_shapefit.report.matched import DrawnMatches

Result = TypeVar("Result", bound=LocateResult | GraphResult | MapResult | JoinedModel)

_PICKED = 1000  # points that are asked for a color; one that has it is enough
_WRITTEN = {".html", ".glb", ".ply", ".csv", ".json", ".tum", ".txt"}
"""Suffixes of single files that commands write, perhaps into the folder of a model."""
_READ = {
    *(MARKER, MAP_MARKER, "cameras.csv", "pairs.csv", "doubtful_pairs.csv"),
    *(f"{name}.txt" for name in ("cameras", "images", "points3D", "rigs", "frames")),
}
"""Files with such suffixes that are part of a model or of an output."""


@explained
@dataclass(frozen=True, kw_only=True)
class WriteOptions(Settings):
    """How a result is written."""

    overwrite: bool = option(False, "Replace an earlier output of this package.")
    protect: tuple[Path | str, ...] = option(
        (), "Paths that the folder must not be or contain, beside the inputs of the result."
    )
    report: bool = option(True, "Write report.html, one page that explains the result and works offline.")
    images: Path | str = option(
        "", "Folder of the images: points get their colors, and report.html has small pictures of them."
    )


def write_result(
    found: LocateResult | GraphResult | MapResult | JoinedModel,
    out: Path | str,
    *,
    options: WriteOptions | None = None,
    **overrides: Any,
) -> Path:
    """Write a result into a folder that appears whole or not at all: models, tables, a page for each.

    Args:
        found: what `locate`, `map_database`, `join` or `place_graph_file` returned.
        out: the folder to be made.
        options: settings, see `help(WriteOptions)`; defaults if None.
        **overrides: single options by name: `write_result(found, "out", overwrite=True)`.

    Returns:
        The folder.

    Raises:
        InputError: if the folder exists, cannot be written, or would hit a protected path.
    """
    deliver(found, out, merge_options(options, WriteOptions, overrides))
    return Path(out)


def deliver(found: Result, out: Path | str, options: WriteOptions) -> Result:
    """Write a result as `write_result` does, and return it with the colors that its points have there."""
    found = with_colors(found, options.images) if str(options.images) else found
    protect = [*_inputs_of(found), *options.protect]
    made = isinstance(found, MapResult) and found.images is not None
    kept = MADE_FIRST if made else ()
    with atomic_folder(out, overwrite=options.overwrite, protect=protect, kept=kept) as folder:
        if isinstance(found, MapResult):
            models = {str(number): model for number, model in enumerate(found.models)}
            for name, one in (models | {joined.folder: joined for joined in found.joined}).items():
                (folder / name).mkdir()
                _write_files(one, folder / name, Path(out) / name, options)
            write_json(found.summary(), folder / MAP_MARKER)
        else:
            _write_files(found, folder, Path(out), options)
    return found


def has_colors(found: LocateResult | GraphResult | MapResult | JoinedModel) -> bool:
    """Return whether points of a result, of several models the largest, have colors; none need no color."""
    if isinstance(found, GraphResult):
        return True
    shown = found.models[0] if isinstance(found, MapResult) else found
    picked = pick_points(shown.model if isinstance(shown, LocateResult) else shown.reconstruction, _PICKED)
    return not picked.num_all or bool(picked.colors.any())


def with_colors(found: Result, images: Path | str) -> Result:
    """Return a result whose points without a color have that of the pictures which see them.

    Pictures that are missing or cannot be read give none, and a warning says so.

    Args:
        found: the result; a bare graph has no points, and stays as it is.
        images: folder of the pictures.

    Raises:
        InputError: if the folder is none.
    """
    if isinstance(found, GraphResult):
        return found
    refuse_no_folder(Path(images))
    pictures = PictureFolder(Path(images), count_threads())
    unread: set[str] = set()
    colored: Any = _colored(found, pictures, unread)
    warnings = [*found.warnings, *_color_warnings(pictures.folder, found.image_names, sorted(unread))]
    if isinstance(found, JoinedModel):
        told: dict[str, Any] = {"facts": replace(found.facts, warnings=warnings)}
    else:
        told = {"warnings": tuple(warnings)}
    result: Result = replace(colored, **told)
    return result


def _colored(found: Any, pictures: PictureFolder, unread: set[str]) -> Any:
    """Return a result with colors; names of unreadable pictures are added to `unread`."""
    if isinstance(found, MapResult):
        models = [_colored(one, pictures, unread) for one in found.models]
        joined = [_colored(one, pictures, unread) for one in found.joined]
        return replace(found, models=tuple(models), joined=tuple(joined))
    if isinstance(found, JoinedModel):
        model, missed = color_model(found.reconstruction, pictures)
        unread.update(missed)
        return replace(found, reconstruction=model)
    seed, missed = found.seed.colored(pictures)
    unread.update(missed)
    further = [_colored(one, pictures, unread) for one in found.further]
    return replace(found, seed=seed, further=tuple(further))


def _color_warnings(folder: Path, names: Sequence[str], unread: Sequence[str]) -> list[str]:
    missing, said = sum(file_of(folder, name) is None for name in names), []
    if missing:
        said.append(f"{folder} lacks {missing} of {counted(len(names), 'image')}: is it the right folder?")
    if unread:
        said.append(f"{counted(len(unread), 'picture')} in {folder} cannot be read: {first_of(unread)}")
    return said


def _inputs_of(found: Any) -> list[Path]:
    if isinstance(found, LocateResult):
        return [path for path in (found.inputs.folder, found.inputs.database) if path is not None]
    if isinstance(found, MapResult) and found.images is not None:
        return [found.images]
    if isinstance(found, MapResult | GraphResult):
        return [found.database if isinstance(found, MapResult) else found.path]
    read = found.facts.inputs  # such are models that were joined or checked
    return [Path(path) for path in (read.model, read.database) if path and path != IN_MEMORY]


def _write_files(
    found: LocateResult | GraphResult | JoinedModel, folder: Path, called: Path, options: WriteOptions
) -> None:
    """Write a result into a folder, which will be `called` otherwise."""
    if isinstance(found, LocateResult):
        write_model(found.model, folder)
    elif isinstance(found, JoinedModel):
        write_model(found.reconstruction, folder)
    for piece in () if isinstance(found, JoinedModel) else found.further:
        placement = piece.placement if isinstance(piece, LocateResult) else piece
        subfolder = folder / folder_of(placement.piece)
        subfolder.mkdir(parents=True)
        if isinstance(piece, LocateResult):
            write_model(piece.model, subfolder)
            rows = piece.own_cameras
        else:
            rows = own_camera_rows(piece, piece.locations, 1.0)
        _write_cameras(rows, subfolder)
    _write_cameras(found.cameras, folder)
    write_rows(found.pairs, folder / "pairs.csv")
    if isinstance(found, LocateResult) and found.doubtful_pairs:
        write_rows(found.doubtful_pairs, folder / "doubtful_pairs.csv")
    write_json(found.facts.summary(), folder / MARKER)
    if options.report:
        _write_report(found, folder / "report.html", options.images, str(called))


def _write_cameras(rows: Table[CameraRow], folder: Path) -> None:
    """Write cameras.csv and, in space and where any is known, the covariances of centers."""
    write_rows(rows, folder / "cameras.csv")
    every = zip(rows.columns["name"], covariances_of(rows), strict=True)
    known = {name: one for name, one in every if np.isfinite(one).all()}
    if known and rows.dimension == 3:
        text = covariances_text(known)
        (folder / "covariances.csv").write_text(text, encoding="utf-8", errors="backslashreplace")


def write_page(
    found: Reported, page: Path | str, *, images: Path | str = "", overwrite: bool = False
) -> Path:
    """Write the report of a result to a file, and return it; see `Reported.report`."""
    refuse_file(
        Path(page), overwrite=overwrite, protect=[*_inputs_of(found), *([images] if str(images) else [])]
    )
    with atomic_file(Path(page)) as partial:
        has_pictures = _write_report(found, partial, images)
    if not has_pictures:
        raise InputError(f"{images} has none of the images, so {page} has no pictures")
    return Path(page)


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


def _draw_page(found: Any) -> str:
    from sfm_shapefit.report.page import report_html

    return report_html(_drawing_of(found), found.facts)


def _drawing_of(found: Any) -> "Drawing":
    from sfm_shapefit.report.results import draw_joined, draw_result

    if isinstance(found, JoinedModel):
        return draw_joined(found)
    drawing: Drawing = draw_result(found) if hasattr(found, "placement") else found.drawing
    return drawing


def _write_report(found: Any, page: Path, images: Path | str, out: str = "OUT") -> bool:
    """Write a report, of several models that of the largest; False if pictures were asked for in vain."""
    from sfm_shapefit.report.page import Occasion, Pictures, write_report
    from sfm_shapefit.report.thumbnails import read_thumbnails

    shown = found.models[0] if isinstance(found, MapResult) else found
    drawing = _drawing_of(shown)
    occasion = Occasion(out, day=date.today().isoformat())
    if not str(images):
        write_report(drawing, shown.facts, page, occasion=occasion)
        return True
    small = read_thumbnails(Path(images), drawing.cameras.names, drawing.cameras.trust)
    pictures = Pictures(small, _matches_between(shown, drawing, small)) if small else None
    occasion = occasion._replace(images=str(images)) if small else occasion
    write_report(drawing, shown.facts, page, pictures, occasion)
    return bool(small)


def _matches_between(found: Any, drawing: "Drawing", pictures: Collection[int]) -> "DrawnMatches | None":
    """Return the matches between pictures, of the database or else of the model's points.

    None where there are none, or the database cannot be read any more.
    """
    from sfm_shapefit.report.matched import pick_matches

    if isinstance(found, GraphResult):
        return None
    with suppress(ShapeFitError), ExitStack() as stack:
        database = found.facts.inputs.database
        if database and isinstance(found, LocateResult):
            images: Images = found.placed
            matches: Matches = open_database(database, images.names)
        else:
            model = read_model(found)
            images = model.images
            matches = open_database(database, images.names) if database else TrackMatches(model)
        stack.callback(matches.close)
        structure = found.options.structure if isinstance(found, LocateResult) else StructureOptions()
        limit_px = structure.max_reprojection_error_px
        return pick_matches(drawing.cameras, drawing.pairs, matches.at(images), pictures, limit_px)
    return None


WRITERS = Writers(_draw_page, write_page, write_result)
"""What `base.display` writes results by."""
