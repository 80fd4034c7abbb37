"""Turns too small for a single pair: one correction of each camera's rotation, from all pairs at once.

In dense scenes, or with short baselines, a pair knows its relative rotation to two degrees or so. A camera
that is turned by less contradicts none of its pairs, but all of them together. With corrections x in world
axes, one of each camera, the turn E of a pair (see `turns`) is to first order

    log E_ij = x_i - x_j + noise,

and the x that fit best are found jointly, so that the cameras of a turned group do not speak for one another:

    min_x  sum_ij w_ij |log E_ij - x_i + x_j|^2 / sigma_ij^2  +  sum_i u_i |x_i|^2 / tau^2

The weights are those of Geman and McClure, w = 1 / (1 + (r / 3.5 sigma)^2)^2, anew in every round: a pair of
repeated structure soon has none. The prior, rotations right to tau = 0.2 degrees, is of Cauchy's form,
u = 1 / (1 + (x / 0.6 deg)^2), and hardly holds a camera whose rotation is not. The inverse of the same matrix
is the covariance of x. Large turns are mended before: from x = 0 a pair that contradicts has little weight.

How exact pairs are is seen from those that agree best, and may be several times better than each can be sure
of. Rounds begin with the larger standard deviations, so that no turn falls between the two tests, and come
down to the smaller ones.

Turns of 2 degrees are corrected by 1.7 to 3.3 degrees and 15 standard deviations or more, right cameras by
0.6 degrees and 8 standard deviations at most, since errors that matches share are not modelled:
`scripts/results/notes.md#small-turns`.
"""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.laplacian.superlu import superlu

_ROBUST_SIGMAS = 3.5  # standard deviations at which a weight is a quarter; beyond, a pair hardly counts
_PRIOR_RAD, _PRIOR_WIDTH_RAD = np.radians(0.2), np.radians(0.6)  # radians, tau and width; see the header
_COOLING, _MOST_ROUNDS = 0.8, 30  # factor on the standard deviations per round; seven scenes took 8 to 16
_SETTLED_RAD = np.radians(0.002)  # radians; once no correction moves farther, weights change no more


class Corrections(NamedTuple):
    """What n cameras are turned by, from all their pairs together."""

    vectors: FloatArray
    """(n, 3) rotation vectors in world axes, radians."""
    cameras: IntArray
    """The cameras whose correction is larger than was asked for."""
    sigmas_rad: FloatArray
    """Standard deviations per axis of the corrections."""


def solve_corrections(
    pairs: IntArray,
    turns: FloatArray,
    sigmas_rad: FloatArray,
    count: int,
    *,
    level: float = 1.0,
    larger_than_rad: float = 0.0,
) -> Corrections:
    """Return the corrections of cameras that fit the turns of their pairs best.

    Args:
        pairs: (k, 2) cameras.
        turns: (k, 3) rotation vectors of the turns of pairs, in world axes, radians.
        sigmas_rad: (k,) their standard deviations, finite.
        count: the number of cameras, n.
        level: factor on the standard deviations, at most 1.
        larger_than_rad: size of the corrections whose standard deviations are returned.
    """
    x, (i, j), ends = np.zeros((count, 3)), pairs.T, pairs.ravel()
    nodes = np.arange(count)
    places = np.concatenate([j, i, nodes]), np.concatenate([i, j, nodes])
    for round_ in range(_MOST_ROUNDS):
        scale = max(level, _COOLING**round_)
        sigmas = scale * sigmas_rad
        off = np.linalg.norm(turns - (x[i] - x[j]), axis=1) / sigmas
        weights = 1.0 / (sigmas * (1.0 + (off / _ROBUST_SIGMAS) ** 2)) ** 2
        prior = 1.0 / (_PRIOR_RAD**2 * (1.0 + (np.linalg.norm(x, axis=1) / _PRIOR_WIDTH_RAD) ** 2))
        diagonal = np.bincount(ends, np.repeat(weights, 2), count) + prior
        factor = superlu(count, places, np.concatenate([-weights, -weights, diagonal]))
        pulls = (weights[:, None] * turns)[:, None] * np.array([[1.0], [-1.0]])
        right = np.column_stack([np.bincount(ends, pulls[:, :, c].ravel(), count) for c in range(3)])
        previous, x = x, factor.solve(right)
        if scale == level and np.abs(x - previous).max(initial=0.0) < _SETTLED_RAD:
            break
    large = np.flatnonzero(np.linalg.norm(x, axis=1) > larger_than_rad)
    units = (np.bincount([camera], minlength=count).astype(np.float64) for camera in large.tolist())
    variances = [factor.solve(unit)[camera] for camera, unit in zip(large.tolist(), units, strict=True)]
    return Corrections(x, large, np.sqrt(np.array(variances)))
