"""The 3D points of a model, and the keypoints of images that observe them, as arrays."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import (
    BoolArray,
    FloatArray,
    Int32Array,
    IntArray,
    stable_order,
)
from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.base.lists import Lists, RowLists, offsets_of
from sfm_shapefit.scene.matches import KeypointMatches


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Points(Lists):
    """Points with their tracks: point x has the observations offsets[x]:offsets[x + 1]."""

    xyz: FloatArray
    """(x, 3)"""
    offsets: IntArray
    """(x + 1,)"""
    images: IntArray | Int32Array
    """(o,) image of each observation; of 32 bits, as the next ones."""
    keypoints: IntArray | Int32Array
    """(o,) which of the image's keypoints it is."""
    ids: IntArray
    """(x,)"""
    errors_px: FloatArray | None = None
    """(x,) mean reprojection errors; None if unknown."""

    def __post_init__(self) -> None:
        """Bring the columns of observations to their type."""
        for name in ("images", "keypoints"):
            object.__setattr__(self, name, getattr(self, name).astype(np.int32, copy=False))

    @property
    def num_points(self) -> int:
        """Number of points, x."""
        return len(self.xyz)

    def points_seen(self) -> Int32Array:
        """Return the point of each observation, (o,)."""
        return self.spread(np.arange(self.num_points, dtype=np.int32))

    def count_seen(self, num_images: int) -> IntArray:
        """Return how many observations each image has, (i,)."""
        return np.bincount(self.images, minlength=num_images).astype(np.int64)

    def rows_of_images(self, num_images: int) -> RowLists:
        """Return the observations of each image, ascending."""
        rows_of = RowLists.by_label(self.images, num_images)
        rows: Any = rows_of.rows.astype(np.int32)
        return RowLists(rows_of.offsets, rows)

    def paired(self, chosen: BoolArray) -> BoolArray:
        """Return which observations (o,) are chosen with another one of their point."""
        return chosen & (self.count(chosen) >= 2)[self.points_seen()]

    def taken(self, chosen: BoolArray) -> "Points":
        """Return the points with some of their observations (o,); those that keep none are gone."""
        lengths = self.count(chosen)
        kept = lengths > 0
        return Points(
            xyz=self.xyz[kept],
            offsets=offsets_of(lengths[kept]),
            images=self.images[chosen],
            keypoints=self.keypoints[chosen],
            ids=self.ids[kept],
            errors_px=None if self.errors_px is None else self.errors_px[kept],
        )

    def seen_by(
        self, others: BoolArray, num_keypoints: IntArray, links: Iterable[KeypointMatches], least: int = 1
    ) -> "Points":
        """Return the points with the keypoints of other images (i,) that match their observations.

        Args:
            others: images that see none of the points yet.
            num_keypoints: (i,) of all images.
            links: matches of all pairs of images.
            least: observations of a point that a keypoint is to match.
        """
        begins = offsets_of(num_keypoints)
        point_of = np.full(begins[-1], -1)
        point_of[begins[self.images] + self.keypoints] = self.points_seen()
        observations = [np.zeros((0, 3), dtype=np.int64)]
        for batch in links:
            ends = batch.spread(batch.pairs)
            for end in (0, 1):
                points = point_of[begins[ends[:, 1 - end]] + batch.keypoints[:, 1 - end]]
                rows = np.flatnonzero(others[ends[:, end]] & (points >= 0))
                observations.append(
                    np.column_stack([points[rows], ends[rows, end], batch.keypoints[rows, end]])
                )
        new = np.concatenate(observations)
        if least > 1:
            new, counts = np.unique(new, axis=0, return_counts=True)
            new = new[counts >= least]
        # A keypoint sees one point, and a point is seen once in an image.
        new = new[np.unique(begins[new[:, 1]] + new[:, 2], return_index=True)[1]]
        new = new[np.unique(new[:, :2], axis=0, return_index=True)[1]]
        points = np.append(self.points_seen(), new[:, 0])
        order = stable_order(points)
        return replace(
            self,
            offsets=offsets_of(np.bincount(points, minlength=self.num_points)),
            images=np.append(self.images, new[:, 1])[order].astype(np.int32),
            keypoints=np.append(self.keypoints, new[:, 2])[order].astype(np.int32),
        )

    def transformed(self, motion: Similarity) -> "Points":
        """Return the points after a similarity of the world."""
        return replace(self, xyz=motion.apply(self.xyz))

    def count(self, chosen: BoolArray) -> IntArray:
        """Return how many observations (o,) of each point are chosen, (x,)."""
        before = np.zeros(len(chosen) + 1, dtype=np.int32)
        np.cumsum(chosen, out=before[1:])
        return np.diff(before[self.offsets]).astype(np.int64)


def number_points(parts: Iterable[Points]) -> Points:
    """Return the points of all parts one after the other, with ids from 1 on."""
    points = concatenate_points(parts)
    return replace(points, ids=np.arange(1, points.num_points + 1))


def concatenate_points(parts: Iterable[Points]) -> Points:
    """Return the points of all parts one after the other, with the ids that they have."""
    nothing = np.zeros(0, dtype=np.int32)
    columns: list[list[Any]] = [[np.zeros((0, 3))], [nothing], [nothing], [nothing], [nothing]]
    for part in parts:
        own = part.xyz, part.lengths(), part.images, part.keypoints, part.ids
        for column, rows in zip(columns, own, strict=True):
            column.append(rows)
    # A column at a time, for all of them twice would take the most memory of a run.
    xyz, lengths, images, keypoints, ids = (np.concatenate(columns.pop(0)) for _ in range(5))
    return Points(xyz=xyz, offsets=offsets_of(lengths), images=images, keypoints=keypoints, ids=ids)
