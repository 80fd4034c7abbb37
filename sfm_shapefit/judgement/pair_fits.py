"""How the directions of pairs fit where cameras stand.

A pair agrees with where its cameras stand if its direction is off their baseline by at most a degree, or six
times what is usual, but never more than two degrees, lest a model that is wrong throughout set the limit by
which it is judged; and by three of its own standard deviations where these are more. It contradicts if it is
farther off and knows its direction to a degree, or if most of its matches contradict the rotations, so that
it has none at all. Half of the pairs between fisheyes in a park know theirs worse, and are off by 40 degrees
though the model is sound.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, distinct_pairs
from sfm_shapefit.base.geometry import SIGMA_PER_MEDIAN, angle_between_deg, normalized
from sfm_shapefit.graph.rigidity import parallel_rigid_pieces
from sfm_shapefit.judgement.limits import (
    FEWEST_ALIKE,
    FEWEST_POINTS,
    KNOWN_DEG,
    MOST_AGAINST,
    OUTNUMBERED,
    SIGMAS,
    SURE_SIGMAS,
)
from sfm_shapefit.judgement.places import AmbiguousPlace, find_other_places
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points

_FAR_DEG = (KNOWN_DEG, OUTNUMBERED * KNOWN_DEG)  # degrees, least and most limit; sound models: .01 to .13


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairFits:
    """How the directions of k pairs fit where cameras stand."""

    centers: FloatArray
    """(n, 3) where cameras stand; NaN for those that are not asked."""
    directions: PairDirections
    """As measured."""
    residuals_deg: FloatArray
    """(k,) NaN where there is no direction, or no baseline."""
    level_deg: float
    """Standard deviation per axis of the exact ones, else of all, by their median; NaN without any."""
    agrees: BoolArray
    """(k,) pairs that agree."""
    contradicts: BoolArray
    """(k,) pairs that contradict."""

    def other_places(self, names: Sequence[str]) -> tuple[AmbiguousPlace, ...]:
        """Return the cameras for which many of the contradicting pairs agree on another place."""
        rows, measured = np.isfinite(self.residuals_deg), self.directions
        pairs, directions = measured.pairs[rows], measured.directions[rows]
        return find_other_places(names, self.centers, pairs, directions, self.agrees[rows], self.level_deg)

    def contradicted(self, images: Images) -> dict[str, tuple[int, int]]:
        """Return, by name, the images whose frames are contradicted by more of their pairs than is usual.

        The numbers are of pairs of the frame with a direction, and of those that contradict. A frame none of
        whose pairs has a direction is contradicted by three whose matches contradict it.
        """
        ends = images.frame_of[self.directions.pairs]
        known = np.isfinite(self.residuals_deg) & (ends[:, 0] != ends[:, 1])
        count = len(images.frames.ids)
        total = np.bincount(ends[known].ravel(), minlength=count)
        against = np.bincount(ends[known & self.contradicts].ravel(), minlength=count)
        shares = against / np.maximum(total, 1)
        asked = total > 0
        usual = float(np.median(shares[asked])) if asked.any() else 0.0
        many = asked & (shares > max(MOST_AGAINST, OUTNUMBERED * usual))
        lost = np.bincount(ends[self.contradicts & (ends[:, 0] != ends[:, 1])].ravel(), minlength=count)
        for counts in (total, against):
            counts[~asked] = lost[~asked]
        many |= ~asked & (lost >= FEWEST_ALIKE)
        rows = np.flatnonzero(many[images.frame_of] & np.isfinite(self.centers).all(axis=1))
        of = images.frame_of.tolist()
        return {images.names[k]: (int(total[of[k]]), int(against[of[k]])) for k in rows.tolist()}

    def held(self, images: Images, points: Points | None = None) -> BoolArray:
        """Return which cameras (n,) are in the largest rigid piece of agreeing pairs, each frame one node.

        Points of three images or more tie them too, as on a chain of neighbors, whose pairs tell no lengths.
        """
        frame_of, count, pairs = images.frame_of, len(images.frames.ids), self.directions.pairs[self.agrees]
        edges = frame_of[pairs]
        if points is not None and len(pairs):
            ties = points.taken(np.isin(points.images, pairs))
            ties = ties.taken((ties.lengths() > 2)[ties.points_seen()])
            rays = np.stack([frame_of[ties.images], count + ties.points_seen()], axis=1)
            edges, count = np.concatenate([edges, rays]), count + ties.num_points
        edges = distinct_pairs(np.sort(edges[edges[:, 0] != edges[:, 1]], axis=1))
        rows = edges[parallel_rigid_pieces(count, edges, 3) == 0] if len(edges) else edges
        return np.asarray(np.isin(frame_of, rows) & np.isfinite(self.centers).all(axis=1))

    @property
    def may_hold(self) -> BoolArray:
        """Pairs (k,) that agree, or whose matches suit the rotations and tell no direction."""
        stands = np.isfinite(self.centers[self.directions.pairs]).all(axis=(1, 2))
        is_silent = stands & ~np.isfinite(self.residuals_deg) & ~self.contradicts
        return self.agrees | (is_silent & (self.directions.num_inliers >= FEWEST_POINTS))

    @property
    def sides(self) -> tuple[IntArray, IntArray]:
        """Pairs of cameras that agree (a, 2), and that contradict (b, 2)."""
        pairs = self.directions.pairs
        return pairs[self.agrees], pairs[self.contradicts]


def fit_pairs(centers: FloatArray, directions: PairDirections) -> PairFits:
    """Return how the directions of pairs fit where cameras stand, (n, 3); NaN for those that do not count."""
    pairs = directions.pairs
    baselines = normalized(centers[pairs[:, 0]] - centers[pairs[:, 1]])
    known = np.isfinite(baselines).all(axis=1)
    usable = known & np.isfinite(directions.directions).all(axis=1)
    residuals = np.full(len(pairs), np.nan)
    residuals[usable] = angle_between_deg(directions.directions[usable], baselines[usable])
    sigmas = directions.sigma_deg()
    exact = usable & (sigmas <= KNOWN_DEG)
    best = exact if exact.any() else usable
    level = SIGMA_PER_MEDIAN * float(np.median(residuals[best])) if usable.any() else np.nan
    limit = np.maximum(np.clip(SURE_SIGMAS * level, *_FAR_DEG), SIGMAS * sigmas)
    against = np.zeros(len(pairs), dtype=np.bool_)
    against[directions.contradicting()] = True
    return PairFits(
        centers=centers,
        directions=directions,
        residuals_deg=residuals,
        level_deg=level,
        agrees=usable & (residuals <= limit),
        contradicts=(exact & (residuals > limit)) | (known & against),
    )
