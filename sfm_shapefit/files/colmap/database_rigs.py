"""The rigs of a COLMAP database: which images were taken together, and where the sensors are in their rig.

A rig counts if all its sensors are calibrated (`sensor_from_rig` is there) and its images stand in frames;
rigs of one camera are none. Frames get the id of their first image.

Source: https://colmap.github.io/database.html, tables rigs, rig_sensors, frames and frame_data (COLMAP 3.12
and later); `sensor_from_rig` is a quaternion w x y z and a translation, eight bytes each.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.database_pairs import MAX_NUM_IMAGES, NO_ID
from sfm_shapefit.files.colmap.model_arrays import CAMERA_SENSOR, RigRecord
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile, is_between
from sfm_shapefit.files.lines import UNIT_TOLERANCE

_POSE_BYTES = 7 * 8  # bytes of a pose; a quaternion and a translation in doubles


class InFrame(NamedTuple):
    """Where an image belongs."""

    rig_id: int
    frame_id: int


@dataclass(frozen=True, slots=True, kw_only=True)
class DatabaseRigs:
    """The calibrated rigs of several cameras, and the images that they took."""

    rigs: Mapping[int, RigRecord]
    """By id."""
    place_of_image: Mapping[int, InFrame]
    """By image id; images of no such rig are not in it."""
    incomplete: tuple[int, ...]
    """Ids of the rigs that do not count, because a sensor has no pose in them or an image no frame."""


def read_rigs(
    file: DatabaseFile, cameras: Collection[int], camera_of: Mapping[int, int], lost: Collection[int]
) -> DatabaseRigs:
    """Read the rigs of a database.

    Args:
        file: the database.
        cameras: ids of its cameras.
        camera_of: which camera each of its images is of, by their ids.
        lost: ids of further cameras, whose sensors are none.

    Raises:
        InputError: if the database cannot be read, or a rig or a frame is damaged.
    """
    path = file.path
    sensors = _rows(file, "rig_sensors", ("rig_id", "sensor_id", "sensor_from_rig"), "sensor_type")
    references = dict(_rows(file, "rigs", ("rig_id", "ref_sensor_id"), "ref_sensor_type"))
    rig_of_frame = dict(_rows(file, "frames", ("frame_id", "rig_id")))
    data = _rows(file, "frame_data", ("frame_id", "data_id", "sensor_id"), "sensor_type")
    rigs: dict[int, RigRecord] = {}
    incomplete = {rig_id for rig_id, *_ in sensors if references.get(rig_id) in lost}
    sensors = [row for row in sensors if row[0] not in incomplete and row[1] not in lost]
    incomplete |= {rig_id for rig_id, _, pose in sensors if pose is None}
    for rig_id, camera_id, pose in sensors:
        _refuse_unknown_camera(path, cameras, rig_id, references.get(rig_id), camera_id)
        if rig_id in incomplete:
            continue
        if rig_id not in rigs:
            rigs[rig_id] = RigRecord(rig_id, {(CAMERA_SENSOR, references[rig_id]): None})
        if (CAMERA_SENSOR, camera_id) in rigs[rig_id].sensors:
            raise InputError(
                f"{path}: camera {camera_id} appears twice in rig {rig_id}; configure rigs again"
            )
        sensors_of_rig = {**rigs[rig_id].sensors, (CAMERA_SENSOR, camera_id): _pose(path, rig_id, pose)}
        rigs[rig_id] = RigRecord(rig_id, sensors_of_rig)
    places = _places(path, camera_of, rig_of_frame, data)
    for image_id, camera_id in camera_of.items():
        place = places.get(image_id)
        for rig_id, rig in rigs.items():
            if (CAMERA_SENSOR, camera_id) in rig.sensors and (place is None or place.rig_id != rig_id):
                incomplete.add(rig_id)
    return DatabaseRigs(
        rigs={rig_id: rig for rig_id, rig in rigs.items() if rig_id not in incomplete},
        place_of_image={i: p for i, p in places.items() if p.rig_id in rigs and p.rig_id not in incomplete},
        incomplete=tuple(sorted(incomplete)),
    )


def _rows(file: DatabaseFile, table: str, columns: tuple[str, ...], kind: str = "") -> list[tuple[Any, ...]]:
    """Return rows of a table, of cameras alone where a column says what kind of sensor it is of."""
    of_cameras = f" WHERE {kind} = {CAMERA_SENSOR}" if kind else ""
    query = f"SELECT {', '.join(columns)} FROM {table}{of_cameras} ORDER BY 1, 2"
    return file.rows(table, {(*columns, *([kind] if kind else [])): query})


def _refuse_unknown_camera(path: Path, cameras: Collection[int], rig_id: object, *camera_ids: Any) -> None:
    for camera_id in camera_ids:
        if not (is_between(camera_id, 0, NO_ID) and camera_id in cameras):
            raise InputError(f"{path}: rig {rig_id} refers to camera {camera_id!r}, which is not there")


def _pose(path: Path, rig_id: int, blob: object) -> FloatArray:
    """Return the pose (7,) of a sensor in its rig."""
    values: FloatArray = np.zeros(7)
    if isinstance(blob, bytes) and len(blob) == _POSE_BYTES:
        values = np.frombuffer(blob, dtype="<f8").astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        is_unit = abs(float(np.linalg.norm(values[:4])) - 1.0) <= UNIT_TOLERANCE
    if not (is_unit and np.isfinite(values).all()):
        raise InputError(f"{path}: the pose of a sensor in rig {rig_id} is damaged; configure rigs again")
    return values


def _places(
    path: Path,
    camera_of: Mapping[int, int],
    rig_of_frame: Mapping[int, int],
    data: list[tuple[Any, ...]],
) -> dict[int, InFrame]:
    """Return the frame of each image, by its id; a frame's id is that of its first image."""
    members: dict[int, list[int]] = {}
    for frame_id, image_id, camera_id in data:
        known = is_between(image_id, 0, MAX_NUM_IMAGES) and image_id in camera_of
        if known and camera_of[image_id] != camera_id:
            raise InputError(f"{path}: frame {frame_id} has image {image_id} at another camera's place")
        if known:
            members.setdefault(frame_id, []).append(image_id)
    frame_of: dict[int, InFrame] = {}
    for frame_id, image_ids in members.items():
        cameras = [camera_of[i] for i in image_ids]
        if len(set(cameras)) < len(cameras) or any(i in frame_of for i in image_ids):
            raise InputError(f"{path}: an image of frame {frame_id} appears twice; configure rigs again")
        frame_of |= {i: InFrame(rig_of_frame.get(frame_id, -1), min(image_ids)) for i in image_ids}
    return frame_of
