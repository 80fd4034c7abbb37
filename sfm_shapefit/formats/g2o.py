"""Poses and positions as g2o vertices, which pose-graph tools (g2o, GTSAM) read.

    VERTEX_SE3:QUAT    id x y z qx qy qz qw      centre and rotation world_from_cam
    VERTEX_TRACKXYZ    id x y z                  a point, where there is no rotation
    VERTEX_XY          id x y                    the same in the plane

Ids are whole numbers: the nodes' own where all are, else 0, 1, ... with the names in comments.

Source: Kuemmerle, Grisetti, Strasdat, Konolige, Burgard, "g2o: a general framework for graph
optimization", ICRA 2011, and its file format.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.errors import InputError


def g2o_text(names: Sequence[str], locations: FloatArray, rotations: FloatArray | None = None) -> str:
    """Return the vertices of named nodes; numbers round-trip.

    Args:
        names: (k,) of the nodes.
        locations: (k, 3), or (k, 2) without rotations.
        rotations: (k, 3, 3) cam_from_world; points are written without.

    Raises:
        InputError: if the dimension is neither 2 nor 3.
    """
    dimension = locations.shape[1]
    if dimension not in (2, 3):
        raise InputError(f"g2o has no vertices in {dimension} dimensions; leave out its file")
    numbered = all(name.isascii() and name.isdigit() for name in names)
    tag, values = ("VERTEX_XY" if dimension == 2 else "VERTEX_TRACKXYZ"), locations
    if rotations is not None:
        tag = "VERTEX_SE3:QUAT"
        quaternions = Rotation.from_matrix(rotations.swapaxes(1, 2)).as_quat(canonical=True)  # x, y, z, w
        values = np.concatenate([locations, quaternions], axis=1)
    lines = []
    for k, (name, row) in enumerate(zip(names, values.tolist(), strict=True)):
        if not numbered:
            lines.append(f"# {k} {_one_line(name)}")
        lines.append(" ".join([tag, name if numbered else str(k), *map(repr, row)]))
    return "\n".join(lines) + "\n"


def _one_line(name: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in name)
