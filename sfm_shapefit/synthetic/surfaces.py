"""The textured surfaces of a rendered scene: houses, a tower, the ground, and boxes that stand about.

Every surface is a closed trimesh mesh whose triangles carry a picture by planar mapping, in the axes of the
thing that it belongs to: along its front, into it, and up. Where houses repeat, they are one house: same
picture, same balconies. Boxes and ground never repeat.

The surfaces stand where the layout of the same shape has its points, and its cameras look at them. World
axes: z is up; one unit is a meter.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import trimesh

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.synthetic.layouts import FARTHEST_M, ByteArray, street
from sfm_shapefit.synthetic.scene_options import Shape
from sfm_shapefit.synthetic.textures import facade_texture, ground_texture

_HOUSE_DEPTH_M = 4.0  # meters; a terraced house's
_HOUSE_WIDTH_M = 8.0  # meters; several houses to a view
_TOWER_SIDES = 8  # sides; each has a picture of its own
_STORY_M = 2.6  # meters; a usual house's
_MOST_TEXELS = 2048  # texels of the ground's picture along either side; bounds its memory
_TEXELS_PER_M = 64.0  # texels per meter; as fine as pixels from across the street
_TEXELS_PER_M_NEAR = 160.0  # texels per meter of the tower; it is photographed from nearby
_LIGHT = normalized(np.array([0.3, -0.5, 0.8]))  # direction to the light; from the side, mostly above
_SHADE = 0.7  # brightness of a surface that the light does not reach; still shows its texture


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surfaces:
    """Triangles, each with its picture."""

    corners: FloatArray
    """(t, 3, 3) the three corners of each triangle, counterclockwise from outside."""
    texels: FloatArray
    """(t, 3, 2) x, y of each corner in its picture, in pixels; pictures go on for ever by repeating."""
    texture: IntArray
    """(t,) the picture of each triangle."""
    brightness: FloatArray
    """(t,) factor to the picture's colors."""
    textures: tuple[ByteArray, ...]
    """The pictures, (height, width, 3): red, green, blue."""


class _Part(NamedTuple):
    corners: FloatArray
    texels: FloatArray
    normals: FloatArray
    texture: ByteArray


class _Place(NamedTuple):
    """The axes of a thing: its origin on the ground, and the horizontal unit vector along its front."""

    origin: FloatArray
    along: FloatArray

    def axes(self) -> FloatArray:
        """Return (3, 3) with columns along, into the thing (to the left), and up."""
        x, y, _ = self.along
        return np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]])


_ALONG_X = np.array([1.0, 0.0, 0.0])  # unit vector; the axis of walls without a turn


def make_surfaces(shape: Shape, num_images: int, repeated: float, rng: np.random.Generator) -> Surfaces:
    """Return a layout's surfaces, the fraction `repeated` of them alike; InputError if the shape has none."""
    if shape not in _BUILDERS:
        raise InputError(
            f"a {shape} has no surfaces to draw; choose one of the shapes {', '.join(_BUILDERS)}"
        )
    parts = _BUILDERS[shape](num_images, repeated, rng)
    pictures = {id(part.texture): part.texture for part in parts}
    index = {key: k for k, key in enumerate(pictures)}
    counts = [len(part.corners) for part in parts]
    normals = np.concatenate([part.normals for part in parts])
    return Surfaces(
        corners=np.concatenate([part.corners for part in parts]),
        texels=np.concatenate([part.texels for part in parts]),
        texture=np.repeat(np.array([index[id(part.texture)] for part in parts], dtype=np.int64), counts),
        brightness=_SHADE + (1.0 - _SHADE) * np.maximum(normals @ _LIGHT, 0.0),
        textures=tuple(pictures.values()),
    )


def _facade(num_images: int, repeated: float, rng: np.random.Generator) -> list[_Part]:
    """Return a row of houses along x, their fronts at y = 0, with boxes and ground before them."""
    columns = int(np.ceil(np.sqrt(num_images)))
    rows = -(-num_images // columns)
    num_houses = int(np.ceil((2.0 * columns + 20.0) / _HOUSE_WIDTH_M))
    low, high = -10.0, -10.0 + num_houses * _HOUSE_WIDTH_M
    houses = _row(
        _Place(np.array([low, 0.0, 0.0]), _ALONG_X),
        num_houses,
        _house_maker(num_houses, 2.0 * rows + 8.0, repeated, rng),
    )
    at = np.column_stack([rng.uniform(low, high, 2 * columns), rng.uniform(-3.0, -1.0, 2 * columns)])
    return houses + _boxes(at, 1.0, rng) + [_ground((low, -16.0), (high, 4.0), rng)]


def _courtyard(_num_images: int, repeated: float, rng: np.random.Generator) -> list[_Part]:
    """Return four rows of houses round a yard of 24 by 18 m, boxes along them, and the ground."""
    half = np.array([12.0, 9.0])
    maker = _house_maker(12, 8.0, repeated, rng)
    parts = []
    for turn, (x, y) in enumerate([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)]):
        along, inward = np.array([x, y, 0.0]), np.array([-y, x, 0.0])
        origin = -half[turn % 2] * along + half[1 - turn % 2] * inward
        # Houses that reach beyond a corner are hidden by the next row.
        parts += _row(_Place(origin, along), 3, maker)
    angle = rng.uniform(0.0, 2.0 * np.pi, 16)
    at = 0.85 * half * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return parts + _boxes(at, 1.0, rng) + [_ground((-13.0, -10.0), (13.0, 10.0), rng)]


def _drive(num_images: int, repeated: float, rng: np.random.Generator) -> list[_Part]:
    """Return houses left and right of the street, boxes at its sides, and the ground."""
    end = 1.5 * (num_images - 1) + FARTHEST_M
    starts = np.arange(0.0, end, _HOUSE_WIDTH_M)
    maker = _house_maker(2 * len(starts), 8.0, repeated, rng)
    parts = []
    for side in (-1.0, 1.0):
        road, _, left = street(starts)
        feet = road + 7.0 * side * left
        next_feet = np.concatenate([feet[1:], feet[-1:] + (feet[-1:] - feet[-2:-1])])
        for foot, next_foot in zip(feet, next_feet, strict=True):
            ends = (foot, next_foot) if side > 0.0 else (next_foot, foot)
            parts += maker(_Place(ends[0], normalized(ends[1] - ends[0])))
    stations = rng.uniform(0.0, end, round(end / 4.0))
    road, _, left = street(stations)
    sides = rng.choice([-1.0, 1.0], len(stations)) * rng.uniform(4.5, 5.5, len(stations))
    at = (road + sides[:, None] * left)[:, :2]
    return parts + _boxes(at, 1.2, rng) + [_ground((-5.0, -30.0), (end + 10.0, 30.0), rng)]


def _ring(_num_images: int, repeated: float, rng: np.random.Generator) -> list[_Part]:
    """Return a round tower of 2.4 m by 2.8 m about the origin, boxes at its foot, and the ground."""
    radius, height, floor = 1.2, 2.8, -1.4
    tower = trimesh.creation.cylinder(radius=radius, height=height, sections=2 * _TOWER_SIDES)
    corners, normals = np.asarray(tower.triangles), np.asarray(tower.face_normals)
    angle = np.arctan2(normals[:, 1], normals[:, 0]) % (2.0 * np.pi)
    side_angle = 2.0 * np.pi / _TOWER_SIDES
    side = np.floor(angle / side_angle).astype(np.int64) % _TOWER_SIDES
    tangent = np.stack([-np.sin(angle), np.cos(angle), np.zeros(len(angle))], axis=1)
    u = np.einsum("tca,ta->tc", corners, tangent) + radius * (angle - side_angle * side)[:, None]
    texels = _TEXELS_PER_M_NEAR * np.stack([u, 0.5 * height - corners[:, :, 2]], axis=2)
    cap = np.abs(normals[:, 2]) > 0.5
    texels[cap] = _TEXELS_PER_M_NEAR * corners[cap][:, :, :2]
    size = (round(height * _TEXELS_PER_M_NEAR), round(radius * side_angle * _TEXELS_PER_M_NEAR))
    repeating = facade_texture(*size, 100, rng)
    parts = []
    for k, repeats in enumerate(_choose(_TOWER_SIDES, repeated, rng)):
        picture = repeating if repeats else facade_texture(*size, 100, rng)
        rows = side == k
        parts.append(_Part(corners[rows], texels[rows], normals[rows], picture))
    around_foot = 2.0 * np.pi * np.arange(10) / 10.0
    at = 2.0 * np.stack([np.cos(around_foot), np.sin(around_foot)], axis=1) + rng.uniform(-0.2, 0.2, (10, 2))
    ground = _ground((-8.0, -8.0), (8.0, 8.0), rng, floor)
    return [*parts, *_boxes(at, 0.45, rng, floor, _TEXELS_PER_M_NEAR), ground]


_BUILDERS: dict[Shape, Callable[[int, float, np.random.Generator], list[_Part]]] = {
    "ring": _ring,
    "facade": _facade,
    "drive": _drive,
    "courtyard": _courtyard,
}


def _house_maker(
    num_houses: int, height_m: float, repeated: float, rng: np.random.Generator
) -> Callable[[_Place], list[_Part]]:
    """Return what puts a house at each place it is given: at some the one that repeats, else a new one."""
    width = _HOUSE_WIDTH_M
    size = (round(height_m * _TEXELS_PER_M), round(width * _TEXELS_PER_M))

    def drawn() -> tuple[ByteArray, FloatArray, FloatArray]:
        picture = facade_texture(*size, round(_STORY_M * _TEXELS_PER_M), rng)
        count = round(width * height_m / 12.0)
        low = rng.uniform([0.2, 0.0, 1.0], [width - 1.2, 0.0, height_m - 1.5], (count, 3))
        extent = rng.uniform([0.5, 0.2, 0.3], [1.0, 0.7, 0.9], (count, 3))
        return picture, low, extent

    repeating = drawn()
    repeats = iter(_choose(num_houses, repeated, rng))

    def house(place: _Place) -> list[_Part]:
        picture, low, extent = repeating if next(repeats) else drawn()
        front = low - extent * [0.0, 1.0, 0.0]  # balconies stand out of the front
        balconies = [_box(place, a, a + e, picture) for a, e in zip(front, extent, strict=True)]
        return [_box(place, np.zeros(3), np.array([width, _HOUSE_DEPTH_M, height_m]), picture), *balconies]

    return house


def _choose(count: int, fraction: float, rng: np.random.Generator) -> list[bool]:
    """Return which of so many things are among a random fraction of them."""
    return list(rng.permutation(count) < round(fraction * count))


def _row(start: _Place, num_houses: int, maker: Callable[[_Place], list[_Part]]) -> list[_Part]:
    """Return houses side by side from a place on."""
    parts = []
    for k in range(num_houses):
        parts += maker(_Place(start.origin + k * _HOUSE_WIDTH_M * start.along, start.along))
    return parts


def _boxes(
    at: FloatArray,
    size_m: float,
    rng: np.random.Generator,
    floor_m: float = 0.0,
    texels_per_m: float = _TEXELS_PER_M,
) -> list[_Part]:
    """Return boxes of about a size, turned at random, with their centers at (k, 2) on the floor."""
    parts = []
    for x, y in at.tolist():
        angle = rng.uniform(0.0, 2.0 * np.pi)
        place = _Place(np.array([x, y, floor_m]), np.array([np.cos(angle), np.sin(angle), 0.0]))
        extent = size_m * rng.uniform(0.6, 1.4, 3)
        pixels = round(2.0 * size_m * texels_per_m)
        low = -0.5 * extent * [1.0, 1.0, 0.0]
        parts.append(_box(place, low, low + extent, ground_texture(pixels, pixels, rng), texels_per_m))
    return parts


def _ground(
    low: Sequence[float], high: Sequence[float], rng: np.random.Generator, level_m: float = 0.0
) -> _Part:
    """Return a slab whose upper side is the ground between two corners (x, y)."""
    size = np.subtract(high, low)
    density = min(_TEXELS_PER_M, _MOST_TEXELS / float(size.max()))
    width_px, height_px = np.ceil(density * size).astype(int).tolist()
    picture = ground_texture(height_px, width_px, rng)
    place = _Place(np.zeros(3), _ALONG_X)
    return _box(place, np.array([*low, level_m - 0.1]), np.array([*high, level_m]), picture, density)


def _box(
    place: _Place, low: FloatArray, high: FloatArray, picture: ByteArray, texels_per_m: float = _TEXELS_PER_M
) -> _Part:
    """Return a box between two corners in the axes of a place, each side showing the picture upright."""
    mesh = trimesh.creation.box(bounds=np.stack([low, high]))
    local, normals = np.asarray(mesh.triangles), np.asarray(mesh.face_normals)
    axis = np.argmax(np.abs(normals), axis=1)
    across, down = np.array([1, 0, 0])[axis], np.array([2, 2, 1])[axis]
    top = np.where(down == 2, high[2], high[1])[:, None]
    rows = np.arange(len(local))
    u, v = local[rows, :, across], top - local[rows, :, down]
    axes = place.axes()
    texels = texels_per_m * np.stack([u, v], axis=2)
    return _Part(local @ axes.T + place.origin, texels, normals @ axes.T, picture)
