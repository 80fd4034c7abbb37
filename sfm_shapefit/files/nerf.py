"""NeRF's transforms.json, written as nerfstudio and instant-ngp read it.

    transform_matrix  world_from_camera, 4 x 4, in OpenGL's camera axes: x right, y up, looking along -z

so its columns are those of R^T S with S = diag(1, -1, -1), and the camera's center. World axes stay
COLMAP's. Intrinsics stand at the top if all images share them, else in each frame; the names of images are
taken to lie in images/, as in COLMAP's usual workspace. Beside nerfstudio's keys stands camera_angle_x,
for instant-ngp and the original NeRF.

Source: https://docs.nerf.studio/quickstart/data_conventions.html.
"""

import json
from typing import Any

import numpy as np

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import FLIP_YZ
from sfm_shapefit.scene.posed_model import Intrinsics, PosedModelFile

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


def nerf_text(scene: PosedModelFile) -> str:
    """Return the posed images as the text of a transforms.json.

    Raises:
        InputError: if a camera model has no equivalent there.
    """
    intrinsics = [_intrinsics(camera) for camera in scene.cameras]
    used = sorted(set(scene.camera_of.tolist()))
    shared = intrinsics[used[0]] if len(used) == 1 else {}
    frames: list[dict[str, Any]] = []
    for name, camera, rotation, center in zip(
        scene.names, scene.camera_of.tolist(), scene.rotations, scene.centers, strict=True
    ):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation.T @ FLIP_YZ, center
        lens = {} if shared else intrinsics[camera]
        frames.append({"file_path": f"images/{name}", **lens, "transform_matrix": (matrix + 0.0).tolist()})
    return json.dumps({**shared, "frames": frames}, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _intrinsics(camera: Intrinsics) -> dict[str, Any]:
    """Return a camera's keys."""
    if camera.model not in _MODELS:
        raise InputError(
            f"the camera model {camera.model} has no equivalent in transforms.json; "
            "undistort the images first"
        )
    name, num_focals, keys = _MODELS[camera.model]
    focals, (cx, cy, *coefficients) = camera.params[:num_focals], camera.params[num_focals:]
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
        "w": camera.width,
        "h": camera.height,
        **distortion,
        "camera_angle_x": float(2.0 * np.arctan(camera.width / (2.0 * focals[0]))),
    }
