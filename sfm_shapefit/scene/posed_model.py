"""A posed model in plain arrays: what the model formats of other programs are read into and written from.

COLMAP's conventions hold: x_cam = R x_world + t with +z forward and y down, pixels with the center of the
first one at (0.5, 0.5), camera models and the order of their parameters by COLMAP's names.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray


class Intrinsics(NamedTuple):
    """A camera, by COLMAP's name of its model and in COLMAP's order of parameters."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


class ListedPoses(NamedTuple):
    """Poses of n images, and nothing else that is believed; cameras as in COLMAP."""

    names: tuple[str, ...]
    """(n,) as their program writes them: with a folder of its own, without suffix, or a timestamp."""
    rotations: FloatArray
    """(n, 3, 3) cam_from_world."""
    centers: FloatArray
    """(n, 3) camera centers in the world."""
    focal_shares: FloatArray
    """(n, 2) focal lengths over width and height of the image; NaN where unknown."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PosedModelFile:
    """The posed images and the tracks of a model."""

    cameras: tuple[Intrinsics, ...]
    names: tuple[str, ...]
    """(n,) names of the posed images."""
    camera_of: IntArray
    """(n,) index of each image's camera."""
    rotations: FloatArray
    """(n, 3, 3) cam_from_world."""
    centers: FloatArray
    """(n, 3) camera centers in the world."""
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """(p, 3)"""
    colors: IntArray = field(default_factory=lambda: np.zeros((0, 3), dtype=np.int64))
    """(p, 3) in 0..255."""
    observed: IntArray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    """(o, 2) point and image of each observation."""
    pixels: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    """(o, 2) where."""


PosedImage = tuple[str, int, FloatArray, FloatArray]
"""The name of an image, the index of its camera, its rotation (3, 3) and its center (3,)."""


def model_of_images(
    cameras: Iterable[Intrinsics], images: Sequence[PosedImage], **structure: Any
) -> PosedModelFile:
    """Return a model of posed images; points, colors, observations and pixels are passed on as they are."""
    names, camera_of, rotations, centers = zip(*images, strict=True) if images else ((),) * 4
    return PosedModelFile(
        cameras=tuple(cameras),
        names=names,
        camera_of=np.array(camera_of, dtype=np.int64),
        rotations=np.array(rotations).reshape(-1, 3, 3),
        centers=np.array(centers).reshape(-1, 3),
        **structure,
    )
