"""Which photographs are matched: those near by their positions, and all that have none with the others."""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray, distinct_pairs
from sfm_shapefit.files.colmap.database_images import read_images
from sfm_shapefit.files.colmap.known import read_priors
from sfm_shapefit.files.colmap.photographs import PhotographDatabase
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.files.matching_options import MOST_EXHAUSTIVE, MatchingOptions
from sfm_shapefit.judgement.chosen_pairs import NEAR_A_STEP, nearest_pairs
from sfm_shapefit.scene.sequences import find_sequences


class NearPairs(NamedTuple):
    """Pairs by positions and images without one, as rows of the names of the database, and notes."""

    pairs: IntArray
    """(k, 2)"""
    lost: IntArray
    """(m,) images without a position."""
    notes: tuple[str, ...]


NO_PAIRS = NearPairs(np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.int64), ())
"""Pairs where positions say nothing."""


def near_pairs(made: PhotographDatabase, priors: Path | str) -> NearPairs:
    """Return the pairs of each image and those nearest to it; one without a position has pairs with all.

    Where images are many, it has none: those that look alike are to be found for it.
    """
    names = made.known_names()
    rows, positions = read_places(made, priors)
    near = np.sort(rows[nearest_pairs(positions, NEAR_A_STEP * made.options.overlap)], axis=1)
    lost = np.setdiff1d(np.arange(len(names)), rows)
    if not len(lost):
        return NearPairs(near, lost, ())
    whom = "those that look alike"
    if len(names) <= MOST_EXHAUSTIVE:
        whom = "all others"
        every = np.column_stack(np.triu_indices(len(names), 1))
        near = distinct_pairs(np.concatenate([near, every[np.isin(every, lost).any(axis=1)]]))
    has, are = ("has", "it is") if len(lost) == 1 else ("have", "they are")
    which = f"{len(lost):,} of {len(names):,} images {has} no position, such as {names[lost[0]]}"
    return NearPairs(near, lost, (f"{which}: {are} matched with {whom}",))


def read_places(made: PhotographDatabase, priors: Path | str) -> tuple[IntArray, FloatArray]:
    """Return the images that have a position (k,), as rows of the names of the database, and these (k, 3)."""
    with closing(DatabaseFile(made.database)) as file:
        images = read_images(file).images
        known = read_priors(images, file, priors).known
    row_of = {name: row for row, name in enumerate(made.known_names())}
    return np.array([row_of[name] for name in images.names_of(known.indices)]), known.positions


def pairing_of(names: Sequence[str], options: MatchingOptions) -> str:
    """Return the pairing of the options; for "auto" the one that suits so many images of these names."""
    if options.pairing != "auto":
        return options.pairing
    if len(names) <= MOST_EXHAUSTIVE:
        return "exhaustive"
    numbered = sum(len(rows) for rows, _ in find_sequences(names))
    return "sequential" if numbered == len(names) else "retrieval"
