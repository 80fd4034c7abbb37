"""Rigs of synthetic scenes: which images were taken at once, and where the sensors stand in their rig.

A rig's axes are those of its first sensor: x to the right, y down, z ahead. Sensors stand apart as on a
car, so that a scene of some 20 m has a scale to a thousandth:

    pair            two look ahead, side by side
    back-to-back    one looks ahead, one backwards: they never see the same
    four            a pair, and a back-to-back pair that looks to the left and to the right
"""

from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.synthetic.scene_options import RigKind


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rigs:
    """Which images belong to which rig: image k is what a sensor of a rig saw in a frame of it."""

    rig_of_frame: IntArray
    """(f,)"""
    frame_of_image: IntArray
    """(n,) ascending; each frame has all sensors of its rig."""
    sensor_of_image: IntArray
    """(n,) 0 is the reference sensor of the rig."""
    sensor_rotations: FloatArray
    """(rigs, sensors, 3, 3) sensor_from_rig."""
    sensor_centers: FloatArray
    """(rigs, sensors, 3) place of each sensor in its rig, in meters; 0 for the reference."""

    def rotations_of(self, frame_rotations: FloatArray) -> FloatArray:
        """Return cam_from_world (n, 3, 3) of the images from rig_from_world (f, 3, 3) of their frames."""
        rig = self.rig_of_frame[self.frame_of_image]
        sensors = self.sensor_rotations[rig, self.sensor_of_image]
        return np.asarray(sensors @ frame_rotations[self.frame_of_image])

    def centers_of(self, frame_rotations: FloatArray, frame_centers: FloatArray) -> FloatArray:
        """Return the centers (n, 3) of the images from the poses of their frames."""
        rig = self.rig_of_frame[self.frame_of_image]
        offsets = self.sensor_centers[rig, self.sensor_of_image]
        turned = np.einsum("nji,nj->ni", frame_rotations[self.frame_of_image], offsets)
        return np.asarray(frame_centers[self.frame_of_image] + turned)


def mounted(kind: RigKind, num_images: int) -> Rigs:
    """Return one rig of a kind and its frames: whole ones only, so that there may be fewer images."""
    yaw_deg, offsets_m = _SENSORS[kind]
    frames = np.zeros(num_images // len(yaw_deg), dtype=np.int64)
    return rigs_of(frames, np.array(yaw_deg), np.array([offsets_m]))


def rigs_of(rig_of_frame: IntArray, yaw_deg: FloatArray, offsets_m: FloatArray) -> Rigs:
    """Return rigs of s sensors, turned left by `yaw_deg` (s,), and their frames, all complete.

    Args:
        rig_of_frame: (f,) the rig of each frame.
        yaw_deg: (s,) of the sensors, in every rig.
        offsets_m: (rigs, s, 3) place of each sensor in its rig.
    """
    count, num_frames = len(yaw_deg), len(rig_of_frame)
    return Rigs(
        rig_of_frame=rig_of_frame,
        frame_of_image=np.repeat(np.arange(num_frames), count),
        sensor_of_image=np.tile(np.arange(count), num_frames),
        sensor_rotations=np.tile(_yawed(yaw_deg), (len(offsets_m), 1, 1, 1)),
        sensor_centers=offsets_m,
    )


def _yawed(yaw_deg: FloatArray) -> FloatArray:
    """Return sensor_from_rig rotations (s, 3, 3) of sensors turned to the left about the rig's y axis."""
    yaw = np.radians(yaw_deg)
    cosine, sine, zero, one = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw), np.ones_like(yaw)
    rows = [[cosine, zero, sine], [zero, one, zero], [-sine, zero, cosine]]
    return np.moveaxis(np.array(rows), 2, 0)


_SENSORS: dict[RigKind, tuple[list[float], list[list[float]]]] = {
    "none": ([0.0], [[0.0, 0.0, 0.0]]),
    "pair": ([0.0, 0.0], [[0.0, 0.0, 0.0], [1.2, 0.0, 0.0]]),
    "back-to-back": ([0.0, 180.0], [[0.0, 0.0, 0.0], [0.3, 0.1, -2.4]]),
    "four": (
        [0.0, 0.0, 90.0, -90.0],
        [[0.0, 0.0, 0.0], [1.2, 0.0, 0.0], [-0.2, -0.2, -1.0], [1.4, -0.2, -1.0]],
    ),
}
"""Yaw in degrees, and offset in meters, of each sensor of a kind of rig."""
