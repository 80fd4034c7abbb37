"""Bundler's .out file, version 0.3: read.

    # Bundle file v0.3
    <num_cameras> <num_points>
    f k1 k2 / R (3 rows) / t                   per camera; f = 0: not reconstructed
    X / r g b / n  (camera key x y) * n        per point

    P = R X + t,   p = -P / P_z,   pixel = f (1 + k1 |p|^2 + k2 |p|^4) p

from the center of the image, x to the right and y up: the camera looks along -z. S = diag(1, -1, -1) takes
its axes to COLMAP's, cam_from_world = S R; the distortion is that of COLMAP's RADIAL.

Names stand in a list file beside it, one a line (`list.txt`, or the .out file's name with .list.txt
appended, as COLMAP writes it); without one they are camera0000 and so on. Sizes of images stand nowhere:
the smallest even size that holds all observations is taken, with the principal point at its center, as
Bundler has it.

Source: Snavely, "Bundler v0.4 User's Manual", section VI.
"""

from pathlib import Path

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import FLIP_YZ
from sfm_shapefit.files.json_node import is_rotation
from sfm_shapefit.files.lines import is_number, text_of
from sfm_shapefit.scene.posed_model import (
    Intrinsics,
    PosedImage,
    PosedModelFile,
    model_of_images,
    observation_arrays,
)

_HEADER = "# Bundle file v0.3"
_NUMBERS_PER_CAMERA = 15
_LEAST_SIZE = 2


def is_bundler(file: Path) -> bool:
    """Return whether a file begins as Bundler's do."""
    if not file.is_file():  # a pipe would be read for ever
        return False
    try:
        with file.open("rb") as stream:
            return stream.read(13) == b"# Bundle file"
    except OSError:
        return False


def read_bundler(file: Path) -> PosedModelFile:
    """Read the reconstructed cameras and the points.

    Raises:
        InputError: if the file is malformed, naming the line.
    """
    words = _Words(file)
    num_cameras, num_points = words.integer(), words.integer()
    if num_cameras < 0 or num_points < 0:
        raise words.error("the numbers of cameras and points must not be negative")
    all_names = _names(file, num_cameras)
    index_of: dict[int, int] = {}
    lenses: list[list[float]] = []
    images: list[PosedImage] = []
    for camera in range(num_cameras):
        values = words.numbers(_NUMBERS_PER_CAMERA)
        if values[0] <= 0.0:
            continue
        rotation = values[3:12].reshape(3, 3)
        if not is_rotation(rotation):
            raise words.error(f"camera {camera} has no rotation")
        index_of[camera] = len(images)
        images.append((all_names[camera], len(images), FLIP_YZ @ rotation, -rotation.T @ values[12:15]))
        lenses.append(values[:3].tolist())
    points, colors, observed, offsets = _points(words, num_points, num_cameras, index_of)
    # The smallest even sizes (n, 2) that hold the observations of each image.
    halves = np.full((len(images), 2), _LEAST_SIZE / 2.0)
    np.maximum.at(halves, observed[:, 1], np.ceil(np.abs(offsets)))
    cameras = (
        Intrinsics("RADIAL", int(2.0 * x), int(2.0 * y), (f, x, y, k1, k2))
        for (f, k1, k2), (x, y) in zip(lenses, halves.tolist(), strict=True)
    )
    return model_of_images(
        cameras,
        images,
        points=points,
        colors=colors,
        observed=observed,
        pixels=halves[observed[:, 1]] + offsets * [1.0, -1.0],
    )


class _Words:
    """The words of a file, one after the other, with their lines."""

    def __init__(self, file: Path) -> None:
        first, _, rest = text_of(file).partition("\n")
        if first.strip() != _HEADER:
            raise InputError(f"{file}, line 1: expected {_HEADER!r}; other versions are not read")
        self.file, self._next = file, 0
        self._words: list[str] = []
        self._lines: list[int] = []
        for number, line in enumerate(rest.splitlines(), start=2):
            words = line.split()
            self._words += words
            self._lines += [number] * len(words)

    def numbers(self, count: int) -> FloatArray:
        """Return the next numbers, all finite."""
        taken = self._words[self._next : self._next + count]
        if len(taken) < count:
            raise InputError(f"{self.file} ends early, in line {self._lines[-1] if self._lines else 1}")
        try:
            values = np.array(taken, dtype=np.float64)
        except ValueError:
            values = np.full(count, np.nan)
        if not np.isfinite(values).all():
            self._next += next(
                k for k, word in enumerate(taken) if not (is_number(word) and np.isfinite(float(word)))
            )
            raise self.error(f"{self._words[self._next]!r} is no finite number")
        self._next += count
        return values

    def integer(self) -> int:
        """Return the next whole number."""
        (value,) = self.numbers(1)
        if value != int(value):
            self._next -= 1
            raise self.error(f"{value:g} is no whole number")
        return int(value)

    def error(self, what: str) -> InputError:
        """Return the error that names the line that was read last."""
        line = self._lines[min(self._next, len(self._lines) - 1)]
        return InputError(f"{self.file}, line {line}: {what}")


def _points(
    words: _Words, num_points: int, num_cameras: int, index_of: dict[int, int]
) -> tuple[FloatArray, IntArray, IntArray, FloatArray]:
    """Return points, colors, observations (point, image), and their offsets from the image's center."""
    points, colors, observed, offsets = [], [], [], []
    for point in range(num_points):
        values = words.numbers(6)
        points.append(values[:3])
        colors.append(np.clip(values[3:], 0, 255))
        count = words.integer()
        if count < 0:
            raise words.error("the length of a view list must not be negative")
        views = words.numbers(4 * count).reshape(count, 4)
        for camera, _, x, y in views.tolist():
            if not 0 <= camera < num_cameras:
                raise words.error(f"point {point} is seen by camera {camera:g} of {num_cameras}")
            if int(camera) in index_of:
                observed.append((point, index_of[int(camera)]))
                offsets.append((x, y))
    return (
        np.array(points).reshape(-1, 3),
        np.array(colors).reshape(-1, 3).astype(np.int64),
        *observation_arrays(observed, offsets),
    )


def _names(file: Path, count: int) -> list[str]:
    """Return the names of the list file beside a .out file, or made-up ones."""
    for candidate in (
        file.with_name(file.name + ".list.txt"),
        file.with_suffix(".list.txt"),
        file.with_name("list.txt"),
    ):
        if candidate.is_file():
            names = [words[0] for line in text_of(candidate).splitlines() if (words := line.split())]
            if len(names) != count:
                raise InputError(f"{candidate} has {len(names)} names, but {file} has {count} cameras")
            return names
    return [f"camera{k:04d}" for k in range(count)]
