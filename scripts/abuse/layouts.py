"""Where the fields of COLMAP's files are: what a mutation can aim at.

A binary model file is a sequence of little-endian fields, and a text file a sequence of words. Both are cut
into fields here by a plain walk over a sound file, apart from the walkers of the package, which are what is
under attack. Layouts: see `sfm_shapefit/files/colmap/check.py`.
"""

import re
import struct
from itertools import pairwise
from typing import NamedTuple

# Parameters of the camera models that the base scenes may have.
_NUM_PARAMS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12}
_POSE = ("ddddddd", "pose")
_SENSOR = (("i", "sensor type"), ("I", "reference"))
_RECORDS = {
    "cameras": (("I", "id"), ("i", "camera model"), ("QQ", "size"), ("parameters", "parameter")),
    "images": (
        *(("I", "id"), _POSE, ("I", "reference"), ("name", "name")),
        ("Q", "count", (("dd", "xy"), ("Q", "point reference"))),
    ),
    "points3D": (
        *(("Q", "id"), ("ddd", "xyz"), ("BBB", "color"), ("d", "error")),
        ("Q", "count", (("I", "image reference"), ("I", "reference"))),
    ),
    "rigs": (("I", "id"), ("I", "count", _SENSOR, (*_SENSOR, ("B", "has pose", (_POSE,))))),
    "frames": (
        *(("I", "id"), ("I", "reference"), _POSE),
        ("I", "count", (*_SENSOR, ("Q", "image reference"))),
    ),
}
"""Kinds and meaning of the fields of a record. One more entry follows so often as the field says; of two
entries, the first follows once and then the second."""


class Field(NamedTuple):
    """One field of a binary file."""

    offset: int
    kind: str
    """A format of `struct` without byte order, or "name" for bytes up to NUL."""
    meaning: str
    """Such as "count", "id", "pose", "xy"."""
    size: int


def binary_fields(name: str, data: bytes) -> list[Field]:
    """Return the fields of a sound file; `name` is cameras, images, points3D, rigs or frames."""
    fields: list[Field] = []
    end = _cut(data, 0, (("Q", "count", _RECORDS[name]),), fields)
    if end != len(data):
        raise ValueError(f"{name}: {len(data) - end} bytes follow the last record")
    return fields


def cut_records(name: str, data: bytes) -> list[bytes]:
    """Return the records of a sound file; each starts at its id."""
    starts = [field.offset for field in binary_fields(name, data) if field.meaning == "id"]
    return [data[a:b] for a, b in pairwise([*starts, len(data)])]


def read_field(data: bytes, field: Field) -> int:
    """Return the whole number that a field holds."""
    return int(struct.unpack_from(f"<{field.kind}", data, field.offset)[0])


def _cut(data: bytes, offset: int, record: tuple[tuple, ...], fields: list[Field]) -> int:
    """Add the fields of a record that begins at an offset; return where it ends."""
    for kinds, meaning, *inner in record:
        if kinds == "name":
            fields.append(Field(offset, "name", meaning, data.index(b"\0", offset) + 1 - offset))
            offset += fields[-1].size
            continue
        if kinds == "parameters":
            model = next(field for field in reversed(fields) if field.meaning == "camera model")
            singles = "d" * _NUM_PARAMS[read_field(data, model)]
        else:
            singles = kinds
        for kind in singles:
            fields.append(Field(offset, kind, meaning, struct.calcsize(f"<{kind}")))
            offset += fields[-1].size
        for k in range(read_field(data, fields[-1]) if inner else 0):
            offset = _cut(data, offset, inner[min(k, len(inner) - 1)], fields)
    return offset


def words(data: bytes) -> list[tuple[int, int]]:
    """Return where each word of a text file starts and ends."""
    return [match.span() for match in re.finditer(rb"\S+", data)]
