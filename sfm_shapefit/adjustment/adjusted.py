"""What an adjustment of a model gives back, and how well it knows that."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import pycolmap

from sfm_shapefit.adjustment.free_lenses import ALL_HELD, FreeLenses
from sfm_shapefit.adjustment.free_sensors import SensorSigma
from sfm_shapefit.adjustment.given_rotations import RotationErrors, RotationWeight
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.wording import counted


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


class Uncertainty(NamedTuple):
    """How well an adjustment knows centers and scale, see `adjustment.shared_errors`."""

    covariances: Mapping[int, FloatArray] = {}
    """(3, 3) of the center of each image by its id, in squared units of the seed; an image of a rig has its
    frame's. Empty where they are not known."""
    scale_sigma: float | None = None
    """Relative standard deviation of the scale; None where it is not known, or nothing tells the scale."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Adjusted:
    """A bundle adjustment's answer and how it went."""

    reconstruction: pycolmap.Reconstruction
    """New poses and points, filtered; point errors updated."""
    initial_error_px: float
    """Mean reprojection error at the seed's poses, of the points triangulated and filtered there."""
    final_error_px: float
    """Mean reprojection error of the filtered points of the answer."""
    converged: bool
    """Whether the last solve met its tolerance within its limit of 100 steps."""
    iterations: int
    """Steps of all solves together."""
    uncertainty: Uncertainty
    """Empty for models of more frames than are worth the time."""
    lenses: RefinedLenses = UNREFINED
    """What became of lenses that were free."""
    sensors: Mapping[int, SensorSigma] = field(default_factory=dict)
    """Of the sensors that were free in their rigs, by the ids of their cameras."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AdjustedPlacement:
    """Placed cameras after adjustment, and what became of their rotations."""

    reconstruction: pycolmap.Reconstruction
    """The adjusted poses, without points."""
    weight: RotationWeight
    """How the given rotations were treated."""
    frame_ids: tuple[int, ...]
    """The frames, in the order of its standard deviations."""
    errors: RotationErrors | None
    """What the matches said of them, if they were asked."""
    uncertainty: Uncertainty
    lenses: RefinedLenses = UNREFINED
    """What became of lenses that were free."""
    sensors: Mapping[int, SensorSigma] = field(default_factory=dict)
    """Of the sensors that were free in their rigs, by the ids of their cameras."""

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
