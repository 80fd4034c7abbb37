"""Where the fields of COLMAP's binary files are: what a mutation can aim at.

A plain walk over a sound file, apart from the walkers of the package, which are what is under attack.
Layouts: see `sfm_shapefit/files/colmap/read_binary.py`.
"""

import struct
from itertools import pairwise
from typing import NamedTuple

MODEL_FILES = ("cameras", "images", "points3D", "rigs", "frames")

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
"""Kinds and meaning of the fields of a record. One more entry follows as often as the field says; of two
entries, the first follows once and then the second."""


class Field(NamedTuple):
    offset: int
    kind: str
    """A format of `struct` without byte order, or "name" for bytes up to NUL."""
    meaning: str
    size: int


def binary_fields(name, data):
    """Return the fields of a sound file.

    Raises:
        ValueError, IndexError, KeyError, struct.error: if it is not sound.
    """
    fields = []
    end = _cut(data, 0, (("Q", "count", _RECORDS[name]),), fields)
    if end != len(data):
        raise ValueError(f"{name}: {len(data) - end} bytes follow the last record")
    return fields


def cut_records(name, data):
    """Return the records of a sound file; each starts at its id."""
    starts = [field.offset for field in binary_fields(name, data) if field.meaning == "id"]
    return [data[a:b] for a, b in pairwise([*starts, len(data)])]


def read_field(data, field):
    return int(struct.unpack_from(f"<{field.kind}", data, field.offset)[0])


def _cut(data, offset, record, fields):
    """Add the fields of a record that begins at an offset; return where it ends."""
    for kinds, meaning, *inner in record:
        singles = [kinds] if kinds == "name" else kinds
        if kinds == "parameters":
            model = next(field for field in reversed(fields) if field.meaning == "camera model")
            singles = "d" * _NUM_PARAMS[read_field(data, model)]
        for kind in singles:
            size = data.index(b"\0", offset) + 1 - offset if kind == "name" else struct.calcsize(f"<{kind}")
            fields.append(Field(offset, kind, meaning, size))
            offset += size
        for k in range(read_field(data, fields[-1]) if inner else 0):
            offset = _cut(data, offset, inner[min(k, len(inner) - 1)], fields)
    return offset
