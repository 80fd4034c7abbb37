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
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import FLIP_YZ, nearest_rotations, normalized, rotation_angles_deg
from sfm_shapefit.files.lines import (
    UNIT_TOLERANCE,
    first_numbers,
    is_repeated,
    read_lines,
    rotations_by_name,
)
from sfm_shapefit.graph.viewgraph import ViewGraph

_PAIRS_FILE, _COMPONENT_FILE = "EGs.txt", "cc.txt"
_PAIR_COLUMNS, _ROTATION_COLUMNS = 14, 10


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

    def subset(self, rows: Sequence[int]) -> "EpipolarGeometries":
        """Return some of the pairs of the same cameras."""
        pairs, rotations, to_second = self.pairs[rows], self.rotations[rows], self.to_second[rows]
        return replace(self, pairs=pairs, rotations=rotations, to_second=to_second)

    def mismatch_deg(self, rotations: FloatArray) -> FloatArray:
        """Return (m,) by how many degrees each relative rotation contradicts the cameras' (n, 3, 3)."""
        i, j = self.pairs.T
        return rotation_angles_deg(self.rotations @ rotations[i] @ rotations[j].swapaxes(1, 2))

    def view_graph(self, rotations: FloatArray, known: BoolArray) -> ViewGraph:
        """Return the directions in world axes of all pairs both of whose cameras have a rotation.

        Args:
            rotations: (n, 3, 3) cam_from_world.
            known: (n,) which cameras have one.

        Raises:
            InputError: if no pair is left.
        """
        kept = known[self.pairs].all(axis=1)
        if not kept.any():
            raise InputError("no pair joins two cameras that have a rotation; check the rotations' ids")
        i = self.pairs[kept, 0]
        to_first = -np.einsum("eba,eb->ea", rotations[i], self.to_second[kept])
        return ViewGraph(len(self.names), self.pairs[kept], normalized(to_first), names=self.names)


def is_onedsfm(source: Path | str) -> bool:
    """Return whether a path is a folder with EGs.txt, or a text file whose first line is one of its lines."""
    path = Path(source)
    if path.is_dir():
        return (path / _PAIRS_FILE).is_file()
    values = first_numbers(path, _PAIR_COLUMNS)
    return values is not None and not _is_no_rotation(values[:9].reshape(1, 3, 3))[0]


def read_onedsfm(source: Path | str) -> EpipolarGeometries:
    """Read a 1DSfM folder (EGs.txt, and cc.txt if it has one, whose cameras alone are kept) or an EGs.txt.

    A pair that stands twice, in whatever order, is an error.

    Raises:
        InputError: if a file cannot be read, naming the first malformed line by its number.
    """
    path = Path(source)
    table = read_lines(path / _PAIRS_FILE if path.is_dir() else path, "i j R11 ... R33 t1 t2 t3")
    values = table.values(first=2, width=_PAIR_COLUMNS)
    rotations, translations = values[:, :9].reshape(-1, 3, 3), values[:, 9:]
    names, pairs = table.pairs()
    table.refuse(_is_no_rotation(rotations), "has no rotation matrix in columns 3 to 11")
    table.refuse_no_unit(translations, "has no unit direction at its end")
    table.refuse(pairs[:, 0] == pairs[:, 1], "joins a camera with itself")
    table.refuse(is_repeated(np.sort(pairs, axis=1)), "repeats an earlier pair; keep one of them")
    found = EpipolarGeometries(
        names=names,
        pairs=pairs,
        rotations=FLIP_YZ @ nearest_rotations(rotations).swapaxes(1, 2) @ FLIP_YZ,
        to_second=normalized(translations) @ FLIP_YZ,
    )
    component = path / _COMPONENT_FILE
    return _restrict(found, component) if path.is_dir() and component.is_file() else found


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


def onedsfm_files(
    found: EpipolarGeometries, rotations: FloatArray, cameras: IntArray, locations: FloatArray
) -> dict[str, str]:
    """Return the text of EGs.txt, cc.txt, rots.txt and soln.txt, by name; numbers round-trip.

    Args:
        found: the pairs to write.
        rotations: (n, 3, 3) cam_from_world, of all cameras.
        cameras: (k,) those that are placed, which alone stand in the last three files.
        locations: (k, 3) of these.
    """
    relative = FLIP_YZ @ found.rotations.swapaxes(1, 2) @ FLIP_YZ
    pair_rows = np.concatenate([relative.reshape(-1, 9), found.to_second @ FLIP_YZ], axis=1)
    ids = [f"{found.names[i]} {found.names[j]}" for i, j in found.pairs.tolist()]
    placed = [found.names[k] for k in cameras.tolist()]
    return {
        _PAIRS_FILE: _text(ids, pair_rows),
        _COMPONENT_FILE: "".join(f"{name}\n" for name in placed),
        "rots.txt": _text(placed, (FLIP_YZ @ rotations[cameras]).reshape(-1, 9)),
        "soln.txt": _text(placed, locations),
    }


def _text(ids: list[str], values: FloatArray) -> str:
    rows = zip(ids, values.tolist(), strict=True)
    return "".join(f"{name} {' '.join(map(repr, row))}\n" for name, row in rows)


def _restrict(found: EpipolarGeometries, component: Path) -> EpipolarGeometries:
    """Return the cameras of a cc.txt and the pairs between them."""
    table = read_lines(component, "i")
    table.refuse(np.array([len(row) != 1 for row in table.rows]), "is not one camera's id")
    wanted = {row[0] for row in table.rows}
    inside = np.array([name in wanted for name in found.names])
    kept = inside[found.pairs].all(axis=1)
    if not kept.any():
        raise InputError(f"{component} keeps no pair of {_PAIRS_FILE}; remove it, or correct its ids")
    left, renumbered = found.subset(np.flatnonzero(kept).tolist()), np.cumsum(inside) - 1
    names = tuple(name for name in found.names if name in wanted)
    return replace(left, names=names, pairs=renumbered[left.pairs])


def _is_no_rotation(matrices: FloatArray) -> BoolArray:
    """Return which of (k, 3, 3) matrices are not orthonormal, or mirror."""
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(matrices @ matrices.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
        bad: BoolArray = ~((off <= UNIT_TOLERANCE) & (np.linalg.det(matrices) > 0.0))
    return bad
