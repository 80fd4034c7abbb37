"""Cameras that fly: far from all others, or, in a video, far from where its frames before and after stand.

A camera flies off if it is beyond 30 median distances from the median of all, and three times as far as the
next nearer one: where a camera turns on the spot and then leaves, the distances grow without such a gap.

A sequence of images (`scene.sequences`) is a path if a step from one to the next is a quarter of the distance
of any two, or less, by the median; photographs in any order have no such steps, and frames of several cameras
in turn have even ones. One to three images in a row leap if each is farther from the images before and after
these than three times as four of five steps nearby reach, for each number between, than twice the distance of
these two, and than 5 % of the extent. A jump from one clip to the next is one way only, so that nothing leaps
there. On 200 drawn walks of 15 to 120 steps, as many with pauses, gaps, jitter, or in another order, no image
leaps; of 162 with 40 steps or more, 159 do where one image was moved by 12 % of the extent.
"""

from collections.abc import Iterator

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, quantile
from sfm_shapefit.base.geometry import INSIDE, distances_in_spreads
from sfm_shapefit.judgement.evidence import OddImages
from sfm_shapefit.judgement.limits import CHANCE_SHARE, MOST_AGAINST, MOST_COMPARED, OUTNUMBERED, SIGMAS
from sfm_shapefit.judgement.reasons import Kind
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.sequences import find_sequences

_SHORT_STEP = 0.25  # share of the distance of any two images; steps of a path are shorter
_SHORTEST_PATH = 8  # images; fewer have no usual step
_NEARBY = 5  # steps on either side; a video goes as fast there
_LONG_STEP = 0.8  # share of these steps that are no longer; two leaps among ten are
_MOST_IN_A_ROW = 3  # images that leap together; more are a piece of their own


def find_flights(images: Images) -> Iterator[OddImages]:
    """Yield the posed images that fly off, and those that leap from where their neighbors stand."""
    posed = np.flatnonzero(images.is_posed)
    centers, names = images.centers[posed], [images.names[k] for k in posed.tolist()]
    spreads = distances_in_spreads(centers, centers)
    flies = _flying(spreads)
    if flies.any():
        sentence = "a place {} times as far out as is usual"
        yield OddImages.of_values(Kind.PLACE, images.names_of(posed[flies]), spreads[flies], sentence)
    extent = float(np.linalg.norm(np.ptp(centers[~flies], axis=0)))
    leaps = np.zeros(len(posed))
    for rows, numbers in find_sequences(names):
        kept = ~flies[rows]
        leaps[rows[kept]] = _leaps(centers[rows[kept]], numbers[kept], CHANCE_SHARE * extent)
    if (far := leaps > 0.0).any():
        sentence = "a place {} % of the extent away from the images before and after it"
        shares = 100.0 * leaps[far] / extent
        yield OddImages.of_values(Kind.PLACE, images.names_of(posed[far]), shares, sentence)


def _flying(spreads: FloatArray) -> BoolArray:
    """Return which cameras (n,), at some distances in spreads, fly off."""
    order = np.sort(spreads)
    gaps = np.flatnonzero((order[1:] > INSIDE) & (order[1:] > SIGMAS * order[:-1])) + 1
    gaps = gaps[gaps >= (1.0 - MOST_AGAINST) * len(spreads)]  # what is left behind is the rest
    return spreads >= order[gaps[0]] if len(gaps) else np.zeros(len(spreads), dtype=np.bool_)


def _leaps(centers: FloatArray, numbers: IntArray, least: float) -> FloatArray:
    """Return how far each image of a sequence (n, 3) leaps, `least` or more; 0 for all but those, (n,)."""
    count, found = len(centers), np.zeros(len(centers))
    steps, some = _distances(centers[1:], centers[:-1]), centers[:: -(-count // MOST_COMPARED)]
    if count < _SHORTEST_PATH or np.median(steps) > _SHORT_STEP * np.median(_distances(some[:, None], some)):
        return found
    speeds = steps / np.maximum(np.diff(numbers), 1)
    for num in range(1, _MOST_IN_A_ROW + 1):
        for before in np.flatnonzero(steps[: count - num - 1] > least).tolist():
            ends, row = np.array([before, before + num + 1]), slice(before + 1, before + num + 1)
            near = np.r_[speeds[max(0, before - _NEARBY) : before], speeds[ends[1] :][:_NEARBY]]
            usual = SIGMAS * quantile(near, _LONG_STEP) * np.abs(numbers[ends][:, None] - numbers[row])
            far = _distances(centers[ends][:, None], centers[row])
            across = OUTNUMBERED * float(_distances(*centers[ends]))
            if (far > np.maximum(usual, max(across, least))).all() and not found[ends].any():
                found[row] = far.min(axis=0)
    return found


def _distances(one: FloatArray, other: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(one - other, axis=-1))
