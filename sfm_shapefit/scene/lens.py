"""Lenses of any of COLMAP's models, those that an adjustment may change, and how far given ones may be off.

Five models are cases of OPENCV:

u = x/z, v = y/z, s = u^2 + v^2,
pixel = (fx (u (1 + k1 s + k2 s^2) + 2 p1 u v + p2 (s + 2 u^2)) + cx,
         fy (v (1 + k1 s + k2 s^2) + 2 p2 u v + p1 (s + 2 v^2)) + cy).

Projections of the others stand in `scene.wide_lenses`. Numbers of a lens that an adjustment may change are
its first eight, its values: fx, fy, cx, cy, and its first four coefficients, of OPENCV k1, k2, p1, p2.
"""

from dataclasses import dataclass, replace
from enum import Enum
from typing import Annotated, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.base.record import Record
from sfm_shapefit.scene.wide_lenses import (
    ANGLE,
    DIVISION,
    EUCM,
    FOV,
    KIND,
    PLANE,
    RAD_TAN,
    RATIONAL,
    ROW,
    THIN_PRISM,
    write_rays,
)

NUM_VALUES = 8  # numbers of a lens that may change; two focal lengths and four coefficients fill a node


class _Model(NamedTuple):
    """What the parameters of a model are, in COLMAP's order: focal lengths, cx, cy, coefficients."""

    kind: int
    """Its projection, see `scene.wide_lenses`."""
    num_focal: int
    num_coefficients: int
    bends: tuple[float, ...] = ()
    """First coefficients to be tried where a lens that was guessed a plane may be a fisheye."""


_LENS_MODELS = {
    "SIMPLE_PINHOLE": _Model(PLANE, 1, 0),
    "PINHOLE": _Model(PLANE, 2, 0),
    "SIMPLE_RADIAL": _Model(PLANE, 1, 1),
    "RADIAL": _Model(PLANE, 1, 2),
    "OPENCV": _Model(PLANE, 2, 4),
    "FULL_OPENCV": _Model(RATIONAL, 2, 8),
    "SIMPLE_FISHEYE": _Model(ANGLE, 1, 0),
    "FISHEYE": _Model(ANGLE, 2, 0),
    "SIMPLE_RADIAL_FISHEYE": _Model(ANGLE, 1, 1),
    "RADIAL_FISHEYE": _Model(ANGLE, 1, 2),
    "OPENCV_FISHEYE": _Model(ANGLE, 2, 4),
    "THIN_PRISM_FISHEYE": _Model(THIN_PRISM, 2, 8),
    "RAD_TAN_THIN_PRISM_FISHEYE": _Model(RAD_TAN, 2, 12),
    "FOV": _Model(FOV, 2, 1, (0.5, 1.0, 1.5)),
    "SIMPLE_DIVISION": _Model(DIVISION, 1, 1, (-0.1, -0.3)),
    "DIVISION": _Model(DIVISION, 2, 1, (-0.1, -0.3)),
    "EUCM": _Model(EUCM, 2, 2, (0.4, 0.7)),
}
"""All of pycolmap 4.2 but for EQUIRECTANGULAR, which has nothing to free."""
ADJUSTED_ELSEWHERE = "intrinsics of this model are not adjusted here, but by COLMAP's bundle_adjuster"
"""What is said of a model that a later pycolmap may bring."""
_ONE_FOCAL_LENGTH = ("SIMPLE_", "RADIAL")  # how names of models that are not known begin, if they have one

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
# The same for lenses that are no case of OPENCV, whose coefficients are of any size: factor by which these
# may change the angle of a ray, and share of the largest circle in the picture up to which that is asked,
# since pictures of fisheyes end before its corners.
_MOST_BENT, _ASKED_SHARE = 3.0, 0.7


class Origin(Enum):
    """Where the intrinsics of a camera come from; the value names it in words."""

    GUESS = "a guess"
    EXIF = "EXIF data"
    CALIBRATION = "given"


class LensPart(NamedTuple):
    """Parameters of a lens that are free, or held, together."""

    places: slice
    """Where they are among the values of a lens."""
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
    """COLMAP's name of it. What is said of values holds for those that an adjustment may change."""
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
        """Whether an adjustment knows the model; images through others are undistorted to be adjusted."""
        return self.model in _LENS_MODELS

    @property
    def is_plane(self) -> bool:
        """Whether the model is a case of OPENCV: its rays point ahead, by x/z and y/z."""
        return self.is_adjustable and _LENS_MODELS[self.model].kind == PLANE

    @property
    def is_angular(self) -> bool:
        """Whether the distance from the center of its pictures grows with the angle, as of fisheyes."""
        if self.is_adjustable:
            return _LENS_MODELS[self.model].kind in (ANGLE, THIN_PRISM, RAD_TAN, FOV)
        return self.is_panorama or "FISHEYE" in self.model

    @property
    def bends(self) -> tuple[float, ...]:
        """First coefficients that make a fisheye of the lens, to be tried; empty of most models."""
        return _LENS_MODELS[self.model].bends if self.is_adjustable else ()

    @property
    def is_panorama(self) -> bool:
        """Whether its pictures show all directions, as longitude and latitude."""
        return self.model == "EQUIRECTANGULAR"

    @property
    def focal_widths(self) -> float:
        """Focal length over the longer side of the picture; NaN where its size is not known."""
        longer = max(self.width, self.height)
        return self.focal_px / longer if longer else np.nan

    @property
    def focal_px(self) -> float:
        """Mean focal length; of an equirectangular picture, which has none, its pixels per radian."""
        count = self._num_focal
        # The width of a panorama covers a full turn.
        return sum(self.parameters[:count]) / count if count else self.parameters[0] / (2.0 * np.pi)

    @property
    def _num_focal(self) -> int:
        """Number of focal lengths, which are the first parameters."""
        if self.is_adjustable:
            return _LENS_MODELS[self.model].num_focal
        return 0 if self.is_panorama else 2 - self.model.startswith(_ONE_FOCAL_LENGTH)

    def split_parameters(self) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
        """Return focal lengths, principal point and distortion."""
        count = self._num_focal
        return self.parameters[:count], self.parameters[count : count + 2], self.parameters[count + 2 :]

    def bent(self, coefficient: float) -> "Lens":
        """Return the lens with another first coefficient."""
        first = self._num_focal + 2
        return replace(
            self, parameters=(*self.parameters[:first], coefficient, *self.parameters[first + 1 :])
        )

    def longer(self, factor: float) -> "Lens":
        """Return the lens with focal lengths that are some factor larger."""
        count = self._num_focal
        scaled = (factor * length for length in self.parameters[:count])
        return replace(self, parameters=(*scaled, *self.parameters[count:]))

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
            known = ", ".join(_LENS_MODELS)
            raise InputError(
                f"lens model {self.model} cannot be adjusted; undistort it, or give one of {known}"
            )
        known_as = _LENS_MODELS[self.model]
        wanted = 2 + known_as.num_focal + known_as.num_coefficients
        if len(self.parameters) != wanted or not np.isfinite(self.parameters).all():
            raise InputError(f"a lens of model {self.model} takes {wanted} finite parameters")
        if min(self.values()[:2]) <= 0.0:
            raise InputError("a lens has a focal length that is not positive; correct its parameters")

    def row(self) -> FloatArray:
        """Return the numbers that a projection takes, (17,), see `scene.wide_lenses`; values come first."""
        kind, num_focal, *_ = _LENS_MODELS[self.model]
        row, others = np.zeros(ROW), self.parameters[num_focal:]
        row[0], row[1], row[KIND] = self.parameters[0], self.parameters[num_focal - 1], kind
        row[2 : 2 + len(others)] = others
        return row

    def values(self) -> FloatArray:
        """Return the numbers that an adjustment may change, (8,)."""
        return self.row()[:NUM_VALUES]

    def with_values(self, values: FloatArray) -> "Lens":
        """Return the lens of this model that has other values, (8,)."""
        parameters = values[self.own_values()].tolist()
        return replace(self, parameters=(*parameters, *self.parameters[len(parameters) :]))

    def own_values(self) -> BoolArray:
        """Return which of the values the model states by itself, (8,): fy is none where it is fx."""
        chosen = np.zeros(NUM_VALUES, np.bool_)
        if self.is_adjustable:
            _, num_focal, num_coefficients, _ = _LENS_MODELS[self.model]
            chosen[: 4 + num_coefficients] = True
            chosen[1] = num_focal == 2
        return chosen

    def undistort(self, pixels: FloatArray) -> FloatArray:
        """Return x/z and y/z (m, 2) of the rays of pixels (m, 2), by Newton's method; NaN where it fails.

        The model is a case of OPENCV.
        """
        fx, fy, cx, cy, *distortion = self.values().tolist()
        distorted: FloatArray = (pixels - [cx, cy]) / [fx, fy]
        if not any(distortion):
            return distorted
        points = np.empty_like(distorted)
        for first in range(0, len(points), _PIXELS_A_SLICE):
            part = slice(first, first + _PIXELS_A_SLICE)
            points[part] = _undistort(distorted[part].T, *distortion).T
        return points

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Return the unit rays (m, 3) of pixels (m, 2); NaN for those that have none."""
        if self.is_plane:
            return normalized(np.insert(self.undistort(pixels), 2, 1.0, axis=1))
        rays = np.empty((len(pixels), 3))
        write_rays(self.row(), np.ascontiguousarray(pixels, dtype=np.float64), rays)
        return rays

    def differs_in_rays(self, other: "Lens") -> bool:
        """Return whether the unit rays of a corner or of edges differ by a hundredth from those of another.

        Lenses that cannot be adjusted differ if their parameters do.
        """
        if self.parameters == other.parameters or not (self.is_adjustable and other.is_adjustable):
            return self.parameters != other.parameters
        w, h = self.width, self.height
        pixels = np.array([[w, h], [w, 0.5 * h], [0.5 * w, h]], dtype=np.float64)
        rays, those = (lens.rays(pixels) for lens in (self, other))
        if not self.is_plane:  # beyond the circle of a fisheye's picture there may be no ray
            rays, those = np.nan_to_num(rays), np.nan_to_num(those)
        return not bool(np.abs(rays - those).max() <= _SAME_RAYS)  # NaN differs too

    def slots(self, free: BoolArray) -> IntArray:
        """Return which unknown each value is, (8,), by the `PARTS` free; -1 for those held."""
        slots, moves = np.full(NUM_VALUES, -1), np.zeros(NUM_VALUES, np.bool_)
        for part, is_free in zip(PARTS.values(), free & ~np.array(self.fixed), strict=True):
            moves[part.places] = is_free
        chosen = self.own_values()
        slots[chosen & moves] = np.arange(np.sum(chosen & moves))
        if not chosen[1]:
            slots[1] = slots[0]
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
        """Return the inverse variances of the values as given, (8,); 0 for those always held."""
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
        sound = 1.0 / _MOST_OFF <= ratio <= _MOST_OFF and self._is_sound()
        better = _SHARED_NOISE * sigma <= self.sigmas[FOCAL]
        contradicts = abs(ratio - 1.0) >= _CONTRADICTION * max(sigma, self.sigmas[FOCAL])
        return sound and sigma <= LARGEST_SIGMA and (better or contradicts)

    def _is_sound(self) -> bool:
        if self.is_plane:
            return bool(np.abs(self.values()[_DISTORTION]).max() <= _MOST_DISTORTION)
        row = self.row()
        row[4:KIND] = 0.0
        most = 0.5 * _ASKED_SHARE * (min(self.width, self.height) or self.focal_px)
        turns = np.arange(8)[:, None, None] * (np.pi / 4.0)
        along = np.concatenate([np.cos(turns), np.sin(turns)], axis=2)
        pixels = (row[2:4] + most * np.linspace(0.25, 1.0, 4)[:, None] * along).reshape(-1, 2)
        rays, ideal = self.rays(pixels), np.empty((len(pixels), 3))
        write_rays(row, pixels, ideal)
        angles, those = (np.arctan2(np.hypot(r[:, 0], r[:, 1]), r[:, 2]).reshape(8, 4) for r in (rays, ideal))
        grows = bool((np.diff(angles, axis=1) > 0.0).all())  # NaN does not
        return grows and bool((np.abs(np.log(angles / those)) <= np.log(_MOST_BENT)).all())


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


class LensErrors(Record):
    """What the standard deviations take smooth errors of the lenses for, by what the residuals say."""

    score: Annotated[
        float,
        "Standard score of errors that all images of a lens share, the largest; up to 3 they are noise, "
        "from 4 on they count in full.",
    ]
    own_px: Annotated[float, "Errors of an image of its own, root of the mean square in pixels; 0 if none."]
    shared_px: Annotated[float, "The same of errors that all images of a lens share."]
