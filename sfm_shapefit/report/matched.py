"""Matches between the pictures of a report: which fit where the cameras stand, and which contradict that.

A match contradicts if it misses the epipolar lines of its cameras by more than an observation of a 3D point
may be off; a pair can be set aside and yet have matches that fit, and the other way round.
"""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.report.drawing import MAX_PAIRS, Cameras, Pairs
from sfm_shapefit.scene.epipolar import sampson_errors_px
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import MatchBatch, View, rows_of_pairs

MOST_DRAWN = 32
"""Matches of a pair that are drawn; with more, lines hide the pictures."""
_MOST_BESIDE = 8  # pairs of a camera whose matches are on the page; each takes 0.4 kB
_PLACES = 65_535  # steps across a picture in which places are told: two bytes each


class DrawnMatches(NamedTuple):
    """Matches of k pairs, m of them drawn, one pair after the other, of each pair those that fit first."""

    pairs: IntArray
    """(k,) rows of `Pairs`."""
    counts: IntArray
    """(k, 2) how many matches fit, and how many contradict."""
    drawn: IntArray
    """(k, 2) how many of either are drawn."""
    places: IntArray
    """(m, 4) x and y in the picture of the first camera, and in that of the second, of 65,535 steps."""


def pick_matches(
    cameras: Cameras, pairs: Pairs, view: View, pictures: Collection[int], max_error_px: float
) -> DrawnMatches | None:
    """Return matches of the pairs that tell most of each camera; None where no two pictures share any.

    Args:
        cameras, pairs: as they are drawn.
        view: the matches as the images see them where they are drawn, by the same names.
        pictures: rows of the cameras that have a picture.
        max_error_px: distance from the epipolar lines, to first order, beyond which a match contradicts.
    """
    index = {name: k for k, name in enumerate(view.images.names)}
    image_of = np.array([index.get(name, -1) for name in cameras.names], dtype=np.int64)
    shown = np.isin(np.arange(len(image_of)), list(pictures)) & cameras.placed & (image_of >= 0)
    listed = pairs.worst_first()[:MAX_PAIRS]
    rows = listed[shown[pairs.cameras[listed]].all(axis=1)]
    ends = image_of[pairs.cameras[rows]]
    found = []
    for batch in view.of_pairs(ends):
        places = rows_of_pairs(batch.pairs, ends)
        misses = _sampson_px(batch, view.images) > max_error_px
        for place, pair, own in zip(places.tolist(), batch.pairs, batch.slices(), strict=True):
            keypoints = batch.keypoints[own] if pair[0] == ends[place, 0] else batch.keypoints[own, ::-1]
            found.append((int(rows[place]), *_draw(view, ends[place], keypoints, misses[own])))
    if not found:
        return None
    every, counts, drawn, steps = zip(*found, strict=True)
    chosen = _most_telling(np.array(counts), pairs.cameras[list(every)], len(image_of))
    places = np.concatenate([steps[k] for k in chosen.tolist()])
    return DrawnMatches(np.array(every)[chosen], np.array(counts)[chosen], np.array(drawn)[chosen], places)


def _draw(
    view: View, images: IntArray, keypoints: IntArray, misses: BoolArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Return how many matches of two images fit and contradict, of either how many are drawn, and where."""
    order = np.argsort(misses, kind="stable")  # matches that fit come first
    order = order[np.linspace(0, len(order) - 1, min(len(order), MOST_DRAWN)).round().astype(np.int64)]
    places = [
        view.keypoints(image)[own] / view.images.sizes_px[image]
        for image, own in zip(images.tolist(), keypoints[order].T, strict=True)
    ]
    steps = np.round(_PLACES * np.clip(np.concatenate(places, axis=1), 0.0, 1.0)).astype(np.int64)
    return np.bincount(misses, minlength=2), np.bincount(misses[order], minlength=2), steps


def _sampson_px(batch: MatchBatch, images: Images) -> FloatArray:
    """Return how far matches (M,) are from the epipolar lines, to first order, in pixels of both pictures.

    Cameras at one place have no such lines; their matches have NaN.
    """
    baselines = images.centers[batch.pairs[:, 1]] - images.centers[batch.pairs[:, 0]]
    directions, angles = batch.spread(normalized(baselines)), batch.spread(batch.pixel_angles)
    return sampson_errors_px(batch.rays_i, batch.rays_j, directions, angles)


def _most_telling(counts: IntArray, cameras: IntArray, num_cameras: int) -> IntArray:
    """Return which pairs of cameras (k, 2) to keep: of each camera the first few.

    Pairs most of whose matches contradict, by `counts` (k, 2), come first, then the others; with more matches
    first.
    """
    fit, against = counts.T
    order = np.lexsort((-counts.max(axis=1), fit >= against))
    seen, kept = np.zeros(num_cameras, dtype=np.int64), []
    for p, ends in zip(order.tolist(), cameras[order], strict=True):
        if (seen[ends] < _MOST_BESIDE).any():
            kept.append(p)
        seen[ends] += 1
    return np.sort(np.array(kept, dtype=np.int64))
