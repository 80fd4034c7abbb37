"""COLMAP's text models, as records of binary ones, which are what is checked and given to pycolmap.

    cameras   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
    images    IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, and in the next line (X, Y, POINT3D_ID)[]
    points3D  POINT3D_ID, X, Y, Z, R, G, B, ERROR, (IMAGE_ID, POINT2D_IDX)[]
    rigs      RIG_ID, NUM_SENSORS, (SENSOR_TYPE, SENSOR_ID), (SENSOR_TYPE, SENSOR_ID, HAS_POSE, [QW .. TZ])[]
    frames    FRAME_ID, RIG_ID, QW .. TZ, NUM_DATA_IDS, (SENSOR_TYPE, SENSOR_ID, DATA_ID)[]

Numbers stand between blanks or tabs; a name is the rest of its line, blanks and all. Files may begin with a
byte order mark, and have comments (#) and empty lines anywhere but for the second lines of images, which are
empty where an image has no points. All of this pycolmap's own reader of text takes otherwise.

Source: https://colmap.github.io/format.html, "Text file format".
"""

import codecs
import itertools
import math
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.binary_records import (
    CAMERA,
    COUNT,
    FRAME,
    FRAME_DATA,
    HAS_POSE,
    IMAGE,
    POINT,
    POINT2D,
    POSE,
    RIG,
    SENSOR_ID,
)
from sfm_shapefit.files.colmap.camera_variants import cameras_alike, num_params_of_model, read_camera
from sfm_shapefit.files.norms import may_be_rotations

_EXACT = 2.0**53  # whole numbers; from here on floating-point numbers are not all of them
_TWO_LINES = "each image has two lines, its own and that of its points, which may be empty"


@dataclass(frozen=True, slots=True)
class _Line:
    path: Path
    number: int
    text: str

    def fault(self, reason: str) -> InputError:
        return InputError(f"{self.path}:{self.number}: {reason}")

    def numbers(self, words: Sequence[str], what: str) -> list[float]:
        """Return words as numbers, finite or not."""
        try:
            return list(map(float, words))
        except ValueError:
            raise self.fault(f"{what} holds something that is not a number") from None

    def integers(self, words: Sequence[str], what: str) -> list[int]:
        """Return words as whole numbers; other programs write some of them as 1920.0."""
        with suppress(ValueError):
            return list(map(int, words))
        try:
            return list(map(int, map(float, words)))
        except (ValueError, OverflowError):
            raise self.fault(f"{what} holds something that is not a whole number") from None

    def pack(self, layout: struct.Struct | str, *values: float) -> bytes:
        try:
            return (struct.Struct(layout) if isinstance(layout, str) else layout).pack(*values)
        except struct.error:
            raise self.fault("a number is out of its range") from None

    @property
    def is_record(self) -> bool:
        """Whether this is neither blank nor a comment."""
        return not (self.is_comment or self.text.isspace())

    @property
    def is_comment(self) -> bool:
        """Whether it begins with #."""
        return self.text.lstrip().startswith("#")

    @property
    def is_image(self) -> bool:
        """Whether this may be the first line of an image, and is no line of points."""
        words = self.text.split(None, 9)
        try:
            values = list(map(float, words[:9]))
        except ValueError:
            return False
        if len(words) < 10 or not may_be_rotations(np.array([math.hypot(*values[1:5])])).all():
            return False
        try:
            return len([float(word) for word in self.text.split()]) % 3 != 0
        except ValueError:
            return True


def binary_records(folder: Path) -> tuple[dict[str, Iterator[bytes]], list[str]]:
    """Return the records that each text file of a model has, and a list that reading them appends notes to.

    Raises:
        InputError: on the way, if a file cannot be read or a line is malformed, which is named then.
    """
    notes: list[str] = []
    readers: dict[str, Callable[[Iterator[_Line]], Iterator[bytes]]] = {
        "cameras": lambda lines: _cameras(lines, notes),
        "images": lambda lines: _images(lines, notes),
        "points3D": _points,
        "rigs": _rigs,
        "frames": _frames,
    }
    files = {name: folder / f"{name}.txt" for name in readers}
    return {name: readers[name](_lines(path)) for name, path in files.items() if path.exists()}, notes


def _lines(path: Path) -> Iterator[_Line]:
    """Yield all lines of a text file; bytes that are no UTF-8 are those of names, and kept."""
    try:
        with path.open("rb") as stream:
            wide = stream.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
        encoding, errors = ("utf-16", "replace") if wide else ("utf-8-sig", "surrogateescape")
        with path.open(encoding=encoding, errors=errors) as stream_of_text:
            for number, text in enumerate(stream_of_text, start=1):
                yield _Line(path, number, text)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None


def _records(lines: Iterable[_Line]) -> Iterator[_Line]:
    return (line for line in lines if line.is_record)


def _cameras(lines: Iterator[_Line], notes: list[str]) -> Iterator[bytes]:
    known = {name: (model_id, count) for model_id, (name, count) in num_params_of_model().items()}
    variants: dict[int, str] = {}
    for line in _records(lines):
        words = line.text.split()
        if len(words) < 4:
            raise line.fault("expected CAMERA_ID, a known camera MODEL, WIDTH, HEIGHT, PARAMS[]")
        camera_id, width, height = line.integers([words[0], *words[2:4]], "the camera")
        params = line.numbers(words[4:], "the camera")
        read = read_camera(words[1], (width, height), params)
        if read is None and words[1] in known:
            raise line.fault(f"{words[1]} has {known[words[1]][1]} parameters, but {len(params)} are given")
        if read is None:
            raise line.fault("expected CAMERA_ID, a known camera MODEL, WIDTH, HEIGHT, PARAMS[]")
        if read.note:
            variants[camera_id] = read.note
        head = line.pack(CAMERA, camera_id, known[read.model][0], width, height)
        yield head + struct.pack(f"<{len(read.params)}d", *read.params)
    notes += (f"{cameras} of the model: {note}" for cameras, _, note in cameras_alike(variants))


def _images(lines: Iterator[_Line], notes: list[str]) -> Iterator[bytes]:
    """Yield images; a file of poses alone may lack all second lines, or the last one."""
    alone, has_pairs, has_points = None, False, False
    line = next(_records(lines), None)
    while line is not None:
        head = _image_head(line)
        points = next((other for other in lines if not other.is_comment), None)
        if points is None and has_points:
            raise line.fault(f"the line of its points is missing; {_TWO_LINES}")
        if points is not None and points.is_image:
            alone, following, words = alone or line, points, []
        else:
            words = [] if points is None else points.text.split()
            has_pairs, has_points = has_pairs or points is not None, has_points or bool(words)
            following = None
        if alone is not None and has_pairs:
            raise alone.fault(f"the line of its points is missing; {_TWO_LINES}")
        yield head + _points2d(points or line, words)
        line = following or next(_records(lines), None)
    if alone is not None:
        notes.append(
            f"{alone.path} has one line for each image and is read as poses without points; where "
            f"COLMAP is to read it, {_TWO_LINES}"
        )


def _image_head(line: _Line) -> bytes:
    words = line.text.split(None, 9)
    if len(words) < 10:
        raise line.fault(f"expected IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME: {_TWO_LINES}")
    image_id, camera_id = line.integers([words[0], words[8]], "the image")
    head = line.pack(IMAGE, image_id, *line.numbers(words[1:8], "the pose"), camera_id)
    name = words[9].rstrip(" \t\r\n").encode("utf-8", "surrogateescape")
    if b"\0" in name:
        raise line.fault("the name holds a byte that is zero")
    return head + name + b"\0"


def _points2d(line: _Line, words: list[str]) -> bytes:
    """Return what follows the name of an image: the words are those of its points."""
    if len(words) % 3:
        raise line.fault(f"expected triples X, Y, POINT3D_ID: {_TWO_LINES}")
    try:
        values = np.array(words, dtype=np.float64).reshape(-1, 3)
    except ValueError:
        raise line.fault("a point holds something that is not a number") from None
    points = np.empty(len(values), dtype=POINT2D)
    points["xy"] = values[:, :2]
    if (np.abs(values[:, 2]) < _EXACT).all():
        points["point3d_id"] = values[:, 2].astype(np.int64).view(np.uint64)
    else:
        ids = line.integers(words[2::3], "a point")
        points["point3d_id"] = [number % 2**64 for number in ids]
    return COUNT.pack(len(points)) + points.tobytes()


def _points(lines: Iterator[_Line]) -> Iterator[bytes]:
    for line in _records(lines):
        words = line.text.split()
        if len(words) < 8 or len(words) % 2:
            raise line.fault("expected POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as pairs")
        floats, color, track = [*words[1:4], words[7]], words[4:7], words[8:]
        try:
            number, (*xyz, error_px) = int(words[0]), map(float, floats)
            values = (number, *xyz, *map(int, color), error_px, len(track) // 2, *map(int, track))
            yield struct.pack(f"{POINT.format}{len(track)}I", *values)
        except (ValueError, struct.error):  # one by one, to name what is wrong or read what is only unusual
            *xyz, error_px = line.numbers(floats, "the 3D point")
            number, *rgb = line.integers([words[0], *color], "the 3D point")
            rgb, elements = [part % 256 for part in rgb], line.integers(track, "the track")
            head = line.pack(POINT, number, *xyz, *rgb, error_px, len(track) // 2)
            yield head + line.pack(f"<{len(track)}I", *elements)


def _rigs(lines: Iterator[_Line]) -> Iterator[bytes]:
    for line in _records(lines):
        words = iter(line.text.split())
        rig_id, count = line.integers(_taken(line, words, 2), "the rig")
        record = line.pack(RIG, rig_id, count)
        for k in range(count):
            record += line.pack(SENSOR_ID, *_sensor(line, words))
            if k > 0:
                (has_pose,) = line.integers(_taken(line, words, 1), "the rig")
                record += line.pack(HAS_POSE, has_pose)
                record += (
                    line.pack(POSE, *line.numbers(_taken(line, words, 7), "the pose")) if has_pose else b""
                )
        yield record


def _frames(lines: Iterator[_Line]) -> Iterator[bytes]:
    for line in _records(lines):
        words = iter(line.text.split())
        frame_id, rig_id = line.integers(_taken(line, words, 2), "the frame")
        pose = line.numbers(_taken(line, words, 7), "the pose")
        (count,) = line.integers(_taken(line, words, 1), "the frame")
        record = line.pack(FRAME, frame_id, rig_id, *pose, count)
        for _ in range(count):
            sensor = _sensor(line, words)
            record += line.pack(FRAME_DATA, *sensor, *line.integers(_taken(line, words, 1), "the frame"))
        yield record


def _taken(line: _Line, words: Iterator[str], count: int) -> list[str]:
    some = list(itertools.islice(words, count))
    if len(some) < count:
        raise line.fault("the line ends too early; write it again")
    return some


def _sensor(line: _Line, words: Iterator[str]) -> tuple[int, int]:
    """Return type and id of the sensor that the next words of a line name."""
    kind, number = _taken(line, words, 2)
    known = pycolmap.SensorType.__members__
    if kind not in known:
        raise line.fault(f"{kind!r} is no type of a sensor; known are {', '.join(known)}")
    return int(known[kind]), line.integers([number], "the sensor")[0]
