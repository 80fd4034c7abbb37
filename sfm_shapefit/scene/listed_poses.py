"""Poses as other programs list them, before they become a model."""

from typing import NamedTuple

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.scene.lens import Lens


class ListedPoses(NamedTuple):
    """Poses of n images, and what is told of their lenses; cameras as in COLMAP."""

    names: tuple[str, ...]
    """(n,) as their program writes them: with a folder of its own, without suffix, or a timestamp."""
    rotations: FloatArray
    """(n, 3, 3) cam_from_world."""
    centers: FloatArray
    """(n, 3) camera centers in the world."""
    focal_shares: FloatArray
    """(n, 2) focal lengths over width and height of the image; NaN where unknown."""
    lenses: tuple[Lens | None, ...]
    """(n,) whole lenses; None where one is not known."""
    notes: tuple[str, ...] = ()
    """What is read otherwise than it stands in the file, a sentence each."""
