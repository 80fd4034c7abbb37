"""NeRF's transforms.json, read as many programs write it, written as nerfstudio and instant-ngp read it.

    transform_matrix  world_from_camera, 4 x 4, in OpenGL's camera axes: x right, y up, looking along -z

so its columns are those of R^T S with S = diag(1, -1, -1), and the camera's center. World axes stay
COLMAP's. Intrinsics stand at the top if all images share them, else in each frame; the names of images are
taken to lie in images/, as in COLMAP's usual workspace. Beside nerfstudio's keys stands camera_angle_x,
for instant-ngp and the original NeRF.

A panorama is EQUIRECTANGULAR. nerfstudio wants half its width and its height for focal lengths; LichtFeld
takes a file for one of panoramas if none stands at the top, so they stand in the frames.

Source: https://docs.nerf.studio/quickstart/data_conventions.html.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import FLIP_YZ
from sfm_shapefit.files.json_node import JsonNode, read_json
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import Lens
from sfm_shapefit.scene.listed_poses import ListedPoses

_LEAST_ANGLE_RAD = 1e-3  # radians, angle of view; no lens has so small a one, and none has 0

_LEAST_SCALE = 1e-100  # factor of a world; what is smaller is none, and divides to infinity
_LARGEST_SIDE = 2**31  # pixels; no picture has such a side

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
_NUM_NUMERATOR = 5  # coefficients of FULL_OPENCV; the terms above come after these
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")

_OF_PINHOLES = ("fl_x", "fl_y", "cx", "cy")

_ORTHOGONAL = 0.01  # entries of M^T M / s^2 - I; a rotation written with three digits is nearer


def read_nerf(file: Path) -> ListedPoses:
    """Read the poses and lenses of a transforms.json, in the world before its `applied_transform`.

    Raises:
        InputError: if it is none, or a matrix is no pose, or a lens impossible; the message names the key.
    """
    content = JsonNode(file, "", read_json(file))
    if not content.has("frames"):
        raise InputError(
            f"{file} has no key 'frames'; give a transforms.json of NeRF's kind, or a COLMAP folder "
            "(`convert` makes one of OpenSfM's reconstruction.json)"
        )
    frames = content.get("frames").elements()
    turns, centers = _poses([frame.get("transform_matrix") for frame in frames])
    if content.has("applied_scale"):
        scale = content.get("applied_scale").number()
        if scale < _LEAST_SCALE:
            raise content.get("applied_scale").error("is not positive")
        centers = centers / scale
    if content.has("applied_transform"):
        (turn,), (shift,) = _poses([content.get("applied_transform")])
        turns, centers = turn.T @ turns, (centers - shift) @ turn
    lenses = [_Intrinsics(frame, content) for frame in frames]
    return ListedPoses(
        names=tuple(frame.get("file_path").text() for frame in frames),
        rotations=(turns @ FLIP_YZ).transpose(0, 2, 1),
        centers=centers,
        focal_shares=np.array([lens.focal_shares() for lens in lenses]).reshape(-1, 2),
        lenses=tuple(lens.read() for lens in lenses),
    )


def _poses(nodes: list[JsonNode]) -> tuple[FloatArray, FloatArray]:
    """Return the rotations (n, 3, 3) and last columns (n, 3) of matrices of 3 or 4 rows."""
    turns, shifts = np.empty((len(nodes), 3, 3)), np.empty((len(nodes), 3))
    for k, node in enumerate(nodes):
        rows = np.array([row.numbers(4) for row in node.elements()[:3]])
        turn = rows[:, :3] if len(rows) == 3 else np.zeros((3, 3))
        scale = np.cbrt(np.linalg.det(turn))  # one of the world, in some files
        off = np.abs(turn.T @ turn - scale**2 * np.eye(3)).max()
        if not (scale > 0.0 and off <= _ORTHOGONAL * scale**2):
            raise node.error("is no pose: its first three columns are no rotation")
        u, _, vt = np.linalg.svd(turn)
        turns[k], shifts[k] = u @ vt, rows[:, 3]
    return turns, shifts


class _Intrinsics(NamedTuple):
    """Keys of a lens: those of a frame, or else of all."""

    frame: JsonNode
    content: JsonNode

    def node(self, key: str) -> JsonNode | None:
        """Return the value of a key; None where there is none, or null."""
        nodes = (node.get(key) for node in (self.frame, self.content) if node.has(key))
        return next((node for node in nodes if node.value is not None), None)

    def number(self, key: str, default: float = np.nan) -> float:
        node = self.node(key)
        return default if node is None else node.number()

    def focal_shares(self) -> tuple[float, float]:
        """Return focal lengths over width and height; NaN where there is none."""
        shares = []
        for axis, side in zip("xy", "wh", strict=True):
            share = self.number(f"fl_{axis}") / (self.number(side) or np.nan)
            angle = self.number(f"camera_angle_{axis}")
            if np.isnan(share) and _LEAST_ANGLE_RAD < angle < np.pi:
                share = 0.5 / np.tan(0.5 * angle)
            shares.append(float(share))
        return shares[0], shares[1]

    def read(self) -> Lens | None:
        """Return the lens; None where size or focal length is missing, or COLMAP has no such model."""
        if not all(1.0 <= self.number(side) <= _LARGEST_SIDE for side in "wh"):
            return None
        width, height = int(self.number("w")), int(self.number("h"))
        kind = "OPENCV" if (node := self.node("camera_model")) is None else node.text()
        if kind == "EQUIRECTANGULAR":
            return Lens(kind, (width, height), width=width, height=height)
        family = _MODELS.get(kind, ("", 0, ()))[0]
        if (node := self.node("is_fisheye")) is not None and node.value is True:
            kind = family = "OPENCV_FISHEYE"
        given = np.array([self.number("fl_x"), self.number("fl_y")])
        focals = np.where(given > 0.0, given, self.focal_shares() * np.array([width, height]))
        fx, fy = np.where(focals > 0.0, focals, focals[::-1]).tolist()
        if not (family and fx > 0.0):
            return None
        distortion = {key: self.number(key) for key in _DISTORTION if self.node(key) is not None}
        name = _model_that_has(kind, family, distortion, are_equal=fx == fy)
        if not name:
            raise self.frame.error("has a distortion that no lens of COLMAP has; undistort the images first")
        _, num_focals, keys = _MODELS[name]
        center = self.number("cx", 0.5 * width), self.number("cy", 0.5 * height)
        values = (*(fx, fy)[:num_focals], *center, *(distortion.get(key, 0.0) for key in keys))
        return Lens(name, values, width=width, height=height)


def _model_that_has(kind: str, family: str, distortion: dict[str, float], *, are_equal: bool) -> str:
    """Return the model of COLMAP's that a lens is: `kind` if it may be, else the smallest; "" if none is.

    A `kind` that is a family of nerfstudio's is none of the models. Coefficients of 0 count if they stand
    there and the family has them, so that what was written here comes back as it was.
    """
    nonzero = {key for key, value in distortion.items() if value}
    stated = nonzero | (distortion.keys() & {*_MODELS[family][2]})
    for name, wanted in [(kind, nonzero)] * (kind != family) + [(name, stated) for name in _MODELS]:
        parameters, num_focals, keys = _MODELS[name]
        has = {*keys[:_NUM_NUMERATOR]}
        if parameters == family and wanted <= has and (are_equal or num_focals == 2):
            return name
    return ""


def nerf_text(images: Images, points_file: str = "", masks: str = "") -> str:
    """Return posed images as the text of a transforms.json, with the names of its points and masks.

    Raises:
        InputError: if a camera model has no equivalent there.
    """
    intrinsics = [_intrinsics(lens) for lens in images.lenses]
    shared = dict(intrinsics[0]) if len(intrinsics) == 1 else {}
    if shared and images.lenses[0].is_panorama:
        intrinsics[0] = {key: shared.pop(key) for key in _OF_PINHOLES}
    matrices = np.tile(np.eye(4), (images.num_images, 1, 1))
    matrices[:, :3, :3] = images.rotations.swapaxes(1, 2) @ FLIP_YZ
    matrices[:, :3, 3] = images.centers
    frames: list[dict[str, Any]] = []
    for name, lens, matrix in zip(images.names, images.lens_of.tolist(), matrices, strict=True):
        of_frame = {} if shared and not images.lenses[0].is_panorama else intrinsics[lens]
        mask = {"mask_path": f"{masks}/{name}.png"} if masks else {}
        pose = {"transform_matrix": (matrix + 0.0).tolist()}
        frames.append({"file_path": f"images/{name}"} | mask | of_frame | pose)
    points = {"ply_file_path": points_file} if points_file else {}
    return (
        json.dumps({**shared, **points, "frames": frames}, indent=2, ensure_ascii=False, allow_nan=False)
        + "\n"
    )


def _intrinsics(lens: Lens) -> dict[str, Any]:
    if lens.is_panorama:
        width, height = lens.parameters
        values = (0.5 * width, height, 0.5 * width, 0.5 * height)
        return {"camera_model": lens.model, "w": lens.width, "h": lens.height} | dict(
            zip(_OF_PINHOLES, values, strict=True)
        )
    if lens.model not in _MODELS:
        raise InputError(
            f"the camera model {lens.model} has no equivalent in transforms.json; undistort the images first"
        )
    name, num_focals, keys = _MODELS[lens.model]
    focals, (cx, cy, *coefficients) = lens.parameters[:num_focals], lens.parameters[num_focals:]
    distortion = dict(zip(keys, coefficients, strict=True))
    denominator = _DENOMINATOR if lens.model == "FULL_OPENCV" else ()
    if any(distortion.pop(key) for key in denominator):
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
