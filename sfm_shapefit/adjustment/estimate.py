"""What an adjustment gives back: images where they stand, and how well that is known."""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from sfm_shapefit.adjustment.freedom import Freedom
from sfm_shapefit.adjustment.given_rotations import RotationErrors
from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import counted
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import LensErrors


class BundleAdjustment(Record):
    """What --adjust full reached; mean reprojection errors."""

    converged: Annotated[bool, "Whether the last round met its tolerance."]
    iterations: Annotated[int, "Steps of all rounds together."]
    initial_error_px: Annotated[float, "At the seed's poses."]
    final_error_px: Annotated[float, "At the adjusted poses."]

    @property
    def statement(self) -> str:
        """How it went, in words."""
        state = "converged" if self.converged else "stopped at its limit"
        errors = f"{self.initial_error_px:.2f} -> {self.final_error_px:.2f} px"
        return f"{state} after {self.iterations} steps, mean error {errors}"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate:
    """Where images stand after an adjustment, how well that is known, and how it went."""

    images: Images
    """All posed."""
    freedom: Freedom
    """What moved, and what may move in later adjustments."""
    errors: RotationErrors | None = None
    """What the matches said of the given rotations, if they were asked."""
    covariances: FloatArray | None = None
    """Covariances (i, 3, 3) of the centers, an image of a rig having its frame's, in squared units of the
    images; see `shared_errors`. None where unknown, as for more frames than are worth the time."""
    draws: FloatArray | None = None
    """Errors of the frames (f, 6, s) of which the covariances are, but for what lenses add that move or are
    left open; see `CenterErrors`. None where the covariances are."""
    noise_px: float = math.nan
    """Standard deviation of an observation along an axis; NaN where it is unknown."""
    lens_errors: LensErrors | None = None
    """What the covariances take errors of the lenses for; None where they are unknown."""
    scale_sigma: float | None = None
    """Relative standard deviation of the scale; None where it is not known, or nothing sets the scale."""
    focal_sigmas: FloatArray
    """(l,) standard deviations of the focal lengths that were free, as shares of them; NaN for the others."""
    undetermined: BoolArray
    """(l,) lenses whose focal length the points leave open: it is what was given."""
    sensor_sigmas: FloatArray
    """(l, 2) standard deviations of the sensors that were free in their rigs, see `judge_sensors`; NaN for
    the others."""
    solves: BundleAdjustment
    """How the solves went; the final error stands in it where the model's points are known."""

    @property
    def num_draws(self) -> int:
        """Number of draws of the errors; 0 where there are none."""
        return 0 if self.draws is None else self.draws.shape[2]

    @property
    def is_refined(self) -> BoolArray:
        """Lenses whose focal length was free, (l,)."""
        return ~np.isnan(self.focal_sigmas)

    @property
    def is_tried(self) -> BoolArray:
        """Lenses whose focal length was free, or is held because the points left it open, (l,)."""
        return self.is_refined | self.undetermined

    @property
    def refines_sensors(self) -> bool:
        """Whether sensors were free in their rigs."""
        return bool(np.isfinite(self.sensor_sigmas).any())

    @property
    def statement(self) -> str:
        """What was chosen and why, in words."""
        if self.errors is None:
            if self.freedom.holds_rotations:
                return "centers and points adjusted, rotations held, as asked"
            sigma_deg = math.degrees(self.freedom.least_pull_rad)
            kept = f"weighted by {sigma_deg:.2g} deg" if math.isfinite(sigma_deg) else "free"
            return f"centers, points and rotations adjusted, rotations {kept}, as asked"
        chance = f"{math.degrees(self.errors.chance_rad):.2g} deg"
        if self.freedom.holds_rotations:
            why = "and fit hardly better" if self.errors.are_unseen else f"by chance ({chance})"
            return f"centers and points adjusted, rotations held: freed, they would turn {why}"
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
