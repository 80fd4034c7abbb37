"""Another place: do the rejected pairs of a camera agree on where it is instead?

The direction of a pair is a ray from the other camera, on which this one lies. The rays of pairs that are
wrong at random meet nowhere; those of coherent lies, as of repeated structure, meet where they put the
camera. Each two rejected rays have a point nearest to both; where most of them pass is the other place.

That it fits by chance is unlikely, but a camera that its pairs leave loose has many places. So the other one
counts if three pairs or more are for it, half as many at least as are for this one alone, if most pairs that
agree with this place do not pass there too. Directions that are a degree off in general tell no places.

castle-P19 and P30, 40 % of whose pairs are rejected, have no camera with another place, nor has any of 13
more scenes that are sound (`scripts/results/verdict.md` has spoiled ones).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.geometry import angle_between_deg, normalized
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import counted
from sfm_shapefit.judgement.limits import ALIKE_DEG, FEWEST_ALIKE, NEAR_DEG, RIVAL_SHARE, SIGMAS

_MOST_RAYS = 30  # rejected rays of a camera that define places, evenly taken; all of them count


class AmbiguousPlace(Record):
    """A camera that two sets of pairs put at two places."""

    image: Annotated[str, "Its name."]
    num_here: Annotated[int, "Pairs that put it where it is."]
    num_there: Annotated[int, "Pairs that agree on the other place."]
    offset: Annotated[tuple[float, ...], "The other place minus this one, in axes and units of the output."]
    pairs_here: tuple[tuple[str, str], ...] = ()
    """The pairs that put it here, and not there, by the names of their images."""

    def moved(self, scale: float, axes: FloatArray | None) -> "AmbiguousPlace":
        """Return the same in other units and, unless None, after a rotation (3, 3) of the axes."""
        offset = np.array(self.offset)
        offset = scale * (offset if axes is None else axes @ offset)
        return replace(self, offset=tuple(offset.tolist()))

    @property
    def statement(self) -> str:
        """The same in a sentence."""
        away = f"{self.num_there} put it {np.linalg.norm(self.offset):.3g} units away"
        if not self.num_here:
            return f"no pair puts {self.image} where it is, {away}"
        here = f"{counted(self.num_here, 'pair')} put{'s' if self.num_here == 1 else ''}"
        return (
            f"{here} {self.image} where it is, {away}: the scene repeats itself, or one of the sets is wrong"
        )


def find_other_places(
    names: Sequence[str],
    centers: FloatArray,
    pairs: IntArray,
    directions: FloatArray,
    agrees: BoolArray,
    level_deg: float,
) -> tuple[AmbiguousPlace, ...]:
    """Return the cameras for which many of their rejected pairs agree on another place.

    Args:
        names: (n,) of the cameras' images.
        centers: (n, 3) where cameras are; NaN for those that are not to be asked, or believed.
        pairs: (k, 2) cameras i, j.
        directions: (k, 3) measured unit directions of C_i - C_j.
        agrees: (k,) whether the pair agrees with the centers.
        level_deg: standard deviation of the agreeing residuals, per axis.
    """
    known = np.asarray(np.isfinite(centers).all(axis=1))
    inside = known[pairs].all(axis=1)
    pairs, directions, agrees = pairs[inside], directions[inside], agrees[inside]
    near_deg = max(SIGMAS * level_deg, NEAR_DEG)
    if not (near_deg <= ALIKE_DEG and len(pairs)):
        return ()
    ends, rows = pairs.T.ravel(), np.tile(np.arange(len(pairs)), 2)
    order = np.argsort(ends, kind="stable")
    cameras, begins = np.unique(ends[order], return_index=True)
    found = []
    for camera, own in zip(cameras.tolist(), np.split(rows[order], begins[1:]), strict=True):
        num_right = int(agrees[own].sum())
        if len(own) - num_right < max(FEWEST_ALIKE, RIVAL_SHARE * (1.0 - RIVAL_SHARE) * num_right):
            continue  # even if all that are wrong met in one place
        signs = np.where(pairs[own, 0] == camera, 1.0, -1.0)[:, None]
        others = np.where(pairs[own, 0] == camera, pairs[own, 1], pairs[own, 0])
        sides = (agrees[own], ~agrees[own])
        right, wrong = (_Rays(centers[others[side]], (signs * directions[own])[side]) for side in sides)
        there, place = wrong.best_place(near_deg)
        both = right.pass_at(place[None], near_deg)[0]
        agreeing, shared = len(both), int(both.sum())
        is_enough = there >= max(FEWEST_ALIKE, RIVAL_SHARE * (agreeing - shared))
        if is_enough and shared <= RIVAL_SHARE * agreeing:
            here = tuple((names[i], names[j]) for i, j in pairs[own[agrees[own]][~both]].tolist())
            found.append(
                AmbiguousPlace(
                    image=names[camera],
                    num_here=len(here),
                    num_there=there,
                    offset=tuple((place - centers[camera]).tolist()),
                    pairs_here=here,
                )
            )
    return tuple(found)


class _Rays(NamedTuple):
    """Pairs of one camera, seen from the others."""

    origins: FloatArray
    """(k, 3) centers of the others."""
    directions: FloatArray
    """(k, 3) unit directions from there to the camera."""

    def pass_at(self, places: FloatArray, near_deg: float) -> BoolArray:
        """Return which rays pass at each of some places (m, 3), (m, k)."""
        towards = places[:, None] - self.origins
        with np.errstate(invalid="ignore"):  # a place at a center
            angles = angle_between_deg(np.broadcast_to(self.directions, towards.shape), normalized(towards))
        return np.asarray(angles <= near_deg)

    def best_place(self, near_deg: float) -> tuple[int, FloatArray]:
        """Return how many rays pass at the place where most of them do, and that place (3,)."""
        places = self._meetings()
        if not len(places):
            return 0, np.full(3, np.nan)
        counts = self.pass_at(places, near_deg).sum(axis=1)
        best = int(np.argmax(counts))
        return int(counts[best]), places[best]

    def _meetings(self) -> FloatArray:
        """Return the points (m, 3) that are nearest to two rays each."""
        count, taken = len(self.origins), min(len(self.origins), _MOST_RAYS)
        a, b = (side * count // max(taken, 1) for side in np.triu_indices(taken, 1))
        u, v, between = self.directions[a], self.directions[b], self.origins[b] - self.origins[a]
        cosine = np.einsum("ka,ka->k", u, v)
        square = 1.0 - cosine**2
        wide = square > np.sin(np.radians(ALIKE_DEG)) ** 2  # flatter ones cut anywhere
        u, v, between, cosine, square = u[wide], v[wide], between[wide], cosine[wide], square[wide]
        along_u, along_v = np.einsum("ka,ka->k", u, between), np.einsum("ka,ka->k", v, between)
        s, t = (along_u - cosine * along_v) / square, (cosine * along_u - along_v) / square
        first = self.origins[a[wide]] + s[:, None] * u
        second = self.origins[b[wide]] + t[:, None] * v
        return np.asarray(0.5 * (first + second))
