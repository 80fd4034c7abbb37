"""What seeded models are made from: cameras, rigs, frames and images of the input, but none of its points."""

from dataclasses import dataclass, replace

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.files.colmap.model import ColmapModel
from sfm_shapefit.files.colmap.model_arrays import CAMERA_SENSOR, ModelArrays, RigRecord, Sensor
from sfm_shapefit.files.colmap.point_colors import PointColors, read_colors


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Template:
    """A model without points, with what `Images` do not hold; only `files` looks into it."""

    model: ModelArrays
    """Without points, with the keypoints that images keep."""
    colors: PointColors | None = None
    """Colors of the input's points, by the keypoints that see them; None if it had no points."""

    @property
    def image_names(self) -> tuple[str, ...]:
        """Names of all images, posed or not."""
        return self.model.images.names

    @property
    def has_open_sensors(self) -> bool:
        """Whether a rig has sensors that are no cameras, such as an IMU, and no camera off its origin."""
        return any(map(_open_sensors, self.model.rigs))

    def resized(self, scale: float) -> "Template":
        """Return the same with these sensors so many times as far from the origins of their rigs."""
        rigs = []
        for rig in self.model.rigs:
            moved = {
                sensor: np.append(pose[:4], scale * pose[4:]) for sensor, pose in _open_sensors(rig).items()
            }
            rigs.append(RigRecord(rig.id, {**rig.sensors, **moved}))
        return replace(self, model=replace(self.model, rigs=tuple(rigs)))


def _open_sensors(rig: RigRecord) -> dict[Sensor, FloatArray]:
    """Return the posed sensors of a rig that are no cameras; none where a camera is off its origin."""
    poses = rig.poses
    if any(pose[4:].any() for (kind, _), pose in poses.items() if kind == CAMERA_SENSOR):
        return {}
    return {sensor: pose for sensor, pose in poses.items() if sensor[0] != CAMERA_SENSOR}


def template_of(model: ColmapModel, replaced: BoolArray | None = None) -> Template:
    """Return the template of a model.

    Args:
        model: as read. Its points serve for their colors alone: of 10,000 images, points and keypoints take
            0.5 GB, which is free once the model is.
        replaced: (i,) images whose keypoints a database has, which are left out here; None: none.
    """
    bare = None if replaced is None else np.isin(model.arrays.images.ids, model.images.ids[replaced])
    return Template(model=model.arrays.without_points(bare), colors=read_colors(model.arrays))
