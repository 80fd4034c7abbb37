"""Where the cameras of a synthetic scene stand, and which surface points lie before them, for each shape.

World axes: z is up; one unit is a meter. Every surface is convex towards its cameras, so that which way a
point faces also decides whether it is hidden.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.synthetic.mounts import Rigs, mounted
from sfm_shapefit.synthetic.scene_options import SceneOptions, Shape

ByteArray = npt.NDArray[np.uint8]

FARTHEST_M = 40.0
"""Meters from a camera to a surface; beyond, its texture is too small to be detected."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneCameras:
    """The n cameras of a scene, true and as a model states them."""

    options: SceneOptions
    """What made the scene."""
    rotations: FloatArray
    """(n, 3, 3) cam_from_world, true."""
    centers: FloatArray
    """(n, 3) camera centers, true."""
    stated_rotations: FloatArray
    """(n, 3, 3) cam_from_world as a model states them: the true ones after `rotation_noise_deg`."""
    rigs: Rigs
    """What the cameras are mounted on; a frame is one image where `rig` is "none"."""

    @property
    def num_images(self) -> int:
        """Number of images, n."""
        return len(self.centers)

    @property
    def calibration(self) -> FloatArray:
        """The (3, 3) calibration matrix K of every image."""
        return self.options.calibration


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneLayout:
    """Surfaces and cameras, before any photograph."""

    centers: FloatArray
    """(n, 3) camera centers."""
    rotations: FloatArray
    """(n, 3, 3) cam_from_world."""
    points: FloatArray
    """(p, 3) surface points."""
    normals: FloatArray
    """(p, 3) unit normals, outwards."""
    colors: ByteArray
    """(p, 3) red, green, blue."""


def _ring(n: int, p: int, rng: np.random.Generator) -> SceneLayout:
    """Cameras on a circle of 4 m around a ball of 1.4 m, all looking at it."""
    angle = 2.0 * np.pi * (np.arange(n) + rng.uniform(-0.2, 0.2, n)) / n
    radius = rng.uniform(3.8, 4.4, n)
    centers = np.stack([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(0.0, 1.5, n)], axis=1)
    target = rng.uniform(-0.15, 0.15, (n, 3))
    outward = normalized(rng.standard_normal((p, 3)))
    longitude = np.arctan2(outward[:, 1], outward[:, 0])
    return SceneLayout(
        centers=centers,
        rotations=looking_along(target - centers),
        points=outward * rng.uniform(1.35, 1.45, (p, 1)),
        normals=outward,
        colors=_draw_board(4.0 * longitude, 6.0 * outward[:, 2], (214, 96, 77), (247, 224, 190), rng),
    )


def _facade(n: int, p: int, rng: np.random.Generator) -> SceneLayout:
    """A grid of cameras, 2 m apart, 10 m before a wall with 1 m of relief."""
    columns = int(np.ceil(np.sqrt(n)))
    column, row = np.arange(n) % columns, np.arange(n) // columns
    centers = np.stack([2.0 * column, np.full(n, -10.0), 2.0 * row + 3.0], axis=1)
    centers += rng.uniform(-0.4, 0.4, (n, 3))
    forward = np.array([0.0, 1.0, 0.0]) + 0.1 * rng.standard_normal((n, 3))
    along = rng.uniform(-4.0, 2.0 * columns + 2.0, p)
    height = rng.uniform(0.0, 2.0 * float(row.max()) + 7.0, p)
    return SceneLayout(
        centers=centers,
        rotations=looking_along(forward),
        points=np.stack([along, rng.uniform(-0.5, 0.5, p), height], axis=1),
        normals=_tilt(np.broadcast_to([0.0, -1.0, 0.0], (p, 3)), rng),
        colors=_draw_board(along / 1.5, height / 1.5, (205, 170, 125), (92, 107, 130), rng),
    )


def _drive(n: int, p: int, rng: np.random.Generator) -> SceneLayout:
    """Cameras every 1.5 m on a winding street, looking ahead; facades 7 m left and right, and the ground."""
    at = 1.5 * np.arange(n)
    road, ahead, left = street(at)
    centers = road + 0.1 * rng.standard_normal((n, 1)) * left
    centers[:, 2] = 1.5 + 0.05 * rng.standard_normal(n)

    along = rng.uniform(0.0, at[-1] + FARTHEST_M, p)
    side = rng.choice([-1.0, 0.0, 1.0], size=p, p=[0.4, 0.2, 0.4])
    on_ground = side == 0.0
    lateral = np.where(on_ground, rng.uniform(-6.5, 6.5, p), side * rng.uniform(6.5, 7.5, p))
    height = np.where(on_ground, 0.0, rng.uniform(0.0, 8.0, p))
    foot, _, across = street(along)
    points = foot + lateral[:, None] * across
    points[:, 2] = height
    normals = np.where(on_ground[:, None], [0.0, 0.0, 1.0], -side[:, None] * across)
    walls = _draw_board(along / 2.0, height / 1.5, (188, 143, 110), (84, 96, 112), rng)
    asphalt = _draw_board(along / 3.0, lateral / 3.0, (96, 96, 96), (120, 120, 118), rng)
    return SceneLayout(
        centers=centers,
        rotations=looking_along(ahead + 0.02 * rng.standard_normal((n, 3))),
        points=points,
        normals=_tilt(normals, rng),
        colors=np.where(on_ground[:, None], asphalt, walls),
    )


def street(along_m: npt.NDArray[np.floating]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return position, unit tangent and unit left normal (k, 3) of the street y = 18 sin(x / 60) at x."""
    slope = 0.3 * np.cos(along_m / 60.0)
    zero = np.zeros_like(along_m)
    position = np.stack([along_m, 18.0 * np.sin(along_m / 60.0), zero], axis=1)
    ahead = normalized(np.stack([np.ones_like(along_m), slope, zero], axis=1))
    return position, ahead, np.stack([-ahead[:, 1], ahead[:, 0], zero], axis=1)


def _cloud(n: int, p: int, rng: np.random.Generator) -> SceneLayout:
    """Cameras 4 to 7 m around a Gaussian cloud, with random roll; each point faces a random way."""
    centers = rng.uniform(4.0, 7.0, (n, 1)) * normalized(rng.standard_normal((n, 3)))
    target = 0.3 * rng.standard_normal((n, 3))
    points = rng.standard_normal((p, 3))
    return SceneLayout(
        centers=centers,
        rotations=looking_along(target - centers, up=rng.standard_normal((n, 3))),
        points=points,
        normals=normalized(rng.standard_normal((p, 3))),
        colors=_draw_board(points[:, 0], points[:, 1] + points[:, 2], (67, 147, 195), (244, 165, 130), rng),
    )


def _courtyard(n: int, p: int, rng: np.random.Generator) -> SceneLayout:
    """Cameras around the inside of a yard, 24 by 18 m, looking across at four facades and the ground."""
    half = np.array([12.0, 9.0])
    angle = 2.0 * np.pi * (np.arange(n) + rng.uniform(-0.3, 0.3, n)) / n
    ring = half * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    centers = np.column_stack([0.5 * ring + rng.uniform(-0.5, 0.5, (n, 2)), rng.uniform(1.2, 3.5, n)])
    yaw = 0.25 * rng.standard_normal((n, 1))
    across = -np.cos(yaw) * ring + np.sin(yaw) * np.stack([ring[:, 1], -ring[:, 0]], axis=1)
    forward = np.column_stack([across, rng.uniform(-1.0, 2.0, n)])

    wall = rng.choice(5, size=p, p=[0.21, 0.21, 0.17, 0.17, 0.24])  # north, south, east, west, ground
    normals = np.array([[0, -1, 0], [0, 1, 0], [-1, 0, 0], [1, 0, 0], [0, 0, 1]], dtype=np.float64)[wall]
    flat = rng.uniform([-half[0], -half[1], 0.0], [half[0], half[1], 8.0], (p, 3))
    surface = np.array([half[1], half[1], half[0], half[0], 0.0])[wall]
    relief = np.where(wall == 4, 0.1, 1.0) * rng.uniform(-0.4, 0.4, p)
    depth = np.sum(flat * normals, axis=1)
    points = flat + (-surface + relief - depth)[:, None] * normals
    along = np.where(wall < 2, flat[:, 0], flat[:, 1])
    bricks = _draw_board(along / 1.5, flat[:, 2] / 1.5, (178, 102, 78), (226, 205, 170), rng)
    paving = _draw_board(flat[:, 0] / 2.0, flat[:, 1] / 2.0, (128, 128, 120), (150, 150, 140), rng)
    return SceneLayout(
        centers=centers,
        rotations=looking_along(forward),
        points=points,
        normals=_tilt(normals, rng),
        colors=np.where((wall == 4)[:, None], paving, bricks),
    )


LAYOUTS: dict[Shape, Callable[[int, int, np.random.Generator], SceneLayout]] = {
    "ring": _ring,
    "facade": _facade,
    "drive": _drive,
    "cloud": _cloud,
    "courtyard": _courtyard,
}
"""By shape: (number of images, number of points, generator) -> layout."""


def lay_out_scene(options: SceneOptions, rng: np.random.Generator) -> tuple[SceneLayout, Rigs]:
    """Return the layout of a scene, each camera of its shape replaced by a frame of the rig, and that rig."""
    rigs = mounted(options.rig, options.num_images)
    layout = LAYOUTS[options.shape](len(rigs.rig_of_frame), options.num_points, rng)
    rotations, centers = layout.rotations, layout.centers
    if options.rig != "none":
        centers, rotations = rigs.centers_of(rotations, centers), rigs.rotations_of(rotations)
    return replace(layout, centers=centers, rotations=rotations), rigs


def state_rotations(
    rotations: FloatArray, rigs: Rigs, options: SceneOptions, rng: np.random.Generator
) -> FloatArray:
    """Return the rotations (n, 3, 3) that a model states: true ones, the frames turned at random."""
    if options.rotation_noise_deg == 0.0:
        return rotations
    frames = rotations[rigs.sensor_of_image == 0]
    return rigs.rotations_of(turn_at_random(frames, np.radians(options.rotation_noise_deg), rng))


def turn_at_random(rotations: FloatArray, sigma_rad: float, rng: np.random.Generator) -> FloatArray:
    """Return the rotations (n, 3, 3) after small random turns, N(0, sigma^2) about each camera axis."""
    from scipy.spatial.transform import Rotation

    if sigma_rad == 0.0:
        return rotations
    turns = Rotation.from_rotvec(sigma_rad * rng.standard_normal((len(rotations), 3))).as_matrix()
    return np.asarray(turns @ rotations)


def looking_along(forward: FloatArray, up: FloatArray | None = None) -> FloatArray:
    """Return cam_from_world, rows right, down, ahead, of cameras along `forward` (n, 3); up is z if None."""
    ahead = normalized(forward)
    upward = np.broadcast_to([0.0, 0.0, 1.0], ahead.shape) if up is None else up
    right = normalized(np.cross(ahead, upward))
    return np.stack([right, np.cross(ahead, right), ahead], axis=1)


def _tilt(normals: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return unit normals (p, 3) tilted at random by about 15 degrees: masonry is not a mirror."""
    return normalized(normals + 0.2 * rng.standard_normal(normals.shape))


def _draw_board(
    u: FloatArray,
    v: FloatArray,
    light: tuple[int, int, int],
    dark: tuple[int, int, int],
    rng: np.random.Generator,
) -> ByteArray:
    """Return colors (p, 3) of a board with unit fields at texture coordinates u, v, with some grain."""
    odd = (np.floor(u) + np.floor(v)) % 2.0 == 1.0
    grain = rng.integers(-8, 9, size=(len(u), 1))
    return np.asarray(np.clip(np.where(odd[:, None], dark, light) + grain, 0, 255), dtype=np.uint8)
