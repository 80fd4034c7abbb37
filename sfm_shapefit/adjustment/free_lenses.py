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
from sfm_shapefit.adjustment.problem import AdjustmentProblem, LensPrior
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.scene.lens import DISTORTION, FOCAL_LENGTHS, Lens, LensDoubt


class FreeLenses(NamedTuple):
    """The lenses that an adjustment may change, by the ids of their cameras; all others stay."""

    doubts: Mapping[int, LensDoubt]
    distortion: bool
    """Whether their distortion changes beside their focal lengths."""
    focal_held: frozenset[int] = frozenset()
    """Those of them whose focal lengths stay, so that only their distortion changes."""

    def apply(self, problem: AdjustmentProblem) -> AdjustmentProblem:
        """Return the problem with priors, other lenses fixed."""
        if not self.doubts:
            return problem
        values = np.array([lens.values() for lens in problem.lenses])
        information = np.zeros_like(values)
        lenses = list(problem.lenses)
        for k, lens in enumerate(problem.lenses):
            doubt = self.doubts.get(lens.id)
            if doubt is None:
                lenses[k] = replace(lenses[k], fixed=True)
            elif not lenses[k].fixed:
                lenses[k] = replace(lenses[k], focal_fixed=lens.id in self.focal_held)
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
    return bool(lens.own_values()[DISTORTION].any())


def focal_sigmas(problem: AdjustmentProblem, options: AdjustmentOptions) -> FloatArray:
    """Return the standard deviation of each lens's focal length as a share of it, (l,); 0 for what is held.

    Args:
        problem: at its minimum, with its priors.
        options: as it was adjusted with.

    Raises:
        UnsolvableError: if the observations leave more open than a similarity.
    """
    sigmas = estimate_covariances(problem, options).lens_sigmas[:, FOCAL_LENGTHS]
    values = np.array([lens.values()[FOCAL_LENGTHS] for lens in problem.lenses])
    return np.asarray((sigmas / values).max(axis=1))
