"""The door between reconstructions and `Points`, and pixels and rays of the points2D that observe them."""

from collections.abc import Callable

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import FloatArray, Int32Array, IntArray
from sfm_shapefit.files.colmap.images import put_images
from sfm_shapefit.files.colmap.lenses import camera_of, lens_of
from sfm_shapefit.files.colmap.model import camera_rays, observed_points, points2d_xy
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points

Keypoints = Callable[[int], FloatArray | None]
"""Returns the pixels (k, 2) of the keypoints of an image by its row, if there are any."""


class ModelPictures:
    """The points2D of a reconstruction, or keypoints instead, seen through the lenses of `images`."""

    def __init__(
        self, reconstruction: pycolmap.Reconstruction, images: Images, keypoints: Keypoints | None = None
    ) -> None:
        self._images = [reconstruction.image(i) for i in images.ids.tolist()]
        self._cameras, self._lens_of = [camera_of(lens) for lens in images.lenses], images.lens_of.tolist()
        self._keypoints = keypoints

    def count(self, image: int) -> int:
        """Return how many points2D an image has."""
        return len(self._pixels(image))

    def pixels(self, image: int, keypoints: IntArray | Int32Array) -> FloatArray:
        """Return where points2D are, (k, 2)."""
        return self._pixels(image)[keypoints]

    def rays(self, image: int, pixels: FloatArray) -> FloatArray:
        """Return rays (k, 3) of pixels; through a case of OPENCV, of depth 1."""
        camera = self._cameras[self._lens_of[image]]
        if not lens_of(camera).is_adjustable:
            return camera_rays(camera, pixels)
        on_plane = np.asarray(camera.cam_from_img(pixels)).reshape(-1, 2)
        return np.concatenate([on_plane, np.ones((len(pixels), 1))], axis=1)

    def project(self, image: int, positions: FloatArray, *, ahead: bool = True) -> FloatArray:
        """Return the pixels (k, 2) of points (k, 3) in axes of the camera; of all, or of those it sees."""
        camera = self._cameras[self._lens_of[image]]
        found = camera.img_from_cam(positions, check_cheirality=ahead)
        return np.asarray(found, dtype=np.float64).reshape(-1, 2)

    def _pixels(self, image: int) -> FloatArray:
        """Return the pixels of an image, (k, 2)."""
        xy = None if self._keypoints is None else self._keypoints(image)
        return points2d_xy(self._images[image]) if xy is None or not len(xy) else xy


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
    reconstruction: pycolmap.Reconstruction,
    images: Images,
    points: Points,
    colors: pycolmap.Reconstruction | None = None,
) -> None:
    """Add points to our own `reconstruction`.

    Args:
        reconstruction: changed in place.
        images: of it, which the points' observations index.
        points: with ids that it has not.
        colors: the model whose points give theirs, by the same ids.
    """
    image_ids, keypoints = images.ids[points.images].tolist(), points.keypoints.tolist()
    begin = 0
    errors = np.full(points.num_points, -1.0) if points.errors_px is None else points.errors_px
    given = zip(points.ids.tolist(), points.offsets[1:].tolist(), points.xyz, errors.tolist(), strict=True)
    for point_id, end, xyz, error in given:
        track = pycolmap.Track()
        for image_id, keypoint in zip(image_ids[begin:end], keypoints[begin:end], strict=True):
            track.add_element(image_id, keypoint)  # a TrackElement for each takes four times as long
        point = pycolmap.Point3D(xyz=xyz, track=track)
        point.error = error
        if colors is not None:
            point.color = colors.point3D(point_id).color
        reconstruction.add_point3D_with_id(point_id, point)
        begin = end


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
