"""Bare graphs of scenes that repeat themselves, whose wrong pairs agree with one another."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_shapefit import ViewGraph
from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.geometry import normalized


class RepeatedScene(NamedTuple):
    """Cameras around a thing of four equal sides, of radius 1."""

    graph: ViewGraph
    relative: FloatArray
    """(m, 3, 3) cam_j_from_cam_i of the pairs, wrong ones off by 90 or 180 deg."""
    num_matches: IntArray
    """(m,) 200 of right pairs, 50 of wrong ones."""
    centers: FloatArray
    rotations: FloatArray
    """(n, 3, 3) cam_from_world."""


def four_alike_sides(confused: float, seed: int, num_cameras: int = 48) -> RepeatedScene:
    """Return a scene; a pair that sees two sides for one is matched with the odds `confused`."""
    rng, n = np.random.default_rng(seed), num_cameras
    angles = 2.0 * np.pi * (np.arange(n) + 0.3 * rng.random(n)) / n
    centers = np.column_stack([np.cos(angles), np.sin(angles), 0.3 * rng.standard_normal(n)])
    turns = Rotation.random(n, random_state=rng)
    i, j = np.triu_indices(n, 1)
    ahead = (j - i + n // 2) % n - n // 2
    side = np.round(4.0 * ahead / n).astype(int)
    matched = (np.abs(ahead - side * n // 4) <= 7) & ((side == 0) | (rng.random(len(i)) < confused))
    i, j, side = i[matched], j[matched], side[matched]
    seen_as = Rotation.from_rotvec(np.outer(-0.5 * np.pi * side, [0.0, 0.0, 1.0]))  # of the world by camera j
    noise = Rotation.from_rotvec(np.radians(0.1) * rng.standard_normal((len(i), 3)))
    relative = noise * turns[j] * seen_as.inv() * turns[i].inv()
    directions = normalized(centers[i] - seen_as.apply(centers[j]))
    directions = normalized(directions + 0.002 * rng.standard_normal(directions.shape))
    graph = ViewGraph(n, np.column_stack([i, j]), directions)
    matches = np.where(side == 0, 200, 50)
    return RepeatedScene(graph, relative.as_matrix(), matches, centers, turns.as_matrix())
