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

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.base.quaternions import rotations_of
from sfm_shapefit.files.json_node import JsonNode, read_json
from sfm_shapefit.files.lines import text_of
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import Lens
from sfm_shapefit.scene.points import Points

_TRACKS_FILE = "tracks.csv"
_MODELS = {
    "perspective": "RADIAL",
    "brown": "FULL_OPENCV",
    "fisheye": "OPENCV_FISHEYE",
    "fisheye_opencv": "OPENCV_FISHEYE",
    "simple_radial": "OPENCV",
    "radial": "OPENCV",
    "spherical": "EQUIRECTANGULAR",
    "equirectangular": "EQUIRECTANGULAR",  # its name in early versions
}
"""COLMAP's name of a camera model, by OpenSfM's."""


class OpenSfmModel(NamedTuple):
    """Images in the order of the file, each in a frame of its own, and the points that two of them see."""

    images: Images
    points: Points
    colors: npt.NDArray[np.uint8]
    """(x, 3)"""
    keypoints: list[FloatArray]
    """Pixels (k, 2) of the observations of each image."""


def read_opensfm(file: Path) -> OpenSfmModel:
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
    images = _images(chosen)
    ids, xyz, colors = [], [], []
    for key, node in chosen.get("points").items() if chosen.has("points") else []:
        ids.append(key)
        xyz.append(node.get("coordinates").numbers(3))
        colors.append(node.get("color").numbers(3) if node.has("color") else [0.0, 0.0, 0.0])
    observed, scaled = _observations(file, ids, images.names)
    sizes = images.sizes_px[observed[:, 1]]
    pixels = scaled * sizes.max(axis=1, keepdims=True, initial=0.0) + sizes / 2.0
    bounds = np.searchsorted(observed[:, 1], np.arange(images.num_images + 1))
    order = np.argsort(observed[:, 0], kind="stable")
    known, lengths = np.unique(observed[:, 0], return_counts=True)
    points = Points(
        xyz=np.reshape(xyz, (-1, 3))[known],
        offsets=offsets_of(lengths),
        images=observed[order, 1],
        keypoints=(np.arange(len(observed)) - bounds[observed[:, 1]])[order],
        ids=known + 1,
    )
    rounded = np.clip(np.reshape(colors, (-1, 3)), 0, 255).astype(np.uint8)[known]
    return OpenSfmModel(images, points, rounded, np.split(pixels, bounds[1:-1]))


def _images(reconstruction: JsonNode) -> Images:
    """Return the images of a reconstruction; ids are from 1 on."""
    cameras = reconstruction.get("cameras").items()
    order = {key: k for k, (key, _) in enumerate(cameras)}
    shots = reconstruction.get("shots").items()
    if not shots:
        raise reconstruction.error("has no shots")
    names, lens_of, rotations, centers = [], [], [], []
    for name, shot in shots:
        key = shot.get("camera").text()
        if key not in order:
            raise shot.error(f"has the camera {key!r}, which is not among the cameras")
        rotation = rotations_of(np.array([shot.get("rotation").numbers(3)]))[0]
        names.append(name)
        lens_of.append(order[key])
        rotations.append(rotation)
        centers.append(-rotation.T @ np.array(shot.get("translation").numbers(3)))
    poses = np.array(rotations), np.array(centers)
    return Images.listed(names, poses, lens_of, [_lens(node) for _, node in cameras])


def _lens(node: JsonNode) -> Lens:
    """Return a camera's lens in COLMAP's terms; missing coefficients are 0."""
    kind = node.get("projection_type").text()
    if kind not in _MODELS:
        raise node.error(f"has the projection type {kind!r}; {', '.join(_MODELS)} are read")
    width, height = node.get("width").integer(), node.get("height").integer()
    if width < 1 or height < 1:
        raise node.error("has no size")
    if _MODELS[kind] == "EQUIRECTANGULAR":
        return Lens(_MODELS[kind], (float(width), float(height)), width=width, height=height)
    size = float(max(width, height))

    def value(key: str) -> float:
        return node.get(key).number() if node.has(key) else 0.0

    keys = ("focal_x", "focal_y") if node.has("focal_x") else ("focal", "focal")
    fx, fy = (node.get(key).number() * size for key in keys)
    if fx <= 0.0 or fy <= 0.0:
        raise node.error("has a focal length that is not positive")
    center = (size * value("c_x") + width / 2.0, size * value("c_y") + height / 2.0)
    parameters = [fx, fy, *center, value("k1"), value("k2"), 0.0, 0.0]
    if kind == "fisheye_opencv":
        parameters[6:] = [value("k3"), value("k4")]
    if kind == "perspective":
        parameters = [fx, *parameters[2:6]]
    elif kind == "brown":
        parameters[6:] = [value("p1"), value("p2"), value("k3"), 0.0, 0.0, 0.0]
    return Lens(_MODELS[kind], tuple(parameters), width=width, height=height)


def _observations(file: Path, points: Sequence[str], names: Sequence[str]) -> tuple[IntArray, FloatArray]:
    """Return the observations (point, image) of tracks.csv, by image, and their normalized coordinates.

    If an image observes a point several times, the first observation counts; points of one image are none.
    """
    tracks = file.with_name(_TRACKS_FILE)
    observations: dict[tuple[int, int], tuple[float, float]] = {}
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
                observations.setdefault((point_of[track], image_of[image]), (x, y))
    observed = np.array(list(observations), dtype=np.int64).reshape(-1, 2)
    coordinates = np.array(list(observations.values()), dtype=np.float64).reshape(-1, 2)
    rows = np.argsort(observed[:, 1], kind="stable")
    rows = rows[np.bincount(observed[:, 0])[observed[rows, 0]] >= 2]
    return observed[rows], coordinates[rows]
