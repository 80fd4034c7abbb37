"""Conventions of other programs' poses, recognized by the rotations that pairs have by themselves.

Poses that are read as what they are not contradict most pairs. If they are from camera to world, in OpenGL's
camera axes (x right, y up, z backward), or their quaternions in another order, they agree with most once that
is undone. Axes of any other body, such as an IMU, are the rotation C that best takes the vectors of the given
relative rotations to those of the pairs, since R_j' R_i'^T = C R_j R_i^T C^T.
"""

import itertools
from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import FLIP_YZ, nearest_rotations, rotation_angles_deg
from sfm_shapefit.base.quaternions import matrices_of, quaternions_of, rotation_vectors
from sfm_shapefit.pairs.relative_rotations import AGREEMENT_DEG, RelativeRotations

PoseFile = Literal["model", "transforms", "trajectory"]
"""What the poses are read as: of COLMAP, NeRF, or TUM."""

_TELLING_DEG = 10.0  # degrees; relative rotations of smaller angles are much alike in any convention
_FEWEST_PAIRS = 5  # sound pairs with such angles; fewer tell nothing
# Shares of pairs that agree with poses as they are read and otherwise; wrong ones lie between by chance only.
_MOST_AS_READ, _LEAST_OTHERWISE = 0.3, 0.6
_TIE = 0.05  # share; conventions whose shares differ by less cannot be told apart

_ORDERS = {"model": ([3, 0, 1, 2], "x y z w", "w x y z"), "trajectory": ([1, 2, 3, 0], "w x y z", "x y z w")}
"""Numbers of a quaternion as read which are x, y, z, w, how it is written then, and how it should be."""
_DIRECTIONS = ("world-to-camera", "camera-to-world")
_AXES = ("COLMAP's camera axes (y down, z forward)", "OpenGL's camera axes (y up, z backward)")

_OTHER_AXES = "in other axes than the camera's, such as those of an IMU or a robot"


class Recognized(NamedTuple):
    """A convention that was recognized."""

    clause: str
    """What the poses look like, and by how many pairs."""
    remedy: str
    """What to do."""

    @property
    def sentence(self) -> str:
        """Both."""
        return f"{self.clause}; {self.remedy}"


class _Reading(NamedTuple):
    """Poses read by another convention."""

    rotations: FloatArray
    """(n, 3, 3) cam_from_world."""
    looks: tuple[str, ...]
    """What they seem to be, by that in which they differ."""
    wanted: tuple[str, ...]
    """What they should be."""


def recognize_convention(
    rotations: FloatArray, relative: RelativeRotations, written: PoseFile
) -> Recognized | None:
    """Return the convention that poses (n, 3, 3), cam_from_world as they were read, are in.

    None if that is the one of their format, if no other agrees with most pairs, or if pairs are too few.
    """
    sure = relative.subset(relative.are_sound() & (rotation_angles_deg(relative.rotations) >= _TELLING_DEG))
    count = len(sure.pairs)

    def agreeing(turned: FloatArray) -> int:
        return int(np.sum(sure.residuals_deg(turned) <= AGREEMENT_DEG))

    if count < _FEWEST_PAIRS or (as_read := agreeing(rotations)) > _MOST_AS_READ * count:
        return None
    for readings in (_in_other_conventions(rotations, written), _in_other_axes(rotations, sure)):
        found = [(agreeing(one.rotations), one) for one in readings]
        best = max(number for number, _ in found)
        if best >= _LEAST_OTHERWISE * count:
            ties = [one for number, one in found if number >= best - _TIE * count]
            simplest = [one for one in ties if len(one.looks) == min(len(other.looks) for other in ties)]
            looks = " or ".join(dict.fromkeys(", ".join(one.looks) for one in simplest))
            wanted = " or ".join(dict.fromkeys(", ".join(one.wanted) for one in simplest))
            agree = f"{best} of {count} pairs agree with that, {as_read} as they are read"
            return Recognized(f"the poses seem to be {looks}: {agree}", f"write them {wanted}")
    return None


def _in_other_conventions(rotations: FloatArray, written: PoseFile) -> Iterator[_Reading]:
    is_transforms, into = written == "transforms", written != "model"  # are to be camera-to-world
    own = rotations.transpose(0, 2, 1) if into else rotations  # as the file has them
    order, *orders = _ORDERS["model" if is_transforms else written]
    other = matrices_of(quaternions_of(own)[:, order])
    other = other.transpose(0, 2, 1) if into else other
    for reorders, inverts, flips in itertools.product((False, True), repeat=3):
        turned = other if reorders else rotations
        turned = turned.transpose(0, 2, 1) if inverts else turned
        differences = (
            (inverts, (_DIRECTIONS[not into], _DIRECTIONS[into])),
            # The inverse of a matrix in OpenGL's axes has the flip on its other side.
            (
                flips != (inverts and is_transforms),
                [f"in {_AXES[k != is_transforms]}" for k in (True, False)],
            ),
            (reorders, [f"with quaternions in the order {one}" for one in orders]),
        )
        words = [words for differs, words in differences if differs]
        if words and not (reorders and is_transforms):
            looks, wanted = (tuple(one[k] for one in words) for k in (0, 1))
            yield _Reading(FLIP_YZ @ turned if flips else turned, looks, wanted)


def _in_other_axes(rotations: FloatArray, sure: RelativeRotations) -> Iterator[_Reading]:
    """Yield poses of cameras by those of bodies that they are fixed to, or by the inverse of these."""
    own, (i, j) = rotation_vectors(sure.rotations), sure.pairs.T
    for turned in (rotations, rotations.transpose(0, 2, 1)):
        given = rotation_vectors(turned[j] @ turned[i].transpose(0, 2, 1))
        axes = nearest_rotations((own.T @ given)[None])
        yield _Reading(axes @ turned, (_OTHER_AXES,), ("in those of the camera",))
