"""Matches by a model's own 3D points: images that see the same one have a match there.

The keypoints of a match are `points2D` of its images. An image that observes the same point with several
keypoints gives no match for that point: it is unknown which one is right.
"""

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray, UInt32Array, distinct, stable_order
from sfm_shapefit.base.lists import RowLists
from sfm_shapefit.files.colmap.lenses import rays_of
from sfm_shapefit.files.colmap.model import ColmapModel
from sfm_shapefit.files.colmap.points import points_of
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import Lens
from sfm_shapefit.scene.matches import PLENTY, Matches, PairNames, Reading, View, batch_ranges
from sfm_shapefit.scene.points import Points


class TrackMatches(Matches):
    """The matches between the posed images of a model by its own points."""

    file = None
    """There is no database."""

    def __init__(self, model: ColmapModel) -> None:
        """Collect what the images observe, and count the matches of each pair."""
        super().__init__()
        self.lacking = "" if model.num_points else "; ".join(model.notes)
        self.names = model.images.names
        self._model, rows = model.arrays, model.arrays.images.rows(model.images.ids)
        self._rows = dict(zip(self.names, rows.tolist(), strict=True))
        self.num_keypoints = model.arrays.lengths()[rows]
        self.total_keypoints = int(self.num_keypoints.sum())
        seen = [model.arrays.observed(row) for row in rows.tolist()]
        points = np.concatenate([ids for _, ids in seen])
        image_of = np.repeat(np.arange(len(seen)), [len(ids) for _, ids in seen])
        order = stable_order(points)
        points, image_of = points[order], image_of[order]
        again = (points[1:] == points[:-1]) & (image_of[1:] == image_of[:-1])
        once = np.ones(len(points), dtype=np.bool_)
        once[1:] &= ~again
        once[:-1] &= ~again
        # Unambiguous observations by point, then by image: whose, by what, and how many of the point follow.
        self._image_of = image_of[once]
        self._keypoints = np.concatenate([keypoints for keypoints, _ in seen])[order[once]].astype(np.uint32)
        _, sizes = np.unique(points[once], return_counts=True)
        self._following = np.repeat(np.cumsum(sizes), sizes) - np.arange(len(self._image_of)) - 1
        self._of_images = RowLists.by_label(self._image_of, len(rows))
        self.pairs, self.num_matches = self._count()

    def at(self, images: Images, left_out: PairNames = frozenset(), reading: Reading = PLENTY) -> View:
        """Return the matches as other images see them; none is kept, for they are made anew in no time."""
        return super().at(images, left_out, reading._replace(keeps=False))

    def points_of(self, images: Images) -> Points:
        """Return the points that some of the images observe, as the model has them."""
        return points_of(self._model, images)

    def keypoints(self, name: str) -> FloatArray:
        """Return the pixels (k, 2) of the points of an image."""
        return np.ascontiguousarray(self._model.keypoints(self._rows[name])["xy"])

    def rays(self, lens: Lens, pixels: FloatArray) -> FloatArray:
        """Return the unit rays (k, 3) of pixels (k, 2) in camera axes; NaN for those without."""
        return rays_of(lens, pixels)

    def read(self, pairs: IntArray, *, keep: bool) -> tuple[IntArray, UInt32Array]:  # noqa: ARG002
        """Return the matches of pairs; they are made anew each time."""
        left, right = self._pair_up(distinct(self.pairs[pairs, 0]))
        wanted = self._codes(*self.pairs[pairs].T)
        codes = self._codes(self._image_of[left], self._image_of[right])
        row = np.minimum(np.searchsorted(wanted, codes), len(wanted) - 1)
        kept = wanted[row] == codes
        left, right, row = left[kept], right[kept], row[kept]
        order = np.lexsort((self._keypoints[left], row))
        matches = np.stack([self._keypoints[left], self._keypoints[right]], axis=1)[order]
        return np.bincount(row, minlength=len(pairs)), matches

    def _count(self) -> tuple[IntArray, IntArray]:
        """Return all pairs of images, and how many matches each has."""
        sizes = np.bincount(self._image_of, self._following, len(self.names)).astype(np.int64)
        codes, counts = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
        for first, last in batch_ranges(sizes, PLENTY.batch):
            left, right = self._pair_up(np.arange(first, last))
            of_pair = self._codes(self._image_of[left], self._image_of[right])
            for counted, parts in zip(np.unique(of_pair, return_counts=True), (codes, counts), strict=True):
                parts.append(counted)
        pairs = np.stack(np.divmod(np.concatenate(codes), len(self.names)), axis=1)
        return pairs, np.concatenate(counts)

    def _codes(self, i: IntArray, j: IntArray) -> IntArray:
        """Return numbers that ascend as pairs do."""
        return i * len(self.names) + j

    def _pair_up(self, images: IntArray) -> tuple[IntArray, IntArray]:
        """Return the observations of the images, and with each in turn those of its point that follow."""
        observations = self._of_images.subset(images).rows
        follows = self._following[observations]
        left = np.repeat(observations, follows)
        return left, left + 1 + np.arange(len(left)) - np.repeat(np.cumsum(follows) - follows, follows)
