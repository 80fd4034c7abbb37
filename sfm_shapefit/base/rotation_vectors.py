"""Rotations and their vectors, to the bit those of scipy's `Rotation`, which takes long to import."""

from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.jit import kernel

_SERIES_RAD = 1e-3  # angle below which a series replaces sin(t / 2) / t; its next term is t^6 / 322,560 of it


def rotations_of(vectors: FloatArray) -> FloatArray:
    """Return the rotations (n, 3, 3) by rotation vectors (n, 3) in radians."""
    rotations = np.empty((len(vectors), 3, 3))
    _exponentials(np.ascontiguousarray(vectors, dtype=np.float64), rotations)
    return rotations


def rotation_vectors(rotations: FloatArray) -> FloatArray:
    """Return the vectors (n, 3) in radians, of length up to pi, of rotations (n, 3, 3)."""
    vectors = np.empty((len(rotations), 3))
    _logarithms(np.ascontiguousarray(rotations, dtype=np.float64), vectors)
    return vectors


@kernel
def _exponentials(vectors: Any, turns: Any) -> None:
    """Fill turns (n, 3, 3) with the rotations of vectors (n, 3), by unit quaternions."""
    for k in range(len(vectors)):
        v, r = vectors[k], turns[k]
        angle = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
        square = angle * angle
        if angle <= _SERIES_RAD:
            scale = 0.5 - square / 48.0 + square * square / 3840.0
        else:
            scale = np.sin(angle / 2.0) / angle
        x, y, z, w = scale * v[0], scale * v[1], scale * v[2], np.cos(angle / 2.0)
        r[0, 0] = x * x - y * y - z * z + w * w
        r[1, 1] = -x * x + y * y - z * z + w * w
        r[2, 2] = -x * x - y * y + z * z + w * w
        r[1, 0], r[0, 1] = 2.0 * (x * y + z * w), 2.0 * (x * y - z * w)
        r[2, 0], r[0, 2] = 2.0 * (x * z - y * w), 2.0 * (x * z + y * w)
        r[2, 1], r[1, 2] = 2.0 * (y * z + x * w), 2.0 * (y * z - x * w)


@kernel
def _logarithms(rotations: Any, vectors: Any) -> None:
    """Fill vectors (n, 3) with those of rotations, by the quaternion's entry that is largest for sure."""
    q = np.empty(4)
    for n in range(len(rotations)):
        r, trace = rotations[n], rotations[n, 0, 0] + rotations[n, 1, 1] + rotations[n, 2, 2]
        i, largest = 3, trace
        for axis in range(2, -1, -1):
            if r[axis, axis] >= largest:
                i, largest = axis, r[axis, axis]
        if i == 3:
            q[0], q[1], q[2] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
            q[3] = 1.0 + trace
        else:
            j, k = (i + 1) % 3, (i + 2) % 3
            q[i] = 1.0 - trace + 2.0 * r[i, i]
            q[j], q[k], q[3] = r[j, i] + r[i, j], r[k, i] + r[i, k], r[k, j] - r[j, k]
        q /= np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
        if q[3] < 0.0:
            q *= -1.0
        angle = 2.0 * np.arctan2(np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2]), q[3])
        square = angle * angle
        if angle <= _SERIES_RAD:
            scale = 2.0 + square / 12.0 + 7.0 * square * square / 2880.0
        else:
            scale = angle / np.sin(angle / 2.0)
        for axis in range(3):
            vectors[n, axis] = scale * q[axis]
