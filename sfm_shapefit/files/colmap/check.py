"""Everything that must hold before pycolmap may open a model folder.

pycolmap trusts its input: on a file that was cut short it can loop for ever, or read a camera that is
not there, and it passes NaN through without a word. So the files are walked here first, record by
record, with every length checked against the end of the file and every reference against the file it
refers to. Binary layouts, all little-endian, counts uint64 unless noted:

    cameras   count, then  id u32, model i32, width u64, height u64, params f64 each
    images    count, then  id u32, qw qx qy qz tx ty tz f64, camera u32, name to NUL,
                           count, then  x y f64, point3D id u64 (all ones: none)
    points3D  count, then  id u64, x y z f64, r g b u8, error f64, count, then  image u32, point2D u32
    rigs      count, then  id u32, count u32, reference sensor (type i32, id u32), and for each further
                           sensor  type i32, id u32, has_pose u8, and then qw .. tz f64 if it has
    frames    count, then  id u32, rig u32, qw .. tz f64, count u32, then  type i32, sensor u32, data u64

Text models are checked line by line for what pycolmap overlooks (NaN, lines cut short, names it would cut);
it refuses the rest itself.

Source: https://colmap.github.io/format.html, "Sparse reconstruction".
"""

import math
import os
import struct
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pycolmap

from sfm_shapefit.base.arrays import Int32Array, IntArray, UInt64Array
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.base.paths import refuse_irregular_file
from sfm_shapefit.files.colmap.camera_variants import (
    OTHER_COUNTS,
    CameraVariant,
    num_params_of_model,
    read_camera,
)
from sfm_shapefit.files.colmap.points import Observed
from sfm_shapefit.files.model_folder import REQUIRED_FILES, model_suffix
from sfm_shapefit.files.norms import may_be_rotation

UNIT_QUATERNION_TOLERANCE = 1e-3
"""A quaternion printed with 4 digits still passes; one farther off is normalized, and said."""

NO_POINT = np.uint64(2**64 - 1)  # id of a point; COLMAP writes it where a keypoint observes none
_CAMERA_SENSOR = int(pycolmap.SensorType.CAMERA)

_U64 = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
IMAGE = struct.Struct("<I7dI")
_RIG = struct.Struct("<II")
_SENSOR = struct.Struct("<iI")
_HAS_POSE = struct.Struct("<B")
_POSE = struct.Struct("<7d")
_FRAME = struct.Struct("<II7dI")
_FRAME_DATA = struct.Struct("<iIQ")
POINT2D = np.dtype([("xy", "<f8", 2), ("point3d_id", "<u8")])
POINT3D = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])
_PIECE_BYTES = 2**22  # bytes of points3D.bin read at once; checking them takes ten times as much memory
_IMAGES_AT_ONCE = 256  # images whose points are looked up at once; all 10,000 would take 200 MB


def check_model_files(folder: Path) -> Observed:
    """Refuse a model folder that pycolmap must not be given; return what the images of a binary one observe.

    Where a folder holds both formats, the binary one is checked, since pycolmap reads that. It
    must have cameras, images and points3D, and either both or none of rigs and frames.

    Raises:
        InputError: naming the file, and the record or the line, that is missing, truncated, not finite,
            repeated, or refers to something that is not there.
    """
    suffix = model_suffix(folder)
    for name in (*REQUIRED_FILES, "rigs", "frames"):
        refuse_irregular_file(folder / f"{name}{suffix}")
    has_rigs = (folder / f"rigs{suffix}").exists()
    has_frames = (folder / f"frames{suffix}").exists()
    if has_rigs != has_frames:
        there, missing = ("rigs", "frames") if has_rigs else ("frames", "rigs")
        raise InputError(
            f"{folder} has {there}{suffix} but no {missing}{suffix}; add it, or remove {there}{suffix}"
        )
    if suffix == ".bin":
        return _check_binary_model(folder, with_rigs=has_rigs)
    check_camera_lines(folder / "cameras.txt")
    _check_image_lines(folder / "images.txt")
    _check_point_lines(folder / "points3D.txt")
    return {}


def _refuse_pose(source: "_BinaryFile | _Line", label: str, pose: Sequence[float]) -> None:
    """Refuse a bad pose (qw, qx, qy, qz, tx, ty, tz) of what `label` names; NaN is an unknown position."""
    if not all(map(math.isfinite, pose[:4])) or any(map(math.isinf, pose[4:])):
        raise source.fault(f"{label} has a pose that is not finite")
    norm = math.hypot(*pose[:4])
    if not may_be_rotation(norm):
        raise source.fault(f"{label} has a rotation quaternion of norm {norm:.4g} instead of 1")


class _BinaryFile:
    """A model file that is read once, from its begin to its end; every read is checked against the end."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._stream = path.open("rb")  # until its end or its first fault
            self.left = os.fstat(self._stream.fileno()).st_size
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}") from None

    def fault(self, reason: str) -> InputError:
        """Return the error that names this file, which is read no further."""
        self._stream.close()
        return InputError(f"{self.path}: {reason}")

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
        count = int(self.take(_U64, f"the number of {what}")[0])
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


def _check_binary_model(folder: Path, *, with_rigs: bool) -> Observed:
    """Walk the binary files in the order in which they refer to each other."""
    camera_ids = set(check_cameras(folder / "cameras.bin"))
    image_file = _BinaryFile(folder / "images.bin")
    images = _check_images(image_file, camera_ids)
    point_ids = _check_points(_BinaryFile(folder / "points3D.bin"), images)
    seen = [points for _, points in images.observed.values()]
    for first in range(0, len(seen), _IMAGES_AT_ONCE):
        some = np.concatenate(seen[first : first + _IMAGES_AT_ONCE])
        unknown = some[~np.isin(some, point_ids)]
        if len(unknown):
            raise image_file.fault(
                f"an image observes 3D point {unknown[0]}, which points3D.bin does not have"
            )
    if with_rigs:
        rigs = _check_rigs(_BinaryFile(folder / "rigs.bin"), camera_ids)
        frame_file = _BinaryFile(folder / "frames.bin")
        camera_of_image = _check_frames(frame_file, rigs)
        if rigs or camera_of_image:  # two empty files are read like a model without rigs and frames
            _check_frames_match_images(frame_file, camera_of_image, images)
    return images.observed


class FoundCamera(NamedTuple):
    """A camera as its file has it, and as COLMAP has it."""

    size: tuple[int, int]
    read: CameraVariant


def check_cameras(path: Path) -> dict[int, FoundCamera]:
    """Walk cameras.bin and return its cameras by their ids; lists of other lengths are tried at last."""
    try:
        return _walk_cameras(_BinaryFile(path), {})
    except InputError:
        for model_id, count in OTHER_COUNTS:
            with suppress(InputError):
                return _walk_cameras(_BinaryFile(path), {model_id: count})
        raise


def _walk_cameras(file: _BinaryFile, counts: dict[int, int]) -> dict[int, FoundCamera]:
    """Walk cameras.bin, where models may have other `counts` of parameters."""
    num_params = num_params_of_model()
    found: dict[int, FoundCamera] = {}
    for _ in range(file.take_count(_CAMERA.size, "cameras")):
        camera_id, model_id, *size = map(int, file.take(_CAMERA, "a camera"))
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
    for _ in range(file.take_count(IMAGE.size + 1 + _U64.size, "images")):
        image_id, *pose, camera_id = file.take(IMAGE, "an image")
        label = f"image {image_id}"
        name = file.take_name(f"the name of {label}")
        _refuse_pose(file, label, pose)
        if camera_id not in camera_ids:
            raise file.fault(f"{label} refers to camera {camera_id}, which cameras.bin does not have")
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
    """Walk points3D.bin, a piece at a time, and return the point ids, ascending."""
    count = file.take_count(POINT3D.itemsize, "3D points")
    ids, done, data = np.empty(count, dtype=np.uint64), 0, b""
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
        elements = piece[:end][~is_head[:end]].view("<u4").reshape(-1, 2)
        is_finite = np.isfinite(heads["xyz"]).all(axis=1)
        if not is_finite.all():
            raise file.fault(f"3D point {heads['id'][~is_finite][0]} has coordinates that are not finite")
        ids[done : done + complete] = heads["id"]
        # Each element of a track refers to an image, and to a point of it.
        position = np.searchsorted(images.ids, elements[:, 0])
        is_known = np.append(images.ids, -1)[position] == elements[:, 0]
        bad = elements[~(is_known & (elements[:, 1] < np.append(images.num_points2d, 0)[position]))]
        if len(bad):
            image_id, point = bad[0]
            raise file.fault(
                f"a track refers to point {point} of image {image_id}, which images.bin does not have"
            )
        data, done = data[end:], done + complete
    file.left += len(data)
    file.finish()
    ids.sort()
    repeated = ids[1:][ids[1:] == ids[:-1]]
    if len(repeated):
        raise file.fault(f"3D point {repeated[0]} stands twice")
    return ids


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
    for _ in range(file.take_count(_RIG.size, "rigs")):
        rig_id, num_sensors = map(int, file.take(_RIG, "a rig"))
        label = f"rig {rig_id}"
        if rig_id in rigs:
            raise file.fault(f"{label} stands twice")
        file.require_room(num_sensors, _SENSOR.size, f"sensors of {label}")
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
    sensor_type, sensor_id = map(int, file.take(_SENSOR, label))
    if sensor_type == _CAMERA_SENSOR and sensor_id not in camera_ids:
        raise file.fault(f"{label} refers to camera {sensor_id}, which cameras.bin does not have")
    if not is_reference and file.take(_HAS_POSE, label)[0]:
        _refuse_pose(file, f"{label} has a sensor that", file.take(_POSE, label))
    return sensor_type, sensor_id


def _check_frames(file: _BinaryFile, rigs: dict[int, set[tuple[int, int]]]) -> dict[int, int]:
    """Walk frames.bin and return the camera of each image that a frame refers to."""
    camera_of_image: dict[int, int] = {}
    frame_ids: set[int] = set()
    for _ in range(file.take_count(_FRAME.size, "frames")):
        frame_id, rig_id, *pose, num_data = file.take(_FRAME, "a frame")
        label = f"frame {frame_id}"
        if frame_id in frame_ids:
            raise file.fault(f"{label} stands twice")
        frame_ids.add(int(frame_id))
        if rig_id not in rigs:
            raise file.fault(f"{label} refers to rig {rig_id}, which rigs.bin does not have")
        _refuse_pose(file, label, pose)
        file.require_room(int(num_data), _FRAME_DATA.size, f"images of {label}")
        for _ in range(int(num_data)):
            sensor_type, sensor_id, data_id = map(int, file.take(_FRAME_DATA, label))
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
            raise file.fault(f"a frame refers to image {image_id}, which images.bin does not have")
        if image_id not in camera_of_image:
            raise file.fault(f"image {image_id} of images.bin is in no frame")
        if camera_of[image_id] != camera_of_image[image_id]:
            raise file.fault(
                f"image {image_id} belongs to camera {camera_of_image[image_id]} here, "
                f"but to camera {camera_of[image_id]} in images.bin"
            )


@dataclass(frozen=True, slots=True)
class _Line:
    """One line of a text file, with its place for messages."""

    path: Path
    number: int
    text: str

    def fault(self, reason: str) -> InputError:
        """Return the error that names this line."""
        return InputError(f"{self.path}:{self.number}: {reason}")

    def finite(self, tokens: Sequence[str], what: str, *, or_unknown: bool = False) -> list[float]:
        """Return the tokens as numbers, which may be NaN if `or_unknown`."""
        try:
            values = list(map(float, tokens))
        except ValueError:
            raise self.fault(f"{what} holds something that is not a number") from None
        if not all(math.isfinite(value) or (or_unknown and math.isnan(value)) for value in values):
            raise self.fault(f"{what} holds a number that is not finite")
        return values

    @property
    def is_record(self) -> bool:
        """Whether this is neither blank nor a comment."""
        return not self.text.strip().startswith("#") and not self.text.isspace()


def _lines(path: Path, *, records_only: bool = True) -> Iterator[_Line]:
    """Yield the lines of a text file that are records, or all."""
    try:
        with path.open(encoding="utf-8", errors="surrogateescape") as stream:
            for number, text in enumerate(stream, start=1):
                line = _Line(path, number, text)
                if line.is_record or not records_only:
                    yield line
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None


def check_camera_lines(path: Path) -> dict[int, FoundCamera]:
    """Return the cameras of lines CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[], by their ids."""
    num_params, found = dict(num_params_of_model().values()), dict[int, FoundCamera]()
    for line in _lines(path):
        camera_id, model, *words = *line.text.split(), "", ""
        words = words[:-2]
        if len(words) < 2 or not camera_id.isdigit():
            raise line.fault("expected CAMERA_ID, a known camera MODEL, WIDTH, HEIGHT, PARAMS[]")
        width, height, *params = line.finite(words, "the camera")
        read = read_camera(model, (width, height), params)
        if read is None and model not in num_params:
            raise line.fault("expected CAMERA_ID, a known camera MODEL, WIDTH, HEIGHT, PARAMS[]")
        if read is None:
            raise line.fault(f"{model} has {num_params[model]} parameters, but {len(params)} are given")
        found[int(camera_id)] = FoundCamera((int(width), int(height)), read)
    return found


def _check_image_lines(path: Path) -> None:
    """Two lines per image: IMAGE_ID, QW .. TZ, CAMERA_ID, NAME and then (X, Y, POINT3D_ID)[]."""
    names: dict[str, int] = {}
    lines = _lines(path, records_only=False)
    for line in lines:
        if not line.is_record:
            continue
        tokens = line.text.split()
        if len(tokens) != 10:
            raise line.fault(
                "expected IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME "
                "(a name with spaces needs the .bin format)"
            )
        pose = line.finite(tokens[1:5], "the pose"), line.finite(tokens[5:8], "the pose", or_unknown=True)
        _refuse_pose(line, f"image {tokens[0]}", [*pose[0], *pose[1]])
        if tokens[9] in names:
            raise line.fault(f"the name {tokens[9]} stands in line {names[tokens[9]]} already")
        names[tokens[9]] = line.number
        points = next(lines, None)
        if points is None:
            raise line.fault("the line of its points is missing; add one, empty if the image has none")
        tokens = points.text.split()
        if len(tokens) % 3:
            raise points.fault("expected triples X, Y, POINT3D_ID")
        points.finite(tokens, "a point")


def _check_point_lines(path: Path) -> None:
    """Each line: POINT3D_ID, X, Y, Z, R, G, B, ERROR, (IMAGE_ID, POINT2D_IDX)[]."""
    for line in _lines(path):
        tokens = line.text.split()
        if len(tokens) < 8 or len(tokens) % 2:
            raise line.fault("expected POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as pairs")
        line.finite(tokens[1:4], "the 3D point")
