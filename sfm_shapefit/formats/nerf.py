"""NeRF's transforms.json, as nerfstudio and instant-ngp read it: written.

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

from sfm_shapefit.errors import InputError
from sfm_shapefit.formats.posed_model import Intrinsics, PosedModelFile
from sfm_shapefit.geometry import FLIP_YZ

_RADIAL_KEYS = {
    "SIMPLE_PINHOLE": "",
    "PINHOLE": "",
    "SIMPLE_RADIAL": "k1",
    "RADIAL": "k1 k2",
    "OPENCV": "k1 k2 p1 p2",
    "FULL_OPENCV": "k1 k2 p1 p2 k3 k4 k5 k6",
}
_FISHEYE_KEYS = {
    "SIMPLE_FISHEYE": "",
    "FISHEYE": "",
    "SIMPLE_RADIAL_FISHEYE": "k1",
    "RADIAL_FISHEYE": "k1 k2",
    "OPENCV_FISHEYE": "k1 k2 k3 k4",
}
_ONE_FOCAL = {
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "SIMPLE_FISHEYE",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
}
# nerfstudio has no such terms of FULL_OPENCV.
_DENOMINATOR = ("k4", "k5", "k6")


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
        own = {} if shared else intrinsics[camera]
        frames.append({"file_path": f"images/{name}", **own, "transform_matrix": (matrix + 0.0).tolist()})
    return json.dumps({**shared, "frames": frames}, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _intrinsics(camera: Intrinsics) -> dict[str, Any]:
    """Return a camera's keys."""
    is_fisheye = camera.model in _FISHEYE_KEYS
    if not is_fisheye and camera.model not in _RADIAL_KEYS:
        raise InputError(
            f"the camera model {camera.model} has no equivalent in transforms.json; "
            "undistort the images first"
        )
    keys = (_FISHEYE_KEYS if is_fisheye else _RADIAL_KEYS)[camera.model].split()
    focal = camera.params[:1] * 2 if camera.model in _ONE_FOCAL else camera.params[:2]
    rest = camera.params[1:] if camera.model in _ONE_FOCAL else camera.params[2:]
    distortion = dict(zip(keys, rest[2:], strict=True))
    if camera.model == "FULL_OPENCV":
        denominator = [distortion.pop(key) for key in _DENOMINATOR]
        if any(denominator):
            raise InputError("transforms.json has no k4, k5, k6 of FULL_OPENCV; undistort the images first")
    return {
        "camera_model": "OPENCV_FISHEYE" if is_fisheye else "OPENCV",
        "fl_x": focal[0],
        "fl_y": focal[1],
        "cx": rest[0],
        "cy": rest[1],
        "w": camera.width,
        "h": camera.height,
        **distortion,
        "camera_angle_x": float(2.0 * np.arctan(camera.width / (2.0 * focal[0]))),
    }
