"""From photographs to a COLMAP database: features, chosen pairs, matches, verified by pycolmap.

images and lenses -> features -> pairs -> matches and two-view geometries
"""

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import IntArray, distinct_pairs
from sfm_shapefit.base.clock import Clock, Progress
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.paths import MASKS, OF_DATABASE, refuse_no_folder
from sfm_shapefit.base.settings import merge_options
from sfm_shapefit.base.wording import first_of
from sfm_shapefit.commands.photograph_pairs import NO_PAIRS, near_pairs, pairing_of, read_places
from sfm_shapefit.files.colmap.photographs import (
    PhotographDatabase,
    check_rigs,
    find_photographs,
    refuse_lens,
    remember_options,
)
from sfm_shapefit.files.colmap.picture_matches import read_descriptors
from sfm_shapefit.files.colmap.priors import MissingPriorsError
from sfm_shapefit.files.matching_options import MATCHING_FILE, MatchingOptions
from sfm_shapefit.judgement.chosen_pairs import NUM_DESCRIBED, alike_pairs
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
            read_places(made, OF_DATABASE)
        except MissingPriorsError:
            if is_new:
                _remove(path, with_folder=not has_folder)
            lack = "pairing=spatial needs positions, and the EXIF data of the images have none"
            raise InputError(f"{lack}; give a table (priors=FILE)") from None
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
    pairing = pairing_of(made.known_names(), made.options)
    near, lost, notes = near_pairs(made, priors or OF_DATABASE) if pairing == "spatial" else NO_PAIRS
    with clock("features"):
        made.detect(clock.advance)
    with clock("matches"):
        if len(near):
            made.match_pairs(near, clock.advance)
        _match(made, pairing, lost, clock)
    return list(notes)


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
