"""The door between models and `Points`, and pixels and rays of the points2D that observe them."""

from collections.abc import Callable

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, Int32Array, IntArray
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.files.colmap.lenses import camera_of, rays_of
from sfm_shapefit.files.colmap.model_arrays import ModelArrays
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points
from sfm_shapefit.scene.structure import Structure

Keypoints = Callable[[int], FloatArray | None]
"""Returns the pixels (k, 2) of the keypoints of an image by its row; k = 0 or None if there are none."""


class ModelKeypoints:
    """Keypoints seen through the lenses of `images`."""

    def __init__(self, images: Images, keypoints: Keypoints, counts: IntArray | None = None) -> None:
        self._lenses, self._lens_of = images.lenses, images.lens_of.tolist()
        self._cameras = [camera_of(lens) for lens in images.lenses]
        self._keypoints, self._counts = keypoints, counts  # (i,), where they are known

    def count(self, image: int) -> int:
        """Return how many keypoints an image has."""
        return len(self._pixels(image)) if self._counts is None else int(self._counts[image])

    def pixels(self, image: int, keypoints: IntArray | Int32Array) -> FloatArray:
        """Return where keypoints are, (k, 2)."""
        return self._pixels(image).take(keypoints, axis=0)  # indexing takes several times as long

    def rays(self, image: int, pixels: FloatArray) -> FloatArray:
        """Return rays (k, 3) of pixels; through a case of OPENCV, of depth 1."""
        lens, camera = self._lenses[self._lens_of[image]], self._cameras[self._lens_of[image]]
        if not lens.is_plane:
            return rays_of(lens, pixels)
        on_plane = np.asarray(camera.cam_from_img(pixels)).reshape(-1, 2)
        return np.concatenate([on_plane, np.ones((len(pixels), 1))], axis=1)

    def project(self, image: int, positions: FloatArray, *, ahead: bool = True) -> FloatArray:
        """Return the pixels (k, 2) of points (k, 3) in axes of the camera; of all, or of those it sees."""
        camera = self._cameras[self._lens_of[image]]
        pixels = camera.img_from_cam(positions, check_cheirality=ahead)
        return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)

    def _pixels(self, image: int) -> FloatArray:
        """Return the pixels of an image, (k, 2)."""
        xy = self._keypoints(image)
        return np.zeros((0, 2)) if xy is None else xy


def points2d_of(model: ModelArrays, images: Images) -> Keypoints:
    """Return what looks up the points2D of images."""
    rows = model.images.rows(images.ids).tolist()
    return lambda image: np.ascontiguousarray(model.keypoints(rows[image])["xy"], dtype=np.float64)


def structure_of(model: ModelArrays, images: Images) -> Structure:
    """Return the points that some images of a model observe, with their points2D."""
    return Structure(points_of(model, images), images, ModelKeypoints(images, points2d_of(model, images)))


def points_of(model: ModelArrays, images: Images) -> Points:
    """Return the points that some images of a model observe, ascending by id."""
    seen = [model.observed(row) for row in model.images.rows(images.ids).tolist()]
    ids = np.concatenate([points for _, points in seen]).astype(np.int64)
    order = np.argsort(ids, kind="stable")
    known, lengths = np.unique(ids, return_counts=True)
    return Points(
        xyz=np.ascontiguousarray(
            model.points["xyz"][np.searchsorted(model.points["id"], known.astype(np.uint64))]
        ),
        offsets=offsets_of(lengths),
        images=np.repeat(np.arange(len(seen)), [len(points) for _, points in seen])[order],
        keypoints=np.concatenate([keypoints for keypoints, _ in seen])[order],
        ids=known,
    )
