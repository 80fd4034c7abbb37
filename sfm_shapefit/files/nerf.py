"""NeRF's transforms.json, read as many programs write it, written as nerfstudio and instant-ngp read it.

    transform_matrix  world_from_camera, 4 x 4, in OpenGL's camera axes: x right, y up, looking along -z

so its columns are those of R^T S with S = diag(1, -1, -1), and the camera's center. World axes stay
COLMAP's. Intrinsics stand at the top if all images share them, else in each frame; the names of images are
taken to lie in images/, as in COLMAP's usual workspace. Beside nerfstudio's keys stands camera_angle_x,
for instant-ngp and the original NeRF. Only poses and focal lengths are read: other programs shrink images,
and have distortions of their own.

Source: https://docs.nerf.studio/quickstart/data_conventions.html.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import FLIP_YZ
from sfm_shapefit.files.json_node import JsonNode, read_json
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import Lens
from sfm_shapefit.scene.listed_poses import ListedPoses

_LEAST_ANGLE_RAD = 1e-3  # radians, angle of view; no lens has so small a one, and none has 0

_MODELS = {
    "SIMPLE_PINHOLE": ("OPENCV", 1, ()),
    "PINHOLE": ("OPENCV", 2, ()),
    "SIMPLE_RADIAL": ("OPENCV", 1, ("k1",)),
    "RADIAL": ("OPENCV", 1, ("k1", "k2")),
    "OPENCV": ("OPENCV", 2, ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": ("OPENCV", 2, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "SIMPLE_FISHEYE": ("OPENCV_FISHEYE", 1, ()),
    "FISHEYE": ("OPENCV_FISHEYE", 2, ()),
    "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", 1, ("k1",)),
    "RADIAL_FISHEYE": ("OPENCV_FISHEYE", 1, ("k1", "k2")),
    "OPENCV_FISHEYE": ("OPENCV_FISHEYE", 2, ("k1", "k2", "k3", "k4")),
}
"""By COLMAP's name of a camera model: nerfstudio's, the number of focal lengths, keys of the distortion."""
_DENOMINATOR = ("k4", "k5", "k6")
"""Terms of FULL_OPENCV that nerfstudio does not have."""

_ORTHOGONAL = 0.01  # entries of M^T M / s^2 - I; a rotation written with three digits is nearer


def read_nerf(file: Path) -> ListedPoses:
    """Read the poses of a transforms.json.

    Raises:
        InputError: if it is none, or a matrix is no pose; the message names the key.
    """
    content = JsonNode(file, "", read_json(file))
    if not content.has("frames"):
        raise InputError(
            f"{file} has no key 'frames'; give a transforms.json of NeRF's kind, or a COLMAP folder "
            "(`convert` makes one of OpenSfM's reconstruction.json)"
        )
    names, rotations, centers, focals = [], [], [], []
    for frame in content.get("frames").elements():
        node = frame.get("transform_matrix")
        rows = np.array([row.numbers(4) for row in node.elements()[:3]])
        turn = rows[:, :3] if len(rows) == 3 else np.zeros((3, 3))
        scale = np.cbrt(np.linalg.det(turn))  # one of the world, in some files
        off = np.abs(turn.T @ turn - scale**2 * np.eye(3)).max()
        if not (scale > 0.0 and off <= _ORTHOGONAL * scale**2):
            raise node.error("is no pose: its first three columns are no rotation")
        u, _, vt = np.linalg.svd(turn)
        names.append(frame.get("file_path").text())
        rotations.append((u @ vt @ FLIP_YZ).T)
        centers.append(rows[:, 3])
        focals.append(_focal_shares(frame, content))
    return ListedPoses(tuple(names), *(np.array(x) for x in (rotations, centers, focals)))


def _focal_shares(frame: JsonNode, content: JsonNode) -> tuple[float, float]:
    """Return focal lengths over width and height, of a frame or else of all; NaN where there is none."""

    def value(key: str) -> float:
        node = next((node for node in (frame, content) if node.has(key)), None)
        return np.nan if node is None else node.get(key).number()

    width, height, x, y = (value(key) for key in ("w", "h", "fl_x", "fl_y"))
    across = x / width if width > 0.0 else np.nan
    angle = value("camera_angle_x")
    if np.isnan(across) and _LEAST_ANGLE_RAD < angle < np.pi:
        across = 0.5 / np.tan(0.5 * angle)
    return (across, y / height if height > 0.0 else np.nan)


def nerf_text(images: Images) -> str:
    """Return posed images as the text of a transforms.json.

    Raises:
        InputError: if a camera model has no equivalent there.
    """
    intrinsics = [_intrinsics(lens) for lens in images.lenses]
    shared = intrinsics[0] if len(intrinsics) == 1 else {}
    matrices = np.tile(np.eye(4), (images.num_images, 1, 1))
    matrices[:, :3, :3] = images.rotations.swapaxes(1, 2) @ FLIP_YZ
    matrices[:, :3, 3] = images.centers
    frames: list[dict[str, Any]] = []
    for name, lens, matrix in zip(images.names, images.lens_of.tolist(), matrices, strict=True):
        own = {} if shared else intrinsics[lens]
        frames.append({"file_path": f"images/{name}", **own, "transform_matrix": (matrix + 0.0).tolist()})
    return json.dumps({**shared, "frames": frames}, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _intrinsics(lens: Lens) -> dict[str, Any]:
    """Return a lens's keys."""
    if lens.model not in _MODELS:
        raise InputError(
            f"the camera model {lens.model} has no equivalent in transforms.json; undistort the images first"
        )
    name, num_focals, keys = _MODELS[lens.model]
    focals, (cx, cy, *coefficients) = lens.parameters[:num_focals], lens.parameters[num_focals:]
    distortion = dict(zip(keys, coefficients, strict=True))
    denominator = [distortion.pop(key) for key in _DENOMINATOR if key in distortion]
    if any(denominator):
        raise InputError("transforms.json has no k4, k5, k6 of FULL_OPENCV; undistort the images first")
    return {
        "camera_model": name,
        "fl_x": focals[0],
        "fl_y": focals[-1],
        "cx": cx,
        "cy": cy,
        "w": lens.width,
        "h": lens.height,
        **distortion,
        "camera_angle_x": float(2.0 * np.arctan(lens.width / (2.0 * focals[0]))),
    }
