"""From photographs to a COLMAP database: features, chosen pairs, matches, verified by pycolmap.

images and lenses -> features -> pairs -> matches and two-view geometries
"""

import warnings
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray, distinct_pairs
from sfm_shapefit.base.clock import Clock, Progress
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.paths import MASKS, OF_DATABASE, refuse_no_folder
from sfm_shapefit.base.settings import merge_options
from sfm_shapefit.base.wording import first_of
from sfm_shapefit.files.colmap.database_images import read_images
from sfm_shapefit.files.colmap.known import read_priors
from sfm_shapefit.files.colmap.photographs import (
    PhotographDatabase,
    check_rigs,
    find_photographs,
    refuse_lens,
    remember_options,
)
from sfm_shapefit.files.colmap.picture_matches import read_descriptors
from sfm_shapefit.files.colmap.priors import MissingPriorsError
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.files.matching_options import MATCHING_FILE, MOST_EXHAUSTIVE, MatchingOptions
from sfm_shapefit.judgement.chosen_pairs import NEAR_A_STEP, NUM_DESCRIBED, alike_pairs, nearest_pairs
from sfm_shapefit.scene.sequences import find_sequences
from sfm_shapefit.solver.solver_options import SolverOptions

_ALIKE, _ALIKE_BESIDE = 30, 5
"""Alike images that each is matched with: as many as COLMAP's retrieval would be asked for, or what closes
loops beside images next in a sequence or near in position."""


def match_images(
    images: Path | str,
    database: Path | str,
    *,
    options: MatchingOptions | None = None,
    priors: Path | str | None = None,
    threads: int = 0,
    progress: Progress | None = None,
    **overrides: Any,
) -> Path:
    """Make a COLMAP database of photographs, by pycolmap's features, matcher and verification.

        database = sfm_shapefit.match_images("images", "work/database.db")
        mapped = sfm_shapefit.map_database(database)

    Args:
        images: folder of the images, those in folders below it included.
        database: file to be made. One that an interrupted call left is gone on with, and so is one to which
            images are added.
        options: settings, see `help(MatchingOptions)`; defaults if None.
        priors: a table of positions, or a folder with EXIF data, for `pairing="spatial"`; without it, the
            EXIF data of the images.
        threads: 0 for all cores.
        progress: called as stages advance.
        **overrides: single options by name: `match_images(images, database, pairing="sequential")`.

    Returns:
        the path of the database.

    Raises:
        InputError: if there are no two images that can be read, the database is of other images, or
            `pairing="spatial"` has no positions.

    Warns:
        UserWarning: if photographs or videos in the folder cannot be read, sensors of rigs have no poses, or
            `pairing="spatial"` lacks the positions of some images.
    """
    options = merge_options(options, MatchingOptions, overrides)
    clock = Clock.of(progress, SolverOptions(threads=threads).threads)
    made, notes = begin_database(Path(images), Path(database), options, clock, priors)
    notes += match_begun(made, clock, priors)
    for note in notes:
        warnings.warn(note, stacklevel=2)
    return Path(database)


def begin_database(
    folder: Path, path: Path, options: MatchingOptions, clock: Clock, priors: Path | str | None = None
) -> tuple[PhotographDatabase, list[str]]:
    """Make a database with images and lenses; return it, and notes; errors as of `match_images`."""
    refuse_lens(options)
    if options.mask_path:
        refuse_no_folder(Path(options.mask_path), MASKS)
    found = find_photographs(folder)
    notes = check_rigs(options, found.names)
    made = PhotographDatabase(
        folder=folder, database=path, names=found.names, options=options, threads=clock.threads
    )
    is_new, has_folder = not path.exists(), path.parent.exists()
    path.parent.mkdir(parents=True, exist_ok=True)
    remember_options(path, options)
    with clock("images"):
        unreadable = made.write_images(clock.advance)
        names = made.known_names()
    if len(names) < 2:
        _remove(path, with_folder=not has_folder)
        raise InputError(f"{folder} has no two images that pycolmap can read; not {first_of(unreadable)}")
    if options.pairing == "spatial" and priors is None:
        try:
            _read_places(made, OF_DATABASE)
        except MissingPriorsError:
            if is_new:
                _remove(path, with_folder=not has_folder)
            raise InputError(
                "pairing=spatial needs positions, and the EXIF data of the images have none; give a table "
                "(priors=FILE)"
            ) from None
    if unused := [*found.unread, *unreadable]:
        notes.append(f"not used, since pycolmap cannot read them: {first_of(unused)} in {folder}")
    return made, notes


def _remove(database: Path, *, with_folder: bool) -> None:
    database.unlink()
    database.with_name(MATCHING_FILE).unlink()
    if with_folder:
        database.parent.rmdir()


def match_begun(made: PhotographDatabase, clock: Clock, priors: Path | str | None = None) -> list[str]:
    """Write the features and matches that a database lacks; return notes; `priors` as of `match_images`."""
    names = made.known_names()
    pairing, rows, notes = _pairing_of(names, made.options), np.arange(len(names)), list[str]()
    near = np.zeros((0, 2), dtype=np.int64)
    if pairing == "spatial":
        rows, positions = _read_places(made, priors or OF_DATABASE)
        near = np.sort(rows[nearest_pairs(positions, NEAR_A_STEP * made.options.overlap)], axis=1)
    lost = np.setdiff1d(np.arange(len(names)), rows)
    if len(lost):
        whom = "those that look alike"
        if len(names) <= MOST_EXHAUSTIVE:
            whom = "all others"
            every = np.column_stack(np.triu_indices(len(names), 1))
            near = distinct_pairs(np.concatenate([near, every[np.isin(every, lost).any(axis=1)]]))
        has, are = ("has", "it is") if len(lost) == 1 else ("have", "they are")
        which = f"{len(lost):,} of {len(names):,} images {has} no position, such as {names[lost[0]]}"
        notes.append(f"{which}: {are} matched with {whom}")
    with clock("features"):
        made.detect(clock.advance)
    with clock("matches"):
        if len(near):
            made.match_pairs(near, clock.advance)
        _match(made, pairing, lost, clock)
    return notes


def _read_places(made: PhotographDatabase, priors: Path | str) -> tuple[IntArray, FloatArray]:
    """Return the images that have a position (k,), as rows of the names of the database, and these (k, 3)."""
    with closing(DatabaseFile(made.database)) as file:
        images = read_images(file).images
        known = read_priors(images, file, priors).known
    row_of = {name: row for row, name in enumerate(made.known_names())}
    return np.array([row_of[name] for name in images.names_of(known.indices)]), known.positions


def _pairing_of(names: list[str], options: MatchingOptions) -> str:
    if options.pairing != "auto":
        return options.pairing
    if len(names) <= MOST_EXHAUSTIVE:
        return "exhaustive"
    numbered = sum(len(rows) for rows, _ in find_sequences(names))
    return "sequential" if numbered == len(names) else "retrieval"


def _match(made: PhotographDatabase, pairing: str, lost: IntArray, clock: Clock) -> None:
    """Match all pairs, or those of a sequence, and those that look alike; more of these for `lost` rows."""
    if pairing == "exhaustive":
        return made.match_exhaustively(clock.advance)
    if pairing == "sequential":
        made.match_sequentially(clock.advance)
    most = _ALIKE if pairing == "retrieval" else _ALIKE_BESIDE
    described = read_descriptors(made.database, NUM_DESCRIBED)
    pairs = alike_pairs(described, most)
    if len(lost):
        alike = alike_pairs(described, _ALIKE)
        pairs = distinct_pairs(np.concatenate([pairs, alike[np.isin(alike, lost).any(axis=1)]]))
    return made.match_pairs(pairs, clock.advance)
