"""What points say of lenses, and which cameras fly off: independent questions, asked side by side."""

from collections.abc import Callable
from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, distinct
from sfm_shapefit.base.executors import in_threads
from sfm_shapefit.judgement.evidence import LensField, OddImages
from sfm_shapefit.judgement.flights import find_flights
from sfm_shapefit.judgement.lens_residuals import find_bent_lenses, lens_fields
from sfm_shapefit.judgement.lenses import find_odd_lenses
from sfm_shapefit.judgement.wrong_lenses import ContradictedLens, question_lenses
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.structure import Structure

_MOST_ASKED = 200  # images of a lens that are left out; each takes 1.4 ms, and a median of so many is exact


def ask_points(
    structure: Structure, bogus: BoolArray, threads: int
) -> tuple[tuple[ContradictedLens, ...], tuple[LensField, ...], tuple[OddImages, ...]]:
    """Return lenses that images contradict, mean residuals of lenses, and images whose lens or place is odd.

    See `find_odd_lenses` for `bogus`.
    """
    images, _ = structure.images, structure.pixels  # read by one thread, before several ask
    jobs: list[Callable[[], Any]] = [
        lambda: question_lenses(structure, threads, images_to_ask(images, structure.asked))[1],
        lambda: tuple(find_odd_lenses(structure, bogus)),
        lambda: lens_fields(structure),
        lambda: tuple(find_flights(images)),
    ]
    lenses, unlike, fields, flying = in_threads(threads, lambda job: job(), jobs)
    return lenses, fields, (*unlike, *find_bent_lenses(fields, images.names), *flying)


def images_to_ask(images: Images, asked: BoolArray | None) -> BoolArray | None:
    """Return which images (i,) are asked for their focal length: of a lens that took very many, only some.

    Panoramas have none.
    """
    panoramas = np.array([lens.is_panorama for lens in images.lenses], dtype=np.bool_)[images.lens_of]
    if panoramas.any():
        asked = ~panoramas if asked is None else asked & ~panoramas
    every = np.bincount(images.lens_of[images.is_posed])
    if every.max(initial=0) <= _MOST_ASKED:
        return asked
    some = images.is_posed if asked is None else images.is_posed & asked
    for lens in distinct(images.lens_of[some]).tolist():
        rows = np.flatnonzero(some & (images.lens_of == lens))
        some[rows] = np.arange(len(rows)) % -(-len(rows) // _MOST_ASKED) == 0
    return some
