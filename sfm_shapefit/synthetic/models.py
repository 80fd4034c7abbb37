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

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.files.colmap.images import images_of
from sfm_shapefit.files.colmap.reconstructions import arrays_of
from sfm_shapefit.files.colmap.seed import SeededModel, write_model
from sfm_shapefit.files.colmap.template import Template
from sfm_shapefit.scene.points import Points, number_points
from sfm_shapefit.synthetic.layouts import ByteArray, SceneCameras
from sfm_shapefit.synthetic.mounts import Rigs
from sfm_shapefit.synthetic.scene_options import ModelContent


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
    points: Points
    colors: ByteArray
    """(x, 3) red, green, blue of each point."""

    def model(self, rotations: FloatArray) -> pycolmap.Reconstruction:
        """Return the model with the given rotations at the true centers."""
        pairs = zip(rotations, self.scene.centers, strict=True)
        return self._assemble([rigid(rotation, -rotation @ center) for rotation, center in pairs])

    def rotations_only(self) -> pycolmap.Reconstruction:
        """Return cameras and images with the stated rotations, all centers at the origin, and no points."""
        nothing = [np.empty((0, 2))] * self.scene.num_images
        bare = self._replace(keypoints=nothing, points=number_points([]), colors=self.colors[:0])
        return bare._assemble([rigid(rotation, np.zeros(3)) for rotation in self.scene.stated_rotations])

    def _assemble(self, poses: list[pycolmap.Rigid3d]) -> pycolmap.Reconstruction:
        """Return the model; a frame has the pose of the reference sensor of its rig."""
        cameras, rigs = new_rigs(self.scene.rigs, self.camera)
        images, frames = new_images(self.scene.rigs, self.keypoints)
        bare = pycolmap.Reconstruction()
        for camera in cameras:
            bare.add_camera(camera)
        for rig in rigs:
            bare.add_rig(rig)
        for frame, k in zip(frames, np.flatnonzero(self.scene.rigs.sensor_of_image == 0), strict=True):
            frame.rig_from_world = poses[k]
            bare.add_frame(frame)
        for image, frame_number in zip(images, self.scene.rigs.frame_of_image.tolist(), strict=True):
            image.frame_id = frame_number + 1
            bare.add_image(image)
        for frame in frames:
            bare.register_frame(frame.frame_id)
        model, _ = arrays_of(bare)
        own = images_of(model)
        seed = SeededModel(
            template=Template(model=model),
            images=own.part(np.argsort(own.ids)),
            points=self.points,
            colors=self.colors,
            keypoints=tuple(self.keypoints),
        )
        seed.reconstruction.update_point_3d_errors()
        return seed.reconstruction


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
