"""Lenses that cannot be, or hardly: by their focal length, their distortion over the picture, and like ones.

A pixel at the distance rho from the principal point, in focal lengths at the center of the picture, sees a
ray at the angle theta from the axis. All lenses that are made lie between two limits:

    sin theta <= rho <= tan theta        the orthographic fisheye, and the perspective of a pinhole

Zoom and telephoto lenses are beyond either by a few percent. So a lens cannot be if somewhere in the picture
rho is less than 0.95 sin theta or more than 1.5 tan theta (a flat port under water, as wide as they are made,
has 1.3), if its distortion turns back within the circle around the center that touches the nearer edges, or
if it has 150 degrees or more along the longer edge without the compression of a fisheye, where light falls to
cos^4 theta = 0.4 %, or pixels finer than 0.5 seconds of arc, which the air blurs. Beyond 1.15 tan theta it is
unusual, as where COLMAP drops images for parameters that change distances by more than a tenth. A long focal
length alone, or large coefficients that cancel, are neither.

Where there are points, it is to deviate by more than fits (4 px) at the distance within which 95 % of them
lie: in small pictures, and where an object fills their middle, coefficients say nothing of the corners.

Focal lengths of images that one device took (`scene.sequences`) differ by a tenth, by the median, only if
they are not determined or if it zoomed. On nine sound models, each of whose images had a lens of its own,
they differ by 0.05 % to 4 %. Several devices under one numbering, several lenses of a telephone and settings
of a zoom make few values that return, each known well beside its distance to the next; drawn focal lengths do
so in 2 % of the cases for ten images, less often for other numbers.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, distinct, quantile
from sfm_shapefit.base.geometry import SIGMA_PER_MEDIAN
from sfm_shapefit.base.lists import RowLists
from sfm_shapefit.judgement.evidence import OddImages
from sfm_shapefit.judgement.limits import (
    FITTING_PX,
    LOCAL_SHARE,
    RIVAL_SHARE,
    SIGMAS,
    SMALLEST_SHAPE,
    SURE_SIGMAS,
)
from sfm_shapefit.judgement.reasons import Kind
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import PARTS, Lens, Origin
from sfm_shapefit.scene.sequences import find_sequences
from sfm_shapefit.scene.structure import Structure

_LEAST_OF_SINE, _MOST_OF_TANGENT, _USUAL_OF_TANGENT = 0.95, 1.5, 1.15  # factors of the limits; see the header
_WIDEST_DEG, _FINEST_PX = 150.0, 412_530.0  # degrees; focal length in pixels where one is 0.5 seconds of arc
_REACHED = 0.95  # share of the observations of a lens; those farther out are few, or false
_ASKED = 0.7  # share of the shorter side up to which fisheyes are asked; their pictures may end there
# Shares of the way to the edge where a lens is asked; at the first, there is no distortion yet.
_ALONG = np.array([0.02, 0.2, 0.4, 0.6, 0.8, 1.0])
# Ways to the edges and corners; distortion is largest along the diagonals.
_AROUND = np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [1, -1], [-1, 1], [-1, -1]], dtype=np.float64)


class LensShape(NamedTuple):
    """What a lens does to the picture."""

    focal_widths: float
    """Focal length over the longer side of the picture."""
    view_deg: float
    """Angle of view along the longer side; NaN where its edges have no ray."""
    folds: bool
    """Whether its distortion turns back within the circle that touches the nearer edges."""
    of_sine: float
    """Least rho / sin theta in the picture; see the module's header."""
    of_tangent: tuple[float, float]
    """Least and largest rho / tan theta in the picture."""
    off_px: tuple[float, float]
    """Pixels by which rho is short of sin theta, and exceeds tan theta, where points end; else infinite."""

    def fault(self, lens: Lens, is_bogus: bool) -> tuple[str, bool]:
        """Return what is wrong about the lens, and whether it cannot be; "" if nothing is."""
        (least, longer), (is_short, is_long) = self.of_tangent, (off > FITTING_PX for off in self.off_px)
        cx, cy = lens.row()[2:4].tolist()
        is_outside = not (0.0 <= cx <= lens.width and 0.0 <= cy <= lens.height)
        faults = {
            "pixels finer than the air lets any camera see": (lens.focal_px > _FINEST_PX, True),
            f"a straight picture {self.view_deg:.0f} degrees wide, which no lens makes": (
                self.view_deg >= _WIDEST_DEG and least > RIVAL_SHARE,
                True,
            ),
            "a distortion that turns back inside the picture": (self.folds, True),
            "a distortion that draws the edges in more than any fisheye does": (
                self.of_sine < _LEAST_OF_SINE and is_short,
                True,
            ),
            "a distortion that draws the corners out as no lens does": (
                longer > _MOST_OF_TANGENT and is_long,
                True,
            ),
            "a distortion that draws the corners out as hardly any lens does": (
                longer > _USUAL_OF_TANGENT and is_long,
                False,
            ),
            "a principal point outside the picture": (is_outside, False),
            "parameters for which COLMAP's mapper drops images": (
                is_bogus and abs(longer - 1.0) > LOCAL_SHARE and is_long,
                False,
            ),
        }
        return next(((what, cannot_be) for what, (is_so, cannot_be) in faults.items() if is_so), ("", False))


def measure_lens(lens: Lens, reach_px: float = np.nan) -> LensShape:
    """Return what a lens does to its picture; the model is one that can be adjusted.

    Its points end `reach_px` from the principal point; NaN if there are none.
    """
    focal, principal = lens.row()[:2], _middle(lens)
    ends = _AROUND[:4] * _ASKED * 0.5 * min(lens.width, lens.height)
    if lens.is_plane:
        ends = np.where(_AROUND > 0.0, [lens.width, lens.height] - principal, principal) * _AROUND
    ways = np.concatenate([(ends[:, None] * _ALONG[:, None]).reshape(-1, 2), reach_px * _AROUND[:4]])
    rays = lens.rays(lens.row()[2:4] + ways)
    theta = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    rho, asked = np.hypot(*(ways / focal).T), ends.shape[0] * len(_ALONG)
    with np.errstate(invalid="ignore", divide="ignore"):
        rho = rho * np.median(np.tan(theta[: asked : len(_ALONG)]) / rho[: asked : len(_ALONG)])
        straight = np.where(theta < 0.5 * np.pi, np.tan(theta), np.inf)
        bent = np.sin(np.minimum(theta, 0.5 * np.pi))
        along = np.diff(theta[:asked].reshape(len(ends), -1), axis=1)
        inside = np.hypot(*ways[:asked].T).reshape(len(ends), -1)[:, 1:] <= 0.5 * min(lens.width, lens.height)
        edges = theta[:asked].reshape(len(ends), -1)[:4, -1]
        wider = edges[:2] if lens.width >= lens.height else edges[2:]
        short, long, stretch = bent - rho, rho - straight, rho[:asked] / straight[:asked]
    off = np.stack([short[asked:], long[asked:]]) * focal.mean()
    return LensShape(
        focal_widths=lens.focal_widths,
        view_deg=float(np.degrees(wider.sum())) if lens.is_plane else np.nan,
        folds=bool((~(along > 0.0) & inside).any()),
        of_sine=float(np.nanmin(rho[:asked] / bent[:asked], initial=1.0)),
        of_tangent=(float(np.nanmin(stretch, initial=1.0)), float(np.nanmax(stretch, initial=0.0))),
        off_px=tuple(np.nan_to_num(off, nan=np.inf).max(axis=1).tolist()),
    )


def _middle(lens: Lens) -> FloatArray:
    """Return the principal point (2,) in pixels, or the center of the picture if it is not inside."""
    size, principal = np.array([lens.width, lens.height], dtype=np.float64), lens.row()[2:4]
    return principal if ((principal >= 0.0) & (principal <= size)).all() else 0.5 * size


def find_odd_lenses(structure: Structure, bogus: BoolArray) -> Iterator[OddImages]:
    """Yield the posed images whose lenses cannot be, or hardly, together by what is wrong about them.

    For `bogus` lenses (l,), COLMAP's mapper drops images (`Camera.has_bogus_params`).
    """
    images = structure.images
    posed = np.flatnonzero(images.is_posed)
    widths, faults = np.full(len(images.lenses), np.nan), dict[tuple[str, bool], list[int]]()
    reach_px = _reaches(structure)
    for k in distinct(images.lens_of[posed]).tolist():
        lens = images.lenses[k]
        if lens.is_adjustable and min(lens.width, lens.height) > 0:
            shape = measure_lens(lens, float(reach_px[k]))
            widths[k] = shape.focal_widths
            faults.setdefault(shape.fault(lens, bool(bogus[k])), []).append(k)
    faults.pop(("", False), None)
    for (fault, cannot_be), lenses in faults.items():
        cameras = posed[np.isin(images.lens_of[posed], lenses)]
        kind = "an impossible lens" if cannot_be else "an unusual lens"
        sentence = f"{kind}: focal length {{}} picture widths, with {fault}"
        names, own = images.names_of(cameras), widths[images.lens_of[cameras]]
        yield OddImages.of_values(Kind.LENS, names, own, sentence, cannot_be=cannot_be)
    for rows, _ in find_sequences([images.names[k] for k in posed.tolist()]):
        cameras = posed[rows]
        own = widths[images.lens_of[cameras]]
        if len(distinct(images.lens_of[cameras])) >= SMALLEST_SHAPE and np.isfinite(own).all():
            logs = np.log([own, images.focal_lengths_px[cameras]])
            if not any(map(_return_to_few, logs)):
                logs = np.abs(logs - np.median(logs, axis=1, keepdims=True))
                far, usual = logs.min(axis=0) > LOCAL_SHARE, np.median(own)
                sentence = "a lens unlike others of one device, as names say: focal length {} picture widths"
                sentence = f"{sentence}, where {usual:.3g} is usual"
                if far.any():
                    yield OddImages.of_values(Kind.LENS, images.names_of(cameras[far]), own[far], sentence)


def find_changed_lenses(images: Images, known_px: Mapping[int, float]) -> Iterator[OddImages]:
    """Yield the posed images whose focal lengths were known, and changed by more than 3 sigma of EXIF data.

    Known ones are in pixels, by the rows of their lenses.
    """
    factors = np.array([lens.focal_px / known_px.get(k, np.nan) for k, lens in enumerate(images.lenses)])
    most = SIGMAS * PARTS["focal_lengths"].sigmas[Origin.EXIF]
    cameras = np.flatnonzero(images.is_posed & (np.abs(factors - 1.0) > most)[images.lens_of])
    if len(cameras):
        sentence = (
            "a focal length {} times the one that was known, too far from it: is its distortion missing, or "
            "is a pose wrong?"
        )
        own = factors[images.lens_of[cameras]]
        yield OddImages.of_values(Kind.LENS, images.names_of(cameras), own, sentence)


def _return_to_few(logs: FloatArray) -> bool:
    """Return whether half of some logarithms are of one value, or nearly all of few; see the header."""
    ordered = np.sort(logs)
    groups = np.split(ordered, np.flatnonzero(np.diff(ordered) > LOCAL_SHARE) + 1)
    middles = [np.median(group) for group in groups]
    away = np.diff(middles, prepend=-np.inf, append=np.inf)
    most = np.minimum(LOCAL_SHARE, np.minimum(away[:-1], away[1:]) / SURE_SIGMAS)
    tight = [
        len(group)
        for group, limit in zip(groups, most.tolist(), strict=True)
        if len(group) >= SMALLEST_SHAPE and _scatter(group) <= limit
    ]
    return _scatter(logs) <= LOCAL_SHARE or sum(tight) >= (1.0 - LOCAL_SHARE) * len(logs)


def _scatter(logs: FloatArray) -> float:
    """Return the standard deviation of logarithms, by their median."""
    return SIGMA_PER_MEDIAN * float(np.median(np.abs(logs - np.median(logs))))


def _reaches(structure: Structure) -> FloatArray:
    """Return how far from the principal point of each lens its points reach, (l,) in pixels, or NaN."""
    lenses, lens_of = structure.images.lenses, structure.images.lens_of[structure.points.images]
    middles = np.array([_middle(lens) if lens.is_adjustable else (np.nan, np.nan) for lens in lenses])
    far = np.hypot(*(structure.pixels[:, axis] - middles[lens_of, axis] for axis in range(2)))
    own = RowLists.by_label(lens_of, len(lenses))
    return np.array([quantile(far[rows], _REACHED) if len(rows) else np.nan for rows in own])
