"""OUT on disk: the seeded model, `locate.json`, `cameras.csv`, `pairs.csv`, `report.html`.

Further parallel-rigid pieces stand in `pieces/1`, `pieces/2`, ...: a seeded model and a `cameras.csv` each. A
bare graph has no model. `map` has such a folder per model, `0`, `1`, ..., and `map.json` beside them; models
that were joined stand in `joined_0` in one world too.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sfm_shapefit.base.atomic_folder import MAP_MARKER, MARKER, atomic_file, atomic_folder
from sfm_shapefit.base.display import Reported, Writers
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.record import write_json
from sfm_shapefit.base.settings import Settings, explained, merge_options, option
from sfm_shapefit.commands.colors import Result, with_colors
from sfm_shapefit.facts.map_result import JoinedModel, MapResult
from sfm_shapefit.facts.placed import IN_MEMORY, folder_of
from sfm_shapefit.facts.result import GraphResult, LocateResult
from sfm_shapefit.facts.rows import covariances_of, covariances_text, own_camera_rows
from sfm_shapefit.facts.tables import CameraRow, Table, write_rows
from sfm_shapefit.files.colmap.seed import write_model
from sfm_shapefit.files.matching_options import MADE_FIRST
from sfm_shapefit.files.output_paths import refuse_file


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


def _draw_page(found: Any) -> str:
    from sfm_shapefit.report.result_page import draw_page  # here: what draws is not loaded where nothing is

    return draw_page(found)


def _write_report(found: Any, page: Path, images: Path | str, out: str = "OUT") -> bool:
    from sfm_shapefit.report.result_page import write_result_page

    return write_result_page(found, page, images, out)


def _length_of(found: Any, first: str | int, second: str | int) -> Any:
    from sfm_shapefit.commands.lengths import evaluate_lengths  # here: few ask

    told = evaluate_lengths(found, [(first, second)])
    if not told.lengths:
        raise UnsolvableError(told.warnings[-1])
    return told.lengths[0].length


WRITERS = Writers(_draw_page, write_page, write_result, _length_of)
"""What `base.display` writes results by."""
