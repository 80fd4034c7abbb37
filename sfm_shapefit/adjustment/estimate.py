"""What an adjustment gives back: images where they stand, and how well that is known."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from sfm_shapefit.adjustment.free_lenses import ALL_HELD, FreeLenses
from sfm_shapefit.adjustment.free_sensors import SensorSigma
from sfm_shapefit.adjustment.given_rotations import RotationErrors, RotationWeight
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.wording import counted
from sfm_shapefit.scene.images import Images


class RefinedLenses(NamedTuple):
    """What an adjustment makes of the lenses that it may change, by the ids of their cameras."""

    sigmas: Mapping[int, float]
    """Standard deviation of the focal length, as a share of it."""
    undetermined: tuple[int, ...]
    """Those whose focal length the points leave open: it is what was given."""
    free: FreeLenses = ALL_HELD
    """What later adjustments may change."""


UNREFINED = RefinedLenses({}, ())
"""Where no lens was free."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate:
    """Where images stand after an adjustment, how well that is known, and how it went."""

    images: Images
    """All posed."""
    weight: RotationWeight
    """How the given rotations were treated."""
    errors: RotationErrors | None = None
    """What the matches said of them, if they were asked."""
    covariances: FloatArray | None = None
    """(i, 3, 3) of the centers, an image of a rig having its frame's, in squared units of the images; see
    `shared_errors`. None where they are not known, as of models of more frames than are worth the time."""
    scale_sigma: float | None = None
    """Relative standard deviation of the scale; None where it is not known, or nothing tells the scale."""
    lenses: RefinedLenses = UNREFINED
    """What became of lenses that were free."""
    sensors: Mapping[int, SensorSigma] = field(default_factory=dict)
    """Of the sensors that were free in their rigs, by the ids of their cameras."""
    initial_error_px: float = math.nan
    """Mean reprojection error at the poses of the start, of the points triangulated there."""
    final_error_px: float = math.nan
    """Mean reprojection error of the points of the answer."""
    converged: bool = True
    """Whether the last solve met its tolerance within its limit of 100 steps."""
    iterations: int = 0
    """Steps of all solves together."""

    @property
    def statement(self) -> str:
        """What was chosen and why, in words."""
        if self.errors is None:
            if self.weight.hold:
                return "centers and points adjusted, rotations held, as asked"
            sigma = self.weight.sigma_rad
            kept = "free" if sigma is None else f"weighted by {math.degrees(sigma):.2g} deg"
            return f"centers, points and rotations adjusted, rotations {kept}, as asked"
        chance = f"{math.degrees(self.errors.chance_rad):.2g} deg"
        if self.weight.hold:
            return f"centers and points adjusted, rotations held: freed, they would turn by chance ({chance})"
        if self.errors.sigma_rad == 0.0:
            freed = counted(int(self.errors.are_wrong.sum()), "rotation")
            return (
                f"centers and points adjusted, {freed} freed that the matches clearly put off, the others "
                f"nearly held: they would turn by chance ({chance})"
            )
        sigma_deg = math.degrees(self.errors.sigma_rad)
        return (
            f"centers, points and rotations adjusted: the matches put the given rotations off by "
            f"{sigma_deg:.2g} deg per axis, where chance gives {chance}, so they were weighted by that"
        )
