"""Poses as other programs list them, before they become a model."""

from typing import NamedTuple

from sfm_shapefit.base.arrays import FloatArray


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
