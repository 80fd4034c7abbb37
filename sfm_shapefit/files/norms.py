"""Norms of the rotation quaternions that programs write: rounding passes, a little more is normalized."""

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.wording import counted_are
from sfm_shapefit.files.lines import UNIT_TOLERANCE

_MOST_NORM = 1.5  # largest norm of a rotation, and the inverse of the smallest; what is beyond is none


def may_be_rotations(norms: FloatArray) -> BoolArray:
    """Return which quaternions of these norms may be rotations, (n,)."""
    return np.asarray((norms >= 1.0 / _MOST_NORM) & (norms <= _MOST_NORM))


def are_off(norms: FloatArray) -> BoolArray:
    """Return which quaternions are rotations, but not of length 1 to rounding, (n,)."""
    return np.asarray(may_be_rotations(norms) & (np.abs(norms - 1.0) > UNIT_TOLERANCE))


def say_normalized(norms: FloatArray) -> str:
    """Say how many quaternions are normalized, and the norm of the worst; nothing if none is."""
    off = norms[are_off(norms)]
    if not len(off):
        return ""
    worst = off[np.argmax(np.abs(np.log(off)))]
    sentence = f"{counted_are(len(off), 'rotation quaternion')} normalized, the worst of norm {worst:.3g}"
    return f"{sentence} instead of 1; correct what wrote them"
