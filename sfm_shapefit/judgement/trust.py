"""How far each camera is to be trusted, and why not further.

    trust = min(1, agreement / usual) * hold

agreement    the share of the camera's matches with the consensus, the largest set of cameras that agree
             with one another, that agree with the solution, with a prior of a few matches, of which half
             the square of the median share are for the camera. A pair agrees if its direction lies within
             3 degrees, or 5 of its standard deviations, of the solved baseline. It contradicts if the
             direction lies farther off, or if it has none because most of its matches contradict the given
             rotations. A pair counts with its number of matches, up to a limit; if it agrees, less its
             leverage: a direction that decides itself where the camera goes is no evidence.
usual        3/4 of the median agreement of all cameras: where a part of the pairs is wrong everywhere,
             having its part of them says nothing against a camera.
hold         tau^2 / (tau^2 + sigma^2), sigma the camera's standard deviation, tau 10 % of the median
             distance of the cameras from their median: 1 where the pairs hold the camera, 1/2 where they
             leave 10 % open.

So 1 means that a camera's matches agree as is usual in the scene and nothing is loose. In a clean scene

    no evidence either way       2/3 (2/3 of the median share where pairs are wrong)
    as much for it as against    1/2 to 2/3
    more against it, or loose    below 1/2

Several cameras whose rotations are wrong in the same way, as the symmetry of an object makes them, agree with
one another in thousands of matches, which say nothing of how they stand to the rest. So only the pairs with
the consensus count, which correlation clustering finds (`bodies`): two sets of cameras join while the
agreeing matches between them outweigh the contradicting ones, the strongest first, so that each set is judged
by all its pairs with the rest together. Leverages do not count there: who agrees is no question of evidence.

Where repeated structure produces false pairs everywhere, contradictions say little of a single camera: all
together they count at most half as much as all agreements.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.geometry import median_spread
from sfm_shapefit.graph.measured import Evidence, MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.bodies import find_bodies
from sfm_shapefit.placement.conditioning import FEW_PAIRS, Conditioning, Looseness

_AGREEING_ANGLE_RAD = np.radians(3.0)  # radians; a pair agrees within this angle, or ...
_AGREEING_SIGMAS = 5.0  # ... within this, in its standard deviations; a far point's direction is inexact
_MAX_CLUSTERED_PAIRS = 5_000_000  # pairs; more take over ten seconds, and all cameras are the consensus
_LARGEST_CONTRADICTION = 0.5  # weight of all contradictions over that of all agreements; see the header
_PRIOR = 30.0  # matches that every camera has beforehand; half of them for it in a clean scene
_LEAST_MEDIAN = 0.5  # median share of agreement; hardly anything agrees with a collapsed answer
_MAX_SUPPORT = 200.0  # matches of a pair that count; hundreds are no independent witnesses
_UNKNOWN_SUPPORT = 50.0  # matches of a pair that has no number of them; a usual pair's
_USUAL_SHARE = 0.75  # share of the median agreement of all cameras; with that much a camera loses nothing
_HOLD_SHARE = 0.1  # standard deviation tau that halves trust, in spreads; a tenth of the scene is loose
LOW_TRUST = 0.75
"""Trust below which reasons are given; usual cameras have more."""
SOMEWHAT_LOOSE = "its pairs leave it somewhat loose"
_CONTRADICTED = "more of its matches contradict it than usual here: its rotation may be wrong"


class PairFit(NamedTuple):
    """How well the directions of a solved graph fit its locations."""

    angles_rad: FloatArray
    """(m,) residual angles."""
    sigmas_rad: FloatArray
    """(m,) standard deviation of each direction, per axis."""
    leverages: FloatArray
    """(m,) share of its own fitted direction that each agreeing pair decides itself; NaN outside the largest
    rigid piece of those, and everywhere if unknown."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraTrust:
    """The trust of k cameras, and the reasons for a low one."""

    trust: FloatArray
    """(k,) in [0, 1]."""
    agreement: FloatArray
    """(k,) the first factor."""
    hold: FloatArray
    """(k,) the second factor."""
    reasons: tuple[str, ...]
    """k sentences, empty where the trust is not low."""
    loose_reasons: tuple[str, ...]
    """k sentences that say what the pairs leave open; empty where they hold the camera."""


def judge_cameras(
    measured: MeasuredGraph,
    locations: FloatArray,
    fit: PairFit,
    sigmas: FloatArray,
    conditioning: Conditioning,
) -> CameraTrust:
    """Return the trust of each camera and the reasons for a low one.

    A rigid group, such as a frame, is judged by the pairs of all its cameras together. Rays to points speak
    for or against a camera like pairs.

    Args:
        measured: the solved graph.
        locations: (n, d) its solution.
        fit: agreement of its directions.
        sigmas: (n, d) standard deviations of the locations, infinite where nothing holds them.
        conditioning: how well the pairs hold its k cameras.
    """
    graph, num_cameras = measured.graph, measured.num_cameras
    votes = _collect_votes(graph, fit, measured.evidence)
    labels = np.arange(graph.num_nodes) if measured.groups is None else measured.groups.group_of
    checked, votes = _discount_unchecked(votes, fit.leverages), votes.of_groups(labels)
    consensus: BoolArray = np.ones(int(labels.max()) + 1, dtype=np.bool_)
    if len(votes.pairs) <= _MAX_CLUSTERED_PAIRS:
        signed = np.where(votes.agrees, votes.weights, -votes.weights)
        consensus = find_bodies(len(consensus), votes.pairs, signed) == 0
    agreement = _shares(checked.of_groups(labels), consensus, int(labels[:num_cameras].max()) + 1)[
        labels[:num_cameras]
    ]
    usual = _USUAL_SHARE * float(np.median(agreement))
    hold = _hold(locations[:num_cameras], sigmas[:num_cameras].max(axis=1))
    # Where most cameras have no agreement at all, any agreement is more than usual.
    relative = agreement / usual if usual > 0.0 else (agreement > 0.0).astype(np.float64)
    trust = np.minimum(relative, 1.0) * hold
    few = conditioning.num_pairs <= FEW_PAIRS
    loose = [_loose_reason(cause, is_few) for cause, is_few in zip(conditioning.causes, few, strict=True)]
    reasons = [""] * num_cameras
    for k in np.flatnonzero(trust < LOW_TRUST).tolist():
        contradicted = agreement[k] < usual and conditioning.causes[k] is not Looseness.DISTANCE
        found = [_CONTRADICTED] if contradicted else []
        reasons[k] = "; ".join([*found, *filter(None, [loose[k]])]) or SOMEWHAT_LOOSE
    return CameraTrust(
        trust=trust,
        agreement=agreement,
        hold=hold,
        reasons=tuple(reasons),
        loose_reasons=tuple(loose),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Votes:
    """Pairs that speak for or against their cameras."""

    pairs: IntArray
    agrees: BoolArray
    weights: FloatArray

    def of_groups(self, labels: IntArray) -> "_Votes":
        """Return the votes between groups of nodes, by their labels (n,)."""
        pairs = labels[self.pairs]
        outer = pairs[:, 0] != pairs[:, 1]
        return _Votes(pairs[outer], self.agrees[outer], self.weights[outer])


def _collect_votes(graph: ViewGraph, fit: PairFit, evidence: Evidence | None) -> _Votes:
    """Collect the pairs that speak, with the weight of their matches."""
    pairs = graph.edges
    agrees = fit.angles_rad <= np.maximum(_AGREEING_ANGLE_RAD, _AGREEING_SIGMAS * fit.sigmas_rad)
    weights = np.full(graph.num_edges, _UNKNOWN_SUPPORT)
    if evidence is not None:
        weights = np.concatenate([evidence.support, evidence.contradicting_support]).astype(np.float64)
        weights = np.minimum(weights, _MAX_SUPPORT)
        pairs = np.concatenate([pairs, evidence.contradicting.reshape(-1, 2)])
        agrees = np.concatenate([agrees, np.zeros(len(evidence.contradicting), dtype=np.bool_)])
    against = float(weights[~agrees].sum())
    allowed = _LARGEST_CONTRADICTION * float(weights[agrees].sum())
    weights[~agrees] *= min(1.0, allowed / against) if against > 0.0 else 1.0
    return _Votes(pairs, agrees, weights)


def _discount_unchecked(votes: _Votes, leverages: FloatArray) -> _Votes:
    """Return the votes with agreeing pairs counted by how far others check them; as they are if unknown."""
    if not np.isfinite(leverages).any():
        return votes
    checked = np.ones(len(votes.pairs))
    checked[: len(leverages)] = 1.0 - np.nan_to_num(leverages, nan=1.0)
    return _Votes(votes.pairs, votes.agrees, np.where(votes.agrees, checked, 1.0) * votes.weights)


def _shares(votes: _Votes, consensus: BoolArray, num_cameras: int) -> FloatArray:
    """Return the share of each camera's matches with the consensus that agree, prior included."""
    n = len(consensus)
    i, j = votes.pairs.T
    counts = np.zeros((2, n))
    for own, other in ((i, j), (j, i)):
        for row, chosen in enumerate((votes.agrees, ~votes.agrees)):
            used = chosen & consensus[other]
            counts[row] += np.bincount(own[used], weights=votes.weights[used], minlength=n)
    good, total = counts[0, :num_cameras], counts[:, :num_cameras].sum(axis=0)
    spoken = total > 0.0
    median = float(np.median(good[spoken] / total[spoken])) if spoken.any() else 1.0
    median = max(median, _LEAST_MEDIAN)  # a collapsed answer, with which hardly anything agrees
    return np.asarray((good + 0.5 * median**2 * _PRIOR) / (total + _PRIOR))


def _hold(centers: FloatArray, largest_sigmas: FloatArray) -> FloatArray:
    """Return tau^2 / (tau^2 + sigma^2) of each camera, 1 where sigma is not known."""
    tau = _HOLD_SHARE * median_spread(centers)
    if not tau > 0.0:
        return np.where(np.isinf(largest_sigmas), 0.0, 1.0)
    return np.asarray(1.0 / (1.0 + (np.nan_to_num(largest_sigmas, nan=0.0, posinf=np.inf) / tau) ** 2))


def _loose_reason(cause: Looseness | None, few: bool) -> str:
    """Say what leaves a camera loose, or nothing."""
    if cause is not None:
        return str(cause.value)
    return str(Looseness.FEW_PAIRS.value) if few else ""
