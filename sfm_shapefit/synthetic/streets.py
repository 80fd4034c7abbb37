"""A straight street whose truth is known: parallel baselines between cameras, and points at the roadside.

Cameras drive along a line, so that the directions between them say nothing of their distances; rays to points
3 to 10 m aside do. Cameras are a meter apart on average, the speed varies smoothly by a factor of 3. Each
camera starts tracks, seen by it and the next 3 to 7, of a point beside the middle of them. Noise is a random
vector of 0.01 rad between cameras and of 1e-3 rad, a pixel at a focal length of 1000, towards points.
"""

from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.synthetic.graphs import GraphProblem, Seed, noisy_directions

_BAND = 10  # cameras ahead that a camera is paired with; as far as a street's views overlap
_PAIR_NOISE_RAD, _PAIR_SHARE_WRONG = 0.01, 0.1  # radians, and share; directions between cameras
_RAY_NOISE_RAD, _RAY_SHARE_WRONG = 1e-3, 0.15  # radians, and share; directions to points are far more exact
_SPEED_RATIO, _WAVE = 3.0, 50.0  # largest over smallest speed, cameras per wave of it; lengths must be found


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StreetProblem(GraphProblem):
    """Cameras 0..num_cameras-1 of a street, then points, meters; pairs of cameras, then (camera, point)."""

    num_cameras: int
    covariance: FloatArray
    """(m, 2, 2) covariance of each direction in its tangent plane, rad^2, as far as it is not wrong."""


def street_problem(
    num_cameras: int, tracks_per_camera: int = 10, jitter: float = 0.0, seed: Seed = 0
) -> StreetProblem:
    """Return a street.

    Args:
        num_cameras: at least 8, the longest track.
        tracks_per_camera: tracks that start at each camera.
        jitter: standard deviation of the cameras' distance from the line, per axis, in meters.
        seed: an integer, or a Generator to draw from.
    """
    rng = np.random.default_rng(seed)
    n = num_cameras
    speed = _SPEED_RATIO ** (0.5 * np.sin(2.0 * np.pi * np.arange(n) / _WAVE + rng.uniform(0.0, 2.0 * np.pi)))
    cameras = np.zeros((n, 3))
    cameras[:, 0] = np.cumsum(speed)
    cameras[:, 1:] = jitter * rng.standard_normal((n, 2))
    seen_by, points = _tracks(cameras, tracks_per_camera, rng)
    locations = np.concatenate([cameras, points])
    pairs = np.array([(i, j) for i in range(n) for j in range(i + 1, min(i + _BAND, n - 1) + 1)])
    edges = np.concatenate([pairs, seen_by + np.array([0, n])])
    to_point = np.arange(len(edges)) >= len(pairs)
    noise = np.where(to_point, _RAY_NOISE_RAD, _PAIR_NOISE_RAD)
    measured = noisy_directions(locations, edges, noise[:, None], rng)
    wrong = normalized(rng.standard_normal(measured.shape))
    corrupted = rng.random(len(edges)) < np.where(to_point, _RAY_SHARE_WRONG, _PAIR_SHARE_WRONG)
    return StreetProblem(
        locations=locations,
        num_cameras=n,
        edges=edges,
        directions=np.where(corrupted[:, None], wrong, measured),
        covariance=noise[:, None, None] ** 2 / 3.0 * np.eye(2),  # a random vector of that length has it
        corrupted=corrupted,
    )


def _tracks(
    cameras: FloatArray, tracks_per_camera: int, rng: np.random.Generator
) -> tuple[IntArray, FloatArray]:
    """Return the observations (k, 2) as (camera, point), and the points (p, 3)."""
    start = np.repeat(np.arange(len(cameras)), tracks_per_camera)
    views = rng.integers(4, 9, size=len(start))
    start = np.minimum(start, len(cameras) - views)  # the last cameras see tracks that begin before them
    side = rng.choice([-1.0, 1.0], size=len(start)) * rng.uniform(3.0, 10.0, size=len(start))
    ahead = cameras[start + views // 2, 0] + rng.uniform(-0.5, 0.5, size=len(start))
    points = np.stack([ahead, side, rng.uniform(-1.0, 3.0, size=len(start))], axis=1)
    seen = start[:, None] + np.arange(8)
    observed = np.arange(8) < views[:, None]
    point = np.broadcast_to(np.arange(len(start))[:, None], seen.shape)
    return np.stack([seen[observed], point[observed]], axis=1).astype(np.int64), points
