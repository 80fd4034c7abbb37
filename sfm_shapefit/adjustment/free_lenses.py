"""Lenses that an adjustment may change: those in doubt, each with a prior about what was given.

The prior of a focal length is relative, exp(+-s) f to first order; those of the distortion are absolute, as
the coefficients of a lens are of the same size whatever its focal length. A lens without a doubt stays what
it is to the last bit. What the observations leave open after all is told by the standard deviation at the
answer: a focal length known to worse than `LARGEST_SIGMA`, or no better than what was given, stays as given.
The distortion of such a lens stays free, with its prior. Along a street driven straight ahead the focal
length is a stretch of the whole scene along the way, which no pixel sees; what bends the street sideways is
the distortion, and each pixel sees it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.adjustment.covariance import estimate_covariances
from sfm_shapefit.adjustment.options import AdjustmentOptions
from sfm_shapefit.adjustment.problem import NUM_VALUES, AdjustmentProblem, Lens, LensPrior
from sfm_shapefit.base.arrays import FloatArray

LARGEST_SIGMA = 0.02
"""Of a focal length, as a share of it: beyond, the observations do not tell it."""

# Errors that keypoints share make those of a focal length larger than the noise alone does: on kitti-turn,
# driven straight ahead for the greatest part, seven times.
_SHARED_NOISE = 7.0
# So many standard deviations, of the noise and of what was given, are no chance.
_CONTRADICTION = 10.0
# By what factor a guess may be off, and the largest coefficient of a distortion.
_MOST_OFF, _MOST_DISTORTION = 6.0, 2.0
_FOCAL_LENGTHS, _DISTORTION = slice(0, 2), slice(4, NUM_VALUES)


class LensDoubt(NamedTuple):
    """What was given of a lens, and how far it may be off."""

    given: Lens
    focal_sigma: float
    """Standard deviation of its focal lengths, as a share of them."""
    distortion_sigma: float
    """Standard deviation of each coefficient of its distortion."""

    def information(self) -> FloatArray:
        """Return the inverse variances of the OPENCV parameters, (8,); 0 for those that are held anyway."""
        information = np.zeros(NUM_VALUES)
        information[_FOCAL_LENGTHS] = (self.focal_sigma * self.given.values()[_FOCAL_LENGTHS]) ** -2.0
        information[_DISTORTION] = self.distortion_sigma**-2.0
        return information

    def accepts(self, found: Lens, sigma: float) -> bool:
        """Return whether an adjusted lens is to be believed, its focal length known to `sigma` by the noise.

        It is to be known better than what was given, or to contradict that clearly. One that has run away,
        beyond what any lens given so is off by, is not believed either.
        """
        ratio = found.values()[0] / self.given.values()[0]
        sound = bool(np.abs(found.values()[_DISTORTION]).max() <= _MOST_DISTORTION)
        sound = sound and 1.0 / _MOST_OFF <= ratio <= _MOST_OFF
        better = _SHARED_NOISE * sigma <= self.focal_sigma
        contradicts = abs(ratio - 1.0) >= _CONTRADICTION * max(sigma, self.focal_sigma)
        return sound and sigma <= LARGEST_SIGMA and (better or contradicts)


class FreeLenses(NamedTuple):
    """The lenses that an adjustment may change, by the ids of their cameras; all others stay."""

    doubts: Mapping[int, LensDoubt]
    distortion: bool
    """Whether their distortion changes beside their focal lengths."""
    focal_held: frozenset[int] = frozenset()
    """Those of them whose focal lengths stay, so that only their distortion changes."""

    def apply(self, problem: AdjustmentProblem, camera_ids: Sequence[int]) -> AdjustmentProblem:
        """Return the problem with priors, other lenses fixed; `camera_ids` are those of its lenses."""
        if not self.doubts:
            return problem
        values = np.array([lens.values() for lens in problem.lenses])
        information = np.zeros_like(values)
        lenses = list(problem.lenses)
        for k, camera_id in enumerate(camera_ids):
            doubt = self.doubts.get(camera_id)
            if doubt is None:
                lenses[k] = replace(lenses[k], fixed=True)
            elif not lenses[k].fixed:
                lenses[k] = replace(lenses[k], focal_fixed=camera_id in self.focal_held)
                values[k], information[k] = doubt.given.values(), doubt.information()
        prior = LensPrior(values=values, information=information)
        return replace(problem, lenses=lenses, lens_prior=prior)

    def overrides(self) -> dict[str, Any]:
        """Return the options of an adjustment that sets them free."""
        free = bool(self.doubts)
        return {"free_focal_lengths": free, "free_distortion": free and self.distortion}

    def with_free_focal(self) -> list[int]:
        """Return the cameras whose focal lengths may change."""
        return [camera for camera in self.doubts if camera not in self.focal_held]

    def holding(self, camera_ids: Sequence[int]) -> "FreeLenses":
        """Return the same, the focal lengths of some lenses held; without other unknowns, the whole lens.

        Lenses whose focal length was held already are held as a whole.
        """
        bending = {i for i in self.with_free_focal() if self.distortion and _bends(self.doubts[i].given)}
        whole = set(camera_ids) - bending
        kept = {camera: doubt for camera, doubt in self.doubts.items() if camera not in whole}
        held = (self.focal_held | bending.intersection(camera_ids)) - whole
        return self._replace(doubts=kept, focal_held=held)


ALL_HELD = FreeLenses({}, distortion=False)
"""Every lens stays what it is, to the last bit."""


def _bends(lens: Lens) -> bool:
    """Return whether the model of a lens has a distortion."""
    return bool(lens.own_values()[_DISTORTION].any())


def focal_sigmas(problem: AdjustmentProblem, options: AdjustmentOptions) -> FloatArray:
    """Return the standard deviation of each lens's focal length as a share of it, (l,); 0 for what is held.

    Args:
        problem: at its minimum, with its priors.
        options: as it was adjusted with.

    Raises:
        UnsolvableError: if the observations leave more open than a similarity.
    """
    sigmas = estimate_covariances(problem, options).lens_sigmas[:, _FOCAL_LENGTHS]
    values = np.array([lens.values()[_FOCAL_LENGTHS] for lens in problem.lenses])
    return np.asarray((sigmas / values).max(axis=1))
