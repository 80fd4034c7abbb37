"""g2o files, those of pose-graph tools (g2o, GTSAM): relative poses, and rotations of cameras.

    VERTEX_SE3:QUAT    id x y z qx qy qz qw        center and rotation world_from_cam
    EDGE_SE3:QUAT      i j x y z qx qy qz qw [21]  cam_i_from_cam_j, whose x y z is camera j seen from i

The rotation of an edge and the direction of its x y z are read; its length and the 21 numbers of its
information matrix are not used.

Source: Kuemmerle, Grisetti, Strasdat, Konolige, Burgard, "g2o: a general framework for graph
optimization", ICRA 2011, and its file format.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.lines import TextTable, first_words, read_lines, rotations_by_name
from sfm_shapefit.files.onedsfm import EpipolarGeometries, geometries_of

_POSE, _RELATIVE_POSE = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"
_POSE_COLUMNS, _RELATIVE_POSE_COLUMNS = 9, 10  # words; a tag, one id or two, a center, a quaternion
_INFORMATION = 21  # numbers behind an edge; the upper triangle of its information matrix, not used
_PASSED_OVER = ("VERTEX_", "PARAMS_", "FIX")
_FORM = "EDGE_SE3:QUAT i j x y z qx qy qz qw"


def is_g2o(source: Path | str) -> bool:
    """Return whether a path is a text file whose first word is a tag of g2o."""
    words = first_words(Path(source))
    return bool(words) and words[0].startswith(("EDGE_", *_PASSED_OVER))


def read_g2o(path: Path | str) -> EpipolarGeometries:
    """Read the relative poses of a g2o file; its vertices are passed over, see `read_g2o_rotations`.

    Raises:
        InputError: if the file is malformed or holds edges of another kind, naming the first bad line.
    """
    table = _select_tag(Path(path), _RELATIVE_POSE)
    for row in table.rows:
        if len(row) == _RELATIVE_POSE_COLUMNS + _INFORMATION:
            del row[-_INFORMATION:]
    values = table.values(first=3, width=_RELATIVE_POSE_COLUMNS)
    largest = np.abs(values[:, :3]).max(axis=1)
    table.refuse(~(largest > 0.0), "has no translation, so no direction")
    to_second = values[:, :3] / largest[:, None]  # so that squares neither overflow nor vanish
    return geometries_of(table, 1, _rotations(table, values[:, 3:]), to_second)


def read_g2o_rotations(path: Path | str, names: tuple[str, ...]) -> tuple[FloatArray, BoolArray]:
    """Read the vertices' rotations (n, 3, 3) cam_from_world of the named cameras, and (n,) who has one.

    Raises:
        InputError: if the file is malformed, naming the first bad line, or has none of the cameras.
    """
    table = _select_tag(Path(path), _POSE)
    values = table.values(first=2, width=_POSE_COLUMNS)
    return rotations_by_name(table, 1, _rotations(table, values[:, 3:]), names)


def _select_tag(file: Path, tag: str) -> TextTable:
    """Return the lines of one tag; edges that are not understood are refused."""
    table = read_lines(file, _FORM)
    strange = [row[0] != _RELATIVE_POSE and not row[0].startswith(_PASSED_OVER) for row in table.rows]
    table.refuse(np.array(strange), f"is neither a vertex nor {_FORM}, which alone can be read")
    chosen = [k for k, row in enumerate(table.rows) if row[0] == tag]
    if not chosen:
        raise InputError(f"{file} has no {tag}; give a pose graph in three dimensions")
    return TextTable(file, [table.numbers[k] for k in chosen], [table.rows[k] for k in chosen])


def _rotations(table: TextTable, quaternions: FloatArray) -> FloatArray:
    """Return the transposed rotations (k, 3, 3) of quaternions x, y, z, w, which must be of length 1."""
    table.refuse_no_unit(quaternions, "has no unit quaternion qx qy qz qw")
    return np.asarray(Rotation.from_quat(quaternions).as_matrix()).swapaxes(1, 2)
