"""The door between reconstructions and `Points`, and pixels and rays of the points2D that observe them."""

import itertools
from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt
import pycolmap

from sfm_shapefit.base.arrays import FloatArray, Int32Array, IntArray, UInt64Array
from sfm_shapefit.files.colmap.images import put_images
from sfm_shapefit.files.colmap.lenses import camera_of, rays_of
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points

Keypoints = Callable[[int], FloatArray | None]
"""Returns the pixels (k, 2) of the keypoints of an image by its row; k = 0 or None if there are none."""

Observed = Mapping[int, tuple[Int32Array, UInt64Array]]
"""By the id of an image: its points2D that observe a 3D point, ascending, and the ids of those points."""

# For this camera, pixel coordinates and normalized coordinates are the same numbers.
_IDENTITY_CAMERA = pycolmap.Camera(model="PINHOLE", width=1, height=1, params=[1.0, 1.0, 0.0, 0.0])


def points2d_xy(image: pycolmap.Image) -> FloatArray:
    """Return the pixels of all points of an image, (k, 2), without a Python loop over them."""
    if not len(image.points2D):
        return np.zeros((0, 2))
    return np.asarray(_IDENTITY_CAMERA.cam_from_img(image.points2D), dtype=np.float64).reshape(-1, 2)


def observed_points(image: pycolmap.Image) -> tuple[IntArray, UInt64Array]:
    """Return the indices, ascending, of the points2D that observe a 3D point, and the ids of those points.

    pycolmap has no array of the ids. Only the observed points become Python objects, one attribute each;
    most points of an image usually observe nothing.
    """
    keypoints = np.array(image.get_observation_point2D_idxs(), dtype=np.int64)
    points = (point.point3D_id for point in image.get_observation_points2D())
    return keypoints, np.fromiter(points, dtype=np.uint64, count=len(keypoints))


class ModelPictures:
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
        return self._pixels(image)[keypoints]

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
        found = camera.img_from_cam(positions, check_cheirality=ahead)
        return np.asarray(found, dtype=np.float64).reshape(-1, 2)

    def _pixels(self, image: int) -> FloatArray:
        """Return the pixels of an image, (k, 2)."""
        xy = self._keypoints(image)
        return np.zeros((0, 2)) if xy is None else xy


def points2d_of(reconstruction: pycolmap.Reconstruction, images: Images) -> Keypoints:
    """Return what looks up the points2D of images."""
    ids = images.ids.tolist()
    return lambda image: points2d_xy(reconstruction.image(ids[image]))


def points_of(reconstruction: pycolmap.Reconstruction, images: Images) -> Points:
    """Return the points that some images of a reconstruction observe, ascending by id."""
    seen = [observed_points(reconstruction.image(i)) for i in images.ids.tolist()]
    ids = np.concatenate([points for _, points in seen]).astype(np.int64)
    order = np.argsort(ids, kind="stable")
    known, lengths = np.unique(ids, return_counts=True)
    xyz = [reconstruction.point3D(i).xyz for i in known.tolist()]
    return Points(
        xyz=np.array(xyz).reshape(-1, 3),
        offsets=np.append(0, np.cumsum(lengths)),
        images=np.repeat(np.arange(len(seen)), [len(points) for _, points in seen])[order],
        keypoints=np.concatenate([keypoints for keypoints, _ in seen])[order],
        ids=known,
    )


def add_points(
    model: pycolmap.Reconstruction,
    image_ids: IntArray,
    points: Points,
    colors: npt.NDArray[np.uint8],
) -> None:
    """Add points to our own model.

    Args:
        model: changed in place.
        image_ids: (i,) of its images, which the points' observations index.
        points: with ids that it has not.
        colors: (x, 3) of the points.
    """
    errors = np.full(points.num_points, -1.0) if points.errors_px is None else points.errors_px
    bounds = itertools.pairwise(points.offsets.tolist())
    given = zip(points.ids.tolist(), bounds, points.xyz, colors, errors, strict=True)
    for point_id, (begin, end), xyz, color, error in given:
        track = pycolmap.Track()
        ids = image_ids[points.images[begin:end]].tolist()
        for image_id, keypoint in zip(ids, points.keypoints[begin:end].tolist(), strict=True):
            track.add_element(image_id, keypoint)  # a TrackElement for each takes four times as long
        point = pycolmap.Point3D(xyz=xyz, track=track, color=color)
        point.error = error
        model.add_point3D_with_id(point_id, point)


def move_model(
    reconstruction: pycolmap.Reconstruction, images: Images, points: Points
) -> pycolmap.Reconstruction:
    """Return a copy with some images and points elsewhere, see `put_images`; all errors are updated."""
    copy = pycolmap.Reconstruction(reconstruction)
    put_images(copy, images)
    for point_id, xyz in zip(points.ids.tolist(), points.xyz, strict=True):
        copy.point3D(point_id).xyz = xyz
    copy.update_point_3d_errors()
    return copy
