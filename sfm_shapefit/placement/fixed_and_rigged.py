"""Which images of a model are fixed, and which move as groups: those of rigs.

The frames of a model with rigs are groups with metric offsets. Cameras that are fixed stand where the input
has them: two or more are one group, whose offsets are their centers; of a single one only the origin can be
taken.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.graph.groups import RigidGroups, separate
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.placement.gauge import coincide
from sfm_shapefit.scene.images import Images


class FixedAndRigged(NamedTuple):
    """The images of a model that are fixed, and those that move as groups."""

    fixed: BoolArray
    """(n,) images that stay exactly where the input has them."""
    groups: RigidGroups | None
    """The images in groups; None where each moves by itself."""
    fixed_group: int | None
    """The group of the fixed images."""

    @property
    def has_scale(self) -> bool:
        """Whether images of a group stand apart, so that pairs that see two of them tell a scale."""
        return self.groups is not None and self.groups.have_extent

    def apply(self, measured: MeasuredGraph) -> MeasuredGraph:
        """Return a measured graph of the images with these groups; each of its points is one more."""
        if self.groups is None:
            return measured
        groups = self.groups.with_separate(measured.num_points)
        return replace(measured, groups=groups, fixed_group=self.fixed_group)


def find_fixed_and_rigged(images: Images, fixed: BoolArray | None = None) -> FixedAndRigged:
    """Return what moves together and what not at all: the frames of rigs, and `fixed` images (n,).

    Raises:
        InputError: if the fixed images stand at one place.
    """
    fixed = np.zeros(images.num_images, dtype=np.bool_) if fixed is None else fixed
    count = int(np.sum(fixed))
    if not images.has_rigs and count < 2:
        return FixedAndRigged(fixed, None, None)
    frames = RigidGroups(group_of=images.frame_of, offsets=images.offsets)
    groups = frames if images.has_rigs else separate(images.num_images, 3)
    if count == 0:
        return FixedAndRigged(fixed, groups, None)
    if count > 1 and not images.has_rigs and coincide(images.centers[fixed]):
        raise InputError(
            f"the {count} fixed cameras are at one place in the input; fix others, whose positions it has"
        )
    return FixedAndRigged(fixed, groups.with_fixed(fixed, images.centers), 0)
