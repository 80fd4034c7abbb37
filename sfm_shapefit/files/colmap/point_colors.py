"""The colors of a model's points, kept by the keypoints that see them, so that the points need not be."""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pycolmap

from sfm_shapefit.base.arrays import Int32Array, IntArray, UInt64Array
from sfm_shapefit.files.colmap.points import Observed, observed_points, points2d_xy


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


def read_colors(source: pycolmap.Reconstruction, observed: Observed) -> PointColors:
    """Return the colors of a model's points; black is none. `observed` has what some of its images see."""
    points = source.points3D
    ids = np.array(sorted(source.point3D_ids()), dtype=np.uint64)
    colors = np.array([points[k].color for k in ids.tolist()], dtype=np.uint8).reshape(-1, 3)
    if not colors.any():
        return PointColors(colors=colors, images={})
    images = {}
    for image_id in sorted(source.images.keys()):
        image = source.image(image_id)
        keypoints, seen = observed.get(image_id) or observed_points(image)
        if len(keypoints):
            rows = np.searchsorted(ids, seen).astype(np.int32)
            images[image_id] = SeenColors(_digest(image), keypoints.astype(np.int32), rows)
    return PointColors(colors=colors, images=images)


def color_points(result: pycolmap.Reconstruction, source: PointColors) -> None:
    """Give points the mean color of the source's points seen at the same points2D; `result` changes.

    Images take part if their points2D are the same in both, in number and coordinates. Points without
    any common observation keep their color.
    """
    if not source.images:
        return
    ids = np.array(sorted(result.point3D_ids()), dtype=np.uint64)
    sums, counts = np.zeros((len(ids), 3)), np.zeros(len(ids), dtype=np.int64)
    for seen, rows in _common_observations(result, source):
        points = np.searchsorted(ids, seen)
        np.add.at(sums, points, source.colors[rows].astype(np.float64))
        np.add.at(counts, points, 1)
    is_seen = counts > 0
    means = np.rint(sums[is_seen] / counts[is_seen, None]).astype(np.uint8)
    for point_id, mean in zip(ids[is_seen].tolist(), means, strict=True):
        result.point3D(point_id).color = mean


def _common_observations(
    result: pycolmap.Reconstruction, source: PointColors
) -> Iterator[tuple[UInt64Array, IntArray]]:
    """Yield what each points2D of an image sees, if it sees a point in both models: its id, and the row."""
    for image_id in sorted(result.reg_image_ids()):
        image, known = result.image(image_id), source.images.get(image_id)
        if known is None or _digest(image) != known.digest:
            continue
        keypoints, ids = observed_points(image)
        _, own, others = np.intersect1d(keypoints, known.keypoints, assume_unique=True, return_indices=True)
        yield ids[own], known.points[others].astype(np.int64)


def _digest(image: pycolmap.Image) -> bytes:
    """Return what tells the points2D of images apart by their number and coordinates."""
    xy = points2d_xy(image) + 0.0  # -0 is 0
    return hashlib.blake2b(xy.tobytes(), digest_size=16).digest()
