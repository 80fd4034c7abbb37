"""The one writer of COLMAP's models: binary files, byte by byte those that pycolmap writes of the same model.

As there, frames without a pose and their images are in no file.
"""

import struct
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from sfm_shapefit.base.arrays import UInt32Array
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.binary_records import (
    CAMERA,
    COUNT,
    FRAME,
    FRAME_DATA,
    HAS_POSE,
    IMAGE,
    POINT3D,
    POSE,
    RIG,
    SENSOR_ID,
)
from sfm_shapefit.files.colmap.camera_variants import num_params_of_model
from sfm_shapefit.files.colmap.model_arrays import ModelArrays, Records, RigRecord

Blocks = Iterable[tuple[Records, UInt32Array]]
"""Points, ascending by id, and their tracks as `ModelArrays` has them, some at a time."""


def write_binary(
    model: ModelArrays,
    folder: Path,
    points: Blocks | None = None,
    keypoints: Callable[[int], Records] | None = None,
) -> None:
    """Write a model into an existing folder.

    Args:
        model: all of it is written but for what the next two replace.
        folder: where the files go.
        points: points and tracks, so that there need not be arrays of all of them.
        keypoints: returns the keypoints of an image by its row.

    Raises:
        InputError: if a file cannot be written, or not completely.
    """
    files: dict[str, Iterator[tuple[int, bytes]]] = {
        "cameras": _cameras(model),
        "rigs": _rigs(model),
        "frames": _frames(model),
        "images": _images(model, keypoints or model.keypoints),
        "points3D": _points(model.point_blocks() if points is None else points),
    }
    try:
        for name, records in files.items():
            with (folder / f"{name}.bin").open("wb") as stream:
                total = 0
                stream.write(COUNT.pack(total))
                for count, record in records:
                    stream.write(record)
                    total += count
                stream.seek(0)
                stream.write(COUNT.pack(total))
    except OSError as error:
        reason = f"the model in {folder} could not be written completely ({error.strerror})"
        raise InputError(f"{reason}; check the free space and permissions") from error


def _cameras(model: ModelArrays) -> Iterator[tuple[int, bytes]]:
    """Yield one record at a time, as do the next ones."""
    ids = {name: model_id for model_id, (name, _) in num_params_of_model().items()}
    for lens in model.lenses:
        head = CAMERA.pack(lens.id, ids[lens.model], lens.width, lens.height)
        yield 1, head + struct.pack(f"<{len(lens.parameters)}d", *lens.parameters)


def _rigs(model: ModelArrays) -> Iterator[tuple[int, bytes]]:
    for rig in model.rigs:
        yield 1, RIG.pack(rig.id, len(rig.sensors)) + b"".join(_sensors(rig))


def _sensors(rig: RigRecord) -> Iterator[bytes]:
    """Yield the sensors of a rig: the reference, and the others by type and id."""
    if rig.reference is None:
        return
    yield SENSOR_ID.pack(*rig.reference)
    for sensor in sorted(rig.sensors.keys() - {rig.reference}):
        pose = rig.sensors[sensor]
        yield SENSOR_ID.pack(*sensor) + HAS_POSE.pack(pose is not None)
        yield b"" if pose is None else POSE.pack(*pose)


def _frames(model: ModelArrays) -> Iterator[tuple[int, bytes]]:
    frames = model.frames
    for k in np.flatnonzero(frames.is_posed).tolist():
        data = sorted(frames.data[k])
        head = FRAME.pack(int(frames.ids[k]), int(frames.rig_ids[k]), *frames.poses[k], len(data))
        yield 1, head + b"".join(FRAME_DATA.pack(*one) for one in data)


def _images(model: ModelArrays, keypoints: Callable[[int], Records]) -> Iterator[tuple[int, bytes]]:
    images, poses = model.images, model.camera_poses()
    for k in np.flatnonzero(model.frames.is_posed[images.frame_of]).tolist():
        yield 1, IMAGE.pack(int(images.ids[k]), *poses[k], int(images.camera_ids[k]))
        points2d = keypoints(k)
        name = images.names[k].encode("utf-8", "surrogateescape")
        yield 0, b"".join((name, b"\0", COUNT.pack(len(points2d)), points2d.tobytes()))


def _points(blocks: Blocks) -> Iterator[tuple[int, bytes]]:
    for heads, tracks in blocks:
        lengths = heads["length"].astype(np.int64)
        sizes = np.column_stack([np.full(len(lengths), POINT3D.itemsize), 8 * lengths]).ravel()
        is_head = np.repeat(np.tile([True, False], len(lengths)), sizes)
        data = np.empty(len(is_head), dtype=np.uint8)
        data[is_head] = np.ascontiguousarray(heads).view(np.uint8)
        data[~is_head] = np.ascontiguousarray(tracks).view(np.uint8).ravel()
        yield len(heads), data.tobytes()
