"""Everything that must hold before pycolmap may open a model folder.

pycolmap trusts its input: on a file that was cut short it can loop for ever, or read a camera that is
not there, and it passes NaN through without a word. So the files are walked here first, record by
record, with every length checked against the end of the file and every reference against the file it
refers to. Layouts stand in `binary_records`; text models become binary ones by `text_model`.

A model whose points and observations contradict one another has poses all the same, so that this is an error
of its own.
"""

import math
import os
import struct
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pycolmap

from sfm_shapefit.base.arrays import Int32Array, IntArray, UInt64Array
from sfm_shapefit.base.atomic_folder import private_folder
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.jit import inner_kernel, kernel
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
    CameraVariant,
    num_params_of_model,
    read_camera,
)
from sfm_shapefit.files.colmap.points import Observed
from sfm_shapefit.files.colmap.text_model import binary_records
from sfm_shapefit.files.model_folder import REQUIRED_FILES, model_suffix
from sfm_shapefit.files.norms import may_be_rotations

_CAMERA_SENSOR = int(pycolmap.SensorType.CAMERA)
_PIECE_BYTES = 2**22  # bytes of points3D.bin read at once; checking them takes ten times as much memory
_IMAGES_AT_ONCE = 256  # images whose points are looked up at once; all 10,000 would take 200 MB


class ContradictionError(InputError):
    """Points of a model and observations of its images contradict one another; its poses may serve."""


class ModelFiles(NamedTuple):
    """The binary files of a model, and what they are called in messages."""

    folder: Path
    """Where they lie: the user's folder, or a private copy."""
    told: Path
    """The user's folder."""
    suffix: str
    """Suffix of the user's files."""
    notes: tuple[str, ...] = ()
    """What was read otherwise than it stands there, a sentence each."""

    def open(self, name: str) -> "_BinaryFile":
        """Open a file to be walked."""
        return _BinaryFile(self.folder / f"{name}.bin", self.told / f"{name}{self.suffix}")

    def has(self, name: str) -> bool:
        """Whether there is a file of this name."""
        return (self.folder / f"{name}.bin").exists()


def check_model_files(folder: Path) -> Observed:
    """Refuse a model folder that pycolmap must not be given; return what its images observe."""
    with binary_files(folder) as files:
        return walk_files(files)


@contextmanager
def binary_files(folder: Path) -> Iterator[ModelFiles]:
    """Yield the model in a folder as binary files: of a text model, a private copy.

    Where a folder holds both formats, the binary one counts, as for pycolmap.

    Raises:
        InputError: if a file is missing, cannot be read, or has a malformed line, which is named.
    """
    suffix = model_suffix(folder)
    for name in (*REQUIRED_FILES, "points3D", "rigs", "frames"):
        refuse_irregular_file(folder / f"{name}{suffix}")
    there = [name for name in ("rigs", "frames") if (folder / f"{name}{suffix}").exists()]
    if len(there) == 1:
        missing = "frames" if there == ["rigs"] else "rigs"
        raise InputError(
            f"{folder} has {there[0]}{suffix} but no {missing}{suffix}; add it, or remove {there[0]}{suffix}"
        )
    if suffix == ".bin":
        yield ModelFiles(folder, folder, suffix)
        return
    records, notes = binary_records(folder)
    with private_folder() as own:
        for name, of_file in records.items():
            write_binary_file(own / f"{name}.bin", of_file)
        yield ModelFiles(own, folder, suffix, tuple(notes))


def write_binary_file(path: Path, records: Iterable[bytes]) -> None:
    """Write a binary file of a private copy.

    Raises:
        InputError: if there is no room for it.
    """
    try:
        with path.open("wb") as stream:
            count = 0
            stream.write(COUNT.pack(count))
            for count, record in enumerate(records, start=1):  # noqa: B007
                stream.write(record)
            stream.seek(0)
            stream.write(COUNT.pack(count))
    except OSError as error:
        raise InputError(
            f"the model cannot be copied to {path.parent} ({error.strerror}); make room"
        ) from None


def _refuse_pose(file: "_BinaryFile", label: str, pose: Sequence[float]) -> None:
    """Refuse a bad pose (qw, qx, qy, qz, tx, ty, tz) of what `label` names; NaN is an unknown position."""
    if not all(map(math.isfinite, pose[:4])) or any(map(math.isinf, pose[4:])):
        raise file.fault(f"{label} has a pose that is not finite")
    norm = math.hypot(*pose[:4])
    if not may_be_rotations(np.array([norm])).all():
        raise file.fault(f"{label} has a rotation quaternion of norm {norm:.4g} instead of 1")


class _BinaryFile:
    """A model file that is read once, from its begin to its end; every read is checked against the end."""

    def __init__(self, path: Path, told: Path | None = None) -> None:
        self.told = told or path
        try:
            self._stream = path.open("rb")  # until its end or its first fault
            self.left = os.fstat(self._stream.fileno()).st_size
        except OSError as error:
            raise InputError(f"{self.told} cannot be read: {error.strerror}") from None

    def fault(self, reason: str, kind: type[InputError] = InputError) -> InputError:
        """Return the error that names this file, which is read no further."""
        self._stream.close()
        return kind(f"{self.told}: {reason}")

    def beside(self, name: str) -> str:
        """Return what another file of the model is called."""
        return f"{name}{self.told.suffix}"

    def truncated(self, what: str) -> InputError:
        """Return the error that the file ends inside `what`."""
        return self.fault(f"the file ends inside {what}; it is truncated, copy or write it again")

    def read(self, count: int, what: str) -> bytes:
        """Read so many bytes."""
        try:
            data = self._stream.read(count)
        except OSError as error:
            raise self.fault(f"it cannot be read: {error.strerror}") from None
        self.left -= count
        if len(data) < count:
            raise self.truncated(what)
        return data

    def take(self, layout: struct.Struct, what: str) -> tuple[float, ...]:
        """Read one record of fixed length."""
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
            head, end, _ = self._stream.peek(1).partition(b"\0")
            name += self.read(max(len(head + end), 1), what)
        return bytes(name[:-1])

    def finish(self) -> None:
        """Refuse bytes after the last record."""
        if self.left:
            raise self.fault(f"{self.left} bytes follow the last record; write it again")
        self._stream.close()


class _Images(NamedTuple):
    """What other files refer to in images.bin: of each image (n,), by id, and what it observes."""

    ids: IntArray
    camera_ids: IntArray
    num_points2d: IntArray
    observed: Observed


def walk_files(files: ModelFiles) -> Observed:
    """Refuse what pycolmap must not be given; return what the images observe.

    The files are walked in the order in which they refer to each other.

    Raises:
        InputError: naming the file and the record that is truncated, not finite, repeated, or refers to
            something that is not there.
        ContradictionError: if this is a point or an observation, or there are no points at all.
    """
    camera_ids = set(check_cameras(files))
    image_file = files.open("images")
    images = _check_images(image_file, camera_ids)
    if files.has("rigs"):
        rigs = _check_rigs(files.open("rigs"), camera_ids)
        frame_file = files.open("frames")
        camera_of_image = _check_frames(frame_file, rigs)
        if rigs or camera_of_image:  # two empty files are read like a model without rigs and frames
            _check_frames_match_images(frame_file, camera_of_image, images)
    if not files.has("points3D"):
        raise ContradictionError(f"{files.told} has no points3D{files.suffix}")
    point_ids = _check_points(files.open("points3D"), images)
    seen = [points for _, points in images.observed.values()]
    for first in range(0, len(seen), _IMAGES_AT_ONCE):
        some = np.concatenate(seen[first : first + _IMAGES_AT_ONCE])
        unknown = some[~np.isin(some, point_ids)]
        if len(unknown):
            image_id = next(i for i, (_, points) in images.observed.items() if unknown[0] in points)
            raise image_file.fault(
                f"image {image_id} observes 3D point {unknown[0]}, which {image_file.beside('points3D')} "
                "does not have",
                ContradictionError,
            )
    return images.observed


def name_contradiction(files: ModelFiles) -> str:
    """Return which track and image contradict one another in files that were walked; empty if none do."""
    images = _check_images(files.open("images"), set(check_cameras(files)))
    owners = {
        (image_id, keypoint): point
        for image_id, (keypoints, points) in images.observed.items()
        for keypoint, point in zip(keypoints.tolist(), points.tolist(), strict=True)
    }
    file = files.open("points3D")
    for heads, elements in _points_of(file):
        tracked = np.repeat(heads["id"], heads["length"].astype(np.int64)).tolist()
        for point, (image_id, keypoint) in zip(tracked, elements.tolist(), strict=True):
            owner = owners.get((image_id, keypoint), point)  # pycolmap takes those of none for the track's
            if owner != point:
                said = f"the track of 3D point {point} has keypoint {keypoint} of image {image_id}"
                return str(file.fault(f"{said}, to which {file.beside('images')} gives 3D point {owner}"))
    return ""


class FoundCamera(NamedTuple):
    """A camera as its file has it, and as COLMAP has it."""

    size: tuple[int, int]
    read: CameraVariant


def check_cameras(files: ModelFiles) -> dict[int, FoundCamera]:
    """Walk cameras.bin and return its cameras by their ids; lists of other lengths are tried at last."""
    try:
        return _walk_cameras(files.open("cameras"), {})
    except InputError:
        for model_id, count in OTHER_COUNTS:
            with suppress(InputError):
                return _walk_cameras(files.open("cameras"), {model_id: count})
        raise


def _walk_cameras(file: _BinaryFile, counts: dict[int, int]) -> dict[int, FoundCamera]:
    """Walk cameras.bin, where models may have other `counts` of parameters."""
    num_params = num_params_of_model()
    found: dict[int, FoundCamera] = {}
    for _ in range(file.take_count(CAMERA.size, "cameras")):
        camera_id, model_id, *size = map(int, file.take(CAMERA, "a camera"))
        if model_id not in num_params:
            raise file.fault(f"camera {camera_id} has the unknown camera model {model_id}")
        if camera_id in found:
            raise file.fault(f"camera {camera_id} stands twice")
        count = counts.get(model_id, num_params[model_id][1])
        params = file.take(struct.Struct(f"<{count}d"), f"camera {camera_id}")
        if not all(map(math.isfinite, params)):
            raise file.fault(f"camera {camera_id} has a parameter that is not finite")
        read = read_camera(model_id, (size[0], size[1]), params)
        if read is None:
            raise file.fault(f"camera {camera_id} has no parameters of its model")
        found[camera_id] = FoundCamera((size[0], size[1]), read)
    file.finish()
    return found


def _check_images(file: _BinaryFile, camera_ids: set[int]) -> _Images:
    """Walk images.bin; one step per image, its points at once."""
    header_of: dict[int, tuple[int, int]] = {}  # camera id, number of points
    names: set[bytes] = set()
    observed: dict[int, tuple[Int32Array, UInt64Array]] = {}
    for _ in range(file.take_count(IMAGE.size + 1 + COUNT.size, "images")):
        image_id, *pose, camera_id = file.take(IMAGE, "an image")
        label = f"image {image_id}"
        name = file.take_name(f"the name of {label}")
        _refuse_pose(file, label, pose)
        if camera_id not in camera_ids:
            raise file.fault(
                f"{label} refers to camera {camera_id}, which {file.beside('cameras')} does not have"
            )
        if not name:
            raise file.fault(f"{label} has no name")
        if image_id in header_of or name in names:
            raise file.fault(f"{label} ({name.decode(errors='replace')}) stands twice")
        count = file.take_count(POINT2D.itemsize, f"points of {label}")
        points = np.frombuffer(file.read(count * POINT2D.itemsize, label), dtype=POINT2D)
        if not np.isfinite(points["xy"]).all():
            raise file.fault(f"{label} has a point whose coordinates are not finite")
        header_of[int(image_id)] = (int(camera_id), count)
        names.add(name)
        keypoints = np.flatnonzero(points["point3d_id"] != NO_POINT).astype(np.int32)
        observed[int(image_id)] = keypoints, points["point3d_id"][keypoints]
    file.finish()
    table = np.array([(i, *header_of[i]) for i in sorted(header_of)], dtype=np.int64).reshape(-1, 3)
    return _Images(table[:, 0], table[:, 1], table[:, 2], observed)


def _check_points(file: _BinaryFile, images: _Images) -> UInt64Array:
    """Walk points3D.bin and return the point ids, ascending."""
    ids: list[UInt64Array] = []
    for heads, elements in _points_of(file):
        is_finite = np.isfinite(heads["xyz"]).all(axis=1)
        if not is_finite.all():
            raise file.fault(f"3D point {heads['id'][~is_finite][0]} has coordinates that are not finite")
        ids.append(heads["id"].copy())
        # Each element of a track refers to an image, and to a point of it.
        position = np.searchsorted(images.ids, elements[:, 0])
        is_known = np.append(images.ids, -1)[position] == elements[:, 0]
        bad = elements[~(is_known & (elements[:, 1] < np.append(images.num_points2d, 0)[position]))]
        if len(bad):
            image_id, point = bad[0]
            raise file.fault(
                f"a track refers to point {point} of image {image_id}, which {file.beside('images')} does "
                "not have",
                ContradictionError,
            )
    every = np.sort(np.concatenate([np.zeros(0, dtype=np.uint64), *ids]))
    repeated = every[1:][every[1:] == every[:-1]]
    if len(repeated):
        raise file.fault(f"3D point {repeated[0]} stands twice")
    return every


def _points_of(file: _BinaryFile) -> Iterator[tuple[npt.NDArray[np.void], npt.NDArray[np.uint32]]]:
    """Yield the heads of 3D points and the elements (k, 2) of their tracks, a piece of the file at a time."""
    count = file.take_count(POINT3D.itemsize, "3D points")
    done, data = 0, b""
    while done < count:
        data += file.read(min(file.left, _PIECE_BYTES), "3D points")
        piece = np.frombuffer(data, dtype=np.uint8)
        starts = np.empty(min(count - done, len(data) // POINT3D.itemsize) + 1, dtype=np.int64)
        complete = int(_walk_points(piece, 0, starts))
        if not file.left and done + complete < count:
            raise file.truncated(f"3D point {done + complete + 1} of {count}")
        begins, end, is_head = starts[:complete, None], starts[complete], np.zeros(len(piece), dtype=np.bool_)
        is_head[begins + np.arange(POINT3D.itemsize)] = True
        heads = piece[begins + np.arange(POINT3D.itemsize)].view(POINT3D)[:, 0]
        yield heads, piece[:end][~is_head[:end]].view("<u4").reshape(-1, 2)
        data, done = data[end:], done + complete
    file.left += len(data)
    file.finish()


@inner_kernel
def _read_u64(data: npt.NDArray[np.uint8], offset: int) -> np.uint64:
    """Return the little-endian uint64 at `offset`."""
    value = np.uint64(0)
    for k in range(8):
        value |= np.uint64(data[offset + k]) << np.uint64(8 * k)
    return value


@kernel
def _walk_points(data: npt.NDArray[np.uint8], offset: int, starts: IntArray) -> int:
    """Fill in the offset of each point and the end of the last; return how many points are complete."""
    size = len(data)
    count = len(starts) - 1
    for p in range(count):
        starts[p] = offset
        if offset + 51 > size:
            return p
        track_length = _read_u64(data, offset + 43)
        offset += 51
        if track_length > np.uint64((size - offset) // 8):
            return p
        offset += 8 * int(track_length)
    starts[count] = offset
    return count


def _check_rigs(file: _BinaryFile, camera_ids: set[int]) -> dict[int, set[tuple[int, int]]]:
    """Walk rigs.bin and return the sensors (type, id) of each rig."""
    rigs: dict[int, set[tuple[int, int]]] = {}
    for _ in range(file.take_count(RIG.size, "rigs")):
        rig_id, num_sensors = map(int, file.take(RIG, "a rig"))
        label = f"rig {rig_id}"
        if rig_id in rigs:
            raise file.fault(f"{label} stands twice")
        file.require_room(num_sensors, SENSOR_ID.size, f"sensors of {label}")
        rigs[rig_id] = {
            _take_sensor(file, label, camera_ids, is_reference=k == 0) for k in range(num_sensors)
        }
        if len(rigs[rig_id]) < num_sensors:
            raise file.fault(f"{label} has a sensor that stands twice")
    file.finish()
    return rigs


def _take_sensor(
    file: _BinaryFile, label: str, camera_ids: set[int], *, is_reference: bool
) -> tuple[int, int]:
    """Read one sensor of a rig, and its pose unless it is the reference; return its type and id."""
    sensor_type, sensor_id = map(int, file.take(SENSOR_ID, label))
    if sensor_type == _CAMERA_SENSOR and sensor_id not in camera_ids:
        raise file.fault(
            f"{label} refers to camera {sensor_id}, which {file.beside('cameras')} does not have"
        )
    if not is_reference and file.take(HAS_POSE, label)[0]:
        _refuse_pose(file, f"{label} has a sensor that", file.take(POSE, label))
    return sensor_type, sensor_id


def _check_frames(file: _BinaryFile, rigs: dict[int, set[tuple[int, int]]]) -> dict[int, int]:
    """Walk frames.bin and return the camera of each image that a frame refers to."""
    camera_of_image: dict[int, int] = {}
    frame_ids: set[int] = set()
    for _ in range(file.take_count(FRAME.size, "frames")):
        frame_id, rig_id, *pose, num_data = file.take(FRAME, "a frame")
        label = f"frame {frame_id}"
        if frame_id in frame_ids:
            raise file.fault(f"{label} stands twice")
        frame_ids.add(int(frame_id))
        if rig_id not in rigs:
            raise file.fault(f"{label} refers to rig {rig_id}, which {file.beside('rigs')} does not have")
        _refuse_pose(file, label, pose)
        file.require_room(int(num_data), FRAME_DATA.size, f"images of {label}")
        for _ in range(int(num_data)):
            sensor_type, sensor_id, data_id = map(int, file.take(FRAME_DATA, label))
            if (sensor_type, sensor_id) not in rigs[int(rig_id)]:
                raise file.fault(f"{label} refers to sensor {sensor_id}, which rig {rig_id} does not have")
            if sensor_type != _CAMERA_SENSOR:
                continue
            if data_id in camera_of_image:
                raise file.fault(f"image {data_id} stands in two frames")
            camera_of_image[data_id] = sensor_id
    file.finish()
    return camera_of_image


def _check_frames_match_images(file: _BinaryFile, camera_of_image: dict[int, int], images: _Images) -> None:
    """Refuse images without a frame, frames without their image, and two opinions about its camera."""
    camera_of = dict(zip(images.ids.tolist(), images.camera_ids.tolist(), strict=True))
    for image_id in sorted(camera_of_image.keys() | camera_of.keys()):
        if image_id not in camera_of:
            raise file.fault(
                f"a frame refers to image {image_id}, which {file.beside('images')} does not have"
            )
        if image_id not in camera_of_image:
            raise file.fault(f"image {image_id} of {file.beside('images')} is in no frame")
        if camera_of[image_id] != camera_of_image[image_id]:
            raise file.fault(
                f"image {image_id} belongs to camera {camera_of_image[image_id]} here, "
                f"but to camera {camera_of[image_id]} in {file.beside('images')}"
            )
