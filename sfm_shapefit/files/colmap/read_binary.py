"""The one reader of COLMAP's models: their files as arrays, or one sentence that says what is wrong.

Files are read record by record, every length checked against the end of the file and every reference against
the file it refers to; pycolmap would trust them: cut short, one can hold it for ever. Layouts stand in
`binary_records`; text models become binary records in memory by `text_model`.

A model whose points and observations contradict one another has poses all the same, which are what is read
then.
"""

import io
import math
import os
import struct
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, UInt32Array
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.base.paths import refuse_irregular_file
from sfm_shapefit.files.colmap.binary_records import (
    CAMERA,
    COUNT,
    FRAME,
    FRAME_DATA,
    HAS_POSE,
    IMAGE,
    NO_POINT,
    POINT2D,
    POINT3D,
    POSE,
    RIG,
    SENSOR_ID,
)
from sfm_shapefit.files.colmap.camera_variants import (
    OTHER_COUNTS,
    cameras_alike,
    num_params_of_model,
    read_camera,
)
from sfm_shapefit.files.colmap.model_arrays import (
    CAMERA_SENSOR,
    LARGEST_COORDINATE,
    FrameRecords,
    ImageRecords,
    ModelArrays,
    Records,
    RigRecord,
    Sensor,
)
from sfm_shapefit.files.colmap.text_model import binary_records
from sfm_shapefit.files.model_folder import REQUIRED_FILES, model_suffix
from sfm_shapefit.files.norms import may_be_rotations
from sfm_shapefit.scene.lens import Lens


class ContradictionError(InputError):
    """Points of a model and observations of its images contradict one another; its poses may serve."""


class ModelFiles(NamedTuple):
    """The files of a model as binary records, and what they are called in messages."""

    folder: Path
    """Where the binary files lie."""
    called: str
    """What the folder is called."""
    suffix: str
    """Suffix of the user's files; empty of a model in memory."""
    in_memory: Mapping[str, bytes] | None = None
    """Records of a text model, by the names of its files."""

    def open(self, name: str) -> "_BinaryFile":
        """Open a file to be read."""
        called = self.called_as(name)
        if self.in_memory is not None:
            stream = io.BufferedReader(io.BytesIO(self.in_memory[name]))
            return _BinaryFile(stream, len(self.in_memory[name]), called)
        try:
            file = (self.folder / f"{name}.bin").open("rb")  # until its end or its first fault
            return _BinaryFile(file, os.fstat(file.fileno()).st_size, called)
        except OSError as error:
            raise InputError(f"{called} cannot be read: {error.strerror}") from None

    def called_as(self, name: str) -> str:
        """Return what a file is called where a message begins with it."""
        return f"{self.called}/{name}{self.suffix}" if self.suffix else self.called

    def beside(self, name: str) -> str:
        """Return what a file is called beside another one."""
        return f"{name}{self.suffix}"

    def has(self, name: str) -> bool:
        """Whether there is a file of this name."""
        return (
            name in self.in_memory if self.in_memory is not None else (self.folder / f"{name}.bin").exists()
        )


def read_folder(folder: Path) -> tuple[ModelArrays, tuple[str, ...]]:
    """Read the model in a folder; with it come sentences on what is read otherwise than it stands there.

    Where a folder holds both formats, the binary one counts, as for pycolmap.

    Raises:
        InputError: if a file is missing or cannot be read; or naming the file and the line or record that is
            malformed, truncated, not finite, repeated, or refers to something that is not there.
    """
    suffix = model_suffix(folder)
    for name in (*REQUIRED_FILES, "points3D", "rigs", "frames"):
        refuse_irregular_file(folder / f"{name}{suffix}")
    present = [name for name in ("rigs", "frames") if (folder / f"{name}{suffix}").exists()]
    if len(present) == 1:
        missing = "frames" if present == ["rigs"] else "rigs"
        raise InputError(
            f"{folder} has {present[0]}{suffix} but no {missing}{suffix}; add it, or remove "
            f"{present[0]}{suffix}"
        )
    if suffix == ".bin":
        return read_files(ModelFiles(folder, str(folder), suffix))
    records, notes = binary_records(folder)
    in_memory = dict[str, bytes]()
    for name, of_file in records.items():
        parts = list(of_file)
        in_memory[name] = COUNT.pack(len(parts)) + b"".join(parts)
    model, more = read_files(ModelFiles(folder, str(folder), suffix, in_memory))
    return model, (*notes, *more)


def read_files(files: ModelFiles) -> tuple[ModelArrays, tuple[str, ...]]:
    """Read the files of a model in the order in which they refer to each other; returns as `read_folder`.

    Raises:
        InputError: as `read_folder`.
    """
    lenses, notes = _read_cameras(files)
    cameras = [lens.id for lens in lenses]
    images = _read_images(files, set(cameras))
    heads = ImageRecords(images.ids, images.camera_ids, images.ids, images.names)
    model = ModelArrays.alone(lenses, heads, images.poses, frozenset())
    model = replace(model, offsets=images.offsets, points2d=images.points2d)
    if files.has("rigs"):
        rigs = _read_rigs(files, set(cameras))
        frames, taken = _read_frames(files, rigs)
        if rigs:  # two empty files are read like a model without rigs and frames
            _refuse_other_images(files, taken, images)
            frame_of = np.searchsorted(frames.ids, [taken[i][0] for i in images.ids.tolist()])
            model = replace(
                model,
                rigs=tuple(rigs[i] for i in sorted(rigs)),
                frames=frames,
                images=heads._replace(frame_of=frame_of),
            )
    try:
        return _with_points(files, model), notes
    except ContradictionError as error:
        note = f"{error}; points and observations are left aside, poses alone are read"
        return model.without_points(), (*notes, note)


class _BinaryFile:
    """A model file that is read once, from its begin to its end; every read is checked against the end."""

    def __init__(self, stream: BinaryIO, size: int, called: str) -> None:
        self._stream, self.left, self.called = stream, size, called

    def fault(self, reason: str) -> InputError:
        """Return the error that names this file, which is read no further."""
        self._stream.close()
        return InputError(f"{self.called}: {reason}")

    def truncated(self, what: str) -> InputError:
        """Return the error that the file ends inside `what`."""
        return self.fault(f"the file ends inside {what}; it is truncated, copy or write it again")

    def read(self, count: int, what: str) -> bytes:
        try:
            data = self._stream.read(count)
        except OSError as error:
            raise self.fault(f"it cannot be read: {error.strerror}") from None
        self.left -= count
        if len(data) < count:
            raise self.truncated(what)
        return data

    def take(self, layout: struct.Struct, what: str) -> tuple[float, ...]:
        return layout.unpack(self.read(layout.size, what))

    def require_room(self, count: int, smallest: int, what: str) -> None:
        """Refuse a count of records, each at least `smallest` bytes long, that cannot fit in the file."""
        if count * smallest > self.left:
            raise self.truncated(f"its {count} {what}")

    def take_count(self, smallest: int, what: str) -> int:
        """Read a uint64 count and refuse it if so many records cannot fit."""
        count = int(self.take(COUNT, f"the number of {what}")[0])
        self.require_room(count, smallest, what)
        return count

    def take_name(self, what: str) -> bytes:
        """Read bytes up to the next NUL."""
        name = bytearray()
        while not name.endswith(b"\0"):
            head, end, _ = self._stream.peek(1).partition(b"\0")  # type: ignore[attr-defined]
            name += self.read(max(len(head + end), 1), what)
        return bytes(name[:-1])

    def refuse_pose(self, label: str, pose: Sequence[float]) -> None:
        """Refuse a bad pose of what `label` names; a position that is NaN is unknown."""
        if not all(map(math.isfinite, pose[:4])) or any(map(math.isinf, pose[4:])):
            raise self.fault(f"{label} has a pose that is not finite")
        norm = math.hypot(*pose[:4])
        if not may_be_rotations(np.array([norm])).all():
            raise self.fault(f"{label} has a rotation quaternion of norm {norm:.4g} instead of 1")

    def finish(self) -> None:
        """Refuse bytes after the last record."""
        if self.left:
            raise self.fault(f"{self.left} bytes follow the last record; write it again")
        self._stream.close()


def _read_cameras(files: ModelFiles) -> tuple[tuple[Lens, ...], tuple[str, ...]]:
    """Return the cameras by id, and what was read otherwise; lists of other lengths are tried at last."""
    try:
        return _cameras_of(files.open("cameras"), {})
    except InputError:
        for model_id, count in OTHER_COUNTS:
            with suppress(InputError):
                return _cameras_of(files.open("cameras"), {model_id: count})
        raise


def _cameras_of(file: _BinaryFile, counts: dict[int, int]) -> tuple[tuple[Lens, ...], tuple[str, ...]]:
    """Return as `_read_cameras`, where models may have other `counts` of parameters."""
    num_params = num_params_of_model()
    lenses, changed = dict[int, Lens](), dict[int, str]()
    for _ in range(file.take_count(CAMERA.size, "cameras")):
        camera_id, model_id, width, height = map(int, file.take(CAMERA, "a camera"))
        if model_id not in num_params:
            raise file.fault(f"camera {camera_id} has the unknown camera model {model_id}")
        if camera_id in lenses:
            raise file.fault(f"camera {camera_id} appears twice")
        count = counts.get(model_id, num_params[model_id][1])
        params = file.take(struct.Struct(f"<{count}d"), f"camera {camera_id}")
        if not all(map(math.isfinite, params)):
            raise file.fault(f"camera {camera_id} has a parameter that is not finite")
        read = read_camera(model_id, (width, height), params)
        if read is None:
            raise file.fault(f"camera {camera_id} has no parameters of its model")
        lenses[camera_id] = Lens(read.model, read.params, id=camera_id, width=width, height=height)
        if read.note:
            changed[camera_id] = read.note
    file.finish()
    notes = tuple(f"{alike} of the model: {note}" for alike, _, note in cameras_alike(changed))
    return tuple(lenses[i] for i in sorted(lenses)), notes


class _Images(NamedTuple):
    """What stands in images.bin, ascending by id."""

    ids: IntArray
    camera_ids: IntArray
    names: tuple[str, ...]
    poses: FloatArray
    offsets: IntArray
    points2d: Records


def _read_images(files: ModelFiles, camera_ids: set[int]) -> _Images:
    """Read images.bin; one step per image, its points at once."""
    file = files.open("images")
    heads: dict[int, tuple[float, ...]] = {}  # pose, id of the camera, where its points begin and end
    names: dict[bytes, int] = {}
    num_images, end = file.take_count(IMAGE.size + 1 + COUNT.size, "images"), 0
    points2d = np.empty(file.left // POINT2D.itemsize, POINT2D)  # more than there are; unused memory is none
    for _ in range(num_images):
        number, *pose, camera_id = file.take(IMAGE, "an image")
        image_id, label = int(number), f"image {number}"
        name = file.take_name(f"the name of {label}")
        file.refuse_pose(label, pose)
        if camera_id not in camera_ids:
            raise file.fault(
                f"{label} refers to camera {camera_id}, which {files.beside('cameras')} does not have"
            )
        if not name:
            raise file.fault(f"{label} has no name")
        if image_id in heads or name in names:
            raise file.fault(f"{label} ({name.decode(errors='replace')}) appears twice")
        count = file.take_count(POINT2D.itemsize, f"points of {label}")
        begin, end = end, end + count
        points2d[begin:end] = np.frombuffer(file.read(count * POINT2D.itemsize, label), dtype=POINT2D)
        if not np.isfinite(points2d["xy"][begin:end]).all():
            raise file.fault(f"{label} has a point whose coordinates are not finite")
        heads[image_id], names[name] = (*pose, camera_id, begin, end), image_id
    file.finish()
    ids = sorted(heads)
    table = np.array([heads[i] for i in ids], dtype=np.float64).reshape(-1, 10)
    begins, ends = table[:, 8].astype(np.int64), table[:, 9].astype(np.int64)
    points2d = points2d[:end]
    if (begins[1:] < begins[:-1]).any():
        parts = zip(begins.tolist(), ends.tolist(), strict=True)
        points2d = np.concatenate([points2d[begin:end] for begin, end in parts])
    called = {image_id: name.decode("utf-8", "surrogateescape") for name, image_id in names.items()}
    return _Images(
        ids=np.array(ids, dtype=np.int64),
        camera_ids=table[:, 7].astype(np.int64),
        names=tuple(called[i] for i in ids),
        poses=table[:, :7],
        offsets=offsets_of(ends - begins),
        points2d=points2d,
    )


def _read_rigs(files: ModelFiles, camera_ids: set[int]) -> dict[int, RigRecord]:
    file, rigs = files.open("rigs"), dict[int, RigRecord]()
    for _ in range(file.take_count(RIG.size, "rigs")):
        rig_id, num_sensors = map(int, file.take(RIG, "a rig"))
        label = f"rig {rig_id}"
        if rig_id in rigs:
            raise file.fault(f"{label} appears twice")
        file.require_room(num_sensors, SENSOR_ID.size, f"sensors of {label}")
        sensors: dict[Sensor, FloatArray | None] = {}
        for k in range(num_sensors):
            kind, number = map(int, file.take(SENSOR_ID, label))
            if kind == CAMERA_SENSOR and number not in camera_ids:
                raise file.fault(
                    f"{label} refers to camera {number}, which {files.beside('cameras')} does not have"
                )
            if (kind, number) in sensors:
                raise file.fault(f"{label} has a sensor that appears twice")
            has_pose = k > 0 and file.take(HAS_POSE, label)[0]
            pose = np.array(file.take(POSE, label)) if has_pose else None
            if pose is not None:
                file.refuse_pose(f"{label} has a sensor that", pose.tolist())
            sensors[kind, number] = pose
        rigs[rig_id] = RigRecord(rig_id, sensors)
    file.finish()
    return rigs


Taken = dict[int, tuple[int, int]]
"""Id of the frame and of the camera that an image is of, by its own."""


def _read_frames(files: ModelFiles, rigs: Mapping[int, RigRecord]) -> tuple[FrameRecords, Taken]:
    """Read frames.bin; return the frames by id, and what they say of images."""
    file = files.open("frames")
    heads = dict[int, tuple[int, tuple[float, ...], tuple[tuple[int, int, int], ...]]]()
    taken: Taken = {}
    for _ in range(file.take_count(FRAME.size, "frames")):
        number, rig, *pose, num_data = file.take(FRAME, "a frame")
        frame_id, rig_id, label = int(number), int(rig), f"frame {number}"
        if frame_id in heads:
            raise file.fault(f"{label} appears twice")
        if rig_id not in rigs:
            raise file.fault(f"{label} refers to rig {rig_id}, which {files.beside('rigs')} does not have")
        file.refuse_pose(label, pose)
        file.require_room(int(num_data), FRAME_DATA.size, f"images of {label}")
        data = [tuple(map(int, file.take(FRAME_DATA, label))) for _ in range(int(num_data))]
        for kind, sensor_id, image_id in data:
            if (kind, sensor_id) not in rigs[rig_id].sensors:
                raise file.fault(f"{label} refers to sensor {sensor_id}, which rig {rig_id} does not have")
            if kind == CAMERA_SENSOR and image_id in taken:
                raise file.fault(f"image {image_id} is in two frames")
            if kind == CAMERA_SENSOR:
                taken[image_id] = frame_id, sensor_id
        heads[frame_id] = (
            rig_id,
            tuple(pose),
            tuple((kind, sensor_id, image_id) for kind, sensor_id, image_id in data),
        )
    file.finish()
    ids = sorted(heads)
    frames = FrameRecords(
        ids=np.array(ids, dtype=np.int64),
        rig_ids=np.array([heads[i][0] for i in ids], dtype=np.int64),
        poses=np.array([heads[i][1] for i in ids], dtype=np.float64).reshape(-1, 7),
        data=tuple(heads[i][2] for i in ids),
    )
    return frames, taken


def _refuse_other_images(files: ModelFiles, taken: Taken, images: _Images) -> None:
    """Refuse images without a frame, frames without their image, and two opinions about its camera."""
    camera_of = dict(zip(images.ids.tolist(), images.camera_ids.tolist(), strict=True))
    for image_id in sorted(taken.keys() | camera_of.keys()):
        reason = ""
        if image_id not in camera_of:
            reason = f"a frame refers to image {image_id}, which {files.beside('images')} does not have"
        elif image_id not in taken:
            reason = f"image {image_id} of {files.beside('images')} is in no frame"
        elif camera_of[image_id] != taken[image_id][1]:
            reason = (
                f"image {image_id} belongs to camera {taken[image_id][1]} here, "
                f"but to camera {camera_of[image_id]} in {files.beside('images')}"
            )
        if reason:
            raise InputError(f"{files.called_as('frames')}: {reason}")


def _with_points(files: ModelFiles, model: ModelArrays) -> ModelArrays:
    """Return a model with its points; a keypoint of none that is in a track observes its point.

    Raises:
        InputError: as `read_folder`.
        ContradictionError: if points and observations contradict one another, or there are no points at all.
    """
    if not files.has("points3D"):
        raise ContradictionError(f"{files.called} has no {files.beside('points3D')}")
    model = _take_points(files.open("points3D"), model)
    called = files.called_as("points3D")
    contradiction, is_tracked = "", np.zeros(len(model.points2d), dtype=np.bool_)
    for heads, elements in model.point_blocks():
        is_finite = (np.abs(heads["xyz"]) <= LARGEST_COORDINATE).all(axis=1)  # false for NaN
        if not is_finite.all():
            point = heads["id"][~is_finite][0]
            raise InputError(f"{called}: 3D point {point} has coordinates that are not finite")
        rows = np.searchsorted(model.images.ids, elements[:, 0])
        is_there = np.append(model.images.ids, -1)[rows] == elements[:, 0]
        is_there &= elements[:, 1] < np.append(model.lengths(), 0)[rows]
        if not is_there.all():
            image_id, keypoint = elements[~is_there][0].tolist()
            reference = f"a track refers to point {keypoint} of image {image_id}"
            raise ContradictionError(f"{called}: {reference}, which {files.beside('images')} does not have")
        places = model.offsets[rows] + elements[:, 1]
        other = _observe(model, heads, places)
        is_tracked[places] |= other is None
        if other and not contradiction:
            k, point, owner = other
            reference = (
                f"the track of 3D point {point} has keypoint {elements[k, 1]} of image {elements[k, 0]}"
            )
            contradiction = f"{called}: {reference}, to which {files.beside('images')} gives 3D point {owner}"
    _refuse_unknown_points(files, model, is_tracked)
    if contradiction:
        raise ContradictionError(contradiction)
    return model


def _take_points(file: _BinaryFile, model: ModelArrays) -> ModelArrays:
    """Return a model with the points and tracks of points3D.bin, whatever they refer to."""
    count = file.take_count(POINT3D.itemsize, "3D points")
    data = np.frombuffer(file.read(file.left, "3D points"), dtype=np.uint8)
    heads = np.empty((count, POINT3D.itemsize), dtype=np.uint8)
    elements = np.empty((len(data) - heads.size) // 8 * 8, dtype=np.uint8)
    complete, end = _split_points(data, heads, elements)
    if complete < count:
        raise file.truncated(f"3D point {complete + 1} of {count}")
    file.left = len(data) - end
    file.finish()
    points, tracks = _ascending(heads.view(POINT3D).ravel(), elements.view("<u4").reshape(-1, 2))
    if len(repeated := points["id"][1:][points["id"][1:] == points["id"][:-1]]):
        raise file.fault(f"3D point {repeated[0]} appears twice")
    return replace(model, points=points, tracks=tracks)


def _observe(model: ModelArrays, heads: Records, places: IntArray) -> tuple[int, int, int] | None:
    """Let keypoints of no point observe those whose tracks have them.

    Args:
        model: whose keypoints change in place.
        heads: some of its points.
        places: (t,) rows of the keypoints in their tracks.

    Returns:
        Where a keypoint is another point's: its number in the tracks, their point, and the other one.
    """
    tracked, ids = np.repeat(heads["id"], heads["length"].astype(np.int64)), model.points2d["point3d_id"]
    owners = ids[places]
    free = owners == NO_POINT
    if free.any():
        ids[places[free]] = tracked[free]
        owners = ids[places]
    if (owners == tracked).all():
        return None
    k = int(np.argmax(owners != tracked))
    return k, int(tracked[k]), int(owners[k])


def _ascending(points: Records, tracks: UInt32Array) -> tuple[Records, UInt32Array]:
    order = np.argsort(points["id"], kind="stable")
    if (np.diff(order) == 1).all():
        return points, tracks
    lengths = points["length"].astype(np.int64)
    begins = np.cumsum(lengths) - lengths
    moved = np.cumsum(lengths[order]) - lengths[order]
    rows = np.repeat(begins[order] - moved, lengths[order]) + np.arange(len(tracks))
    return points[order], tracks[rows]


def _refuse_unknown_points(files: ModelFiles, model: ModelArrays, is_tracked: BoolArray) -> None:
    """Refuse keypoints that observe points which do not exist; those in tracks (o,) are right already."""
    ids, point_ids = model.points2d["point3d_id"], np.append(model.points["id"], NO_POINT)
    rows = np.flatnonzero(~is_tracked & (ids != NO_POINT))
    unknown = rows[point_ids[np.searchsorted(point_ids, ids[rows])] != ids[rows]]
    if len(unknown):
        image_id = model.images.ids[np.searchsorted(model.offsets, unknown[0], side="right") - 1]
        raise ContradictionError(
            f"{files.called_as('images')}: image {image_id} observes 3D point {ids[unknown[0]]}, which "
            f"{files.beside('points3D')} does not have"
        )


@inner_kernel
def _read_u64(data: npt.NDArray[np.uint8], offset: int) -> np.uint64:
    value = np.uint64(0)
    for k in range(8):
        value |= np.uint64(data[offset + k]) << np.uint64(8 * k)
    return value


@kernel
def _split_points(
    data: npt.NDArray[np.uint8], heads: npt.NDArray[np.uint8], elements: npt.NDArray[np.uint8]
) -> tuple[int, int]:
    """Fill in heads (p, 51) and elements of tracks; return how many are complete, and where these end."""
    offset, done = 0, 0
    for p in range(len(heads)):
        begin = offset + heads.shape[1]
        if begin > len(data):
            return p, offset
        length = _read_u64(data, begin - 8)
        if length > np.uint64((len(elements) - done) // 8):
            return p, offset
        end = begin + 8 * int(length)
        for k in range(heads.shape[1]):
            heads[p, k] = data[offset + k]
        for k in range(end - begin):
            elements[done + k] = data[begin + k]
        offset, done = end, done + end - begin
    return len(heads), offset
