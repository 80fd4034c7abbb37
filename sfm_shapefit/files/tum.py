"""Poses written as plain text: the TUM RGB-D trajectory format, and a CSV.

    TUM   timestamp tx ty tz qx qy qz qw      world_from_camera: the center, and R^T as a quaternion
    CSV   name,x,y,z,qw,qx,qy,qz              the center, and cam_from_world as in COLMAP's images.txt

Camera axes are COLMAP's in both (z forward, y down), as in TUM's own data. The timestamp is the number
that is an image's name without folder and suffix, as in TUM's data (1305031102.175304.png), if all names
are different numbers; otherwise the position of the image in the order of names, from 0. Lines are in the
order of timestamps.

Source: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012; its file formats.
"""

import csv
import io
import math
from pathlib import Path, PurePosixPath

import numpy as np

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.quaternions import matrices_of
from sfm_shapefit.files.lines import is_number, text_of
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.listed_poses import ListedPoses


def read_tum(file: Path) -> ListedPoses:
    """Read a trajectory; its images go by their timestamps.

    Raises:
        InputError: if a line is none of a trajectory.
    """
    names, numbers = [], []
    for number, line in enumerate(text_of(file).splitlines(), start=1):
        words = line.partition("#")[0].replace(",", " ").split()
        values = np.array([float(word) for word in words if is_number(word)])
        if not words:
            continue
        if not (len(words) == len(values) == 8 and np.isfinite(values).all() and np.linalg.norm(values[4:])):
            raise InputError(f"{file}, line {number}: expected timestamp tx ty tz qx qy qz qw")
        names.append(words[0])
        numbers.append(values[1:])
    rows = np.array(numbers).reshape(-1, 7)
    turns = matrices_of(rows[:, 3:])
    return ListedPoses(tuple(names), turns.swapaxes(1, 2), rows[:, :3], np.full((len(rows), 2), np.nan))


def tum_text(images: Images) -> str:
    """Return posed images as a trajectory; numbers round-trip."""
    from scipy.spatial.transform import Rotation  # here, since it takes long to import

    quaternions = Rotation.from_matrix(images.rotations.swapaxes(1, 2)).as_quat(canonical=True)  # x, y, z, w
    numbers = (np.concatenate([images.centers, quaternions], axis=1) + 0.0).tolist()
    rows = sorted(zip(_timestamps(images.names), numbers, strict=True), key=lambda row: float(row[0]))
    lines = [" ".join([stamp, *map(repr, row)]) for stamp, row in rows]
    return "\n".join(["# timestamp tx ty tz qx qy qz qw", *lines, ""])


def poses_csv(images: Images) -> str:
    """Return posed images as a CSV; numbers round-trip."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["name", "x", "y", "z", "qw", "qx", "qy", "qz"])
    from scipy.spatial.transform import Rotation  # here, since it takes long to import

    quaternions = np.roll(Rotation.from_matrix(images.rotations).as_quat(canonical=True), 1, axis=1)
    numbers = np.concatenate([images.centers, quaternions], axis=1) + 0.0
    for name, row in zip(images.names, numbers.tolist(), strict=True):
        writer.writerow([name, *map(repr, row)])
    return stream.getvalue()


def _timestamps(names: tuple[str, ...]) -> list[str]:
    """Return the timestamp of each image, as text."""
    stems = [PurePosixPath(name).stem for name in names]
    if len(set(stems)) == len(stems) and all(map(_is_time, stems)):
        return stems
    position = {name: k for k, name in enumerate(sorted(names))}
    return [str(position[name]) for name in names]


def _is_time(stem: str) -> bool:
    """Return whether a name is a plain decimal number."""
    digits = stem.replace(".", "", 1)
    return digits.isascii() and digits.isdigit() and math.isfinite(float(stem))
