"""The rigs of a COLMAP database: which images were taken together, and where the sensors are in their rig.

A rig counts if all its sensors are calibrated (`sensor_from_rig` is there) and its images stand in frames;
rigs of one camera are none. Frames get the id of their first image.

Source: https://colmap.github.io/database.html, tables rigs, rig_sensors, frames and frame_data (COLMAP 3.12
and later); `sensor_from_rig` is a quaternion w x y z and a translation, eight bytes each.
"""

from collections.abc import Collection, Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.database_pairs import MAX_NUM_IMAGES, NO_ID
from sfm_shapefit.files.colmap.images import sensor_id
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile, is_between
from sfm_shapefit.files.lines import UNIT_TOLERANCE

_CAMERA = 0  # type of a sensor; COLMAP's number for cameras
_POSE_BYTES = 7 * 8  # bytes of a pose; a quaternion and a translation in doubles


class InFrame(NamedTuple):
    """Where an image belongs."""

    rig_id: int
    frame_id: int


@dataclass(frozen=True, slots=True, kw_only=True)
class DatabaseRigs:
    """The calibrated rigs of several cameras, and the images that they took."""

    rigs: Mapping[int, pycolmap.Rig]
    """By id."""
    place_of_image: Mapping[int, InFrame]
    """By image id; images of no such rig are not in it."""
    incomplete: tuple[int, ...]
    """Ids of the rigs that do not count, because a sensor has no pose in them or an image no frame."""

    def camera_ids(self, rig_id: int) -> list[int]:
        """Return the cameras of a rig."""
        return sorted(sensor.id for sensor in self.rigs[rig_id].sensor_ids())

    def renumbered(self, rig_id: int, new_id: int) -> pycolmap.Rig:
        """Return a copy of a rig under another id."""
        copy = deepcopy(self.rigs[rig_id])
        copy.rig_id = new_id
        return copy


def read_rigs(
    file: DatabaseFile, images: pycolmap.Reconstruction, lost: Collection[int] = ()
) -> DatabaseRigs:
    """Read the rigs of a database.

    Args:
        file: the database.
        images: its cameras and images.
        lost: ids of cameras that are not among these; sensors of theirs are none.

    Raises:
        InputError: if the database cannot be read, or a rig or a frame is damaged.
    """
    path = file.path
    sensors = _rows(file, "rig_sensors", ("rig_id", "sensor_id", "sensor_from_rig"), "sensor_type")
    references = dict(_rows(file, "rigs", ("rig_id", "ref_sensor_id"), "ref_sensor_type"))
    rig_of_frame = dict(_rows(file, "frames", ("frame_id", "rig_id")))
    data = _rows(file, "frame_data", ("frame_id", "data_id", "sensor_id"), "sensor_type")
    rigs: dict[int, pycolmap.Rig] = {}
    incomplete = {rig_id for rig_id, *_ in sensors if references.get(rig_id) in lost}
    sensors = [row for row in sensors if row[0] not in incomplete and row[1] not in lost]
    incomplete |= {rig_id for rig_id, _, pose in sensors if pose is None}
    for rig_id, camera_id, pose in sensors:
        _refuse_unknown_camera(path, images, rig_id, references.get(rig_id), camera_id)
        if rig_id in incomplete:
            continue
        if rig_id not in rigs:
            rigs[rig_id] = pycolmap.Rig(rig_id=rig_id)
            rigs[rig_id].add_ref_sensor(sensor_id(references[rig_id]))
        if rigs[rig_id].has_sensor(sensor_id(camera_id)):
            raise InputError(f"{path}: camera {camera_id} stands twice in rig {rig_id}; configure rigs again")
        rigs[rig_id].add_sensor(sensor_id(camera_id), _pose(path, rig_id, pose))
    places = _places(path, images, rig_of_frame, data)
    for image_id, image in images.images.items():
        place = places.get(image_id)
        for rig_id, rig in rigs.items():
            if rig.has_sensor(sensor_id(image.camera_id)) and (place is None or place.rig_id != rig_id):
                incomplete.add(rig_id)
    return DatabaseRigs(
        rigs={rig_id: rig for rig_id, rig in rigs.items() if rig_id not in incomplete},
        place_of_image={i: p for i, p in places.items() if p.rig_id in rigs and p.rig_id not in incomplete},
        incomplete=tuple(sorted(incomplete)),
    )


def _rows(file: DatabaseFile, table: str, columns: tuple[str, ...], kind: str = "") -> list[tuple[Any, ...]]:
    """Return rows of a table, of cameras alone where a column says what kind of sensor it is of."""
    of_cameras = f" WHERE {kind} = {_CAMERA}" if kind else ""
    query = f"SELECT {', '.join(columns)} FROM {table}{of_cameras} ORDER BY 1, 2"
    return file.rows(table, {(*columns, *([kind] if kind else [])): query})


def _refuse_unknown_camera(
    path: Path, images: pycolmap.Reconstruction, rig_id: object, *camera_ids: Any
) -> None:
    """Raise InputError if a rig has a camera that the database has not."""
    for camera_id in camera_ids:
        if not (is_between(camera_id, 0, NO_ID) and images.exists_camera(camera_id)):
            raise InputError(f"{path}: rig {rig_id} refers to camera {camera_id!r}, which is not there")


def _pose(path: Path, rig_id: int, blob: object) -> pycolmap.Rigid3d:
    """Return the pose of a sensor in its rig."""
    values: FloatArray = np.zeros(7)
    if isinstance(blob, bytes) and len(blob) == _POSE_BYTES:
        values = np.frombuffer(blob, dtype="<f8").astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        is_unit = abs(float(np.linalg.norm(values[:4])) - 1.0) <= UNIT_TOLERANCE
    if not (is_unit and np.isfinite(values).all()):
        raise InputError(f"{path}: the pose of a sensor in rig {rig_id} is damaged; configure rigs again")
    return pycolmap.Rigid3d(pycolmap.Rotation3d(values[[1, 2, 3, 0]]), values[4:])


def _places(
    path: Path,
    images: pycolmap.Reconstruction,
    rig_of_frame: Mapping[int, int],
    data: list[tuple[Any, ...]],
) -> dict[int, InFrame]:
    """Return the frame of each image, by its id; a frame's id is that of its first image."""
    members: dict[int, list[int]] = {}
    for frame_id, image_id, camera_id in data:
        known = is_between(image_id, 0, MAX_NUM_IMAGES) and images.exists_image(image_id)
        if known and images.image(image_id).camera_id != camera_id:
            raise InputError(f"{path}: frame {frame_id} has image {image_id} at another camera's place")
        if known:
            members.setdefault(frame_id, []).append(image_id)
    found: dict[int, InFrame] = {}
    for frame_id, image_ids in members.items():
        cameras = [images.image(i).camera_id for i in image_ids]
        if len(set(cameras)) < len(cameras) or any(i in found for i in image_ids):
            raise InputError(f"{path}: an image of frame {frame_id} stands twice; configure rigs again")
        found |= {i: InFrame(rig_of_frame.get(frame_id, -1), min(image_ids)) for i in image_ids}
    return found
