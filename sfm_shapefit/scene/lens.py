"""Lenses of any of COLMAP's models, those that an adjustment may change, and how far given ones may be off.

What is adjusted are the five cases of OPENCV:

u = x/z, v = y/z, s = u^2 + v^2,
pixel = (fx (u (1 + k1 s + k2 s^2) + 2 p1 u v + p2 (s + 2 u^2)) + cx,
         fy (v (1 + k1 s + k2 s^2) + 2 p2 u v + p1 (s + 2 v^2)) + cy).
"""

from dataclasses import dataclass, replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import normalized

_FX, _FY, _CX, _CY, _K1, _K2, _P1, _P2 = range(8)


NUM_VALUES = 8  # parameters of the OPENCV model: fx, fy, cx, cy, k1, k2, p1, p2

# For each model, the place of each of its parameters among OPENCV's; -1 stands for fx and fy at once.
_PLACES = {
    "SIMPLE_PINHOLE": (-1, _CX, _CY),
    "PINHOLE": (_FX, _FY, _CX, _CY),
    "SIMPLE_RADIAL": (-1, _CX, _CY, _K1),
    "RADIAL": (-1, _CX, _CY, _K1, _K2),
    "OPENCV": (_FX, _FY, _CX, _CY, _K1, _K2, _P1, _P2),
}
_ONE_FOCAL_LENGTH = ("SIMPLE_", "RADIAL")  # how the names of models with a single focal length begin

# Newton steps that undo a distortion at most, and their length over the focal length at which they end;
# double precision is reached.
_MOST_STEPS, _STILL = 30, 1e-12
_SAME_RAYS = 0.01  # difference of unit rays; more makes relative rotations worth measuring anew
_PIXELS_A_SLICE = 20_000  # pixels undistorted at once; their arrays stay in the cache

LARGEST_SIGMA = 0.02  # relative sigma of a focal length; above it, the observations leave it open
# Factor by which the errors that keypoints share make those of a focal length larger than the noise alone
# does; measured on kitti-turn, driven straight ahead for the greatest part.
_SHARED_NOISE = 7.0
_CONTRADICTION = 10.0  # sigmas, of the noise and of what was given; as many are no chance
# Factor of the focal length, and largest coefficient of the distortion; a lens beyond has run away.
_MOST_OFF, _MOST_DISTORTION = 6.0, 2.0


class Origin(Enum):
    """Where the intrinsics of a camera come from; the value names it in words."""

    GUESS = "a guess"
    EXIF = "EXIF data"
    CALIBRATION = "given"


class LensPart(NamedTuple):
    """Parameters of a lens that are free, or held, together."""

    places: slice
    """Where they are among those of the OPENCV model."""
    sigmas: dict[Origin, float]
    """Standard deviation of each as it was given."""
    is_relative: bool = False
    """Whether that is a share of the parameter."""


PARTS = {
    "focal_lengths": LensPart(
        slice(0, 2), {Origin.GUESS: 0.3, Origin.EXIF: 0.15, Origin.CALIBRATION: 0.01}, is_relative=True
    ),
    "distortion": LensPart(slice(4, 8), {Origin.GUESS: 0.1, Origin.EXIF: 0.1, Origin.CALIBRATION: 0.01}),
}
"""What adjustments may free of a lens, as `AdjustmentOptions` say by the same name after free_."""
FOCAL = 0  # which of these the focal lengths are: a lens is judged by them
FOCAL_LENGTHS, _DISTORTION = PARTS["focal_lengths"].places, PARTS["distortion"].places


@dataclass(frozen=True, slots=True)
class Lens:
    """The intrinsics that one or several cameras look through."""

    model: str
    """COLMAP's name of it. What is said of OPENCV below holds for its cases only."""
    parameters: tuple[float, ...]
    """In COLMAP's order: focal lengths, principal point, distortion; lengths in pixels."""
    fixed: bool | tuple[bool, ...] = False
    """Whether it stays what it is even where lenses are free, or whether each of its `PARTS` does."""
    id: int = 0
    """COLMAP's id of the camera."""
    width: int = 0
    """Width of the pictures, in pixels; 0 if unknown, as is the height."""
    height: int = 0
    origin: Origin | None = None
    """Where its parameters came from; None if they are not in doubt."""
    given: tuple[float, ...] = ()
    """Parameters as they were given, of a lens in doubt."""
    sigmas: tuple[float, ...] = ()
    """Standard deviation of each of `PARTS` as it was given, of a lens in doubt."""

    @property
    def is_adjustable(self) -> bool:
        """Whether the model is a case of OPENCV; images through others are undistorted to be adjusted."""
        return self.model in _PLACES

    @property
    def is_panorama(self) -> bool:
        """Whether its pictures show all directions, as longitude and latitude."""
        return self.model == "EQUIRECTANGULAR"

    @property
    def focal_px(self) -> float:
        """Mean focal length; of an equirectangular picture, which has none, its pixels per radian."""
        if self.is_panorama:
            return self.parameters[0] / (2.0 * np.pi)  # its width covers a full turn
        has_one = self.model.startswith(_ONE_FOCAL_LENGTH)
        return self.parameters[0] if has_one else (self.parameters[0] + self.parameters[1]) / 2.0

    def offsets_px(self, found: FloatArray, seen: FloatArray) -> FloatArray:
        """Return how far pixels `found` are from those `seen`, (k, 2).

        In a panorama the left edge is the right one, and offsets along a circle of latitude, which is as long
        as the equator there, are as long as on the sphere.
        """
        off = found - seen
        if self.is_panorama:
            width, height = self.parameters
            off[:, 0] -= width * np.rint(off[:, 0] / width)
            off[:, 0] *= np.cos(np.pi * (seen[:, 1] / height - 0.5))
        return off

    def refuse_impossible(self) -> None:
        """Raise InputError if the lens cannot be adjusted, or has impossible parameters."""
        if not self.is_adjustable:
            known = ", ".join(_PLACES)
            raise InputError(
                f"lens model {self.model} cannot be adjusted; undistort it, or give one of {known}"
            )
        wanted = len(_PLACES[self.model])
        if len(self.parameters) != wanted or not np.isfinite(self.parameters).all():
            raise InputError(f"a lens of model {self.model} takes {wanted} finite parameters")
        if min(self.values()[:2]) <= 0.0:
            raise InputError("a lens has a focal length that is not positive; correct its parameters")

    def values(self) -> FloatArray:
        """Return the parameters of the same lens as OPENCV model, (8,)."""
        values = np.zeros(NUM_VALUES)
        for place, parameter in zip(_PLACES[self.model], self.parameters, strict=True):
            values[[_FX, _FY] if place < 0 else place] = parameter
        return values

    def with_values(self, values: FloatArray) -> "Lens":
        """Return the lens of this model whose OPENCV parameters are `values`, (8,)."""
        kept = [float(values[max(place, 0)]) for place in _PLACES[self.model]]
        return replace(self, parameters=tuple(kept))

    def own_values(self) -> BoolArray:
        """Return which of OPENCV's parameters the model states by itself, (8,): fy is none where it is fx."""
        own = np.zeros(NUM_VALUES, np.bool_)
        own[[max(place, 0) for place in _PLACES[self.model]]] = True
        return own

    def undistort(self, pixels: FloatArray) -> FloatArray:
        """Return x/z and y/z (m, 2) of the rays of pixels (m, 2), by Newton's method; NaN where it fails."""
        fx, fy, cx, cy, *distortion = self.values().tolist()
        distorted: FloatArray = (pixels - [cx, cy]) / [fx, fy]
        if not any(distortion):
            return distorted
        found = np.empty_like(distorted)
        for first in range(0, len(found), _PIXELS_A_SLICE):
            part = slice(first, first + _PIXELS_A_SLICE)
            found[part] = _undistort(distorted[part].T, *distortion).T
        return found

    def differs_in_rays(self, other: "Lens") -> bool:
        """Return whether the unit rays of a corner or of edges differ by a hundredth from those of another.

        Lenses that cannot be adjusted differ if their parameters do.
        """
        if self.parameters == other.parameters or not (self.is_adjustable and other.is_adjustable):
            return self.parameters != other.parameters
        w, h = self.width, self.height
        pixels = np.array([[w, h], [w, 0.5 * h], [0.5 * w, h]], dtype=np.float64)
        rays, those = (
            normalized(np.insert(lens.undistort(pixels), 2, 1.0, axis=1)) for lens in (self, other)
        )
        return not bool(np.abs(rays - those).max() <= _SAME_RAYS)  # NaN differs too

    def slots(self, free: BoolArray) -> IntArray:
        """Return which unknown each OPENCV parameter is, (8,), by the `PARTS` free; -1 for those held."""
        slots, moves = np.full(NUM_VALUES, -1), np.zeros(NUM_VALUES, np.bool_)
        for part, is_free in zip(PARTS.values(), free & ~np.array(self.fixed), strict=True):
            moves[part.places] = is_free
        for unknown, place in enumerate(p for p in _PLACES[self.model] if moves[max(p, 0)]):
            slots[[_FX, _FY] if place < 0 else place] = unknown
        return slots

    def in_doubt(self, origin: Origin) -> "Lens":
        """Return the lens told how far it may be off as it stands, by where it comes from."""
        sigmas = tuple(part.sigmas[origin] for part in PARTS.values())
        return replace(self, origin=origin, given=self.parameters, sigmas=sigmas)

    def as_given(self) -> "Lens":
        """Return the lens with the parameters that were given."""
        return replace(self, parameters=self.given)

    @property
    def own_parts(self) -> list[bool]:
        """Whether the model has each of `PARTS`."""
        return [bool(self.own_values()[part.places].any()) for part in PARTS.values()]

    def information(self) -> FloatArray:
        """Return the inverse variances of the OPENCV parameters as given, (8,); 0 for those always held."""
        information = np.zeros(NUM_VALUES)
        for part, sigma in zip(PARTS.values(), self.sigmas, strict=True):
            size = self.as_given().values()[part.places] if part.is_relative else 1.0
            information[part.places] = (sigma * size) ** -2.0
        return information

    def is_credible(self, sigma: float) -> bool:
        """Return whether an adjusted lens is to be believed, its focal length known to `sigma` by the noise.

        It is to be known better than what was given, or to contradict that clearly. A lens that has run away,
        beyond what any lens given so is off by, is not believed either.
        """
        ratio = self.values()[0] / self.as_given().values()[0]
        sound = bool(np.abs(self.values()[_DISTORTION]).max() <= _MOST_DISTORTION)
        sound = sound and 1.0 / _MOST_OFF <= ratio <= _MOST_OFF
        better = _SHARED_NOISE * sigma <= self.sigmas[FOCAL]
        contradicts = abs(ratio - 1.0) >= _CONTRADICTION * max(sigma, self.sigmas[FOCAL])
        return sound and sigma <= LARGEST_SIGMA and (better or contradicts)


def _undistort(distorted: FloatArray, k1: float, k2: float, p1: float, p2: float) -> FloatArray:
    """Return the points (2, m) that a lens of focal length 1 maps to `distorted`; NaN where there is none."""
    u, v = distorted.copy()
    step = np.full_like(u, np.inf)
    with np.errstate(all="ignore"):
        for _ in range(_MOST_STEPS):
            s, uv = u * u + v * v, u * v
            radial, slope = 1.0 + s * (k1 + k2 * s), 2.0 * (k1 + 2.0 * k2 * s)
            off_u = u * radial + 2.0 * p1 * uv + p2 * (s + 2.0 * u * u) - distorted[0]
            off_v = v * radial + 2.0 * p2 * uv + p1 * (s + 2.0 * v * v) - distorted[1]
            uu = radial + slope * u * u + 2.0 * p1 * v + 6.0 * p2 * u
            vv = radial + slope * v * v + 2.0 * p2 * u + 6.0 * p1 * v
            cross = slope * uv + 2.0 * (p1 * u + p2 * v)
            determinant = uu * vv - cross * cross
            step_u = (vv * off_u - cross * off_v) / determinant
            step_v = (uu * off_v - cross * off_u) / determinant
            u, v, step = u - step_u, v - step_v, np.hypot(step_u, step_v)
            if not (step > _STILL).any():
                break
        # Beyond the first extremum of r (1 + k1 r^2 + k2 r^4) the picture is folded. That is at the least
        # positive root of 1 + 3 k1 s + 5 k2 s^2, found by way of 1 / s, as k1 and k2 may be next to none.
        root = np.sqrt(9.0 * k1 * k1 - 20.0 * k2)  # NaN where there is none
        folds = 2.0 / (-3.0 * k1 + np.array([root, -root]))
    largest = np.min(folds, where=folds > 0.0, initial=np.inf)
    return np.where((step <= _STILL) & (u * u + v * v <= largest), [u, v], np.nan)


class LensErrors(NamedTuple):
    """What covariances take errors of the lenses for."""

    score: float
    """Standard score of smooth errors that all images of a lens share, the largest of all lenses'."""
    own_px: float
    """Root of the mean square of the smooth errors of an image of its own; 0 where the lenses fit."""
    shared_px: float
    """The same of those that all images of a lens share, the largest of all lenses'."""
