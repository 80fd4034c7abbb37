"""Rotations that averaging found, and how far the pairs agree with them."""

from dataclasses import dataclass
from typing import Literal

from sfm_shapefit.arrays import BoolArray, FloatArray

Loss = Literal["geman-mcclure", "half-norm"]
"""Of the residual angles of pairs, as pycolmap names them."""

AGREEMENT_DEG = 5.0
"""Pairs agree with averaged rotations up to here."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AveragedRotations:
    """One answer of rotation averaging, and how far the pairs agree with it."""

    rotations: FloatArray
    """(n, 3, 3) cam_from_world; the identity where there is none."""
    registered: BoolArray
    """(n,) which images have a rotation."""
    min_matches: int
    """Pairs with fewer matches were left out."""
    loss: Loss
    sound_only: bool
    """Whether pairs that contradict known focal lengths were left out."""
    score: float
    share: float
    """Of the pairs of registered images, by the square root of their matches: how many agree."""
    fit: float
    agreements: FloatArray
    """(n,) the same share for the pairs of each image; NaN where it has none."""
    num_tried: int = 1
    """How many answers it was chosen from."""

    @property
    def statement(self) -> str:
        """How the rotations were found, for the user."""
        tried = f", the most consistent of {self.num_tried} tried" if self.num_tried > 1 else ""
        return (
            f"averaged over pairs with at least {self.min_matches} matches ({self.loss}){tried}; "
            f"{self.share:.0%} of the pairs' weight agrees within {AGREEMENT_DEG:g} deg"
        )
