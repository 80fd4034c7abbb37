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
import re
from decimal import Decimal
from pathlib import Path

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.quaternions import matrices_of
from sfm_shapefit.files.lines import is_number, text_of
from sfm_shapefit.files.listed_names import NUMBER, number_of, stem_of
from sfm_shapefit.files.norms import may_be_rotations, say_normalized
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.listed_poses import ListedPoses

_COLUMNS = tuple(range(1, 8))  # columns of tx ty tz qx qy qz qw; a header may name others
_KEYS = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")
_UNIT = re.compile(r"\[.*?\]")
_TURN = re.compile(r"(^|[^a-z])q|quat|orient|rot")  # in the name of a column of the quaternion
_MOST_DIGITS = 400  # digits of a timestamp before or after its point; numbers in double precision have fewer
_KITTI = 12  # numbers of a line of KITTI's poses; these name no image


def read_tum(file: Path) -> ListedPoses:
    """Read a trajectory; its images go by their timestamps, written without an exponent.

    A header may name the columns in another order (EuRoC's tables have w x y z), and further ones.

    Raises:
        InputError: if a line is none of a trajectory.
    """
    columns, names, poses = _COLUMNS, list[str](), list[FloatArray]()
    for number, line in enumerate(text_of(file).splitlines(), start=1):
        if not names and (header := _columns_of(line.strip().lstrip("#"))):
            columns = header
            continue
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        cells = [words[k] if k < len(words) else "" for k in (0, *columns)]
        values = np.array([float(cell) if is_number(cell) else np.nan for cell in cells])
        norm = np.linalg.norm(values[None, 4:], axis=1)
        is_pose = bool(np.isfinite(values).all()) and bool(may_be_rotations(norm).all())
        if len(words) == _KITTI or not is_pose or abs(Decimal(words[0]).adjusted()) > _MOST_DIGITS:
            raise InputError(f"{file}, line {number}: expected timestamp tx ty tz qx qy qz qw")
        names.append(f"{Decimal(words[0]):f}")
        poses.append(values[1:])
    rows = np.array(poses).reshape(-1, 7)
    turns = matrices_of(rows[:, 3:])
    note = say_normalized(np.linalg.norm(rows[:, 3:], axis=1))
    return ListedPoses(
        names=tuple(names),
        rotations=turns.swapaxes(1, 2),
        centers=rows[:, :3],
        focal_shares=np.full((len(rows), 2), np.nan),
        lenses=(None,) * len(rows),
        notes=(note,) if note else (),
    )


def _columns_of(header: str) -> tuple[int, ...]:
    """Return the columns of tx ty tz qx qy qz qw that a header names; none if it lacks one."""
    cells = header.split(",") if "," in header else header.split()
    columns: dict[str, int] = {}
    for k, cell in enumerate(_UNIT.sub("", cell).strip().lower() for cell in cells):
        columns.setdefault(("q" if _TURN.search(cell) else "t") + cell[-1:], k)
    return tuple(columns[key] for key in _KEYS) if columns.keys() >= set(_KEYS) else ()


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
    if len({number_of(name) for name in names} - {None}) == len(names):
        return [NUMBER.findall(stem_of(name))[0] for name in names]
    position = {name: k for k, name in enumerate(sorted(names))}
    return [str(position[name]) for name in names]
