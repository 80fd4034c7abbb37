"""openMVG's sfm_data.json: read.

    views        [{key, value: {ptr_wrapper: {data: {filename, width, height,
                   id_view, id_intrinsic, id_pose}}}}]
    intrinsics   [{key, value: {polymorphic_name, ptr_wrapper: {data: {width, height, focal_length,
                   principal_point, disto_k1 | disto_k3 | disto_t2 | fisheye}}}}]
    extrinsics   [{key, value: {rotation: 3 rows, center: [3]}}]
    structure    [{key, value: {X: [3], observations: [{key: view, value: {x: [2]}}]}}]

    x_cam = rotation (X - center)

so rotation is cam_from_world, with z forward and y down as in COLMAP, and center the camera's center.
Newer versions nest the base classes' members in objects `value0`; both forms are read. The camera model is
known by the name of its distortion, for `polymorphic_name` stands only at the first of a kind. Pixels are
taken as they are.

Source: https://openmvg.readthedocs.io, "SfM data scene representation", and openMVG's cameras.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.files.json_node import JsonNode
from sfm_shapefit.scene.posed_model import (
    Intrinsics,
    PosedImage,
    PosedModelFile,
    model_of_images,
    observation_arrays,
)

# This is openMVG's UndefinedIndexT.
_NO_POSE = 2**32 - 1
_CAMERA_KEYS = ("width", "height", "focal_length", "principal_point")


def is_openmvg(content: object) -> bool:
    """Return whether the content of a JSON file is openMVG's scene."""
    return isinstance(content, dict) and "sfm_data_version" in content


def read_openmvg(file: Path, content: object) -> PosedModelFile:
    """Read the posed views and the structure of a file whose JSON is `content`.

    Raises:
        InputError: naming the key that is missing or wrong.
    """
    root = JsonNode(file, "", content)
    cameras = {key: _camera(_data(node)) for key, node in _entries(root, "intrinsics")}
    poses = {
        key: (node.get("rotation").rotation(), np.array(node.get("center").numbers(3)))
        for key, node in _entries(root, "extrinsics")
    }
    order = {key: k for k, key in enumerate(cameras)}
    index_of: dict[int, int] = {}
    images: list[PosedImage] = []
    for _, node in _entries(root, "views"):
        view = _data(node)
        pose = view.get("id_pose").integer()
        if pose == _NO_POSE or pose not in poses:
            continue
        intrinsic = view.get("id_intrinsic").integer()
        if intrinsic not in cameras:
            raise view.error(f"has the intrinsic {intrinsic}, which is not among the intrinsics")
        folder = view.get("local_path").value if view.has("local_path") else ""
        index_of[view.get("id_view").integer()] = len(images)
        name = "/".join(part for part in (str(folder).strip("/"), view.get("filename").text()) if part)
        images.append((name, order[intrinsic], *poses[pose]))
    points, observed, pixels = _structure(root, index_of)
    return model_of_images(
        cameras.values(),
        images,
        points=points,
        colors=np.full((len(points), 3), 128, dtype=np.int64),
        observed=observed,
        pixels=pixels,
    )


def _entries(root: JsonNode, key: str) -> Iterator[tuple[int, JsonNode]]:
    """Yield the keys and values of one of openMVG's maps; none if it is missing."""
    for node in root.get(key).elements() if root.has(key) else []:
        yield node.get("key").integer(), node.get("value")


def _data(node: JsonNode) -> JsonNode:
    """Return the members behind a pointer."""
    return node.get("ptr_wrapper").get("data")


def _found(node: JsonNode, key: str) -> JsonNode | None:
    """Return a member of an object or of its nested base classes; None if there is none."""
    if node.has(key):
        return node.get(key)
    return _found(node.get("value0"), key) if node.has("value0") else None


def _camera(node: JsonNode) -> Intrinsics:
    """Return a camera in COLMAP's terms."""
    found = [_found(node, key) or node.get(key) for key in _CAMERA_KEYS]
    width, height = found[0].integer(), found[1].integer()
    f, center = found[2].number(), found[3].numbers(2)
    if f <= 0.0 or width < 1 or height < 1:
        raise node.error("has a focal length or a size that is not positive")
    if k1 := _found(node, "disto_k1"):
        return Intrinsics("SIMPLE_RADIAL", width, height, (f, *center, *k1.numbers(1)))
    if fisheye := _found(node, "fisheye"):
        return Intrinsics("OPENCV_FISHEYE", width, height, (f, f, *center, *fisheye.numbers(4)))
    if k3 := _found(node, "disto_k3"):
        (a, b, c), p1, p2 = k3.numbers(3), 0.0, 0.0
    elif t2 := _found(node, "disto_t2"):
        a, b, c, p1, p2 = t2.numbers(5)
    else:
        return Intrinsics("SIMPLE_PINHOLE", width, height, (f, *center))
    return Intrinsics("FULL_OPENCV", width, height, (f, f, *center, a, b, p1, p2, c, 0.0, 0.0, 0.0))


def _structure(root: JsonNode, index_of: dict[int, int]) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return points, observations (point, image) and their pixels."""
    points: list[list[float]] = []
    observed, pixels = [], []
    for _, node in _entries(root, "structure"):
        for seen in node.get("observations").elements():
            view = seen.get("key").integer()
            if view in index_of:
                observed.append((len(points), index_of[view]))
                pixels.append(seen.get("value").get("x").numbers(2))
        points.append(node.get("X").numbers(3))
    return np.array(points, dtype=np.float64).reshape(-1, 3), *observation_arrays(observed, pixels)
