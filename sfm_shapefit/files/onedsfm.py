"""The 1DSfM format: `EGs.txt`, `cc.txt`, `rots.txt`, `soln.txt`, and edge lists (`prob.txt`).

    EGs.txt    i j R11 R12 ... R33 t1 t2 t3      a pair's relative pose, R by rows
    cc.txt     i                                 the cameras to place, a connected component of the pairs
    rots.txt   i R11 R12 ... R33                 world-to-camera rotations, by rows
    soln.txt   i x y z                           locations

With world-to-camera rotations R_i, the rotation of a pair is R_i R_j^T, cam_i_from_cam_j; its t is the unit
direction to camera j in the axes of camera i, so that R_i^T t points along C_j - C_i in the world. Camera
axes are Bundler's: x to the right, y up, the camera looks along -z. Here they are turned into those of
COLMAP and OpenCV (y down, along +z) by S = diag(1, -1, -1) on reading, and back on writing; world axes stay.

Checked on the published Madrid Metropolis: among triangles whose rotations close to 2 degrees, the three
directions in the axes of i are coplanar to 0.004 (0.065 if t is taken in the axes of j).

Source: Wilson, Snavely, "Robust global translations with 1DSfM", ECCV 2014, and the manual of its data.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import FLIP_YZ, nearest_rotations, normalized, tangent_bases
from sfm_shapefit.files.lines import (
    UNIT_TOLERANCE,
    TextTable,
    first_numbers,
    is_repeated,
    read_lines,
    rotations_by_name,
)
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph

_PAIRS_FILE, _COMPONENT_FILE = "EGs.txt", "cc.txt"
_PAIR_COLUMNS, _ROTATION_COLUMNS = 14, 10  # words of a line; ids and a matrix, a translation too or not


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EpipolarGeometries:
    """Relative poses of pairs of cameras, in COLMAP's camera axes."""

    names: tuple[str, ...]
    """(n,) the cameras' ids in the file, numbers in numerical order."""
    pairs: IntArray
    """(m, 2) indices (i, j)."""
    rotations: FloatArray
    """(m, 3, 3) cam_j_from_cam_i."""
    to_second: FloatArray
    """(m, 3) unit directions to camera j in the axes of camera i."""
    num_matches: FloatArray | None = None
    """(m,) matches behind each pair; None if the source has no counts."""
    information: FloatArray | None = None
    """(m, 3, 3) inverse covariances of the rotations, as in `average_rotations`; None if there are none."""
    covariance: FloatArray | None = None
    """(m, 3, 3) covariances of `to_second`, rad^2; only those across it count. None if unknown."""

    def subset(self, rows: Sequence[int]) -> "EpipolarGeometries":
        """Return some of the pairs of the same cameras."""
        columns = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "names"}
        return replace(self, **{name: value[rows] for name, value in columns.items() if value is not None})

    def measured(self, rotations: FloatArray, known: BoolArray) -> MeasuredGraph:
        """Return the directions in world axes of all pairs both of whose cameras have a rotation.

        Args:
            rotations: (n, 3, 3) cam_from_world.
            known: (n,) which cameras have one.

        Raises:
            InputError: if no pair is left.
        """
        joined = known[self.pairs].all(axis=1)
        if not joined.any():
            raise InputError("no pair joins two cameras that have a rotation; check the rotations' ids")
        world_from_first = rotations[self.pairs[joined, 0]].swapaxes(1, 2)
        to_first = -np.einsum("eab,eb->ea", world_from_first, self.to_second[joined])
        graph = ViewGraph(len(self.names), self.pairs[joined], normalized(to_first), names=self.names)
        if self.covariance is None:
            return MeasuredGraph(graph)
        across = world_from_first.swapaxes(1, 2) @ tangent_bases(graph.directions)
        return MeasuredGraph(graph, covariance=across.swapaxes(1, 2) @ self.covariance[joined] @ across)


def geometries_of(
    table: TextTable, first: int, rotations: FloatArray, to_second: FloatArray
) -> EpipolarGeometries:
    """Return the relative poses of pairs whose two cameras stand in a table's columns from `first` on.

    Raises:
        InputError: if a line joins a camera with itself, or repeats a pair, in whatever order.
    """
    names, pairs = table.pairs(first)
    table.refuse(pairs[:, 0] == pairs[:, 1], "joins a camera with itself")
    table.refuse(is_repeated(np.sort(pairs, axis=1)), "repeats an earlier pair; keep one of them")
    directions = normalized(to_second)
    return EpipolarGeometries(names=names, pairs=pairs, rotations=rotations, to_second=directions)


def is_onedsfm(source: Path | str) -> bool:
    """Return whether a path is a folder with EGs.txt, or a text file whose first line is one of its lines."""
    path = Path(source)
    if path.is_dir():
        return (path / _PAIRS_FILE).is_file()
    values = first_numbers(path, _PAIR_COLUMNS)
    return values is not None and not _is_no_rotation(values[:9].reshape(1, 3, 3))[0]


def read_onedsfm(source: Path | str) -> EpipolarGeometries:
    """Read a 1DSfM folder (EGs.txt, and cc.txt if it has one, whose cameras alone are kept) or an EGs.txt.

    Raises:
        InputError: if a file cannot be read, naming the first malformed line by its number.
    """
    path = Path(source)
    table = read_lines(path / _PAIRS_FILE if path.is_dir() else path, "i j R11 ... R33 t1 t2 t3")
    values = table.values(first=2, width=_PAIR_COLUMNS)
    rotations, translations = values[:, :9].reshape(-1, 3, 3), values[:, 9:]
    table.refuse(_is_no_rotation(rotations), "has no rotation matrix in columns 3 to 11")
    table.refuse_no_unit(translations, "has no unit direction at its end")
    relative = FLIP_YZ @ nearest_rotations(rotations).swapaxes(1, 2) @ FLIP_YZ
    poses = geometries_of(table, 0, relative, translations @ FLIP_YZ)
    component = path / _COMPONENT_FILE
    return _restrict(poses, component) if path.is_dir() and component.is_file() else poses


def read_rotations(path: Path | str, names: tuple[str, ...]) -> tuple[FloatArray, BoolArray]:
    """Read rots.txt: the rotations (n, 3, 3) cam_from_world of the named cameras, and (n,) who has one.

    Cameras of the file that are not among `names` are passed over.

    Raises:
        InputError: if the file cannot be read, naming the first malformed line, or has none of the cameras.
    """
    table = read_lines(Path(path), "i R11 R12 ... R33")
    rotations = table.values(first=1, width=_ROTATION_COLUMNS).reshape(-1, 3, 3)
    table.refuse(_is_no_rotation(rotations), "has no rotation matrix")
    return rotations_by_name(table, 0, FLIP_YZ @ nearest_rotations(rotations), names)


def _restrict(poses: EpipolarGeometries, component: Path) -> EpipolarGeometries:
    """Return the cameras of a cc.txt and the pairs between them."""
    table = read_lines(component, "i")
    table.refuse(np.array([len(row) != 1 for row in table.rows]), "is not one camera's id")
    wanted = {row[0] for row in table.rows}
    inside = np.array([name in wanted for name in poses.names])
    between = inside[poses.pairs].all(axis=1)
    if not between.any():
        raise InputError(f"{component} keeps no pair of {_PAIRS_FILE}; remove it, or correct its ids")
    remaining, renumbered = poses.subset(np.flatnonzero(between).tolist()), np.cumsum(inside) - 1
    names = tuple(name for name in poses.names if name in wanted)
    return replace(remaining, names=names, pairs=renumbered[remaining.pairs])


def _is_no_rotation(matrices: FloatArray) -> BoolArray:
    """Return which of (k, 3, 3) matrices are not orthonormal, or mirror."""
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(matrices @ matrices.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
        bad: BoolArray = ~((off <= UNIT_TOLERANCE) & (np.linalg.det(matrices) > 0.0))
    return bad
