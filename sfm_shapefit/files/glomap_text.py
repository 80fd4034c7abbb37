"""Relative poses as text, one pair a line, in GLOMAP's form: names instead of ids. They are read only.

    NAME1 NAME2 QW QX QY QZ TX TY TZ [N]        # comments and empty lines are skipped

is cam2_from_cam1 in COLMAP's camera axes: x_2 = R(q) x_1 + t. Only the direction of t counts; t = 0 is
refused, for such a pair has none. Names have no blanks. N, which all lines have or none, is the number of
matches of the pair; GLOMAP's own files lack it.

Source: GLOMAP's relative pose files, `glomap/io/pose_io.cc` (ReadRelPose).
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from sfm_shapefit.base.quaternions import matrices_of
from sfm_shapefit.files.lines import UNIT_TOLERANCE, first_numbers, read_lines
from sfm_shapefit.files.onedsfm import EpipolarGeometries, geometries_of

_COLUMNS = 9  # words of a line; two names, a quaternion, a translation; perhaps one more, a count


def is_relative_poses(source: Path | str) -> bool:
    """Return whether a path is a text file whose first line is one of GLOMAP's, with or without a count."""
    values = first_numbers(Path(source), _COLUMNS)
    if values is None and (values := first_numbers(Path(source), _COLUMNS + 1)) is None:
        return False
    is_unit = abs(float(np.linalg.norm(values[:4])) - 1.0) <= UNIT_TOLERANCE
    return is_unit and bool(
        np.any(values[4:7])
    )  # a direction in 7 dimensions would be of length 1 with these


def read_relative_poses(path: Path | str) -> EpipolarGeometries:
    """Read relative poses; names are in order, numbers by value.

    Raises:
        InputError: if the file is malformed, naming the first bad line.
    """
    table = read_lines(Path(path), "NAME1 NAME2 QW QX QY QZ TX TY TZ [N]")
    is_counted = len(table.rows[0]) == _COLUMNS + 1
    values = table.values(first=2, width=_COLUMNS + is_counted)
    quaternions, translations, counts = values[:, :4], values[:, 4:7], values[:, 7:]
    lengths = np.linalg.norm(translations, axis=1)
    table.refuse_no_unit(quaternions, "has no unit quaternion QW QX QY QZ")
    table.refuse(np.asarray(~(lengths > 0.0)), "has no translation, so no direction")
    table.refuse(np.asarray((counts <= 0.0).any(axis=1)), "has no positive number of matches N at its end")
    rotations = matrices_of(np.roll(quaternions, -1, axis=1))
    poses = geometries_of(table, 0, rotations, -np.einsum("kji,kj->ki", rotations, translations))
    return replace(poses, num_matches=counts[:, 0]) if is_counted else poses
