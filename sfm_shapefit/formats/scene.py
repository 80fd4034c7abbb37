"""A posed scene in plain arrays: what the model formats of other programs are read into and written from.

COLMAP's conventions hold: x_cam = R x_world + t with +z forward and y down, pixels with the centre of the
first one at (0.5, 0.5), camera models and the order of their parameters by COLMAP's names.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.errors import InputError
from sfm_shapefit.formats.lines import text_of

FLIP_YZ = np.diag([1.0, -1.0, -1.0])
"""From camera axes with y up, looking along -z (OpenGL, Bundler, NeRF), to COLMAP's, and back."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneCamera:
    """Intrinsics of a camera."""

    model: str
    """COLMAP's name of the camera model."""
    width: int
    height: int
    params: tuple[float, ...]
    """In COLMAP's order."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneFile:
    """The posed images and the tracks of a model."""

    cameras: tuple[SceneCamera, ...]
    names: tuple[str, ...]
    """(n,) of the posed images."""
    camera_of: IntArray
    """(n,) index of each image's camera."""
    rotations: FloatArray
    """(n, 3, 3) cam_from_world."""
    centers: FloatArray
    """(n, 3) camera centres in the world."""
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """(p, 3)"""
    colors: IntArray = field(default_factory=lambda: np.zeros((0, 3), dtype=np.int64))
    """(p, 3) in 0..255."""
    observed: IntArray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    """(o, 2) point and image of each observation."""
    pixels: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    """(o, 2) where."""


def read_json(file: Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        InputError: if it cannot be read, naming line and column of what is no JSON.
    """
    try:
        return json.loads(text_of(file))
    except json.JSONDecodeError as error:
        raise InputError(
            f"{file}, line {error.lineno}, column {error.colno}: no JSON ({error.msg}); write the file again"
        ) from error
    except (ValueError, RecursionError) as error:  # a number of thousands of digits, endless brackets
        raise InputError(f"{file} is not a readable JSON file ({error})") from error


@dataclass(frozen=True, slots=True)
class JsonNode:
    """A value of a JSON file that knows where it stands, for messages."""

    file: Path
    where: str
    value: Any

    def get(self, key: str) -> "JsonNode":
        """Return the value of a key that must be there."""
        if not isinstance(self.value, dict) or key not in self.value:
            raise self.error(f"has no key {key!r}")
        return JsonNode(self.file, f"{self.where}/{key}", self.value[key])

    def has(self, key: str) -> bool:
        """Return whether this is an object with that key."""
        return isinstance(self.value, dict) and key in self.value

    def items(self) -> "list[tuple[str, JsonNode]]":
        """Return keys and values of an object."""
        if not isinstance(self.value, dict):
            raise self.error("is no JSON object")
        return [(key, JsonNode(self.file, f"{self.where}/{key}", v)) for key, v in self.value.items()]

    def elements(self) -> "list[JsonNode]":
        """Return the elements of a list."""
        if not isinstance(self.value, list):
            raise self.error("is no list")
        return [JsonNode(self.file, f"{self.where}[{k}]", v) for k, v in enumerate(self.value)]

    def text(self) -> str:
        """Return a string that is not empty."""
        if not isinstance(self.value, str) or not self.value:
            raise self.error("is no text")
        return self.value

    def number(self) -> float:
        """Return a finite number."""
        if isinstance(self.value, bool) or not isinstance(self.value, int | float):
            raise self.error("is no number")
        if not np.isfinite(self.value):
            raise self.error("is not finite")
        return float(self.value)

    def numbers(self, count: int) -> list[float]:
        """Return a list of so many finite numbers."""
        if not isinstance(self.value, list) or len(self.value) != count:
            raise self.error(f"is no list of {count} numbers")
        return [node.number() for node in self.elements()]

    def integer(self) -> int:
        """Return a whole number."""
        number = self.number()
        if number != int(number):
            raise self.error("is no whole number")
        return int(number)

    def rotation(self) -> FloatArray:
        """Return a (3, 3) rotation given by rows."""
        rows = self.elements()
        if len(rows) != 3:
            raise self.error("is no list of 3 rows")
        matrix = np.array([row.numbers(3) for row in rows])
        if not is_rotation(matrix):
            raise self.error("is no rotation")
        return matrix

    def error(self, what: str) -> InputError:
        """Return the error that names file and key."""
        return InputError(f"{self.file}: {self.where.lstrip('/') or 'the file'} {what}")


def is_rotation(matrix: FloatArray, tolerance: float = 1e-4) -> bool:
    """Return whether a (3, 3) matrix is a rotation up to what printing with few digits costs."""
    return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() <= tolerance and np.linalg.det(matrix) > 0.0)


def rotation_from_quaternion(wxyz: FloatArray) -> FloatArray:
    """Return the (3, 3) rotation of a quaternion w, x, y, z that is not zero."""
    w, x, y, z = wxyz / np.linalg.norm(wxyz)
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(rotation: FloatArray) -> FloatArray:
    """Return the unit quaternion w, x, y, z with w >= 0 of a (3, 3) rotation.

    The eigenvector of Bar-Itzhack's symmetric matrix to its largest eigenvalue: stable at every angle.
    """
    m = rotation
    k = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    quaternion: FloatArray = np.linalg.eigh(k)[1][:, -1]
    return quaternion if quaternion[0] >= 0.0 else -quaternion
