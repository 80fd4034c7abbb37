"""The world in which a model is written: its own, that of a system of coordinates on Earth, or shifted.

Systems on Earth are curved, so that places and poses go there one by one: each camera by the turn and scale
that the system has where it stands. A model goes as one by what they are at its middle, and so keeps its
reprojection errors; `World.bend_statement` says how far its cameras then stand from their own coordinates.
"""

from dataclasses import dataclass, replace

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import FLOAT32_REACH, Similarity, median_spread, nearest_rotations
from sfm_shapefit.files.colmap.earth import epsg_code, to_epsg
from sfm_shapefit.files.lines import is_number
from sfm_shapefit.scene.given import EarthDatum
from sfm_shapefit.scene.images import Images

_STEP = 100.0  # meters, half the distance over which turn and scale are measured; the error is below 1e-9
_LARGEST = 1e9  # units; larger offsets would swallow the digits of coordinates
_LEAST_DECIMALS = -2  # digits; offsets that are found are multiples of 100 units, as surveyors choose them


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class World:
    """Where what is written stands."""

    datum: EarthDatum | None = None
    """Where the model's own axes are on Earth; None where no other system is asked for."""
    code: int = 0
    """EPSG code of the system; 0 without one."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What is subtracted from all coordinates."""

    @property
    def is_own(self) -> bool:
        """Whether it is the model's own, in which places and poses stay what they are, to the bit."""
        return self.datum is None and not any(self.offset)

    @property
    def offset_line(self) -> bytes:
        """The offset as Pix4D's offset.xyz has it; nothing if it is 0."""
        return "{!r} {!r} {!r}\n".format(*self.offset).encode() if any(self.offset) else b""

    @property
    def statement(self) -> str:
        """System and offset in words; empty for the model's own."""
        offset = "offset {!r} {!r} {!r}".format(*self.offset) if any(self.offset) else ""
        return ", ".join(filter(None, [f"EPSG:{self.code}" if self.code else "", offset]))

    def places(self, own: FloatArray) -> FloatArray:
        """Return places (k, 3) of the model where they stand."""
        there = own if self.datum is None else to_epsg(own, self.datum, self.code)
        return np.asarray(there - self.offset)

    def slopes(self, own: FloatArray) -> FloatArray:
        """Return the derivatives (k, 3, 3) of where places (k, 3) stand."""
        if self.datum is None:
            return np.tile(np.eye(3), (len(own), 1, 1))
        steps = _STEP * np.eye(3)
        ends = [self.places((own[:, None] + sign * steps).reshape(-1, 3)) for sign in (1.0, -1.0)]
        return np.asarray((ends[0] - ends[1]).reshape(-1, 3, 3).swapaxes(1, 2) / (2.0 * _STEP))

    def poses(self, images: Images) -> Images:
        """Return images where they stand, each for itself."""
        if self.is_own:
            return images
        turns = nearest_rotations(self.slopes(images.centers)).swapaxes(1, 2)
        order = np.argsort(images.ids)  # as the frames are when images are apart
        return images.apart().posed((images.rotations @ turns)[order], self.places(images.centers)[order])

    def similarity(self, centers: FloatArray) -> Similarity:
        """Return how a model with cameras at centers (k, 3) goes there as one."""
        middle = np.median(centers, axis=0)[None]
        if self.datum is None:
            return Similarity(scale=1.0, rotation=np.eye(3), translation=-np.array(self.offset))
        slope = self.slopes(middle)
        scale, rotation = float(np.cbrt(np.linalg.det(slope[0]))), nearest_rotations(slope)[0]
        shift = (self.places(middle) - scale * middle @ rotation.T)[0]
        return Similarity(scale=scale, rotation=rotation, translation=shift)

    def bend_statement(self, centers: FloatArray) -> str:
        """Say how far cameras stand from their own coordinates where their model goes as one, if they do."""
        off = self.similarity(centers).apply(centers) - self.places(centers)
        most = float(np.linalg.norm(off, axis=1).max(initial=0.0))
        return (
            f"; as one model, up to {most:.2g} m from the coordinates of each camera" if most > 1e-3 else ""
        )


def world_of(datum: EarthDatum | None, centers: FloatArray, crs: str, offset: str) -> World:
    """Return the world in which a model is to be written.

    Args:
        datum: that of the model; None without.
        centers: (k, 3) of its cameras.
        crs: a system as of `epsg_code`; empty for the model's own axes.
        offset: three numbers with commas between them, or auto: the cameras' middle in round numbers, near
            enough for float32.

    Raises:
        InputError: if nothing says where on Earth the model stands, or `crs` or `offset` is none.
    """
    world = World()
    if crs:
        if datum is None:
            raise InputError(
                "the model has no datum, so that nothing says where on Earth it is; convert the output "
                "of locate or map with priors or control points of known latitude and longitude"
            )
        world = World(datum=datum, code=epsg_code(crs, datum))
    if offset == "auto":
        x, y, z = _round_middle(world.places(centers))
    elif offset:
        words = offset.replace(",", " ").split()
        if len(words) != 3 or not all(is_number(word) and abs(float(word)) < _LARGEST for word in words):
            raise InputError(f"the offset must be auto, or three numbers as 481300,5782900,0; got {offset!r}")
        x, y, z = map(float, words)
    return replace(world, offset=(x, y, z)) if offset else world


def float32_world(places: FloatArray, offset: str) -> World:
    """Return the world of a model for programs that read float32: its own, or with an offset.

    Args:
        places: (k, 3) of its cameras and points.
        offset: three numbers, or auto: one that is found where float32 is too coarse, else none.

    Raises:
        InputError: if `offset` is none.
    """
    return World() if offset == "auto" and not is_too_far(places) else world_of(None, places, "", offset)


def _round_middle(places: FloatArray) -> list[float]:
    """Return the median of places (k, 3), rounded to hundreds or, in a smaller scene, as float32 needs."""
    spread, decimals = median_spread(places), _LEAST_DECIMALS
    if spread > 0.0:
        decimals = max(decimals, int(np.ceil(-np.log10(FLOAT32_REACH * spread))))
    rounded: list[float] = (np.round(np.median(places, axis=0), decimals) + 0.0).tolist()
    return rounded


def is_too_far(places: FloatArray) -> bool:
    """Return whether places (k, 3) are so far from the origin that float32 is too coarse for their scene."""
    spread = median_spread(places)
    return 0.0 < FLOAT32_REACH * spread < float(np.abs(np.median(places, axis=0)).max())
