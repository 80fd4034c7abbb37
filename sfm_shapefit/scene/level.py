"""The direction up in a model that neither priors nor gravity has leveled, by its pictures and points.

People hold cameras level, upright or on their side: one axis of each picture is horizontal, by a roll that
chance decides. Up is the common normal of these axes; robustly, as some pictures are rolled on purpose.
Pictures along a straight way share that axis, and leave open how far the way climbs: there, the plane of the
ground points says it. What the tilt of the cameras says is worth less.

Minimized over unit vectors u, by reweighting:

    sum_i w_i (a_i . u)^2 / s_roll^2  +  |u x n|^2 / s_ground^2  +  |u x p|^2 / s_tilt^2

with horizontal axes a_i, the normal n of the ground, the mean p of the pictures' own up axes.
"""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import SIGMA_PER_MEDIAN, median_spread, normalized, tangent_bases

_LEAST_ROLL = np.radians(0.1)  # radians; nobody holds a camera better
_MEANT = np.radians(10.0)  # radians; a picture that is rolled by more is meant to be
_GROUND = np.radians(2.0)  # radians, standard deviation of the slope of the ground; yards drain by as much
_TILT = np.radians(10.0)  # radians; all cameras together may look down, on a table, or up, at a tower
_NUM_DRAWS = 1000  # planes through three points; of points a fifth of which are ground, eight have no other
_THICKNESS = 0.03  # median spreads of the points; those that are no farther from a plane are on it
_GROUND_SHARE = 0.15  # share of the points on the ground; a plane of fewer may be anything
_FEWEST_POINTS = 50  # points; of fewer, chance puts as large a share on a plane
_STEEPEST = np.radians(25.0)  # radians between up and the ground's normal; steeper planes are roofs and walls
_ROUNDS = 50  # rounds of reweighting, a bound; they end once nothing moves
_SEED = 0  # seed of the draws; any will do, if it is always the same


class Up(NamedTuple):
    """The direction up, and how well it is known."""

    direction: FloatArray
    """(3,) in axes of the model."""
    sigma_rad: float
    """Standard deviation about the worst axis, in radians."""
    roll_rad: float
    """Standard deviation of the pictures' rolls, in radians."""
    ground: float
    """Share of the points on the plane of the ground; 0 where no plane is one."""


def find_up(rotations: FloatArray, centers: FloatArray, points: FloatArray) -> Up:
    """Return which way is up.

    Args:
        rotations: (n, 3, 3) cam_from_world, n >= 1.
        centers: (n, 3) of the cameras.
        points: (x, 3) of the scene, any number; each is compared with a thousand planes.
    """
    start = _first_guess(rotations)
    up = _weigh(rotations, start, None)
    normal, share = _ground(points, centers, up.direction)
    return up if normal is None else _weigh(rotations, up.direction, normal)._replace(ground=share)


def _first_guess(rotations: FloatArray) -> FloatArray:
    """Return the direction with which most pictures agree, of those that two of them or one give."""
    x, y = rotations[:, 0], rotations[:, 1]
    draws = np.random.default_rng(_SEED).integers(0, len(x), (_NUM_DRAWS, 2))
    crossed = np.cross(x[draws[:, 0]], x[draws[:, 1]])
    lengths = np.linalg.norm(crossed, axis=1)
    tried = np.concatenate([-y, normalized(crossed[lengths > np.sin(_MEANT)])])
    rolls = np.minimum(np.abs(tried @ x.T), np.abs(tried @ y.T)) / np.sin(_MEANT)
    votes = np.maximum(0.0, 1.0 - rolls**2).sum(axis=1) + 0.1 * np.abs(tried @ y.T).sum(axis=1)
    return _upward(tried[int(np.argmax(votes))], rotations)


def _upward(direction: FloatArray, rotations: FloatArray) -> FloatArray:
    """Return a direction or its opposite: pictures' y axes point down, or else they look down."""
    leaning = rotations[:, 1:].mean(axis=0) @ direction
    return -direction if max(leaning, key=abs) > 0.0 else direction


def _weigh(rotations: FloatArray, up: FloatArray, normal: FloatArray | None) -> Up:
    """Return the direction up near a first one, from all that is known."""
    horizontal = rotations[:, :2]
    fixed = _about(-horizontal[:, 1].sum(axis=0), _TILT)
    fixed += 0.0 if normal is None else _about(normal, _GROUND)
    for _ in range(_ROUNDS):
        axes = np.where(
            (np.abs(horizontal[:, 0] @ up) <= np.abs(horizontal[:, 1] @ up))[:, None],
            horizontal[:, 0],
            horizontal[:, 1],
        )
        rolls = np.arcsin(np.clip(axes @ up, -1.0, 1.0))
        sigma = max(SIGMA_PER_MEDIAN * float(np.median(np.abs(rolls))), _LEAST_ROLL)
        weights = 1.0 / (1.0 + (rolls / (3.0 * sigma)) ** 2) ** 2
        information = (axes * weights[:, None]).T @ axes / sigma**2 + fixed
        after = _upward(np.linalg.eigh(information)[1][:, 0], rotations)
        moved, up = float(np.linalg.norm(after - up)), after
        if moved < 1e-12:
            break
    basis = tangent_bases(up[None])[0]
    least = float(np.linalg.eigvalsh(basis.T @ information @ basis)[0])
    return Up(up, 1.0 / np.sqrt(least), sigma, 0.0)


def _about(direction: FloatArray, sigma: float) -> FloatArray:
    """Return the information (3, 3) that up has a direction, (3,) of any length; 0 of none."""
    length = float(np.linalg.norm(direction))
    if not length > 0.0:
        return np.zeros((3, 3))
    unit = direction / length
    return np.asarray((np.eye(3) - np.outer(unit, unit)) / sigma**2)


def _ground(points: FloatArray, centers: FloatArray, up: FloatArray) -> tuple[FloatArray | None, float]:
    """Return the normal of the plane below the cameras with most points, and their share; None of none."""
    if len(points) < _FEWEST_POINTS:
        return None, 0.0
    triples = points[np.random.default_rng(_SEED).integers(0, len(points), (_NUM_DRAWS, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    with np.errstate(invalid="ignore"):
        normals = normalized(normals) * np.sign(normals @ up)[:, None]
        steep = ~(normals @ up >= np.cos(_STEEPEST))
        heights, thickness = normals @ points.T, _THICKNESS * median_spread(points)
        levels = np.sum(normals * triples[:, 0], axis=1)
        steep |= np.median(normals @ centers.T, axis=1) < levels
        counts = np.where(steep, 0, (np.abs(heights - levels[:, None]) <= thickness).sum(axis=1))
    best = int(np.argmax(counts))
    share = float(counts[best]) / len(points)
    if share < _GROUND_SHARE:
        return None, 0.0
    on = points[np.abs(heights[best] - levels[best]) <= thickness]
    normal = np.linalg.svd(on - on.mean(axis=0), full_matrices=False)[2][2]
    return normal * np.sign(normal @ up), share
