"""What an adjustment may change beside centers and points, and what is known of poses beside the pixels."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.adjustment.free_lenses import ALL_HELD, FreeLenses
from sfm_shapefit.adjustment.problem import AdjustmentProblem, RotationPrior, isotropic_information
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.known_positions import KnownPositions


class GivenPoses(NamedTuple):
    """What is known of the poses of frames beside the pixels."""

    rotations: FloatArray | None = None
    """(f, 3, 3) those that were given; None: those of the start."""
    fixed: BoolArray | None = None
    """(f,) frames whose poses stay what they are to the last bit; none if None."""
    centers: KnownPositions | None = None
    """Centers measured otherwise, which pull at the frames."""

    def of(self, frames: IntArray) -> "GivenPoses":
        """Return what is known of some frames, ascending."""
        return GivenPoses(
            rotations=None if self.rotations is None else self.rotations[frames],
            fixed=None if self.fixed is None else self.fixed[frames],
            centers=None if self.centers is None else self.centers.among(frames),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Freedom:
    """What moves beside centers and points."""

    pull_rad: FloatArray | float | None = np.inf
    """Standard deviations per axis by which given rotations pull, (f,) or one for all: 0 held, infinite free.
    None: the matches decide, see `given_rotations`."""
    doubt_rad: FloatArray | float = 0.0
    """Standard deviations by which rotations that are held, or nearly, may be wrong, (f,) or one for all.
    They enter covariances, and nothing else."""
    noise_px: float = 0.5
    """Standard deviation of an observation per axis, which pulls are weighed against."""
    lenses: FreeLenses = ALL_HELD
    """All others stay what they are to the bit."""
    has_sensors: bool = False
    """Whether sensors move in their rigs, all but the references."""

    @property
    def holds_rotations(self) -> bool:
        """Whether rotations stay what they are, to the last bit."""
        return self.pull_rad is not None and not np.any(self.pull_rad)

    @property
    def least_pull_rad(self) -> float:
        """Standard deviation of frames that nothing singles out."""
        return float(np.min(np.inf if self.pull_rad is None else self.pull_rad))

    def singled_out(self) -> BoolArray:
        """Return the frames, (f,) or one for all, that pull less: their given rotations are clearly wrong."""
        return np.asarray(self.pull_rad) > self.least_pull_rad

    def sensors(self, images: Images) -> BoolArray:
        """Return the lenses that move in their rigs, (l,)."""
        return self.has_sensors & ~images.sensors.is_reference

    def of(self, frames: IntArray) -> "Freedom":
        """Return the freedom of some of the frames."""
        pull, doubt = self.pull_rad, self.doubt_rad
        return replace(
            self,
            pull_rad=pull[frames] if isinstance(pull, np.ndarray) else pull,
            doubt_rad=doubt[frames] if isinstance(doubt, np.ndarray) else doubt,
        )

    def among(self, frames: IntArray, count: int) -> "Freedom":
        """Return the freedom of so many frames, of which it has some; the others have the usual one."""
        pull, doubt = self.pull_rad, self.doubt_rad
        if isinstance(pull, np.ndarray):
            pull = np.full(count, self.least_pull_rad)
            pull[frames] = self.pull_rad
        if isinstance(doubt, np.ndarray):
            doubt = np.zeros(count)
            doubt[frames] = self.doubt_rad
        return replace(self, pull_rad=pull, doubt_rad=doubt)

    def apply(self, problem: AdjustmentProblem, given: FloatArray | None) -> AdjustmentProblem:
        """Return the problem with the pull of given rotations (f, 3, 3), and with what holds its lenses."""
        problem = self.lenses.apply(problem)
        if given is None or self.holds_rotations or np.isinf(self.least_pull_rad):
            return problem
        sigmas = np.broadcast_to(np.asarray(self.pull_rad), problem.num_frames)
        prior = RotationPrior(rotations=given, information=isotropic_information(sigmas))
        return replace(problem, rotation_prior=prior)
