"""scene.glb and scene.ply, for any viewer: cameras colored by trust, points, pairs. The door to trimesh.

    scene.ply    the output's own axes and units, as the seeded model: it overlays other exports of it
    scene.glb    turned so that y is up, as viewers of glTF expect, the cameras' median at the origin

Both formats hold float32. Few viewers draw the edges that PLY may have, so pairs are thin ribbons in it.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.report.drawing import Drawing, PairClass, frustum_corners

if TYPE_CHECKING:
    import trimesh

Colors = npt.NDArray[np.uint8]

PAIR_COLORS = np.array([[47, 120, 196], [208, 58, 43], [176, 125, 0], [139, 148, 161]], dtype=np.uint8)
"""Of each `PairClass`, as on the page."""
_TRUST_STOPS = np.array([0.0, 0.4, 0.7, 1.0])
_TRUST_COLORS = np.array([[179, 32, 44], [232, 116, 59], [233, 197, 74], [42, 157, 143]], dtype=np.float64)
# A ribbon is this share of the depth of a frustum wide.
_RIBBON = 0.03
_PYRAMID = np.array([[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [1, 2, 3], [1, 3, 4]])
"""Faces around an apex, 0, and four corners."""
_MARKER = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]], dtype=np.float64)
_MARKER_FACES = np.array(
    [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
)
"""An octahedron, for nodes without a picture."""
_MAX_PAIRS = 20_000


def write_meshes(drawing: Drawing, folder: Path) -> None:
    """Write scene.glb and scene.ply into a folder."""
    import trimesh

    vertices, faces, colors = _camera_mesh(drawing)
    ends, line_colors = _lines(drawing)
    _write_ply(drawing, (vertices, faces, colors), (ends, line_colors), folder / "scene.ply")

    middle = (
        np.median(drawing.cameras.centers[drawing.cameras.placed], axis=0) if len(vertices) else np.zeros(3)
    )
    right, forward, up = drawing.axes
    turn = np.stack([right, up, -forward])

    def turn_upright(points: FloatArray) -> FloatArray:
        moved: FloatArray = (points - middle) @ turn.T
        return moved

    shown = trimesh.Scene()
    if len(faces):
        shown.add_geometry(_mesh(turn_upright(vertices), faces, colors), geom_name="cameras")
    if len(drawing.points.positions):
        positions = turn_upright(drawing.points.positions)
        shown.add_geometry(
            trimesh.PointCloud(positions, colors=_opaque(drawing.points.colors)), geom_name="points"
        )
    for kind in PairClass:
        mine = (line_colors == PAIR_COLORS[kind]).all(axis=1)
        if mine.any():
            lines = trimesh.load_path(turn_upright(ends[mine].reshape(-1, 3)).reshape(-1, 2, 3))
            lines.colors = np.tile([*PAIR_COLORS[kind], 255], (len(lines.entities), 1))
            shown.add_geometry(lines, geom_name=f"pairs: {kind.name.lower().replace('_', ' ')}")
    (folder / "scene.glb").write_bytes(shown.export(file_type="glb"))


def trust_colors(trust: FloatArray) -> Colors:
    """Return the colors (n, 3) of trusts in [0, 1], as on the page; gray where it is not known."""
    known = np.nan_to_num(trust)
    colors = np.stack([np.interp(known, _TRUST_STOPS, _TRUST_COLORS[:, c]) for c in range(3)], axis=1)
    colors[np.isnan(trust)] = 128.0
    return colors.round().astype(np.uint8)


def _camera_mesh(drawing: Drawing) -> tuple[FloatArray, IntArray, Colors]:
    """Return vertices, faces and vertex colors of all placed cameras: pyramids, or octahedra for nodes."""
    cameras = drawing.cameras
    rows = np.flatnonzero(cameras.placed)
    has_picture = np.isfinite(cameras.poses.rotations[rows]).all(axis=(1, 2))
    pictured, bare = rows[has_picture], rows[~has_picture]
    apexes = cameras.centers[pictured]
    pyramids = np.concatenate([apexes[:, None, :], frustum_corners(drawing, pictured, apexes)], axis=1)
    markers = cameras.centers[bare][:, None, :] + drawing.frustum_depth / 4 * _MARKER
    first = _PYRAMID + 5 * np.arange(len(pictured))[:, None, None]
    second = _MARKER_FACES + 6 * np.arange(len(bare))[:, None, None] + 5 * len(pictured)
    colors = [
        np.repeat(trust_colors(cameras.trust[chosen]), count, axis=0)
        for chosen, count in ((pictured, 5), (bare, 6))
    ]
    return (
        np.concatenate([pyramids.reshape(-1, 3), markers.reshape(-1, 3)]),
        np.concatenate([first.reshape(-1, 3), second.reshape(-1, 3)]),
        np.concatenate(colors),
    )


def _lines(drawing: Drawing) -> tuple[FloatArray, Colors]:
    """Return the ends (k, 2, 3) and colors (k, 3) of the pairs whose cameras are placed, at most 20,000."""
    worst = drawing.pairs.worst_first()
    ends = drawing.pairs.cameras[worst]
    drawn = drawing.cameras.placed[ends].all(axis=1) & (
        drawing.pairs.classes[worst] != PairClass.NO_DIRECTION
    )
    chosen = worst[drawn][:_MAX_PAIRS]
    return drawing.cameras.centers[drawing.pairs.cameras[chosen]], PAIR_COLORS[drawing.pairs.classes[chosen]]


def _write_ply(
    drawing: Drawing,
    cameras: tuple[FloatArray, IntArray, Colors],
    lines: tuple[FloatArray, Colors],
    path: Path,
) -> None:
    """Write one mesh: cameras, ribbons for pairs, and points as vertices without faces."""
    vertices, faces, colors = cameras
    ends, line_colors = lines
    along = ends[:, 1] - ends[:, 0]
    side = np.cross(along, drawing.axes[2])
    lengths = np.linalg.norm(side, axis=1, keepdims=True)
    side = np.where(lengths > 0.0, side / np.where(lengths > 0.0, lengths, 1.0), drawing.axes[0])
    side = 0.5 * _RIBBON * drawing.frustum_depth * side[:, None, :]
    ribbons = np.concatenate([ends - side, ends + side], axis=1)  # (k, 4, 3)
    quads = np.array([[0, 1, 3], [0, 3, 2]]) + 4 * np.arange(len(ends))[:, None, None] + len(vertices)
    mesh = _mesh(
        np.concatenate([vertices, ribbons.reshape(-1, 3), drawing.points.positions]),
        np.concatenate([faces, quads.reshape(-1, 3)]),
        np.concatenate([colors, np.repeat(line_colors, 4, axis=0), drawing.points.colors.astype(np.uint8)]),
    )
    path.write_bytes(mesh.export(file_type="ply"))


def _mesh(vertices: FloatArray, faces: IntArray, colors: Colors) -> "trimesh.Trimesh":
    import trimesh

    return trimesh.Trimesh(vertices, faces, vertex_colors=_opaque(colors), process=False)


def _opaque(colors: npt.NDArray[np.integer]) -> Colors:
    return np.concatenate([colors, np.full((len(colors), 1), 255)], axis=1).astype(np.uint8)
