"""g2o files, those of pose-graph tools (g2o, GTSAM): relative poses, and rotations of cameras.

    VERTEX_SE3:QUAT    id x y z qx qy qz qw        center and rotation world_from_cam
    EDGE_SE3:QUAT      i j x y z qx qy qz qw [21]  cam_i_from_cam_j, whose x y z is camera j seen from i

The rotation of an edge and the direction of its x y z are read. The 21 numbers are the upper triangle of its
information matrix, in axes of camera j: of x y z, then of a rotation vector, as GTSAM and SE-Sync read it;
g2o itself means half of that. They are used if all edges have a positive definite matrix, and not all the
same, which is a placeholder; those of x y z only if these have length 1, for they mix direction and length
else.

Source: Kuemmerle, Grisetti, Strasdat, Konolige, Burgard, "g2o: a general framework for graph
optimization", ICRA 2011, and its file format.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.quaternions import matrices_of
from sfm_shapefit.files.lines import UNIT_TOLERANCE, TextTable, first_words, read_lines, rotations_by_name
from sfm_shapefit.files.onedsfm import EpipolarGeometries, geometries_of

_POSE, _RELATIVE_POSE = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"
_POSE_COLUMNS, _RELATIVE_POSE_COLUMNS = 9, 10  # words; a tag, one id or two, a center, a quaternion
_INFORMATION = 21  # numbers behind an edge; the upper triangle of its information matrix
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
    behind = [row[_RELATIVE_POSE_COLUMNS:] for row in table.rows]
    for row, numbers in zip(table.rows, behind, strict=True):
        if len(numbers) == _INFORMATION:
            del row[-_INFORMATION:]
    values = table.values(first=3, width=_RELATIVE_POSE_COLUMNS)
    largest = np.abs(values[:, :3]).max(axis=1)
    table.refuse(~(largest > 0.0), "has no translation, so no direction")
    to_second = values[:, :3] / largest[:, None]  # so that squares neither overflow nor vanish
    poses = geometries_of(table, 1, _rotations(table, values[:, 3:]), to_second)
    if not all(behind):
        return poses
    upper = TextTable(table.file, table.numbers, behind).values(first=0, width=_INFORMATION)
    lengths = np.minimum(largest, 2.0) * np.linalg.norm(to_second, axis=1)  # 2 stands for all that are long
    return _with_information(
        poses, upper, are_directions=bool((np.abs(lengths - 1.0) <= UNIT_TOLERANCE).all())
    )


def _with_information(
    poses: EpipolarGeometries, upper: FloatArray, *, are_directions: bool
) -> EpipolarGeometries:
    """Return relative poses with what upper triangles (m, 21) say of rotations, and perhaps of directions."""
    information = np.zeros((len(upper), 6, 6))
    information[:, *np.triu_indices(6)] = upper
    information += np.triu(information, 1).swapaxes(1, 2)
    if not np.ptp(upper, axis=0).any() or not (np.linalg.eigvalsh(information)[:, 0] > 0.0).all():
        return poses
    covariance = np.linalg.inv(information)
    rotations = np.linalg.inv(covariance[:, 3:, 3:])
    poses = replace(poses, information=0.5 * (rotations + rotations.swapaxes(1, 2)))
    if not are_directions:
        return poses
    first_from_second = poses.rotations.swapaxes(1, 2)
    return replace(poses, covariance=first_from_second @ covariance[:, :3, :3] @ poses.rotations)


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
    return matrices_of(quaternions).swapaxes(1, 2)
