"""What is known of images beside their matches and the options."""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray
from sfm_shapefit.facts.intrinsics import RefinedIntrinsics
from sfm_shapefit.facts.result import Inputs
from sfm_shapefit.files.colmap.template import Template
from sfm_shapefit.pipeline.gauge_choice import GaugeRule
from sfm_shapefit.pipeline.rigs import Rigid
from sfm_shapefit.placement.options import KnownDistance, Scale
from sfm_shapefit.scene.given import NOTHING_KNOWN, Known
from sfm_shapefit.scene.images import Images


class Given(NamedTuple):
    """What is known of images beside their matches and the options."""

    template: Template
    """What the images were read from."""
    images: Images
    """The images as they were read: what pulls, what is compared with, whose centers may set a scale."""
    intrinsics: RefinedIntrinsics
    """What may change of lenses in doubt, and what became of them so far."""
    inputs: Inputs
    rigid: Rigid
    pull_rad: float | None
    """Standard deviation by which an adjustment pulls rotations, see `Freedom`; None: the matches decide."""
    scale: Scale = "unit"
    """The scale where nothing that is known sets it."""
    distances: tuple[KnownDistance, ...] = ()
    known: Known = NOTHING_KNOWN
    """What the user told of them beside."""

    @property
    def rule(self) -> GaugeRule:
        """What sets scale, origin and axes."""
        return GaugeRule(self.images, self.rigid, self.scale, self.known.priors, self.distances)

    @property
    def fixed_frames(self) -> BoolArray:
        """Frames that keep their poses to the last bit, (f,)."""
        fixed = np.zeros(len(self.images.frames.ids), dtype=np.bool_)
        fixed[self.images.frame_of[self.rigid.fixed]] = True
        return fixed

    @property
    def believes_rotations(self) -> bool:
        """Whether the given rotations are not to be doubted."""
        return self.pull_rad == 0.0

    def of_further_piece(self) -> "Given":
        """Return what is known of a further rigid piece: nothing of positions."""
        free = self.rigid._replace(fixed=np.zeros_like(self.rigid.fixed), groups=None, fixed_group=None)
        return self._replace(rigid=free, scale="unit", distances=(), known=NOTHING_KNOWN)
