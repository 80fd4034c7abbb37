"""What seeded models are made from: cameras, rigs, frames and image names of the input, but no points."""

from collections.abc import Iterable
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import BoolArray
from sfm_shapefit.files.colmap.images import bytes_of_name, name_of
from sfm_shapefit.files.colmap.model import ColmapModel
from sfm_shapefit.files.colmap.point_colors import PointColors, read_colors
from sfm_shapefit.files.colmap.points import points2d_xy


class FrameHead(NamedTuple):
    """A frame without its rig and images, which a new model has to have first."""

    id: int
    rig_id: int
    data_ids: tuple[pycolmap.data_t, ...]
    pose: pycolmap.Rigid3d | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Template:
    """All that a model has beside its points, with what arrays do not hold; only `files` looks into it."""

    cameras: tuple[pycolmap.Camera, ...]
    rigs: tuple[pycolmap.Rig, ...]
    frames: tuple[FrameHead, ...]
    images: tuple[pycolmap.Image, ...]
    """With the keypoints that they keep."""
    colors: PointColors | None = None
    """Colors of the input's points, by the keypoints that see them; None if it had no points."""

    @property
    def image_names(self) -> tuple[str, ...]:
        """Names of all images, posed or not."""
        return tuple(name_of(image) for image in self.images)

    @property
    def has_open_sensors(self) -> bool:
        """Whether a rig has sensors that are no cameras, such as an IMU, and no camera off its origin."""
        return any(map(_open_sensors, self.rigs))

    def resized(self, scale: float) -> "Template":
        """Return the same with these sensors so many times as far from the origins of their rigs."""
        rigs = deepcopy(self.rigs)
        for rig in rigs:
            for sensor, pose in _open_sensors(rig).items():
                rig.set_sensor_from_rig(sensor, pycolmap.Rigid3d(pose.rotation, scale * pose.translation))
        return replace(self, rigs=rigs)

    def build(self) -> pycolmap.Reconstruction:
        """Return a new model without points, its frames where they were."""
        model = pycolmap.Reconstruction()
        for camera in self.cameras:
            model.add_camera(camera)
        for rig in self.rigs:
            model.add_rig(rig)
        frame_of = {}
        for head in self.frames:
            frame = pycolmap.Frame(frame_id=head.id, rig_id=head.rig_id)
            for data_id in head.data_ids:
                frame.add_data_id(data_id)
                if data_id.sensor_id.type == pycolmap.SensorType.CAMERA:
                    frame_of[data_id.id] = head.id
            if head.pose is not None:
                frame.rig_from_world = head.pose
            model.add_frame(frame)
        for image in self.images:
            copy = bare_image(image, keeps_keypoints=True)
            copy.frame_id = frame_of[image.image_id]
            model.add_image(copy)
        for head in self.frames:
            if head.pose is not None:
                model.register_frame(head.id)
        return model


def _open_sensors(rig: pycolmap.Rig) -> dict[pycolmap.sensor_t, pycolmap.Rigid3d]:
    """Return the posed sensors of a rig that are no cameras; none where a camera is off its origin."""
    posed = {sensor: pose for sensor, pose in rig.non_ref_sensors.items() if pose is not None}
    cameras = [sensor for sensor in posed if sensor.type == pycolmap.SensorType.CAMERA]
    if any(posed.pop(sensor).translation.any() for sensor in cameras):
        return {}
    return posed


def template_of(model: ColmapModel, replaced: BoolArray | None = None) -> Template:
    """Return the template of a model.

    Args:
        model: as read. Its points serve for their colors alone: of 10,000 images, points and keypoints take
            0.5 GB, which is free once the model is.
        replaced: (i,) images whose keypoints a database has, which are left out here; None: none.
    """
    read, is_replaced = model.reconstruction, set[int]()
    if replaced is not None:
        is_replaced = set(model.images.ids[replaced].tolist())
    return Template(
        cameras=tuple(deepcopy(camera) for camera in read.cameras.values()),
        rigs=tuple(deepcopy(rig) for rig in read.rigs.values()),
        frames=heads_of(read.frames.values()),
        images=tuple(
            bare_image(image, keeps_keypoints=image.image_id not in is_replaced)
            for image in read.images.values()
        ),
        colors=read_colors(read, model.observed),
    )


def bare_image(image: pycolmap.Image, *, keeps_keypoints: bool) -> pycolmap.Image:
    """Return an image by itself, in no frame, whose keypoints observe nothing."""
    keypoints = points2d_xy(image) if keeps_keypoints else np.zeros((0, 2))
    return pycolmap.Image(
        name=bytes_of_name(name_of(image)),
        camera_id=image.camera_id,
        image_id=image.image_id,
        keypoints=keypoints,
    )


def heads_of(frames: Iterable[pycolmap.Frame]) -> tuple[FrameHead, ...]:
    """Return the heads of frames, which outlive these."""
    return tuple(
        FrameHead(
            id=frame.frame_id,
            rig_id=frame.rig_id,
            data_ids=tuple(deepcopy(data_id) for data_id in frame.data_ids),
            pose=deepcopy(frame.rig_from_world),
        )
        for frame in frames
    )
