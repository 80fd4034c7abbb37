"""What a user knows of the images beside the matches: positions, control points, gravity; types only."""

from dataclasses import dataclass, fields, replace
from typing import Annotated, NamedTuple, Self

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, rows_taken
from sfm_shapefit.base.geometry import principal_lengths
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import first_of
from sfm_shapefit.scene.known_positions import KnownPositions


class EarthDatum(Record):
    """A point on the WGS84 ellipsoid: the origin of axes east, north and up, in meters."""

    latitude_deg: Annotated[float, "Geodetic latitude."]
    longitude_deg: Annotated[float, "Longitude, east of Greenwich."]
    altitude_m: Annotated[float, "Height above the ellipsoid, or what the priors give for it."]

    @property
    def geodetic(self) -> tuple[float, float, float]:
        """Latitude and longitude in degrees, and altitude in meters."""
        return self.latitude_deg, self.longitude_deg, self.altitude_m

    @property
    def statement(self) -> str:
        """What coordinates in these axes are, in words."""
        place = f"{self.latitude_deg:.6f}, {self.longitude_deg:.6f} deg, {self.altitude_m:.2f} m"
        return f"meters east, north and up of {place}"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PositionPriors:
    """Measured positions of some cameras, such as GPS, in axes and units of their own."""

    known: KnownPositions
    """By camera."""
    statement: str
    """Where they come from, and what their axes are."""
    datum: EarthDatum | None = None
    """Where their origin is on Earth, if that is known."""
    notes: tuple[str, ...] = ()
    """What was read otherwise than it stands, or not at all, a sentence each."""

    def of(self, cameras: IntArray) -> "PositionPriors":
        """Return the priors of some cameras (n,), ascending, numbered by their place among these."""
        return replace(self, known=self.known.among(cameras))

    def with_sigmas(self) -> "PositionPriors":
        """Return those whose standard deviation is known."""
        has_sigma: BoolArray = np.asarray(np.isfinite(self.known.information).all(axis=(1, 2)))
        return replace(self, known=rows_taken(self.known, has_sigma))

    def __len__(self) -> int:
        """Return how many cameras have one."""
        return len(self.known.indices)


FEWEST_CONTROL_POINTS = 3  # control points; fewer leave the axes open
_THIN = 1e-3  # width over length of control points; thinner ones say nothing of the turn about their line


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Marks:
    """Points, and where images show them."""

    names: tuple[str, ...]
    """(k,)"""
    points: IntArray
    """(m,) the point of each mark, ascending."""
    images: IntArray
    """(m,) the image that it is in; of one point ascending, each once."""
    pixels: FloatArray
    """(m, 2)"""
    statement: str
    """Where they come from, and what their axes are."""
    absent: tuple[str, ...] = ()
    """Images that the list names and the model lacks."""

    def of(self, images: IntArray) -> Self:
        """Return them with the marks in some images (n,), ascending, numbered by their place among these."""
        inside = np.isin(self.images, images)
        return replace(
            self,
            points=self.points[inside],
            images=np.searchsorted(images, self.images[inside]),
            pixels=self.pixels[inside],
        )

    def seen_twice(self) -> BoolArray:
        """Return which points have marks in two images, (k,)."""
        return np.bincount(self.points, minlength=len(self.names)) > 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControlPoints(Marks):
    """Points of known position."""

    positions: FloatArray
    """(k, 3) in axes and units of their own."""
    is_check: BoolArray
    """(k,) points that only check the model."""
    datum: EarthDatum | None = None
    """Where their origin is on Earth, if that is known."""

    def why_too_few(self) -> str:
        """Return why the points cannot set scale and axes, a clause; empty if they can."""
        usable = self.seen_twice() & ~self.is_check
        why = why_too_few(self.positions[usable], "have marks in two images of the model")
        lacking = f"; the model has no {first_of(self.absent)}" if self.absent else ""
        return f"{why}{lacking}" if why else ""


def why_too_few(positions: FloatArray, what: str) -> str:
    """Return why points (k, 3) alone cannot set scale and axes, a clause; empty if they can."""
    if len(positions) < FEWEST_CONTROL_POINTS:
        return f"{len(positions)} of the control points {what}, and scale and axes need three"
    lengths = principal_lengths(positions)
    if lengths[1] <= _THIN * lengths[0]:
        return f"the control points that {what} lie on a line, and axes need one beside it"
    return ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScaleBars(Marks):
    """Known distances between points: those 2 b and 2 b + 1 are the ends of bar b."""

    bars: tuple[str, ...]
    """(b,) names."""
    lengths: FloatArray
    """(b,) in the output's units."""
    sigmas: FloatArray
    """(b,) their standard deviations."""
    is_check: BoolArray
    """(b,) bars that only check the model."""
    places: tuple[str, ...]
    """(b,) file and line of each, to begin a sentence with."""

    @property
    def ends(self) -> IntArray:
        """The two points of each bar, (b, 2)."""
        return np.arange(2 * len(self.bars)).reshape(-1, 2)

    @property
    def are_seen(self) -> BoolArray:
        """Bars with a mark, (b,)."""
        return np.bincount(self.points // 2, minlength=len(self.bars)) > 0


class MarkedViews(NamedTuple):
    """How placed images see marks, each through a camera of its own."""

    rotations: FloatArray
    """(r, 3, 3) cam_from_world: of the image, or turned to the mark where that is not before the image."""
    centers: FloatArray
    """(r, 3)"""
    focal_lengths_px: FloatArray
    """(r,)"""
    rows: IntArray
    """(r,) the marks in placed images, by their place in `Marks`, ascending."""
    images: IntArray
    """(r,) image of each mark."""
    on_plane: FloatArray
    """(r, 2) normalized coordinates of each mark; NaN where it has no ray."""


class Gravity(NamedTuple):
    """Measured directions of gravity, in axes of cameras (x right, y down, z ahead)."""

    indices: IntArray
    """(k,) whose they are, ascending without repetition."""
    directions: FloatArray
    """(k, 3) unit vectors."""
    sigmas: FloatArray
    """(k,) standard deviations about each of two axes, in radians."""

    def of(self, images: IntArray) -> "Gravity":
        """Return those of some images (n,), ascending, numbered by their place among these."""
        _, rows, places = np.intersect1d(self.indices, images, assume_unique=True, return_indices=True)
        return rows_taken(self, rows)._replace(indices=places)

    def of_frames(self, frame_of_image: IntArray, sensor_rotations: FloatArray) -> "Gravity":
        """Return the gravities of frames, by the frame (n,) and sensor_from_rig (n, 3, 3) of each image.

        The most certain of several in a frame counts: sensors of one rig share their errors.
        """
        turned = np.einsum("kba,kb->ka", sensor_rotations[self.indices], self.directions)
        frames = frame_of_image[self.indices]
        order = np.lexsort((self.sigmas, frames))
        frames_seen, first = np.unique(frames[order], return_index=True)
        rows = order[first]
        return Gravity(frames_seen, turned[rows], self.sigmas[rows])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Known:
    """What a user knows of images beside the matches."""

    priors: PositionPriors | None = None
    control: ControlPoints | None = None
    bars: ScaleBars | None = None
    gravity: Gravity | None = None

    @property
    def sets_scale(self) -> bool:
        """Whether points or bars that images show are to set the scale."""
        return self.control is not None or (self.bars is not None and not self.bars.is_check.all())

    def of(self, images: IntArray) -> "Known":
        """Return what is told of some images (n,), ascending, numbered by their place among these."""
        columns = {field.name: getattr(self, field.name) for field in fields(self)}
        return Known(**{name: None if one is None else one.of(images) for name, one in columns.items()})


NOTHING_KNOWN = Known()
