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

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.executors import in_ranges
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.base.lists import RowLists
from sfm_shapefit.judgement.evidence import OddImages
from sfm_shapefit.judgement.limits import CHANCE_SHARE, FEWEST_POINTS, LOCAL_SHARE, RIVAL_SHARE
from sfm_shapefit.judgement.reasons import Kind
from sfm_shapefit.pairs.kernels import median, select_rank
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.scene.images import Images, KeypointRays
from sfm_shapefit.scene.matches import KeypointMatches, View, is_among
from sfm_shapefit.scene.points import Points


def find_split_duplicates(
    images: Images,
    points: Points,
    pictures: KeypointRays,
    directions: PairDirections,
    view: View,
    threads: int = 1,
) -> Iterator[OddImages]:
    """Yield the images that have a near duplicate which stands half the distance to their points away.

    The `directions` are of pairs of the view, some of which have none; `threads` share these.
    """
    pairs, counts, most = directions.pairs, directions.num_matches, np.zeros(images.num_images)
    np.maximum.at(most, pairs, counts[:, None])
    asked = counts >= np.maximum(FEWEST_POINTS, RIVAL_SHARE * most[pairs].max(axis=1))
    apart = np.linalg.norm(images.centers[pairs[:, 0]] - images.centers[pairs[:, 1]], axis=1)
    apart /= _depths(images, points)[pairs].max(axis=1)
    pairs, apart = pairs[asked & (apart > RIVAL_SHARE)], apart[asked & (apart > RIVAL_SHARE)]
    found = _find_duplicates(images, pictures, pairs, view, threads)
    split, most = is_among(pairs, found), np.zeros_like(most)
    np.maximum.at(most, pairs[split], apart[split, None])
    if len(named := np.flatnonzero(most)):
        sentence = "a near duplicate that is {} times the distance to its points away"
        yield OddImages.of_values(Kind.PLACE, images.names_of(named), most[named], sentence)


def _depths(images: Images, points: Points) -> FloatArray:
    """Return the median distance of the points of each image, (i,); NaN without any."""
    depths, seen, centers = np.full(images.num_images, np.nan), points.points_seen(), images.centers
    for image, rows in enumerate(points.rows_of_images(images.num_images)):
        if len(rows):
            offsets = points.xyz[seen[rows]] - centers[image]
            depths[image] = np.median(np.linalg.norm(offsets, axis=1))
    return depths


def _find_duplicates(
    images: Images, pictures: KeypointRays, pairs: IntArray, view: View, threads: int
) -> IntArray:
    found = [np.zeros((0, 2), dtype=np.int64)]
    for batch in view.links(chosen=is_among(view.pairs, pairs)) if len(pairs) else ():
        first, second = (_places(images, pictures, batch, side) for side in (0, 1))
        near = np.zeros(len(batch.pairs), dtype=np.bool_)
        in_ranges(threads, len(near), _find_near, batch.offsets, first, second, near)
        found.append(batch.pairs[near])
    return np.concatenate(found)


def _places(images: Images, pictures: KeypointRays, batch: KeypointMatches, side: int) -> FloatArray:
    """Return where the matches of pairs are in their first or second image, (M, 2), in its widths."""
    places = np.empty((len(batch.keypoints), 2))
    for image, rows in enumerate(RowLists.by_label(batch.spread(batch.pairs[:, side]))):
        if len(rows):
            width = max(images.lenses[images.lens_of[image]].width, 1)
            places[rows] = pictures.pixels(image, batch.keypoints[rows, side]) / width
    return places


@kernel
def _find_near(begin: int, end: int, offsets: Any, first: Any, second: Any, near: Any) -> None:
    """Write which of the pairs begin..end-1 are near duplicates, by the places of their matches."""
    middle, nowhere = np.empty(2), np.zeros(2)
    for p in range(begin, end):
        count = offsets[p + 1] - offsets[p]
        if count > 0:
            own, work = first[offsets[p] : offsets[p + 1]], np.empty(count)
            moved = np.empty((count, 2))
            for c in range(2):
                for k in range(count):
                    work[k] = own[k, c]
                    moved[k, c] = own[k, c] - second[offsets[p] + k, c]
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
