"""The cameras, rigs, frames and images of a synthetic scene in COLMAP's terms, for models and databases.

Sensor s of rig r of S sensors is camera S r + s + 1, for COLMAP has every camera in one rig; rig r has id
r + 1, frame f id f + 1, and image k id k + 1 and a name such as "0001.jpg".
"""

import copy
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.synthetic.layouts import ByteArray
from sfm_shapefit.synthetic.rigs import Rigs


class Points(NamedTuple):
    """The points of a model."""

    ids: IntArray
    """(p,)"""
    xyz: FloatArray
    """(p, 3) world axes."""
    colors: ByteArray
    """(p, 3) red, green, blue."""
    tracks: Sequence[IntArray]
    """Per point (k, 2): (image, keypoint)."""


def image_name(index: int) -> str:
    """Return the name of image `index` of a scene."""
    return f"{index + 1:04d}.jpg"


def rigid(rotation: FloatArray, translation: FloatArray) -> pycolmap.Rigid3d:
    """Return the transform x -> rotation @ x + translation."""
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)


def new_rigs(rigs: Rigs, camera: pycolmap.Camera) -> tuple[list[pycolmap.Camera], list[pycolmap.Rig]]:
    """Return the cameras, all alike, and the rigs with the poses of their sensors."""
    count, sensors = rigs.sensor_centers.shape[:2]
    cameras, made = [], []
    for r in range(count):
        rig = pycolmap.Rig(rig_id=r + 1)
        for s in range(sensors):
            own = copy.copy(camera)
            own.camera_id = r * sensors + s + 1
            cameras.append(own)
            if s == 0:
                rig.add_ref_sensor(own.sensor_id)
            else:
                rotation = rigs.sensor_rotations[r, s]
                rig.add_sensor(own.sensor_id, rigid(rotation, -rotation @ rigs.sensor_centers[r, s]))
        made.append(rig)
    return cameras, made


def new_images(
    rigs: Rigs, keypoints: Sequence[FloatArray]
) -> tuple[list[pycolmap.Image], list[pycolmap.Frame]]:
    """Return the images with their keypoints (k, 2), and their frames, without poses."""
    camera = rigs.rig_of_frame[rigs.frame_of_image] * rigs.sensor_centers.shape[1] + rigs.sensor_of_image + 1
    frames = [pycolmap.Frame(frame_id=f + 1, rig_id=int(rig) + 1) for f, rig in enumerate(rigs.rig_of_frame)]
    images = [
        pycolmap.Image(name=image_name(k), keypoints=xy, camera_id=int(camera[k]), image_id=k + 1)
        for k, xy in enumerate(keypoints)
    ]
    for image, frame in zip(images, rigs.frame_of_image, strict=True):
        frames[frame].add_data_id(image.data_id)
    return images, frames


def new_model(
    rigs: Rigs,
    camera: pycolmap.Camera,
    rotations: FloatArray,
    translations: FloatArray,
    keypoints: Sequence[FloatArray],
    points: Points | None,
) -> pycolmap.Reconstruction:
    """Return a model; a frame has the pose of the reference sensor of its rig.

    Args:
        rigs: of n images.
        camera: whose intrinsics all have.
        rotations: (n, 3, 3) cam_from_world.
        translations: (n, 3) cam_from_world.
        keypoints: per image, (k, 2).
        points: with their tracks; none if None.
    """
    model = pycolmap.Reconstruction()
    cameras, made = new_rigs(rigs, camera)
    images, frames = new_images(rigs, keypoints)
    for own in cameras:
        model.add_camera(own)
    for rig in made:
        model.add_rig(rig)
    for frame, k in zip(frames, np.flatnonzero(rigs.sensor_of_image == 0), strict=True):
        frame.rig_from_world = rigid(rotations[k], translations[k])
        model.add_frame(frame)
    for image, f in zip(images, rigs.frame_of_image, strict=True):
        image.frame_id = int(f) + 1
        model.add_image(image)
    if points is not None:
        for point_id, xyz, color, seen in zip(*points, strict=True):
            track = pycolmap.Track([pycolmap.TrackElement(k + 1, keypoint) for k, keypoint in seen.tolist()])
            point = pycolmap.Point3D(xyz=xyz, color=color, track=track)
            model.add_point3D_with_id(int(point_id), point)
        model.update_point_3d_errors()
    return model
