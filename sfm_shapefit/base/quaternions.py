"""Rotations, their vectors and quaternions x, y, z, w: to the bit scipy's, whose `Rotation` loads long."""

from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import nearest_rotations, normalized
from sfm_shapefit.base.jit import kernel

_SERIES_RAD = 1e-3  # angle below which a series replaces sin(t / 2) / t; its next term is t^6 / 322,560 of it
_ORTHOGONAL = 1e-12  # absolute error of an entry of R R^T; where it is larger the nearest rotation counts


def rotations_of(vectors: FloatArray) -> FloatArray:
    """Return the rotations (n, 3, 3) by rotation vectors (n, 3) in radians."""
    quaternions = np.empty((len(vectors), 4))
    _exponentials(np.ascontiguousarray(vectors, dtype=np.float64), quaternions)
    return _matrices(quaternions)


def rotation_vectors(rotations: FloatArray) -> FloatArray:
    """Return the vectors (n, 3) in radians, of length up to pi, of rotations (n, 3, 3)."""
    vectors = np.empty((len(rotations), 3))
    _logarithms(quaternions_of(rotations), vectors)
    return vectors


def matrices_of(quaternions: FloatArray) -> FloatArray:
    """Return the rotations (n, 3, 3) of quaternions (n, 4), which need not be of length 1."""
    return _matrices(normalized(quaternions))


def _matrices(quaternions: FloatArray) -> FloatArray:
    """Return the rotations of quaternions of length 1."""
    x, y, z, w = quaternions.T
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    rows = [
        [xx - yy - zz + ww, 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), -xx + yy - zz + ww, 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), -xx - yy + zz + ww],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), 2, 0))


def quaternions_of(rotations: FloatArray) -> FloatArray:
    """Return quaternions (n, 4), of either sign, of rotations (n, 3, 3)."""
    products = rotations @ rotations.transpose(0, 2, 1)
    off = ~np.isclose(products, np.eye(3), atol=_ORTHOGONAL).all(axis=(1, 2))
    m = rotations.copy()
    m[off] = nearest_rotations(m[off])
    traces = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    largest = np.argmax(np.column_stack([np.einsum("naa->na", m), traces]), axis=1)
    found = np.column_stack(
        [m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1], 1.0 + traces]
    )
    for i in range(3):
        j, k, rows = (i + 1) % 3, (i + 2) % 3, largest == i
        r = m[rows]
        found[rows, i] = 1.0 - traces[rows] + 2.0 * r[:, i, i]
        found[rows, j], found[rows, k] = r[:, j, i] + r[:, i, j], r[:, k, i] + r[:, i, k]
        found[rows, 3] = r[:, k, j] - r[:, j, k]
    return normalized(found)


@kernel
def _exponentials(vectors: Any, quaternions: Any) -> None:
    """Fill in the quaternions (n, 4) of rotation vectors (n, 3)."""
    for k in range(len(vectors)):
        v, q = vectors[k], quaternions[k]
        angle = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
        square = angle * angle
        if angle <= _SERIES_RAD:
            scale = 0.5 - square / 48.0 + square * square / 3840.0
        else:
            scale = np.sin(angle / 2.0) / angle
        q[0], q[1], q[2], q[3] = scale * v[0], scale * v[1], scale * v[2], np.cos(angle / 2.0)


@kernel
def _logarithms(quaternions: Any, vectors: Any) -> None:
    """Fill in the vectors (n, 3) of quaternions (n, 4) of length 1."""
    for n in range(len(quaternions)):
        q = quaternions[n]
        length = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
        angle = 2.0 * np.arctan2(length, abs(q[3]))
        square = angle * angle
        if angle <= _SERIES_RAD:
            scale = 2.0 + square / 12.0 + 7.0 * square * square / 2880.0
        else:
            scale = angle / np.sin(angle / 2.0)
        if q[3] < 0.0:
            scale = -scale
        for axis in range(3):
            vectors[n, axis] = scale * q[axis]
