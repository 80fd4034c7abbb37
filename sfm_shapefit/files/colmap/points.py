"""The door between reconstructions and `Points`, and pixels and rays of the points2D that observe them."""

from collections.abc import Callable

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import FloatArray, Int32Array, IntArray
from sfm_shapefit.files.colmap.images import put_images
from sfm_shapefit.files.colmap.lenses import lens_of
from sfm_shapefit.files.colmap.model import camera_rays, observed_points, points2d_xy
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points

Keypoints = Callable[[int], FloatArray | None]
"""Returns the pixels (k, 2) of the keypoints of an image by its row, if there are any."""


class ModelPictures:
    """The points2D of images of a reconstruction, or keypoints instead of them, see `Pictures`."""

    def __init__(
        self, reconstruction: pycolmap.Reconstruction, images: Images, keypoints: Keypoints | None = None
    ) -> None:
        self._images = [reconstruction.image(i) for i in images.ids.tolist()]
        self._cameras = [reconstruction.camera(image.camera_id) for image in self._images]
        self._keypoints = keypoints

    def count(self, image: int) -> int:
        """Return how many points2D an image has."""
        return len(self._pixels(image))

    def look_up(self, image: int, keypoints: IntArray | Int32Array) -> tuple[FloatArray, FloatArray]:
        """Return pixels (k, 2) and rays (k, 3) of points2D; through a case of OPENCV, of depth 1."""
        camera, xy = self._cameras[image], self._pixels(image)[keypoints]
        if not lens_of(camera).is_adjustable:
            return xy, camera_rays(camera, xy)
        on_plane = np.asarray(camera.cam_from_img(xy)).reshape(-1, 2)
        return xy, np.concatenate([on_plane, np.ones((len(xy), 1))], axis=1)

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
    for point_id, end, xyz in zip(points.ids.tolist(), points.offsets[1:].tolist(), points.xyz, strict=True):
        track = pycolmap.Track()
        for image_id, keypoint in zip(image_ids[begin:end], keypoints[begin:end], strict=True):
            track.add_element(image_id, keypoint)  # a TrackElement for each takes four times as long
        point = pycolmap.Point3D(xyz=xyz, track=track)
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
