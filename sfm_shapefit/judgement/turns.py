"""Which cameras are turned: two explanations of the matches of a camera with the rest, weighed.

The relative rotation of a pair from its own matches, against the given rotations R, leaves a turn in world
axes,

    E = R_j^T R_ij R_i = T_j^T T_i,    T the turn that takes the rays of a camera to where they belong,

so that a pair with cameras that are right says of a camera i what its turn would be: E, or E^T where i is
the second of the pair. If the camera stands as placed the turns are 0. If its rotation is wrong, all its
pairs say the same T, for a camera has one rotation only. Pairs of repeated structure say one thing and
another, or what the symmetry of the scene makes of a right camera. So for a camera, and for each body of
cameras that agree among themselves:

    placed    the weight of the pairs that fit the given rotations and the solution
    turned    the weight of the pairs that agree on one turn T instead, the T of most weight

A pair that both explain counts for neither. With the share s = placed / (placed + turned):

    right         s >= 0.6
    ambiguous     s >= 0.3: both explain many pairs, as in a symmetric scene; which is true is not said
    turned        s < 0.3, and two pairs or more agree on T
    unsupported   a single camera with which no pair agrees as placed, nor do two on a turn
    unknown       no pair says how the camera, or its body, stands to the others

Bodies are found by contraction (`bodies`) from pairs that agree and pairs that contradict. What turns whom is
relative: of all bodies the one whose turn mends most is turned first, the smallest of equals, and none that
has more than half of all cameras; its pairs then agree, and bodies are found anew.

How exact a turn is. The matches of a pair are no independent witnesses of its rotation: errors of calibration
and of neighboring keypoints are common to them. So their information counts as that of 20 at most, 0.1
degrees are added for the given rotations, and where the quarter of pairs that agrees best has larger errors
than that, all standard deviations are as much larger. Chosen on fourteen scenes of good rotations: 4 to 12 %
of their sound pairs seem turned, and 98 % of those of cameras that were turned by 2 degrees.

Support of the given rotations is the ratio of the mean robust weights of a pair's matches with the best
direction there and with the best rotation, the first estimated from share and median residual of the inliers.
It is 1 or more for all but 5 % of the right pairs.
"""

import enum
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, distinct, quantile, rows_taken
from sfm_shapefit.base.geometry import nearest_rotations, rotation_angles_deg
from sfm_shapefit.base.lists import RowLists
from sfm_shapefit.base.losses import GEMAN_MCCLURE, weighed
from sfm_shapefit.judgement.bodies import find_bodies
from sfm_shapefit.judgement.limits import (
    ALIKE_DEG,
    CHANCE_SHARE,
    KNOWN_DEG,
    MOST_AGAINST,
    MOST_COMPARED,
    RIVAL_SHARE,
)
from sfm_shapefit.pairs.pair_directions import PairDirections, is_usable
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.pairs.two_view_poses import LAST_WIDTH_PX
from sfm_shapefit.scene.matches import rows_of_pairs

_INDEPENDENT_MATCHES = 20.0  # matches of a pair that count for its turn; their errors are in part the same
_MOST_WEIGHT = 200.0  # matches of a pair that count for its vote; hundreds are no independent witnesses
_FLOOR_RAD = np.radians(0.1)  # radians; added for the errors of the given rotations
_LEAST_TURN_RAD = np.radians(KNOWN_DEG)  # radians; a turn below this and ...
_AGREEING_SIGMAS = 3.5  # ... below this, in standard deviations of the least certain axis: counts as none
_FAR = 6.0  # standard deviations about each axis; of a billion rotations, hardly one is off by more by chance
_LARGEST_SIGMA_RAD = np.radians(ALIKE_DEG)  # radians; agreement says nothing where more is as likely
_LEVEL_QUANTILE, _NORMAL_QUANTILE = 0.25, 1.1  # quantile of errors, and its value for normal ones; see above
_UNEXPLAINED, _EXPLAINED = (
    0.7,
    1.0 - CHANCE_SHARE,
)  # ratios of weights; given rotations fit not at all, and fully
_MEAN_OF_MEDIAN = 0.8  # median residual of a robust fit over that of all matches; converts the second
RIGHT_SHARE = 0.6
"""Share s; from here on a camera is right, below half of it turned."""
_MOST_TURNED = 50  # bodies turned one after the other; each turn judges all others anew
_AVERAGING_STEPS = 4  # steps of the robust mean turn; they start at the best vote


class Doubt(enum.Enum):
    """What the pairs of a camera say of its rotation."""

    RIGHT = "right"
    AMBIGUOUS = "ambiguous"
    TURNED = "turned"
    UNSUPPORTED = "unsupported"
    UNKNOWN = "unknown"


class PairTurns(NamedTuple):
    """What k pairs say of the rotations of their cameras."""

    pairs: IntArray
    """(k, 2) cameras."""
    turns: FloatArray
    """(k, 3, 3) E in world axes; the identity where it is not known."""
    sigmas_rad: FloatArray
    """(k,) standard deviation of the turn along its least certain axis; infinite where it is not known."""
    weights: FloatArray
    """(k,) what the pair counts: its matches, up to a limit."""
    placed: FloatArray
    """(k,) in [0, 1], how well the matches fit the given rotations and the solved baseline."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Doubts:
    """What the pairs say of the rotations of n cameras."""

    kinds: tuple[Doubt, ...]
    """n verdicts."""
    placed: FloatArray
    """(n,) weight of the pairs that agree with the camera, or its body, as placed."""
    turned: FloatArray
    """(n,) weight of the pairs that agree on a turn instead."""
    num_turned: IntArray
    """(n,) the number of these pairs."""
    angles_deg: FloatArray
    """(n,) that turn; NaN where there is none."""
    bodies: IntArray
    """(n,) label of the body with which the camera was judged; cameras judged alone have one of their own."""
    guessed: BoolArray | None = None
    """(n,) cameras whose focal length is still a guess, which may be what is wrong; none if None."""

    def members(self, camera: int) -> IntArray:
        """Return the cameras of a camera's body, ascending."""
        return np.flatnonzero(self.bodies == self.bodies[camera])

    @property
    def ambiguous(self) -> BoolArray:
        """(n,) cameras whose pairs speak for two rotations."""
        return np.array([kind is Doubt.AMBIGUOUS for kind in self.kinds], dtype=np.bool_)

    def known_to(self, sigma_rad: float) -> "Doubts":
        """Return the same where rotations are known to that standard deviation about each axis.

        Where pairs speak for two rotations, the given one is right if the other is far beyond that.
        """
        return self.without(self.ambiguous & (np.radians(self.angles_deg) > _FAR * sigma_rad))

    def without_repetition(self) -> "Doubts":
        """Return the same where the scene cannot repeat itself: what is ambiguous is not known."""
        kinds = (Doubt.UNKNOWN if kind is Doubt.AMBIGUOUS else kind for kind in self.kinds)
        return replace(self, kinds=tuple(kinds))

    def without(self, sure: BoolArray) -> "Doubts":
        """Return the doubts of the other cameras: those that are `sure` (n,) are right and in no body."""
        kinds = (Doubt.RIGHT if is_sure else k for is_sure, k in zip(sure.tolist(), self.kinds, strict=True))
        bodies = np.where(sure, -1 - np.arange(len(sure)), self.bodies)
        placed, turned = np.where(sure, 1.0, self.placed), np.where(sure, 0.0, self.turned)
        return replace(self, kinds=tuple(kinds), bodies=bodies, placed=placed, turned=turned)


def fit_as_placed(directions: PairDirections) -> FloatArray:
    """Return about the mean robust weight of the matches of k pairs under the given rotations, (k,)."""
    inlier_share = directions.num_inliers / np.maximum(directions.num_matches, 1)
    residual = _MEAN_OF_MEDIAN * np.nan_to_num(directions.median_residual_px) / LAST_WIDTH_PX
    return np.asarray(weighed(GEMAN_MCCLURE, inlier_share, residual**2))


def weigh_pairs(
    directions: PairDirections, agreements: FloatArray, relative: RelativeRotations, rotations: FloatArray
) -> PairTurns:
    """Return what pairs say of rotations, from their directions and from their own relative rotations.

    Args:
        directions: directions of k pairs.
        agreements: (k,) 1 where the direction agrees with the solved baseline, 0 where not; NaN where
            unknown.
        relative: relative rotations of some of these pairs, in any order; a pair without counts by direction.
        rotations: (n, 3, 3) the given ones, cam_from_world.
    """
    k = len(directions.pairs)
    row = rows_of_pairs(relative.pairs, directions.pairs)
    relative, row = relative.subset(row >= 0), row[row >= 0]

    i, j = relative.pairs.T
    turns, sigmas = np.tile(np.eye(3), (k, 1, 1)), np.full(k, np.inf)
    turns[row] = rotations[j].transpose(0, 2, 1) @ relative.rotations @ rotations[i]
    counts = relative.num_matches * relative.weight_shares
    variances = 1.0 / np.maximum(np.linalg.eigvalsh(relative.information)[:, 0], 1e-12)
    variances *= np.maximum(1.0, counts / _INDEPENDENT_MATCHES)
    sound = relative.are_sound()
    sigmas[row[sound]] = np.sqrt(variances + _FLOOR_RAD**2)[sound]

    fit_best = np.ones(k)
    fit_best[row] = np.maximum(relative.weight_shares, 1e-9)
    explained = np.clip(
        (fit_as_placed(directions) / fit_best - _UNEXPLAINED) / (_EXPLAINED - _UNEXPLAINED), 0.0, 1.0
    )
    usable = is_usable(directions.status)
    # A pair whose matches are as far off as it would turn, along its baseline, takes parallax for a turn.
    parallax = np.radians(np.nan_to_num(directions.parallax_deg))
    sigmas[(np.nan_to_num(agreements) == 1.0) & (_angles(turns) > (1.0 - MOST_AGAINST) * parallax)] = np.inf
    small = _angles(turns) <= np.maximum(_AGREEING_SIGMAS * sigmas, _LEAST_TURN_RAD)
    finite = np.isfinite(sigmas)
    judged = usable & np.isfinite(agreements)
    support = np.where(judged, np.nan_to_num(agreements) * explained, 0.0)
    asked = np.zeros(k, dtype=np.bool_)
    asked[row] = True
    support = np.where(asked & ~(finite & small), RIVAL_SHARE * support, support)
    # A pair without a direction that could be compared speaks for the rotation all the same.
    support = np.where(~judged & finite & small & (sigmas <= _LARGEST_SIGMA_RAD), explained, support)
    weights = np.minimum(directions.num_matches.astype(np.float64), _MOST_WEIGHT)
    weights[row] = np.minimum(counts, _MOST_WEIGHT)
    return PairTurns(directions.pairs, turns, sigmas, weights, support)


def find_turned(pairs: PairTurns, labels: IntArray) -> Doubts:
    """Return what the pairs between cameras say of the rotation of each.

    Cameras of a rigid group, such as a frame, turn as one: `labels` (n,) has the group of each.
    """
    count = int(labels.max(initial=-1)) + 1
    ends = labels[pairs.pairs]
    between = ends[:, 0] != ends[:, 1]
    case = rows_taken(pairs, between)._replace(pairs=ends[between])
    inflation = max(1.0, _level(case))
    case = case._replace(sigmas_rad=case.sigmas_rad * inflation)
    least_rad = _LEAST_TURN_RAD * max(1.0, inflation / 2.0)
    touching, verdicts = RowLists.by_label(case.pairs.ravel(), count), _Verdicts(count)
    case, done = _turn_bodies(case, touching, verdicts, least_rad)
    _judge_as_placed(case, touching, done, verdicts, least_rad)
    return verdicts.of_cameras(labels)


class _Judged(NamedTuple):
    """The two explanations of a body's pairs with others, weighed."""

    placed: float = 0.0
    turned: float = 0.0
    num_turned: int = 0
    num_pairs: int = 0
    is_alone: bool = True
    """Whether the body is a single camera."""
    turn: FloatArray = np.eye(3)

    @property
    def angle_deg(self) -> float:
        """The angle of the turn, NaN without."""
        return float(np.degrees(_angles(self.turn[None])[0])) if self.num_turned else np.nan

    @property
    def kind(self) -> Doubt:
        share = self.placed / max(self.placed + self.turned, 1e-300)
        if share < RIVAL_SHARE * RIGHT_SHARE and self.num_turned > 1:
            return Doubt.TURNED
        if self.placed <= 0.0:
            return Doubt.UNSUPPORTED if self.is_alone and self.num_pairs else Doubt.UNKNOWN
        return Doubt.RIGHT if share >= RIGHT_SHARE else Doubt.AMBIGUOUS


class _Verdicts:
    """What is said of each group so far, and the body that it was judged with."""

    def __init__(self, count: int) -> None:
        self.judged = [_Judged() for _ in range(count)]
        self.body_of: IntArray = np.arange(count)

    def note(self, members: IntArray, found: _Judged) -> None:
        for member in members.tolist():
            self.judged[member] = found
        self.body_of[members] = members[0]

    def of_cameras(self, labels: IntArray) -> Doubts:
        """Return what is said of cameras by their groups (n,)."""
        judged = [self.judged[group] for group in labels.tolist()]
        return Doubts(
            kinds=tuple(one.kind for one in judged),
            placed=np.array([one.placed for one in judged]),
            turned=np.array([one.turned for one in judged]),
            num_turned=np.array([one.num_turned for one in judged], dtype=np.int64),
            angles_deg=np.array([one.angle_deg for one in judged]),
            bodies=self.body_of[labels],
        )


def _pairs_of(members: IntArray, touching: RowLists) -> IntArray:
    """Return the pairs that some groups have a part in, ascending; `touching` has the ends of each group."""
    return distinct(touching.subset(members).rows // 2)


def _angles(rotations: FloatArray) -> FloatArray:
    """Return the angles (k,) of rotations (k, 3, 3), radians in [0, pi]."""
    return np.asarray(np.radians(rotation_angles_deg(rotations)))


def _level(pairs: PairTurns) -> float:
    """Return by what the smaller turns are larger than their standard deviations say; 1 without any."""
    known = np.isfinite(pairs.sigmas_rad)
    if not known.any():
        return 1.0
    ratios = _angles(pairs.turns[known]) / pairs.sigmas_rad[known]
    return float(quantile(ratios, _LEVEL_QUANTILE)) / _NORMAL_QUANTILE


def _contradicts(pairs: PairTurns) -> BoolArray:
    """Return which pairs say that one of their cameras is turned, (k,)."""
    finite = np.isfinite(pairs.sigmas_rad)
    limits = np.maximum(_AGREEING_SIGMAS * np.where(finite, pairs.sigmas_rad, 0.0), _LEAST_TURN_RAD)
    return np.asarray(finite & (_angles(pairs.turns) > limits))


def _find_bodies(pairs: PairTurns, count: int) -> IntArray:
    """Return the body of each of the groups, (count,); 0 is the largest."""
    signed = np.where(_contradicts(pairs), pairs.placed - 1.0, pairs.placed)
    return find_bodies(count, pairs.pairs, pairs.weights * signed)


def _turn_bodies(
    case: PairTurns, touching: RowLists, verdicts: _Verdicts, least_rad: float
) -> tuple[PairTurns, BoolArray]:
    """Turn one body after the other, the worst first; return the pairs as mended, and which groups turned."""
    count = len(verdicts.judged)
    done: BoolArray = np.zeros(count, dtype=np.bool_)
    for _ in range(_MOST_TURNED):
        worst = _worst_body(case, touching, _find_bodies(case, count), done, least_rad)
        if worst is None:
            break
        body, found = worst
        verdicts.note(np.flatnonzero(body), found)
        done |= body
        case = _mend(case, body, found.turn)
    return case, done


def _judge_as_placed(
    case: PairTurns, touching: RowLists, done: BoolArray, verdicts: _Verdicts, least_rad: float
) -> None:
    """Judge the groups that were not turned: those of the largest body alone, others with their bodies."""
    bodies = _find_bodies(case, len(done))
    largest = bodies == 0
    for label in range(int(bodies.max(initial=-1)) + 1):
        together = np.flatnonzero((bodies == label) & ~done)
        for members in together[:, None] if label == 0 else [together]:
            if len(members) == 0:
                continue
            part = np.zeros_like(done)
            part[members] = True
            own = rows_taken(case, _pairs_of(members, touching))
            verdicts.note(members, _judge(own, part, largest & ~part, least_rad))


def _worst_body(
    pairs: PairTurns, touching: RowLists, bodies: IntArray, done: BoolArray, least_rad: float
) -> tuple[BoolArray, _Judged] | None:
    """Return the body whose turn mends most, the smallest of equals, and what is said of it."""
    candidates = []
    for label in range(int(bodies.max(initial=-1)) + 1):
        body = (bodies == label) & ~done
        if not body.any() or 2 * body.sum() > len(body):
            continue
        own = rows_taken(pairs, _pairs_of(np.flatnonzero(body), touching))
        judged = _judge(own, body, ~body, least_rad)
        if judged.kind is Doubt.TURNED:
            candidates.append((body, judged))
    if not candidates:
        return None
    most = max(judged.turned - judged.placed for _, judged in candidates)
    equal = [one for one in candidates if one[1].turned - one[1].placed >= 0.9 * most]
    return min(equal, key=lambda one: int(one[0].sum()))


def _judge(pairs: PairTurns, body: BoolArray, others: BoolArray, least_rad: float) -> _Judged:
    """Weigh the two explanations of the pairs of a body (count,) with others (count,).

    `pairs` are those that touch the body, or more: all pairs for each of very many bodies would take long.
    """
    is_first = body[pairs.pairs[:, 0]] & others[pairs.pairs[:, 1]]
    is_second = body[pairs.pairs[:, 1]] & others[pairs.pairs[:, 0]]
    rows = np.flatnonzero(is_first | is_second)
    weights, support, sigmas = pairs.weights[rows], pairs.placed[rows], pairs.sigmas_rad[rows]
    contradict = _contradicts(pairs)[rows]
    placed, against = float(weights @ support), float(weights[contradict].sum())
    judged = _Judged(placed=placed, num_pairs=len(rows), is_alone=bool(body.sum() == 1))
    if against <= placed * (1.0 - RIGHT_SHARE) / RIGHT_SHARE:
        return judged
    votes = np.where(is_first[rows, None, None], pairs.turns[rows], pairs.turns[rows].transpose(0, 2, 1))
    turn = _common_turn(votes, sigmas, weights * (1.0 - support), contradict)
    if turn is None or _angles(turn[None])[0] <= least_rad:
        return judged
    finite = np.isfinite(sigmas)
    scale = np.where(finite, sigmas, 1.0)
    off_turned = np.where(finite, _angles(votes @ turn.T) / scale, np.inf)
    off_placed = np.where(finite, _angles(votes) / scale, np.inf)
    turned = (off_turned <= _AGREEING_SIGMAS) & (off_turned < off_placed)
    # What fits as placed, within the accuracy of its own rotation, is no evidence for the turn.
    fit_both = np.where(off_placed <= _AGREEING_SIGMAS, support, 0.0)
    return judged._replace(
        placed=float((weights * support)[~turned].sum()),
        turned=float((weights * (1.0 - fit_both))[turned].sum()),
        num_turned=int(turned.sum()),
        turn=turn,
    )


def _common_turn(
    votes: FloatArray, sigmas: FloatArray, weights: FloatArray, candidates: BoolArray
) -> FloatArray | None:
    """Return the turn that votes of most weight agree on, averaged over those; None without candidates.

    The votes (k, 3, 3) have standard deviations (k,) in radians; `candidates` (k,) are those that may be the
    turn.
    """
    voting = np.flatnonzero(np.isfinite(sigmas))
    voting = voting[np.argsort(-weights[voting], kind="stable")][:MOST_COMPARED]
    chosen = voting[candidates[voting]]
    if len(chosen) == 0:
        return None
    flat = votes.reshape(-1, 9)
    cosines = np.clip((flat[chosen] @ flat[voting].T - 1.0) / 2.0, -1.0, 1.0)
    limits = _AGREEING_SIGMAS * np.hypot(sigmas[chosen, None], sigmas[None, voting])
    totals = (np.arccos(cosines) <= limits) @ weights[voting]
    turn = votes[chosen[int(np.argmax(totals))]]
    for _ in range(_AVERAGING_STEPS):
        off = _angles(votes[voting] @ turn.T) / sigmas[voting]
        shares = weighed(GEMAN_MCCLURE, weights[voting] / sigmas[voting] ** 2, (off / _AGREEING_SIGMAS) ** 2)
        turn = nearest_rotations(np.einsum("k,kab->ab", shares, votes[voting]))
    return np.asarray(turn)


def _mend(pairs: PairTurns, body: BoolArray, turn: FloatArray) -> PairTurns:
    """Return the pairs as they are once a body is turned: E becomes T_j E T_i^T."""
    turns = pairs.turns.copy()
    first, second = body[pairs.pairs[:, 0]], body[pairs.pairs[:, 1]]
    turns[first] = turns[first] @ turn.T
    turns[second] = turn @ turns[second]
    mended = pairs._replace(turns=turns)
    crossing = first != second
    agrees = np.isfinite(pairs.sigmas_rad) & ~_contradicts(mended)
    placed = np.where(crossing, np.where(agrees, 1.0, 0.0), pairs.placed)
    return mended._replace(placed=placed)
