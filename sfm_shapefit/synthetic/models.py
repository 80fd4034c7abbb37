"""Models of synthetic scenes in COLMAP's terms, and the cameras, rigs and images that databases need too.

Sensor s of rig r of S sensors is camera S r + s + 1, for COLMAP has every camera in one rig; rig r has id
r + 1, frame f id f + 1, and image k id k + 1 and a name such as "0001.jpg".
"""

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.files.colmap.seed import write_model
from sfm_shapefit.synthetic.layouts import ByteArray, SceneCameras
from sfm_shapefit.synthetic.mounts import Rigs
from sfm_shapefit.synthetic.options import ModelContent


class ModelPoints(NamedTuple):
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
            mounted = copy.copy(camera)
            mounted.camera_id = r * sensors + s + 1
            cameras.append(mounted)
            if s == 0:
                rig.add_ref_sensor(mounted.sensor_id)
            else:
                rotation = rigs.sensor_rotations[r, s]
                rig.add_sensor(mounted.sensor_id, rigid(rotation, -rotation @ rigs.sensor_centers[r, s]))
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


def new_camera(scene: SceneCameras, model: str, parameters: list[float]) -> pycolmap.Camera:
    """Return a camera with the size of a scene's images."""
    return pycolmap.Camera(
        camera_id=1,
        model=model,
        width=scene.options.image_width,
        height=scene.options.image_height,
        params=parameters,
        has_prior_focal_length=True,
    )


class ModelParts(NamedTuple):
    """What the models of a scene have in common."""

    scene: SceneCameras
    camera: pycolmap.Camera
    keypoints: Sequence[FloatArray]
    """Per image, (k, 2)."""
    points: ModelPoints | None

    def model(self, rotations: FloatArray) -> pycolmap.Reconstruction:
        """Return the model with the given rotations at the true centers."""
        pairs = zip(rotations, self.scene.centers, strict=True)
        return self._assemble([rigid(rotation, -rotation @ center) for rotation, center in pairs])

    def rotations_only(self) -> pycolmap.Reconstruction:
        """Return cameras and images with the stated rotations, all centers at the origin, and no points."""
        bare = self._replace(keypoints=[np.empty((0, 2))] * self.scene.num_images, points=None)
        return bare._assemble([rigid(rotation, np.zeros(3)) for rotation in self.scene.stated_rotations])

    def _assemble(self, poses: list[pycolmap.Rigid3d]) -> pycolmap.Reconstruction:
        """Return the model; a frame has the pose of the reference sensor of its rig."""
        model = pycolmap.Reconstruction()
        cameras, rigs = new_rigs(self.scene.rigs, self.camera)
        images, frames = new_images(self.scene.rigs, self.keypoints)
        for camera in cameras:
            model.add_camera(camera)
        for rig in rigs:
            model.add_rig(rig)
        for frame, k in zip(frames, np.flatnonzero(self.scene.rigs.sensor_of_image == 0), strict=True):
            frame.rig_from_world = poses[k]
            model.add_frame(frame)
        for image, f in zip(images, self.scene.rigs.frame_of_image, strict=True):
            image.frame_id = int(f) + 1
            model.add_image(image)
        if self.points is not None:
            for point_id, xyz, color, seen in zip(*self.points, strict=True):
                track = pycolmap.Track([pycolmap.TrackElement(k + 1, xy) for k, xy in seen.tolist()])
                point = pycolmap.Point3D(xyz=xyz, color=color, track=track)
                model.add_point3D_with_id(int(point_id), point)
            model.update_point_3d_errors()
        return model


def write_models(parts: ModelParts, workspace: Path, content: ModelContent) -> None:
    """Write sparse/0, and the truth where it is another model."""
    scene = parts.scene
    written = {"sparse/0": parts.model(scene.rotations)}
    if content == "rotations":
        written = {"sparse/0": parts.rotations_only(), "truth": written["sparse/0"]}
    elif not np.array_equal(scene.rotations, scene.stated_rotations):
        written = {"sparse/0": parts.model(scene.stated_rotations), "truth": written["sparse/0"]}
    for folder, model in written.items():
        (workspace / folder).mkdir(parents=True)
        write_model(model, workspace / folder)
