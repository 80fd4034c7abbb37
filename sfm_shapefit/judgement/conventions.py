"""Conventions of other programs' poses, recognized by the rotations that pairs have by themselves.

Poses that are read as what they are not contradict most pairs. Those from camera to world, in OpenGL's camera
axes (x right, y up, z backward), or with the numbers of quaternions in another order, agree with most once
that is undone. Axes of any other body, such as an IMU, are the rotation C that best takes the vectors of the
given relative rotations to those of the pairs, since R_j' R_i'^T = C R_j R_i^T C^T.
"""

import itertools
from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import FLIP_YZ, nearest_rotations, rotation_angles_deg
from sfm_shapefit.base.quaternions import matrices_of, quaternions_of, rotation_vectors
from sfm_shapefit.pairs.relative_rotations import AGREEMENT_DEG, RelativeRotations

Written = Literal["colmap", "nerf", "tum"]
"""Whose files the poses are read as."""

_TELLING_DEG = 10.0  # degrees; relative rotations of smaller angles are much alike in any convention
_FEWEST_PAIRS = 5  # sound pairs with such angles; fewer tell nothing
_MOST_AS_READ, _LEAST_OTHERWISE = (
    0.3,
    0.6,
)  # shares of these pairs that agree with poses read wrong, and right
_TIE = 0.05  # share; conventions whose shares differ by less cannot be told apart

_ORDERS = {"colmap": ([3, 0, 1, 2], "x y z w", "w x y z"), "tum": ([1, 2, 3, 0], "w x y z", "x y z w")}
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


def recognize_convention(
    rotations: FloatArray, relative: RelativeRotations, written: Written
) -> Recognized | None:
    """Return the convention that poses (n, 3, 3), cam_from_world as they were read, are in.

    None if that is the one of their format, if no other agrees with most pairs, or too few pairs can tell.
    """
    angles_deg = rotation_angles_deg(relative.rotations)
    told = relative.subset(relative.are_sound() & (angles_deg >= _TELLING_DEG))
    count = len(told.pairs)

    def share(turned: FloatArray) -> float:
        return float(np.mean(told.residuals_deg(turned) <= AGREEMENT_DEG))

    if count < _FEWEST_PAIRS or (as_read := share(rotations)) > _MOST_AS_READ:
        return None
    shares, found = np.zeros(0), list[_Reading]()
    for readings in (_in_other_conventions(rotations, written), _in_other_axes(rotations, told)):
        if shares.max(initial=0.0) < _LEAST_OTHERWISE:
            found = list(readings)
            shares = np.array([share(one.rotations) for one in found])
    if (best := float(shares.max(initial=0.0))) < _LEAST_OTHERWISE:
        return None
    ties = [one for one, own in zip(found, shares.tolist(), strict=True) if own >= best - _TIE]
    simplest = [one for one in ties if len(one.looks) == min(len(other.looks) for other in ties)]
    looks, wanted = (
        " or ".join(dict.fromkeys(", ".join(words) for words in said))
        for said in ([one.looks for one in simplest], [one.wanted for one in simplest])
    )
    agree = (
        f"{round(best * count)} of {count} pairs agree with that, {round(as_read * count)} as they are read"
    )
    return Recognized(f"the poses seem to be {looks}: {agree}", f"write them {wanted}")


class _Reading(NamedTuple):
    """Poses read by another convention."""

    rotations: FloatArray
    """(n, 3, 3) cam_from_world."""
    looks: tuple[str, ...]
    """What they seem to be, by that in which they differ."""
    wanted: tuple[str, ...]
    """What they should be."""


def _in_other_conventions(rotations: FloatArray, written: Written) -> Iterator[_Reading]:
    """Yield what poses are if they are in another convention than the one they were read by."""
    into, matrices = written != "colmap", rotations.transpose(0, 2, 1) if written != "colmap" else rotations
    order, *orders = _ORDERS.get(written, ([0, 1, 2, 3], "", ""))
    reordered = matrices_of(quaternions_of(matrices)[:, order])
    for is_reordered, inverse, flips in itertools.product((False, True), repeat=3):
        turned = (reordered.transpose(0, 2, 1) if into else reordered) if is_reordered else rotations
        turned = turned.transpose(0, 2, 1) if inverse else turned
        turned = FLIP_YZ @ turned if flips else turned
        has_other_axes = flips != (
            inverse and written == "nerf"
        )  # whose inverse has the flip on its other side
        kinds = [
            (inverse, (_DIRECTIONS[not into], _DIRECTIONS[into])),
            (has_other_axes, [f"in {_AXES[k]}" for k in (written != "nerf", written == "nerf")]),
            (is_reordered, [f"with quaternions in the order {one}" for one in orders]),
        ]
        differ = [words for differs, words in kinds if differs]
        if differ and not (is_reordered and written == "nerf"):
            yield _Reading(turned, tuple(words[0] for words in differ), tuple(words[1] for words in differ))


def _in_other_axes(rotations: FloatArray, told: RelativeRotations) -> Iterator[_Reading]:
    """Yield poses of cameras by those of bodies that they are fixed to, or by the inverse of these."""
    own = rotation_vectors(told.rotations)
    for turned in (rotations, rotations.transpose(0, 2, 1)):
        i, j = told.pairs.T
        given = rotation_vectors(turned[j] @ turned[i].transpose(0, 2, 1))
        axes = nearest_rotations((own.T @ given)[None])
        yield _Reading(axes @ turned, (_OTHER_AXES,), ("in those of the camera",))
