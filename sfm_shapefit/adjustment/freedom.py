"""What an adjustment may change beside centers and points, and what is known of poses beside the pixels.

Only lenses in doubt move, each with a prior about what was given. The prior of a focal length is relative,
exp(+-s) f to first order; those of the distortion are absolute, as the coefficients of a lens are of the same
size whatever its focal length. What the observations leave open after all shows in the standard deviation at
the answer: a focal length that is not credible (`Lens.is_credible`) stays as given. The distortion of such a
lens stays free, with its prior. Along a street driven straight ahead the focal length is a stretch of the
whole scene along the way, which no pixel sees; what bends the street sideways is the distortion, and each
pixel sees it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.adjustment.problem import (
    AdjustmentProblem,
    LensPrior,
    RotationPrior,
    isotropic_information,
)
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.scene.freedom import FreedomOptions
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.known_positions import KnownPositions
from sfm_shapefit.scene.lens import FOCAL, PARTS, Lens


class GivenPoses(NamedTuple):
    """What is known of the poses of frames beside the pixels."""

    rotations: FloatArray | None = None
    """Rotations (f, 3, 3) as they were given; None: those of the start."""
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
    parts: BoolArray = field(default_factory=lambda: np.zeros(len(PARTS), dtype=np.bool_))
    """Which of `PARTS` move, (l, p) of each lens or (p,) of all; such lenses are in doubt."""
    has_sensors: bool = False
    """Whether sensors move in their rigs, all but the references."""

    @classmethod
    def asked(cls, options: FreedomOptions, parts: BoolArray, *, rigs: bool) -> "Freedom":
        """Return what is asked for: `parts` of lenses, and sensors if there are rigs."""
        return cls(parts=parts, has_sensors=rigs and options.rigs == "free")

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

    @property
    def lenses(self) -> BoolArray:
        """Lenses that move, (l,) or one for all; all others stay what they are to the bit."""
        return np.asarray(self.parts.any(axis=-1))

    def over(self, num_lenses: int) -> "Freedom":
        """Return the same with the lenses one by one."""
        return replace(self, parts=np.broadcast_to(self.parts, (num_lenses, len(PARTS))))

    def holding(self, held: BoolArray, lenses: Sequence[Lens]) -> "Freedom":
        """Return the same, the focal lengths of `held` lenses (l,) among all held; else the whole lens.

        Whole: where no other part moves by itself, as the focal length was held already, or as it has none.
        """
        parts = self.over(len(lenses)).parts
        others = parts & np.array([lens.own_parts for lens in lenses], dtype=np.bool_)
        others[:, FOCAL] = False
        goes_on = parts[:, FOCAL] & others.any(axis=1)
        return replace(self, parts=np.where(held[:, None], others & goes_on[:, None], parts))

    def without_lenses(self) -> "Freedom":
        """Return the same with all lenses held."""
        return replace(self, parts=np.zeros_like(self.parts))

    def overrides(self) -> dict[str, Any]:
        """Return the options of an adjustment that moves its lenses."""
        return {f"free_{part}": bool(self.parts[..., k].any()) for k, part in enumerate(PARTS)}

    def of(self, frames: IntArray, lenses: IntArray) -> "Freedom":
        """Return the freedom of some of the frames and lenses."""
        pull, doubt = self.pull_rad, self.doubt_rad
        return replace(
            self,
            parts=self.parts[lenses] if self.parts.ndim > 1 else self.parts,
            pull_rad=pull[frames] if isinstance(pull, np.ndarray) else pull,
            doubt_rad=doubt[frames] if isinstance(doubt, np.ndarray) else doubt,
        )

    def among(self, frames: IntArray, count: int) -> "Freedom":
        """Return the freedom of `count` frames; those that are not among `frames` have the usual one."""
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
        problem = self._apply_to_lenses(problem)
        if given is None or self.holds_rotations or np.isinf(self.least_pull_rad):
            return problem
        sigmas = np.broadcast_to(np.asarray(self.pull_rad), problem.num_frames)
        prior = RotationPrior(rotations=given, information=isotropic_information(sigmas))
        return replace(problem, rotation_prior=prior)

    def _apply_to_lenses(self, problem: AdjustmentProblem) -> AdjustmentProblem:
        """Return the problem with its lenses fixed but for those that move, which their doubts pull at."""
        if not self.lenses.any():
            return problem
        values = np.array([lens.values() for lens in problem.lenses])
        information, lenses = np.zeros_like(values), list(problem.lenses)
        over = self.over(len(lenses))
        for k, lens in enumerate(problem.lenses):
            lenses[k] = replace(lens, fixed=tuple((~over.parts[k]).tolist()))
            if over.lenses[k]:
                values[k], information[k] = lens.as_given().values(), lens.information()
        prior = LensPrior(values=values, information=information)
        return replace(problem, lenses=lenses, lens_prior=prior)
