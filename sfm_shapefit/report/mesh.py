"""A model as meshes for 3D viewers: cameras as pyramids colored by trust, points. The door to trimesh.

    .glb    turned so that y is up, as viewers of glTF expect, the cameras' median at the origin; `offset` in
            the extras of the file says where that is, and its axes where x, y and z point
    .ply    the model's own axes and units, so that it overlays other exports of the model

A .glb holds float32. A .ply does, as COLMAP's own, if that is fine enough for the scene; else double.
"""

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.geometry import FLOAT32_REACH, median_spread
from sfm_shapefit.report.drawing import Drawing, frustum_corners

if TYPE_CHECKING:
    import trimesh

    from sfm_shapefit.files.colmap.model import ColmapModel

Colors = npt.NDArray[np.uint8]

_TRUST_STOPS = np.array([0.0, 0.4, 0.7, 1.0])  # trusts that have a color; others lie between
_TRUST_COLORS = np.array([[179, 32, 44], [232, 116, 59], [233, 197, 74], [42, 157, 143]], dtype=np.float64)
"""Red, green and blue from 0 to 255 at each of these; the page has the same."""
_PYRAMID = np.array([[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [1, 2, 3], [1, 3, 4]])
"""Faces of a camera as rows of its vertices: 0 is the apex, 1 to 4 are the corners of the picture."""


def ply_bytes(
    vertices: FloatArray,
    colors: Colors,
    faces: IntArray | None = None,
    comment: str = "",
    *,
    fine: bool = False,
    with_normals: bool = False,
) -> bytes:
    """Return vertices (n, 3), colors (n, 3) and faces (f, 3) as a binary PLY, in double if need be or `fine`.

    Need is where float32 would move vertices by a millionth of their spread. 3DGS reads no points without
    normals, and looks at none: they are 0.
    """
    largest = np.abs(vertices).max(initial=0.0)
    if len(vertices):
        fine |= bool(largest > FLOAT32_REACH * median_spread(vertices))
        fine |= bool(largest > np.finfo(np.float32).max)
    kind, name = ("<f8", "double") if fine else ("<f4", "float")
    axes = ["x", "y", "z", *(["nx", "ny", "nz"] if with_normals else [])]
    rows = np.zeros(len(vertices), [("xyz", kind, 3), ("n", kind, len(axes) - 3), ("rgb", "u1", 3)])
    rows["xyz"], rows["rgb"] = vertices, colors
    lines = ["ply", "format binary_little_endian 1.0", *([f"comment {comment}"] if comment else [])]
    lines += [f"element vertex {len(rows)}", *(f"property {name} {axis}" for axis in axes)]
    lines += [f"property uchar {color}" for color in ("red", "green", "blue")]
    parts = [rows.tobytes()]
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        listed = np.empty(len(faces), [("count", "u1"), ("vertices", "<i4", 3)])
        listed["count"], listed["vertices"] = 3, faces
        parts.append(listed.tobytes())
    return "\n".join([*lines, "end_header", ""]).encode() + b"".join(parts)


def glb_bytes(drawing: Drawing) -> bytes:
    """Return the cameras and the points of a drawing as a glTF file."""
    exported: bytes = _scene(drawing).export(file_type="glb")
    return exported


def _scene(drawing: Drawing) -> "trimesh.Scene":
    import trimesh

    cameras, points = drawing.cameras, drawing.points
    middle = np.median(cameras.centers[cameras.placed], axis=0) if cameras.placed.any() else np.zeros(3)
    right, forward, up = drawing.axes
    turn = np.stack([right, up, -forward]).T
    vertices, faces, colors = camera_mesh(drawing)
    scene = trimesh.Scene(metadata={"offset": middle.tolist(), "axes": turn.T.tolist()})
    if len(faces):
        scene.add_geometry(_mesh((vertices - middle) @ turn, faces, colors), geom_name="cameras")
    if len(points.xyz):
        cloud = trimesh.PointCloud((points.xyz - middle) @ turn, colors=_opaque(points.colors))
        scene.add_geometry(cloud, geom_name="points")
    return scene


def trust_colors(trust: FloatArray) -> Colors:
    """Return the colors (n, 3) of trusts in [0, 1], as on the page; gray where a trust is NaN."""
    known = np.nan_to_num(trust)
    colors = np.stack([np.interp(known, _TRUST_STOPS, _TRUST_COLORS[:, c]) for c in range(3)], axis=1)
    colors[np.isnan(trust)] = 128.0
    return colors.round().astype(np.uint8)


def camera_mesh(drawing: Drawing) -> tuple[FloatArray, IntArray, Colors]:
    """Return vertices, faces and vertex colors of the pyramids of all placed cameras."""
    rows = np.flatnonzero(drawing.cameras.placed)
    apexes = drawing.cameras.centers[rows]
    pyramids = np.concatenate([apexes[:, None, :], frustum_corners(drawing, rows, apexes)], axis=1)
    faces = _PYRAMID + 5 * np.arange(len(rows))[:, None, None]
    colors = np.repeat(trust_colors(drawing.cameras.trust[rows]), 5, axis=0)
    return pyramids.reshape(-1, 3), faces.reshape(-1, 3), colors


def _mesh(vertices: FloatArray, faces: IntArray, colors: Colors) -> "trimesh.Trimesh":
    import trimesh

    return trimesh.Trimesh(vertices, faces, vertex_colors=_opaque(colors), process=False)


def _opaque(colors: npt.NDArray[np.integer]) -> Colors:
    return np.concatenate([colors, np.full((len(colors), 1), 255)], axis=1).astype(np.uint8)


def nerf_files(model: "ColmapModel", points_file: str, masks: str = "") -> tuple[bytes, bytes]:
    """Return the transforms.json of a model, and the PLY of all its points, to which it refers by that name.

    Args:
        model: in lenses that transforms.json knows.
        points_file, masks: the file of the points and the folder of masks as seen from the transforms.json;
            without masks its frames have none.
    """
    from sfm_shapefit.files.colmap.seed import pick_points
    from sfm_shapefit.files.nerf import nerf_text

    points = pick_points(model.arrays, model.num_points)
    text = nerf_text(model.images, points_file, masks)
    ply = ply_bytes(points.xyz, points.colors, with_normals=True)
    return text.encode(errors="backslashreplace"), ply
