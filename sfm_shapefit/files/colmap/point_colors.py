"""The colors of a model's points, kept by the keypoints that see them, so that the points need not be."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import FloatArray, Int32Array, UInt64Array
from sfm_shapefit.files.colmap.model_arrays import ModelArrays
from sfm_shapefit.scene.points import Points

_SPARSE = 8  # ids for each point; a table by id, of more, takes longer to fill than a search


class SeenColors(NamedTuple):
    """What an image sees of colored points."""

    digest: bytes
    """Digest of the coordinates of all its points2D: another model's are the same if it has the same."""
    keypoints: Int32Array
    """(k,) indices of the points2D that observe a point, ascending."""
    points: Int32Array
    """(k,) the rows of those points in `PointColors.colors`."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointColors:
    """The colors of a model's points, and the images that see them."""

    colors: npt.NDArray[np.uint8]
    """(p, 3) colors of the points, ascending by id."""
    images: Mapping[int, SeenColors]
    """By the ids of the images; of a model without any color, none."""


def read_colors(source: ModelArrays) -> PointColors:
    """Return the colors of a model's points; black is none."""
    ids, colors = source.points["id"].copy(), source.points["rgb"].copy()
    if not colors.any():
        return PointColors(colors=colors, images={})
    images, row_of = {}, _rows_by_id(ids)
    for row, image_id in enumerate(source.images.ids.tolist()):
        keypoints, seen = source.observed(row)
        if len(keypoints):
            rows = np.searchsorted(ids, seen) if row_of is None else row_of[seen - ids[0]]
            digest = _digest(np.ascontiguousarray(source.keypoints(row)["xy"]))
            images[image_id] = SeenColors(digest, keypoints.astype(np.int32), rows.astype(np.int32))
    return PointColors(colors=colors, images=images)


def _rows_by_id(ids: UInt64Array) -> Int32Array | None:
    """Return the row of each id from the first on, where ids (p,), ascending, have few gaps; else None."""
    span = int(ids[-1] - ids[0]) + 1
    if span > _SPARSE * len(ids):
        return None
    row_of = np.zeros(span, dtype=np.int32)
    row_of[ids - ids[0]] = np.arange(len(ids), dtype=np.int32)
    return row_of


def color_points(
    points: Points, ids: Sequence[int], pixels: Callable[[int], FloatArray], source: PointColors | None
) -> npt.NDArray[np.uint8]:
    """Return colors (x, 3) of points: the mean of the source's that are seen at the same points2D, or black.

    Images take part if their points2D are the same in both, in number and coordinates.

    Args:
        points: of images with these ids.
        ids: of the images.
        pixels: returns the points2D (k, 2) of an image by its row.
        source: colors of another model; None if it has no points.
    """
    sums, counts = np.zeros((points.num_points, 3)), np.zeros(points.num_points, dtype=np.int64)
    if source is not None and source.images:
        point_of = points.points_seen()
        for image, rows in enumerate(points.rows_of_images(len(ids))):
            known = source.images.get(ids[image])
            if known is None or not len(rows) or _digest(pixels(image)) != known.digest:
                continue
            both = np.intersect1d(points.keypoints[rows], known.keypoints, True, return_indices=True)
            seen = point_of[rows[both[1]]]
            np.add.at(sums, seen, source.colors[known.points[both[2]]].astype(np.float64))
            np.add.at(counts, seen, 1)
    return np.rint(sums / np.maximum(counts, 1)[:, None]).astype(np.uint8)


def _digest(xy: FloatArray) -> bytes:
    """Return what tells the points2D (k, 2) of images apart by their number and coordinates."""
    return hashlib.blake2b((xy + 0.0).tobytes(), digest_size=16).digest()  # -0 is 0
