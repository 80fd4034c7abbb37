"""The lenses that a run starts from: as read, or with the focal lengths that view graph and pairs ask for."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.wording import first_of
from sfm_shapefit.facts.intrinsics import RefinedIntrinsics, intrinsics_in_doubt
from sfm_shapefit.files.colmap.database import DatabaseMatches
from sfm_shapefit.files.colmap.intrinsics import Uncalibrated, calibrate_view_graph, find_uncalibrated
from sfm_shapefit.files.colmap.pair_focals import PairFocal, read_pair_focals
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.files.colmap.track_matches import TrackMatches
from sfm_shapefit.pairs.focal_lengths import find_lenses
from sfm_shapefit.scene.freedom import PARTS_FREED, IntrinsicsFreedom
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import PARTS, Lens, Origin
from sfm_shapefit.scene.matches import PairNames

_ALIKE = 1.03  # factor; within, pairs tell no more than the fundamental matrices of all
_UNLIKE = 1.1  # factor; pairs that agree scatter by a third of that
_MOST_OFF = 4.0  # factor; a view graph that wants a larger one says more of itself than of the lens


def choose_intrinsics(
    images: Images,
    matches: DatabaseMatches | TrackMatches,
    wanted: IntrinsicsFreedom,
    left_out: PairNames = frozenset(),
    listed: frozenset[int] = frozenset(),
) -> tuple[Images, RefinedIntrinsics]:
    """Return the images to start from, lenses in doubt marked, and what adjustments may change of these.

    The database of the matches, if they are of one, says which intrinsics are guesses, and so are those of
    lenses whose ids are `listed`; pairs that are left out say nothing of focal lengths.
    """
    file = matches.file
    guessed = {} if file is None else find_uncalibrated(file, images, listed)
    lenses, factors = list(images.lenses), np.ones(len(images.lenses))
    if wanted not in ("auto", "held"):
        lenses = [lens if lens.is_panorama else lens.in_doubt(Origin.CALIBRATION) for lens in lenses]
    for k in (k for k, lens in enumerate(images.lenses) if lens.id in listed):
        lenses[k] = images.lenses[k].in_doubt(Origin.GUESS)
    for k, guess in guessed.items():
        lenses[k] = images.lenses[k].in_doubt(guess.origin)
    database_ids = [guess.database_id for guess in guessed.values()]
    by_pairs = read_pair_focals(file, database_ids, left_out) if file is not None and database_ids else {}
    if file is not None and guessed and wanted != "held":
        doubted = np.isin(np.arange(len(lenses)), list(guessed))
        by_rays = doubted & [lens.is_adjustable and not lens.is_plane for lens in lenses]
        factors = _by_view_graph(file, guessed, by_pairs, by_rays, left_out)
        if by_rays.any():
            view = matches.at(images.apart(), left_out)
            for k, seen in find_lenses(view, by_rays, doubted).items():
                factors[k] = seen.focal_px / images.lenses[k].focal_px
                lenses[k] = replace(lenses[k], parameters=seen.longer(1.0 / factors[k]).parameters)
    may_move = [[lens.origin is not None and lens.is_adjustable] for lens in lenses]
    by_view_graph = factors != 1.0
    for k in np.flatnonzero(by_view_graph).tolist():
        lenses[k] = lenses[k].longer(factors[k])
    if file is not None:
        file.notes += _contradicted_guesses(images.lenses, lenses, guessed, by_pairs, held=wanted == "held")
    parts = np.array(may_move, dtype=np.bool_) & np.isin(list(PARTS), PARTS_FREED[wanted])
    return images.with_lenses(lenses), intrinsics_in_doubt(parts, by_view_graph)


def _by_view_graph(
    file: DatabaseFile,
    guessed: Mapping[int, Uncalibrated],
    by_pairs: Mapping[int, PairFocal],
    by_rays: BoolArray,
    left_out: PairNames,
) -> FloatArray:
    """Return by which factor each lens (l,) is to be longer, 1 where no pair says."""
    others = [guess.database_id for k, guess in guessed.items() if not by_rays[k]]
    by_database = calibrate_view_graph(file, others, left_out) if others else {}
    for i, one in by_pairs.items():
        known = by_database.get(i)
        if known is None or (one.is_one_sided and not 1.0 / _ALIKE < one.factor / known < _ALIKE):
            by_database[i] = one.factor
    factors = np.ones(len(by_rays))
    for k, guess in guessed.items():
        factors[k] = by_database.get(guess.database_id, 1.0 / guess.ratio) * guess.ratio
    factors[(factors < 1.0 / _MOST_OFF) | (factors > _MOST_OFF)] = 1.0
    return factors


def _contradicted_guesses(
    as_read: Sequence[Lens],
    lenses: Sequence[Lens],
    guessed: Mapping[int, Uncalibrated],
    by_pairs: Mapping[int, PairFocal],
    *,
    held: bool,
) -> Iterator[str]:
    """Yield which lenses start from another focal length than their pairs were verified with, if any do."""
    named = []
    for k, guess in guessed.items():
        if guess.database_id not in by_pairs:
            continue
        one, focal_px = by_pairs[guess.database_id], lenses[k].focal_px
        asked_px = as_read[k].focal_px * one.factor * guess.ratio
        if not 1.0 / _UNLIKE < asked_px / focal_px < _UNLIKE:
            named.append(
                f"{one.num_pairs} of camera {lenses[k].id} with {asked_px:,.0f} px, not {focal_px:,.0f}"
            )
    if named:
        remedy = "intrinsics=auto lets these change" if held else "check those that are found"
        yield (
            "COLMAP verified pairs with other focal lengths than their guessed lenses start from: "
            f"{first_of(named)}; {remedy}"
        )
