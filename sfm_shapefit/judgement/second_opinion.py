"""A second opinion: which cameras stand elsewhere in another model of the same matches, and who is right.

A group that is wrong as a whole agrees in itself, and where false pairs tie it to the rest too, no test of
the model alone finds it. Another model that takes nothing of the first errs elsewhere, if at all. Both are
brought together by a similarity that half of the cameras may fail (`fit_similarity_l1`). A camera stands
elsewhere if it is off by more than is usual between the two, and by more than half a degree, or what shows as
that from across the scene.

Which of the two is right there, the pairs say that it has with cameras on which both agree, and whose
direction each model measures by its own rotations and lenses: a pair speaks for one of them if it misses the
other by more than twice as much. A camera that few pairs tie to those follows the
others that stand elsewhere. The one with twice as many pairs is right; without that, neither is believed.

Another model confirms cameras only if what is usual between the two needs no judge: half a degree at most
from across the scene, 0.009 spreads. Ten sound models and what `map` makes of their matches differ by 0.007
at most; models that a wrong lens bends by 0.02 to 0.16, where no camera stands out (a ring of eight: from
0.004 on).
"""

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.geometry import fit_similarity_l1, mean_rotation_l1, median_spread, rotation_angles_deg
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import are, counted, rounded
from sfm_shapefit.judgement.limits import (
    FEWEST_ALIKE,
    LOCAL_SHARE,
    NEAR_DEG,
    OUTNUMBERED,
    RIVAL_SHARE,
    SMALLEST_SHAPE,
    SURE_SIGMAS,
)
from sfm_shapefit.judgement.pair_fits import PairFits
from sfm_shapefit.judgement.reasons import Grade
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.same_images import same_images

_FAR = np.radians(NEAR_DEG)  # spreads; what is nearer needs no judge, and six times as far a camera is lost
_ROUNDING = 1e-7  # spreads and radians; usual differences of the same model are smaller
_NO_DIRECTION_DEG = 90.0  # degrees; the matches of such a pair contradict the rotations, as badly as can be
_LEAST_TOLD = 1e-5  # share of the spread; a smaller difference is not told as a number


class SecondOpinion(Record):
    """How the model compares with another one of the same matches, which took nothing of it."""

    num_common: Annotated[int, "Cameras of both."]
    usual: Annotated[float, "Median distance between both, over the median one of cameras from their middle."]
    wrong: Annotated[tuple[str, ...], "Images that stand elsewhere there, which pairs support."] = ()
    undecided: Annotated[
        tuple[str, ...], "Images that stand elsewhere there, where pairs support neither."
    ] = ()
    farthest: Annotated[
        float, "Largest distance of an image that is elsewhere, in the same unit; else 0."
    ] = 0.0
    num_for: Annotated[int, "Pairs that support this model against the other, of wrong images."]
    num_against: Annotated[int, "Pairs of these that support the other."]
    ambiguous: Annotated[
        tuple[str, ...], "Images that stand there too, though matches suit another place or rotation."
    ] = ()
    has_nothing_in_common: Annotated[
        bool, "Whether the two have different shapes, and nothing says whose is right."
    ] = False
    grade: Annotated[Grade, "What the other model is worth by itself."] = Grade.LOOK
    folder: Annotated[str, "Where it stands among the models that map makes of the database."] = "0"
    confirmed: frozenset[str] = frozenset()
    """Images that are no farther apart than is usual between the two, if that is near, and not ambiguous."""

    def __post_init__(self) -> None:
        is_silent = not (self.wrong or self.undecided or self.ambiguous)
        object.__setattr__(self, "has_nothing_in_common", self.usual > LOCAL_SHARE and is_silent)

    @property
    def alike(self) -> frozenset[str]:
        """Images that stand where they do in the other model."""
        return self.confirmed.union(self.ambiguous)

    def has_most_alike(self, images: Sequence[str]) -> bool:
        """Return whether half or more of some images stand where they do in the other model."""
        return len(self.alike.intersection(images)) >= RIVAL_SHARE * len(images)

    @property
    def is_alike(self) -> bool:
        """Whether all its cameras stand where the model has them."""
        return not (self.wrong or self.undecided or self.has_nothing_in_common)

    @property
    def statement(self) -> str:
        """The same in a sentence."""
        by = "in the model that map made of the same matches"
        parts = []
        if self.wrong:
            parts.append(
                f"{are(self.wrong)} elsewhere {by}: "
                f"{counted(self.num_against, 'pair')} support that place, {self.num_for} the one here"
            )
        if self.undecided:
            parts.append(f"{are(self.undecided)} elsewhere {by}, and no pairs support either place")
        if self.ambiguous:
            where = f"{are(self.ambiguous)} in the same place {by}"
            parts.append(f"{where}, but another place or rotation has at least half as much evidence")
        percent = rounded(100.0 * self.usual, digits=2) if self.usual > _LEAST_TOLD else "less than 0.001"
        usual = f"the median difference of positions is {percent} % of their spread"
        if self.wrong or self.undecided:
            usual += f", and the largest {rounded(100.0 * self.farthest, digits=2)} %"
        if parts and not (self.wrong or self.undecided or self.has_nothing_in_common):
            return parts[0]
        if self.has_nothing_in_common:
            return f"{self.num_common} cameras have nothing in common with their places {by} ({usual})"
        told = "; ".join(parts) or f"{self.num_common} cameras are in the same place {by}"
        return f"{told} ({usual})"


def compare_models(
    images: Images, fits: PairFits, others: Images, other_fits: PairFits, doubted: BoolArray
) -> SecondOpinion | None:
    """Return how images compare with others of the same names; None if too few are common.

    Fits are those of the pairs of matches in either model. `doubted` (k,) are the others that may stand
    elsewhere by their own matches.
    """
    places = same_images(images.names, others.names).places
    mine = np.flatnonzero((places >= 0) & others.is_posed[places])
    if len(mine) <= SMALLEST_SHAPE:
        return None  # one of three that is off takes the similarity along
    theirs = places[mine]
    spread = median_spread(images.centers[mine])
    if not spread > 0.0:
        return None
    aligned = fit_similarity_l1(others.centers[theirs], images.centers[mine], cap=SURE_SIGMAS * _FAR * spread)
    distances = np.linalg.norm(aligned.apply(others.centers[theirs]) - images.centers[mine], axis=1) / spread
    turns = np.swapaxes(others.rotations[theirs], 1, 2) @ images.rotations[mine]
    angles = rotation_angles_deg(np.swapaxes(turns, 1, 2) @ mean_rotation_l1(turns))
    usual = float(np.median(distances))
    turned = max(float(np.median(angles)), np.degrees(_ROUNDING))
    unlike = distances > SURE_SIGMAS * max(usual, _ROUNDING), angles > SURE_SIGMAS * turned
    elsewhere = (unlike[0] & (distances > _FAR)) | (unlike[1] & (angles > NEAR_DEG))
    residuals = _residuals(fits, mine), _residuals(other_fits, theirs)
    votes = _count_votes(*residuals, elsewhere)
    votes[votes.sum(axis=1) < FEWEST_ALIKE] = votes.sum(axis=0)
    here, there = votes.T
    wrong = elsewhere & (there >= np.maximum(OUTNUMBERED * here, FEWEST_ALIKE))
    right = elsewhere & (here >= np.maximum(OUTNUMBERED * there, FEWEST_ALIKE))
    undecided = elsewhere & ~wrong & ~right & (here + there >= FEWEST_ALIKE)
    alike = ~(unlike[0] | unlike[1])
    num_for, num_against = _count_votes(*residuals, wrong).sum(axis=0).tolist()
    return SecondOpinion(
        num_common=len(mine),
        usual=usual,
        wrong=images.names_of(mine[wrong]),
        undecided=images.names_of(mine[undecided]),
        farthest=float(np.max(distances, where=wrong | undecided, initial=0.0)),
        confirmed=frozenset(images.names_of(mine[alike & ~doubted[theirs] & (usual <= _FAR)])),
        num_for=num_for,
        num_against=num_against,
        ambiguous=images.names_of(mine[alike & doubted[theirs]]),
    )


class _Residuals(NamedTuple):
    keys: IntArray
    """(m,) i * k + j of cameras i < j of k common ones; ascending."""
    degrees: FloatArray
    """(m,)"""


def _residuals(fits: PairFits, rows: IntArray) -> _Residuals:
    """Return the residuals of the pairs among some cameras (k,), by their rows in the fits."""
    place = np.full(len(fits.centers), -1)
    place[rows] = np.arange(len(rows))
    ends = np.sort(place[fits.directions.pairs], axis=1)
    residuals = np.where(
        np.isnan(fits.residuals_deg) & fits.contradicts, _NO_DIRECTION_DEG, fits.residuals_deg
    )
    there = np.flatnonzero((ends >= 0).all(axis=1) & np.isfinite(residuals))
    keys = ends[there, 0] * len(rows) + ends[there, 1]
    order = np.argsort(keys)
    return _Residuals(keys[order], residuals[there[order]])


def _count_votes(here: _Residuals, there: _Residuals, elsewhere: BoolArray) -> IntArray:
    """Return how many pairs of each camera that stands elsewhere support each model, (k, 2); 0 for others."""
    count = len(elsewhere)
    votes = np.zeros((count, 2), dtype=np.int64)
    keys, a, b = np.intersect1d(here.keys, there.keys, assume_unique=True, return_indices=True)
    ends = np.column_stack(np.divmod(keys, count))
    across = elsewhere[ends].sum(axis=1) == 1
    ends, mine, theirs = ends[across], here.degrees[a][across], there.degrees[b][across]
    away = np.where(elsewhere[ends[:, 0]], ends[:, 0], ends[:, 1])
    for side, (good, bad) in enumerate(((mine, theirs), (theirs, mine))):
        votes[:, side] = np.bincount(away[bad > OUTNUMBERED * good], minlength=count)
    return votes
