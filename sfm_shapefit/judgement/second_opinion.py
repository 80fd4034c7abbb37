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

from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.geometry import fit_similarity_l1, mean_rotation_l1, median_spread, rotation_angles_deg
from sfm_shapefit.judgement.evidence import PairFits, SecondOpinion
from sfm_shapefit.judgement.limits import FEWEST_ALIKE, NEAR_DEG, OUTNUMBERED, SMALLEST_SHAPE, SURE_SIGMAS
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.same_images import same_images

_FAR = np.radians(NEAR_DEG)  # spreads; what is nearer needs no judge, and six times as far a camera is lost
_ROUNDING = 1e-7  # spreads and radians; usual differences of the same model are smaller
_NO_DIRECTION_DEG = 90.0  # degrees; the matches of such a pair contradict the rotations, as badly as can be


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
        wrong=mine[wrong],
        undecided=mine[undecided],
        confirmed=mine[alike & ~doubted[theirs] & (usual <= _FAR)],
        num_for=num_for,
        num_against=num_against,
        ambiguous=mine[alike & doubted[theirs]],
    )


class _Residuals(NamedTuple):
    """Residuals of pairs of common cameras."""

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
