"""Near duplicates: pictures that show nearly the same, whose cameras stand far apart.

Two pictures are near duplicates if nine of ten matches move by a twentieth of the width of what is matched,
at most, and are half as many at least as either picture has with any other. A camera that goes around a flat
thing by 18 degrees, and looks at it, narrows it by a twentieth; that is a third of the distance to it.
Points far behind move as little, and are as far away. So a video of a camera that stands still is sound, and
near duplicates that a fold has put apart are not.
"""

from collections.abc import Iterator

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.judgement.evidence import OddImages
from sfm_shapefit.judgement.limits import FEW, FEWEST_POINTS, HALF, RARE
from sfm_shapefit.judgement.reasons import Kind
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.scene.images import Images, Pictures
from sfm_shapefit.scene.matches import View, is_among
from sfm_shapefit.scene.points import Points


def find_split_duplicates(
    images: Images, points: Points, pictures: Pictures, directions: PairDirections, view: View
) -> Iterator[OddImages]:
    """Yield the images that have a near duplicate which stands half the distance to their points away.

    The `directions` are of pairs of the view, some of which have none.
    """
    pairs, counts, most = directions.pairs, directions.num_matches, np.zeros(images.num_images)
    np.maximum.at(most, pairs, counts[:, None])
    asked = counts >= np.maximum(FEWEST_POINTS, HALF * most[pairs].max(axis=1))
    apart = np.linalg.norm(images.centers[pairs[:, 0]] - images.centers[pairs[:, 1]], axis=1)
    apart /= _depths(images, points)[pairs].max(axis=1)
    pairs, apart = pairs[asked & (apart > HALF)], apart[asked & (apart > HALF)]
    split, most = is_among(pairs, _find_duplicates(images, pictures, pairs, view)), np.zeros_like(most)
    np.maximum.at(most, pairs[split], apart[split, None])
    if len(named := np.flatnonzero(most)):
        sentence = "a near duplicate that stands {} times the distance to its points away"
        yield OddImages.of_values(Kind.PLACE, images.names_of(named), most[named], sentence)


def _depths(images: Images, points: Points) -> FloatArray:
    """Return the median distance of the points of each image, (i,); NaN without any."""
    distances = np.linalg.norm(points.xyz[points.points_seen()] - images.centers[points.images], axis=1)
    depths = np.full(images.num_images, np.nan)
    for image, rows in enumerate(points.rows_of_images(images.num_images)):
        if len(rows):
            depths[image] = np.median(distances[rows])
    return depths


def _find_duplicates(images: Images, pictures: Pictures, pairs: IntArray, view: View) -> IntArray:
    """Return those of some pairs (k, 2) that are near duplicates."""
    found = [np.zeros((0, 2), dtype=np.int64)]
    for batch in view.links(chosen=is_among(view.pairs, pairs)) if len(pairs) else ():
        for pair, begin, end in zip(batch.pairs, batch.offsets[:-1], batch.offsets[1:], strict=True):
            i, j = (
                pictures.pixels(k, own) / max(images.lenses[images.lens_of[k]].width, 1)
                for k, own in zip(pair.tolist(), batch.keypoints[begin:end].T, strict=True)
            )
            if end > begin and _reach(i - j) <= RARE * 2.0 * _reach(i - np.median(i, axis=0)):
                found.append(pair[None])
    return np.concatenate(found)


def _reach(offsets: FloatArray) -> float:
    """Return the length that nine of ten offsets (k, 2) have at most."""
    return float(np.quantile(np.linalg.norm(offsets, axis=1), 1.0 - FEW))
