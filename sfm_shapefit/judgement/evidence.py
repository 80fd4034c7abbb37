"""Evidence that the fit did not use, at the levels of the image, the camera and the group.

A pair agrees with where its cameras stand if its direction is off their baseline by at most a degree, or six
times what is usual, but never more than two degrees, lest a model that is wrong throughout set the limit by
which it is judged; and by three of its own standard deviations where these are more. It contradicts if it is
farther off and knows its direction to a degree, or if most of its matches contradict the rotations, so that
it has none at all. Half of the pairs between fisheyes in a park know theirs worse, and are off by 40 degrees
though the model is sound.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.geometry import SIGMA_PER_MEDIAN, angle_between_deg, extent_of, normalized
from sfm_shapefit.graph.rigidity import parallel_rigid_pieces
from sfm_shapefit.judgement.limits import (
    FEW,
    FEWEST_ALIKE,
    FEWEST_POINTS,
    HALF,
    KNOWN_DEG,
    MANY,
    OUTNUMBERED,
    RARE,
    SIGMAS,
    SURE_SIGMAS,
)
from sfm_shapefit.judgement.places import OtherPlace, find_other_places
from sfm_shapefit.judgement.reasons import Grade, Kind
from sfm_shapefit.judgement.seams import Seam
from sfm_shapefit.judgement.ties import Untied
from sfm_shapefit.judgement.uncertainty import standard_deviations
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


class Oddity(NamedTuple):
    """Images that hardly can be as the model has them: through such a lens, or at such a place."""

    kind: Kind
    """Whether it is the lens of each, or its place."""
    cannot_be: bool
    """Whether that is impossible, and not only unusual."""
    cameras: IntArray
    """(k,) their rows."""
    values: FloatArray
    """(k,) what is odd about each."""
    sentence: str
    """What that is, with {} for the value."""

    @property
    def what(self) -> str:
        """What they have, a lens or a place, with the least and the largest value."""
        return self._say(self.values)

    @property
    def of_each(self) -> Iterator[tuple[int, str]]:
        """The row of each, and what it has."""
        for row, camera in enumerate(self.cameras.tolist()):
            yield camera, self._say(self.values[row : row + 1])

    def _say(self, values: FloatArray) -> str:
        told = [f"{value:,.{0 if value >= 10.0 else 2}f}" for value in (values.min(), values.max())]
        return self.sentence.format(" to ".join(dict.fromkeys(told)))


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
    """Rows of those that are no farther apart than is usual between the two, if that is near."""
    num_for: int
    """Pairs that support this model against the other, of `wrong` cameras."""
    num_against: int
    """Pairs of these that support the other."""
    ambiguous: IntArray
    """Rows of cameras that stand where they do in the other model, which doubts them; none is `confirmed`."""
    grade: Grade = Grade.LOOK
    """What the other model is worth by itself."""
    folder: str = "0"
    """Where it stands among the models of the same matches."""

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


class OpenShape(NamedTuple):
    """What the points leave open of a model's shape, see `adjustment.open_shape`."""

    covariances: FloatArray
    """Covariances (n, 3, 3) of the centers in squared units; 0 without a pose."""
    cameras: IntArray
    """Rows of those whose largest standard deviation is above 5 % of the extent."""
    largest: float
    """The largest of all, as a share of the extent."""

    @classmethod
    def of(cls, images: Images, rows: IntArray, left_open: FloatArray) -> "OpenShape":
        """Return what is left open of the posed images, covariances (r, 3, 3) by their rows (r,)."""
        covariances = np.zeros((images.num_images, 3, 3))
        covariances[rows] = left_open
        sigmas = standard_deviations(left_open).max(axis=1) / extent_of(images.centers[rows])
        return cls(covariances, np.sort(rows[sigmas > RARE]), float(sigmas.max()))


def how_far(share: float) -> str:
    """Say a share of the extent."""
    return f"by {share:.0%} of the extent" if share <= 1.0 else "by more than the extent"


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
    oddities: tuple[Oddity, ...] = ()
    """By rows of the images."""
    num_held: int | None = None
    """Cameras of the largest group that agreeing pairs, or points that fit, hold; None without pairs."""
    sides: tuple[int, int] = (0, 0)
    """Pairs that agree, and that contradict."""
    second: SecondOpinion | None = None
    """How another model of the same matches compares; None if there is none."""
    shape: OpenShape | None = None
    """What the points leave open, where nothing else measured lenses; None where that is not asked."""

    def beside(self, second: SecondOpinion, contradicting: IntArray) -> "ModelEvidence":
        """Return the same with a second opinion, without what that clears; `contradicting` is (b, 2) pairs.

        A group most of which is alike in both is right if the other model is good, or if most pairs that
        contradict it are of cameras that stand elsewhere, in it or not; these are named by themselves.
        """
        elsewhere = np.concatenate([second.wrong, second.undecided])

        def may_be_wrong(group: Seam | Untied) -> bool:
            across = np.isin(contradicting, group.cameras).sum(axis=1) == 1
            of_these = np.isin(contradicting[across], elsewhere).any(axis=1)
            is_cleared = second.grade is Grade.GOOD or of_these.sum() > HALF * across.sum()
            return not (second.has_most_alike(group.cameras) and is_cleared)

        confirmed = set(second.confirmed.tolist())
        return replace(
            self,
            places=tuple(one for one in self.places if one.camera not in confirmed),
            contradicted=tuple(one for one in self.contradicted if one.camera not in confirmed),
            seams=tuple(filter(may_be_wrong, self.seams)),
            untied=tuple(filter(may_be_wrong, self.untied)),
            second=second,
        )
