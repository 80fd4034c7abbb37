"""From photographs to a COLMAP database: features, chosen pairs, matches, verified by pycolmap.

images and lenses -> features -> pairs -> matches and two-view geometries
"""

import warnings
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import IntArray
from sfm_shapefit.base.clock import Clock, Progress
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.paths import MASKS, OF_DATABASE, refuse_no_folder
from sfm_shapefit.base.settings import merge_options
from sfm_shapefit.base.wording import first_of
from sfm_shapefit.files.colmap.database_images import read_images
from sfm_shapefit.files.colmap.known import read_priors
from sfm_shapefit.files.colmap.photographs import (
    PhotographDatabase,
    find_photographs,
    refuse_lens,
    refuse_rigs,
    remember_options,
)
from sfm_shapefit.files.colmap.picture_matches import read_descriptors
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
        InputError: if there are no two images that can be read, or the database is of other images.

    Warns:
        UserWarning: if photographs or videos in the folder cannot be read.
    """
    options = merge_options(options, MatchingOptions, overrides)
    clock = Clock.of(progress, SolverOptions(threads=threads).threads)
    made, notes = begin_database(Path(images), Path(database), options, clock)
    match_begun(made, clock, priors)
    for note in notes:
        warnings.warn(note, stacklevel=2)
    return Path(database)


def begin_database(
    folder: Path, path: Path, options: MatchingOptions, clock: Clock
) -> tuple[PhotographDatabase, list[str]]:
    """Make a database with images and lenses; return it, and notes; errors as of `match_images`."""
    refuse_lens(options)
    if options.mask_path:
        refuse_no_folder(Path(options.mask_path), MASKS)
    found = find_photographs(folder)
    refuse_rigs(options, found.names)
    made = PhotographDatabase(
        folder=folder, database=path, names=found.names, options=options, threads=clock.threads
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    remember_options(path, options)
    with clock("images"):
        unreadable = made.write_images(clock.advance)
        names = made.known_names()
    if len(names) < 2:
        path.unlink()
        path.with_name(MATCHING_FILE).unlink()
        raise InputError(f"{folder} has no two images that pycolmap can read; not {first_of(unreadable)}")
    unused = [*found.unread, *unreadable]
    why = "not used, since pycolmap cannot read them"
    return made, [f"{why}: {first_of(unused)} in {folder}"] if unused else []


def match_begun(made: PhotographDatabase, clock: Clock, priors: Path | str | None = None) -> None:
    """Write the features and matches that a database of photographs lacks; `priors` as of `match_images`."""
    pairing = _pairing_of(made.known_names(), made.options)
    near = _near_pairs(made, priors or OF_DATABASE) if pairing == "spatial" else None
    with clock("features"):
        made.detect(clock.advance)
    with clock("matches"):
        if near is not None:
            made.match_pairs(near, clock.advance)
        _match(made, pairing, clock)


def _near_pairs(made: PhotographDatabase, priors: Path | str) -> IntArray:
    """Return the pairs (k, 2) of each image and those nearest to it, as rows of the names of the database."""
    with closing(DatabaseFile(made.database)) as file:
        images = read_images(file).images
        known = read_priors(images, file, priors).known
    row_of = {name: row for row, name in enumerate(made.known_names())}
    rows = np.array([row_of[name] for name in images.names_of(known.indices)])
    return np.sort(rows[nearest_pairs(known.positions, NEAR_A_STEP * made.options.overlap)], axis=1)


def _pairing_of(names: list[str], options: MatchingOptions) -> str:
    if options.pairing != "auto":
        return options.pairing
    if len(names) <= MOST_EXHAUSTIVE:
        return "exhaustive"
    numbered = sum(len(rows) for rows, _ in find_sequences(names))
    return "sequential" if numbered == len(names) else "retrieval"


def _match(made: PhotographDatabase, pairing: str, clock: Clock) -> None:
    """Match all pairs, or those of a sequence, and those that look alike."""
    if pairing == "exhaustive":
        return made.match_exhaustively(clock.advance)
    if pairing == "sequential":
        made.match_sequentially(clock.advance)
    most = _ALIKE if pairing == "retrieval" else _ALIKE_BESIDE
    return made.match_pairs(alike_pairs(read_descriptors(made.database, NUM_DESCRIBED), most), clock.advance)
