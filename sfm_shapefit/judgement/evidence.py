"""Evidence that the fit did not use, at the levels of the image, the camera and the group.

A pair agrees with where its cameras stand if its direction is off their baseline by at most a degree, or six
times what is usual, but never more than two degrees, lest a model that is wrong throughout set the limit by
which it is judged; and by three of its own standard deviations where these are more. It contradicts if it is
farther off and knows its direction to a degree, or if most of its matches contradict the rotations, so that
it has none at all. Half of the pairs between fisheyes in a park know theirs worse, and are off by 40 degrees
though the model is sound.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.geometry import SIGMA_PER_MEDIAN, angle_between_deg, normalized
from sfm_shapefit.graph.rigidity import parallel_rigid_pieces
from sfm_shapefit.judgement.limits import (
    FEW,
    FEWEST_ALIKE,
    HALF,
    KNOWN_DEG,
    MANY,
    OUTNUMBERED,
    SIGMAS,
    SURE_SIGMAS,
)
from sfm_shapefit.judgement.places import OtherPlace, find_other_places
from sfm_shapefit.judgement.seams import Seam
from sfm_shapefit.judgement.ties import Untied
from sfm_shapefit.judgement.wrong_lenses import WrongLens
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points

_FAR_DEG = (KNOWN_DEG, OUTNUMBERED * KNOWN_DEG)  # degrees, least and most limit; sound models: .01 to .13


class Contradicted(NamedTuple):
    """A camera that many of its pairs contradict, with those of its frame."""

    camera: int
    """Its row."""
    num_pairs: int
    """Pairs with a direction."""
    num_against: int
    """Pairs of these that contradict where it stands."""


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

    def other_places(self) -> tuple[OtherPlace, ...]:
        """Return the cameras for which many of the contradicting pairs agree on another place."""
        rows, measured = np.isfinite(self.residuals_deg), self.directions
        pairs, directions = measured.pairs[rows], measured.directions[rows]
        return find_other_places(self.centers, pairs, directions, self.agrees[rows], self.level_deg)

    def contradicted(self, images: Images) -> tuple[Contradicted, ...]:
        """Return the images whose frames are contradicted by more of their pairs than is usual.

        A frame none of whose pairs has a direction is contradicted by three whose matches contradict it.
        """
        ends = images.frame_of[self.directions.pairs]
        known = np.isfinite(self.residuals_deg) & (ends[:, 0] != ends[:, 1])
        count = len(images.frames.ids)
        total = np.bincount(ends[known].ravel(), minlength=count)
        against = np.bincount(ends[known & self.contradicts].ravel(), minlength=count)
        shares = against / np.maximum(total, 1)
        asked = total > 0
        usual = float(np.median(shares[asked])) if asked.any() else 0.0
        many = asked & (shares > max(MANY, OUTNUMBERED * usual))
        lost = np.bincount(ends[self.contradicts & (ends[:, 0] != ends[:, 1])].ravel(), minlength=count)
        for counts in (total, against):
            counts[~asked] = lost[~asked]
        many |= ~asked & (lost >= FEWEST_ALIKE)
        rows = np.flatnonzero(many[images.frame_of] & np.isfinite(self.centers).all(axis=1))
        of = images.frame_of.tolist()
        return tuple(Contradicted(k, int(total[of[k]]), int(against[of[k]])) for k in rows.tolist())

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
        edges = np.unique(np.sort(edges[edges[:, 0] != edges[:, 1]], axis=1), axis=0)
        rows = edges[parallel_rigid_pieces(count, edges, 3) == 0] if len(edges) else edges
        return np.asarray(np.isin(frame_of, rows) & np.isfinite(self.centers).all(axis=1))

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


class SecondOpinion(NamedTuple):
    """How a model compares with another one of the same matches."""

    num_common: int
    """Cameras of both."""
    usual: float
    """Median distance between the places of a camera in both, over the spread of cameras."""
    wrong: IntArray
    """Rows of the cameras that stand elsewhere in the other model, which pairs support there."""
    undecided: IntArray
    """Rows of those that stand elsewhere, where pairs support neither."""
    confirmed: IntArray
    """Rows of those that are no farther apart than is usual between the two."""
    num_for: int
    """Pairs that support this model against the other, of `wrong` cameras."""
    num_against: int
    """Pairs of these that support the other."""
    ambiguous: IntArray
    """Rows of cameras that stand where they do in the other model, which doubts them; none is `confirmed`."""

    @property
    def alike(self) -> IntArray:
        """Rows of the cameras that stand where they do in the other model."""
        return np.concatenate([self.confirmed, self.ambiguous])

    def has_most_alike(self, cameras: IntArray) -> bool:
        """Return whether half or more of some cameras stand where they do in the other model."""
        return bool(np.isin(cameras, self.alike).mean() >= HALF)

    @property
    def has_nothing_in_common(self) -> bool:
        """Whether the two have different shapes, and no pair says which is right."""
        return self.usual > FEW and not (len(self.wrong) or len(self.undecided) or len(self.ambiguous))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModelEvidence:
    """What speaks against a model although it fits."""

    lenses: tuple[WrongLens, ...] = ()
    """By rows of the lenses of the images."""
    places: tuple[OtherPlace, ...] = ()
    """By rows of the images."""
    seams: tuple[Seam, ...] = ()
    """By rows of the images."""
    contradicted: tuple[Contradicted, ...] = ()
    """By rows of the images; those that the pixels confirm are not among them."""
    untied: tuple[Untied, ...] = ()
    """By rows of the images; those that stand apart are not among them."""
    num_held: int | None = None
    """Cameras of the largest group that agreeing pairs, or points that fit, hold; None without pairs."""
    second: SecondOpinion | None = None
    """How another model of the same matches compares; None if there is none."""

    def beside(self, second: SecondOpinion, contradicting: IntArray) -> "ModelEvidence":
        """Return the same with a second opinion, without what that clears; `contradicting` is (b, 2) pairs.

        A group most of which is alike in both is right if most pairs that contradict it are with wrong ones.
        """

        def may_be_wrong(group: Seam | Untied) -> bool:
            inside = np.isin(contradicting, group.cameras)
            across = inside.sum(axis=1) == 1
            by_wrong = (np.isin(contradicting, second.wrong) & ~inside)[across].any(axis=1)
            return not (second.has_most_alike(group.cameras) and by_wrong.sum() > HALF * across.sum())

        confirmed = set(second.confirmed.tolist())
        return replace(
            self,
            places=tuple(one for one in self.places if one.camera not in confirmed),
            contradicted=tuple(one for one in self.contradicted if one.camera not in confirmed),
            seams=tuple(filter(may_be_wrong, self.seams)),
            untied=tuple(filter(may_be_wrong, self.untied)),
            second=second,
        )
