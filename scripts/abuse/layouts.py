"""Where the fields of COLMAP's files are: what a mutation can aim at.

A binary model file is a sequence of little-endian fields, and a text file a sequence of words. Both are cut
into fields here by a plain walk over a sound file, apart from the walkers of the package, which are what is
under attack. Layouts: see `sfm_shapefit/colmap/check.py`.
"""

import re
import struct
from dataclasses import dataclass

# Parameters of the camera models that the base scenes may have.
_NUM_PARAMS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12}


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a binary file."""

    offset: int
    kind: str
    """A format of `struct` without byte order, or "name" for bytes up to NUL."""
    meaning: str
    """Such as "count", "id", "pose", "xy"."""
    size: int


class _Cutter:
    """Cuts bytes into fields from the start."""

    def __init__(self, data: bytes) -> None:
        self.data, self.offset = data, 0
        self.fields: list[Field] = []

    def take(self, kind: str, meaning: str) -> int:
        size = struct.calcsize(f"<{kind}")
        self.fields.append(Field(self.offset, kind, meaning, size))
        (value,) = struct.unpack_from(f"<{kind}", self.data, self.offset)
        self.offset += size
        return int(value) if kind != "d" else 0

    def take_many(self, kinds: str, meaning: str) -> None:
        for kind in kinds:
            self.take(kind, meaning)

    def take_name(self) -> None:
        end = self.data.index(b"\0", self.offset) + 1
        self.fields.append(Field(self.offset, "name", "name", end - self.offset))
        self.offset = end


def binary_fields(name: str, data: bytes) -> list[Field]:
    """Return the fields of a sound file; `name` is cameras, images, points3D, rigs or frames."""
    cutter = _Cutter(data)
    take_record = {
        "cameras": _cut_camera,
        "images": _cut_image,
        "points3D": _cut_point,
        "rigs": _cut_rig,
        "frames": _cut_frame,
    }[name]
    for _ in range(cutter.take("Q", "count")):
        take_record(cutter)
    if cutter.offset != len(data):
        raise ValueError(f"{name}: {len(data) - cutter.offset} bytes follow the last record")
    return cutter.fields


def _cut_camera(cutter: _Cutter) -> None:
    cutter.take("I", "id")
    model = cutter.take("i", "camera model")
    cutter.take_many("QQ", "size")
    cutter.take_many("d" * _NUM_PARAMS[model], "parameter")


def _cut_image(cutter: _Cutter) -> None:
    cutter.take("I", "id")
    cutter.take_many("d" * 7, "pose")
    cutter.take("I", "reference")
    cutter.take_name()
    for _ in range(cutter.take("Q", "count")):
        cutter.take_many("dd", "xy")
        cutter.take("Q", "point reference")


def _cut_point(cutter: _Cutter) -> None:
    cutter.take("Q", "id")
    cutter.take_many("ddd", "xyz")
    cutter.take_many("BBB", "colour")
    cutter.take("d", "error")
    for _ in range(cutter.take("Q", "count")):
        cutter.take("I", "image reference")
        cutter.take("I", "reference")


def _cut_rig(cutter: _Cutter) -> None:
    cutter.take("I", "id")
    for k in range(cutter.take("I", "count")):
        cutter.take("i", "sensor type")
        cutter.take("I", "reference")
        if k and cutter.take("B", "has pose"):
            cutter.take_many("d" * 7, "pose")


def _cut_frame(cutter: _Cutter) -> None:
    cutter.take("I", "id")
    cutter.take("I", "reference")
    cutter.take_many("d" * 7, "pose")
    for _ in range(cutter.take("I", "count")):
        cutter.take("i", "sensor type")
        cutter.take("I", "reference")
        cutter.take("Q", "image reference")


def words(data: bytes) -> list[tuple[int, int]]:
    """Return where each word of a text file starts and ends."""
    return [match.span() for match in re.finditer(rb"\S+", data)]
