"""OpenSfM's reconstruction.json: read, with the observations of the tracks.csv beside it, if there is one.

    [{"cameras": {id: {projection_type, width, height, focal, k1, k2, ...}},
      "shots":   {name: {rotation: [3], translation: [3], camera: id}},
      "points":  {id: {coordinates: [3], color: [3]}}}, ...]

`rotation` is the angle-axis vector of cam_from_world, `translation` its t: x_cam = R x + t, z forward and
y down as in COLMAP. Lengths in the image are in units of its larger side, from its center:

    pixel = larger side * normalized + (width, height) / 2          (COLMAP's pixels: first center at 0.5)

tracks.csv, versions 1 and 2: `image track feature x y [scale] r g b ...`, tab-separated, x and y
normalized; tracks are the points. Where there are several reconstructions, the one with most shots is read.

Source: https://opensfm.org/docs/geometry.html and dataset.html.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.json_node import JsonNode, read_json
from sfm_shapefit.files.lines import text_of
from sfm_shapefit.scene.posed_model import Intrinsics, PosedImage, PosedModelFile, model_of_images

_TRACKS_FILE = "tracks.csv"
_MODELS = ("perspective", "brown", "fisheye", "simple_radial", "radial")


def read_opensfm(file: Path) -> PosedModelFile:
    """Read the largest reconstruction of a file.

    Raises:
        InputError: if it is no reconstruction.json, or malformed; the message names the key.
    """
    content = read_json(file)
    first = content[0] if isinstance(content, list) and content else None
    if not (isinstance(first, dict) and "shots" in first):
        raise InputError(f"{file} is no model: give OpenSfM's reconstruction.json or a COLMAP folder")
    reconstructions = JsonNode(file, "", content).elements()
    chosen = max(reconstructions, key=lambda node: len(node.get("shots").items()))
    cameras = {key: _camera(node) for key, node in chosen.get("cameras").items()}
    order = {key: k for k, key in enumerate(cameras)}
    images: list[PosedImage] = []
    for name, shot in chosen.get("shots").items():
        key = shot.get("camera").text()
        if key not in cameras:
            raise shot.error(f"has the camera {key!r}, which is not among the cameras")
        rotation = Rotation.from_rotvec(shot.get("rotation").numbers(3)).as_matrix()
        center = -rotation.T @ np.array(shot.get("translation").numbers(3))
        images.append((name, order[key], rotation, center))
    ids, points, colors = [], [], []
    for key, node in chosen.get("points").items() if chosen.has("points") else []:
        ids.append(key)
        points.append(node.get("coordinates").numbers(3))
        colors.append(node.get("color").numbers(3) if node.has("color") else [0.0, 0.0, 0.0])
    observed, scaled = _observations(file, ids, [image[0] for image in images])
    sizes = np.array([camera[1:3] for camera in cameras.values()], dtype=np.float64).reshape(-1, 2)
    of_image = sizes[np.array([image[1] for image in images], dtype=np.int64)[observed[:, 1]]]
    return model_of_images(
        cameras.values(),
        images,
        points=np.array(points).reshape(-1, 3),
        colors=np.clip(np.array(colors).reshape(-1, 3), 0, 255).astype(np.int64),
        observed=observed,
        pixels=scaled * of_image.max(axis=1, keepdims=True, initial=0.0) + of_image / 2.0,
    )


def _camera(node: JsonNode) -> Intrinsics:
    """Return a camera in COLMAP's terms; missing coefficients are 0."""
    kind = node.get("projection_type").text()
    if kind not in _MODELS:
        raise node.error(f"has the projection type {kind!r}; {', '.join(_MODELS)} are read")
    width, height = node.get("width").integer(), node.get("height").integer()
    if width < 1 or height < 1:
        raise node.error("has no size")
    size = float(max(width, height))

    def value(key: str) -> float:
        return node.get(key).number() if node.has(key) else 0.0

    keys = ("focal_x", "focal_y") if node.has("focal_x") else ("focal", "focal")
    fx, fy = (node.get(key).number() * size for key in keys)
    if fx <= 0.0 or fy <= 0.0:
        raise node.error("has a focal length that is not positive")
    center = (size * value("c_x") + width / 2.0, size * value("c_y") + height / 2.0)
    k1, k2 = value("k1"), value("k2")
    if kind == "perspective":
        return Intrinsics("RADIAL", width, height, (fx, *center, k1, k2))
    both = (fx, fy, *center, k1, k2)
    if kind == "brown":
        extra = (value("p1"), value("p2"), value("k3"), 0.0, 0.0, 0.0)
        return Intrinsics("FULL_OPENCV", width, height, (*both, *extra))
    model = "OPENCV_FISHEYE" if kind == "fisheye" else "OPENCV"
    return Intrinsics(model, width, height, (*both, 0.0, 0.0))


def _observations(file: Path, points: list[str], names: list[str]) -> tuple[IntArray, FloatArray]:
    """Return the observations (point, image) of tracks.csv, and their normalized coordinates."""
    tracks = file.with_name(_TRACKS_FILE)
    observed, coordinates = [], []
    if tracks.is_file():
        point_of, image_of = ({key: k for k, key in enumerate(keys)} for keys in (points, names))
        for number, line in enumerate(text_of(tracks).splitlines(), start=1):
            words = line.split("\t")
            if line.startswith("OPENSFM_TRACKS_VERSION") or not line.strip():
                continue
            try:
                image, track, x, y = words[0], words[1], float(words[3]), float(words[4])
            except (IndexError, ValueError):
                raise InputError(f"{tracks}, line {number}: expected image, track, feature, x, y") from None
            if not (np.isfinite(x) and np.isfinite(y)):
                raise InputError(f"{tracks}, line {number}: has a number that is not finite")
            if track in point_of and image in image_of:
                observed.append((point_of[track], image_of[image]))
                coordinates.append((x, y))
    return (
        np.array(observed, dtype=np.int64).reshape(-1, 2),
        np.array(coordinates, dtype=np.float64).reshape(-1, 2),
    )
