"""Near duplicates: pictures that show nearly the same, whose cameras stand far apart.

Two pictures are near duplicates if nine of ten matches move by a twentieth of the width of what is matched,
at most, and are half as many at least as either picture has with any other. A camera that goes around a flat
thing by 18 degrees, and looks at it, narrows it by a twentieth; that is a third of the distance to it.
Points far behind move as little, and are as far away. So a video of a camera that stands still is sound, and
near duplicates that a fold has put apart are not.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray, distinct, frozen
from sfm_shapefit.base.executors import in_ranges
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.judgement.evidence import OddImages
from sfm_shapefit.judgement.limits import CHANCE_SHARE, FEWEST_POINTS, LOCAL_SHARE, RIVAL_SHARE
from sfm_shapefit.judgement.reasons import Kind
from sfm_shapefit.pairs.kernels import median, select_rank
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.scene.matches import View, is_among
from sfm_shapefit.scene.structure import Structure


def find_split_duplicates(
    structure: Structure, directions: PairDirections, view: View, threads: int = 1
) -> Iterator[OddImages]:
    """Yield the images that have a near duplicate which stands half the distance to their points away.

    The `directions` are of pairs of the view, some of which have none; `threads` share these.
    """
    images = structure.images
    pairs, counts, most = directions.pairs, directions.num_matches, np.zeros(images.num_images)
    np.maximum.at(most, pairs, counts[:, None])
    asked = counts >= np.maximum(FEWEST_POINTS, RIVAL_SHARE * most[pairs].max(axis=1))
    apart = np.linalg.norm(images.centers[pairs[:, 0]] - images.centers[pairs[:, 1]], axis=1)
    apart /= _depths(structure, threads)[pairs].max(axis=1)
    pairs, apart = pairs[asked & (apart > RIVAL_SHARE)], apart[asked & (apart > RIVAL_SHARE)]
    found = _find_duplicates(structure, pairs, view, threads)
    split, most = is_among(pairs, found), np.zeros_like(most)
    np.maximum.at(most, pairs[split], apart[split, None])
    if len(named := np.flatnonzero(most)):
        sentence = "a near duplicate that is {} times the distance to its points away"
        yield OddImages.of_values(Kind.PLACE, images.names_of(named), most[named], sentence)


def _depths(structure: Structure, threads: int) -> FloatArray:
    """Return the median distance of the points of each image, (i,); NaN without any."""
    points, images, rows_of = structure.points, structure.images, structure.rows_of_images
    given = points.xyz, points.points_seen(), images.centers, rows_of.offsets, rows_of.rows
    depths = np.full(images.num_images, np.nan)
    in_ranges(threads, len(depths), _fill_depths, *map(frozen, map(np.ascontiguousarray, given)), depths)
    return depths


def _find_duplicates(structure: Structure, pairs: IntArray, view: View, threads: int) -> IntArray:
    found, known = [np.zeros((0, 2), dtype=np.int64)], dict[int, FloatArray]()
    for batch in view.links(chosen=is_among(view.pairs, pairs)) if len(pairs) else ():
        some = distinct(batch.pairs).tolist()
        known = {image: known[image] if image in known else _places(structure, image) for image in some}
        begins = np.zeros(structure.images.num_images, dtype=np.int64)
        begins[some] = offsets_of([len(places) for places in known.values()])[:-1]
        given = batch.offsets, batch.keypoints, begins[batch.pairs], np.concatenate([*known.values()])
        near = np.zeros(len(batch.pairs), dtype=np.bool_)
        in_ranges(threads, len(near), _find_near, *given, near)
        found.append(batch.pairs[near])
    return np.concatenate(found)


def _places(structure: Structure, image: int) -> FloatArray:
    """Return where the keypoints of an image are, (k, 2), in widths of the picture."""
    pictures, lens = structure.pictures, structure.images.lenses[structure.images.lens_of[image]]
    pixels = pictures.pixels(image, np.arange(pictures.count(image)))
    return np.asarray(pixels / max(lens.width, 1))


@kernel
def _fill_depths(
    begin: int, end: int, xyz: Any, point_of: Any, centers: Any, offsets: Any, rows: Any, depths: Any
) -> None:
    """Fill the depths of the images begin..end-1, whose observations are rows[offsets[i]:offsets[i + 1]]."""
    d = np.empty(3)
    for i in range(begin, end):
        work, total = np.empty(offsets[i + 1] - offsets[i]), 0.0
        for k in range(len(work)):
            for c in range(3):
                d[c] = xyz[point_of[rows[offsets[i] + k]], c] - centers[i, c]
            work[k] = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
            total += work[k]
        if len(work) and not np.isnan(total):
            depths[i] = median(work, len(work))


@kernel
def _find_near(begin: int, end: int, offsets: Any, keypoints: Any, rows: Any, places: Any, near: Any) -> None:
    """Write which of the pairs begin..end-1 are near duplicates, by the places of their matches.

    The keypoints of the two images of pair p begin at rows[p] of all places.
    """
    middle, nowhere = np.empty(2), np.zeros(2)
    for p in range(begin, end):
        count = offsets[p + 1] - offsets[p]
        if count > 0:
            own, moved, work = np.empty((count, 2)), np.empty((count, 2)), np.empty(count)
            for c in range(2):
                for k in range(count):
                    i, j = keypoints[offsets[p] + k]
                    work[k] = own[k, c] = places[rows[p, 0] + i, c]
                    moved[k, c] = own[k, c] - places[rows[p, 1] + j, c]
                middle[c] = median(work, count)
            spread = _reach(own, middle, count, work)
            near[p] = _reach(moved, nowhere, count, work) <= CHANCE_SHARE * 2.0 * spread


@inner_kernel
def _reach(places: Any, middle: Any, count: int, work: Any) -> float:
    """Return the distance from the middle that nine of ten places (count, 2) have at most."""
    for k in range(count):
        x, y = places[k, 0] - middle[0], places[k, 1] - middle[1]
        work[k] = np.sqrt(x * x + y * y)
    place = (1.0 - LOCAL_SHARE) * (count - 1)
    rank = int(place)
    low = high = select_rank(work, count, rank)
    if rank + 1 < count:
        high = work[rank + 1]
        for k in range(rank + 2, count):
            high = min(high, work[k])
    return float(low + (high - low) * (place - rank))
