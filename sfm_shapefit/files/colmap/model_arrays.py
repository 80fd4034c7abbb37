"""COLMAP models as arrays: what is read of their files, or of a reconstruction, and written again.

Everything stands in the order in which COLMAP writes it, ascending by id. A pose is qw, qx, qy, qz, tx, ty,
tz, the very numbers of the files, so that what does not change keeps its bits.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt
import pycolmap

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, UInt32Array, UInt64Array
from sfm_shapefit.base.lists import Lists, offsets_of
from sfm_shapefit.files.colmap.binary_records import NO_POINT, POINT2D, POINT3D
from sfm_shapefit.scene.lens import Lens

CAMERA_SENSOR = 0  # type of a sensor; COLMAP's number for cameras
AT_ONCE = 2**14
"""Points or keypoints that are looked at together; all those of 10,000 images take 200 MB."""
ORIGIN = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # a pose; that of the world itself
LARGEST_COORDINATE = 1e100
"""Units; sums of squares of larger coordinates overflow, and these count as not finite."""
FEWEST_IMAGES = 2  # observations; COLMAP removes a point that loses one of so many

Sensor = tuple[int, int]
"""Type and id."""
Records = npt.NDArray[np.void]


class RigRecord(NamedTuple):
    """A rig: cameras and other sensors that are fixed to one another."""

    id: int
    sensors: Mapping[Sensor, FloatArray | None]
    """Pose (7,) of each sensor in the rig; of the first, its reference, and where it is unknown, None."""

    @property
    def reference(self) -> Sensor | None:
        """The first sensor, whose axes are the rig's; None of a rig without sensors."""
        return next(iter(self.sensors), None)

    @property
    def poses(self) -> dict[Sensor, FloatArray]:
        """Poses that are known, by sensor."""
        return {sensor: pose for sensor, pose in self.sensors.items() if pose is not None}

    @property
    def camera_ids(self) -> list[int]:
        """Ids of the cameras, ascending."""
        return sorted(number for kind, number in self.sensors if kind == CAMERA_SENSOR)


class FrameRecords(NamedTuple):
    """Frames: what the sensors of a rig took at once."""

    ids: IntArray
    """(f,)"""
    rig_ids: IntArray
    """(f,)"""
    poses: FloatArray
    """(f, 7) rig_from_world; all NaN where there is none, the last three where the position is unknown."""
    data: tuple[tuple[tuple[int, int, int], ...], ...]
    """Type and id of each sensor, and the id of what it took."""

    @property
    def is_posed(self) -> BoolArray:
        """(f,) whether the rotation is known."""
        return np.asarray(np.isfinite(self.poses[:, :4]).all(axis=1))


class ImageRecords(NamedTuple):
    """Images, without their keypoints."""

    ids: IntArray
    """(i,)"""
    camera_ids: IntArray
    """(i,)"""
    frame_of: IntArray
    """(i,) rows of their frames."""
    names: tuple[str, ...]
    """Names, whose bytes that are no UTF-8 are lone surrogates, as Python's own."""

    def rows(self, ids: IntArray | UInt32Array) -> IntArray:
        """Return the rows of images by their ids, which are there."""
        return np.searchsorted(self.ids, ids)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModelArrays(Lists):
    """A COLMAP model; nobody modifies one."""

    lenses: tuple[Lens, ...]
    """Cameras, by id."""
    prior_focals: frozenset[int] = frozenset()
    """Ids of the cameras whose focal length is a prior, which models in memory and databases know alone."""
    rigs: tuple[RigRecord, ...]
    frames: FrameRecords
    images: ImageRecords
    offsets: IntArray
    """(i + 1,) the keypoints of image i are the rows offsets[i]:offsets[i + 1] of `points2d`."""
    points2d: Records
    """(k,) keypoints as `POINT2D`."""
    points: Records
    """(p,) as `POINT3D`."""
    tracks: UInt32Array
    """(t, 2) ids of images, and numbers of their keypoints, that observe the points one after the other."""

    @classmethod
    def alone(
        cls, lenses: tuple[Lens, ...], images: ImageRecords, poses: FloatArray, prior_focals: frozenset[int]
    ) -> Self:
        """Return the model of images without keypoints, at poses (i, 7), each in a frame of its id.

        Each camera is in a rig of its id, as COLMAP has it where nothing is said of rigs.
        """
        pairs = zip(images.ids.tolist(), images.camera_ids.tolist(), strict=True)
        data = tuple(((CAMERA_SENSOR, camera_id, image_id),) for image_id, camera_id in pairs)
        return cls(
            lenses=lenses,
            prior_focals=prior_focals,
            rigs=tuple(trivial_rig(lens.id) for lens in lenses),
            frames=FrameRecords(images.ids, images.camera_ids, poses, data),
            images=images._replace(frame_of=np.arange(len(images.ids))),
            offsets=np.zeros(len(images.ids) + 1, dtype=np.int64),
            points2d=np.zeros(0, POINT2D),
            points=np.zeros(0, POINT3D),
            tracks=np.zeros((0, 2), np.uint32),
        )

    def keypoints(self, row: int) -> Records:
        """Return the keypoints of an image by its row."""
        return self.points2d[self.slice_of(row)]

    def observed(self, row: int) -> tuple[IntArray, UInt64Array]:
        """Return which keypoints of an image observe a point, ascending, and the ids of the points."""
        ids = self.keypoints(row)["point3d_id"]
        keypoints = np.flatnonzero(ids != NO_POINT)
        return keypoints, ids[keypoints]

    def camera_poses(self) -> FloatArray:
        """Return cam_from_world (i, 7) of the images; NaN of those without a pose.

        Products are pycolmap's, so that they are those which it writes.
        """
        poses, rigs = self.frames.poses[self.images.frame_of], {rig.id: rig for rig in self.rigs}
        rig_of = self.frames.rig_ids[self.images.frame_of]
        posed = self.frames.is_posed[self.images.frame_of]
        for row, (rig_id, camera_id) in enumerate(
            zip(rig_of.tolist(), self.images.camera_ids.tolist(), strict=True)
        ):
            sensor = (CAMERA_SENSOR, camera_id)
            if sensor == rigs[rig_id].reference or not posed[row]:
                continue
            in_rig = rigs[rig_id].sensors[sensor]
            poses[row] = np.nan if in_rig is None else pose_of(rigid_of(in_rig) * rigid_of(poses[row]))
        return poses

    def point_blocks(self) -> Iterator[tuple[Records, UInt32Array]]:
        """Yield points with their tracks, `AT_ONCE` at a time."""
        ends = offsets_of(self.points["length"])
        for first in range(0, len(self.points), AT_ONCE):
            last = min(first + AT_ONCE, len(self.points))
            yield self.points[first:last], self.tracks[ends[first] : ends[last]]

    def without_points(self, bare: BoolArray | None = None) -> Self:
        """Return the model without points; of `bare` (i,) images, without keypoints, too."""
        counts = self.lengths()
        kept, counts = (
            (self.points2d.copy(), counts)
            if bare is None
            else (self.points2d[np.repeat(~bare, counts)], np.where(bare, 0, counts))
        )
        kept["point3d_id"] = NO_POINT
        return replace(
            self,
            offsets=offsets_of(counts),
            points2d=kept,
            points=np.zeros(0, POINT3D),
            tracks=np.zeros((0, 2), np.uint32),
        )

    def without_poses(self, frames: IntArray) -> Self:
        """Return the model in which some frames, by row, have no pose and observe nothing.

        As in COLMAP, a point that loses all but one of its observations is removed.
        """
        poses = self.frames.poses.copy()
        poses[frames] = np.nan
        bare = np.isin(self.images.frame_of, frames)
        lengths = self.points["length"].astype(np.int64)
        owner = np.repeat(np.arange(len(lengths)), lengths)
        kept = ~bare[self.images.rows(self.tracks[:, 0])]
        left = np.bincount(owner[kept], minlength=len(lengths))
        stays = (left == lengths) | (left >= FEWEST_IMAGES)
        kept &= stays[owner]
        points, points2d = self.points[stays], self.points2d.copy()
        points["length"] = left[stays]
        counts = self.lengths()
        gone = np.repeat(bare, counts) | np.isin(points2d["point3d_id"], self.points["id"][~stays])
        points2d["point3d_id"][gone] = NO_POINT
        return replace(
            self,
            frames=self.frames._replace(poses=poses),
            points2d=points2d,
            points=points,
            tracks=self.tracks[kept],
        )

    def renamed(self, names: Mapping[str, str]) -> Self:
        """Return the model whose images have other names, by those that they have."""
        return replace(
            self,
            images=self.images._replace(names=tuple(names.get(name, name) for name in self.images.names)),
        )


def trivial_rig(camera_id: int) -> RigRecord:
    """Return the rig of a camera alone, which has its id."""
    return RigRecord(camera_id, {(CAMERA_SENSOR, camera_id): None})


def rigid_of(pose: FloatArray) -> pycolmap.Rigid3d:
    """Return a pose (7,) as pycolmap's."""
    return pycolmap.Rigid3d(pycolmap.Rotation3d(pose[[1, 2, 3, 0]]), pose[4:])


def pose_of(rigid: pycolmap.Rigid3d) -> FloatArray:
    """Return a pose of pycolmap as seven numbers."""
    return np.concatenate([rigid.rotation.quat[[3, 0, 1, 2]], rigid.translation])
