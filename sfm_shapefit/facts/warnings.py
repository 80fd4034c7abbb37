"""What the user should know beyond the tables, a sentence each.

A warning states what is so. What that means for the use of a model the verdict alone says: a warning that
doubts cameras has a reason in it, by the same rule, and the others stand beside any grade.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.wording import counted_are, first_of, in_unit
from sfm_shapefit.judgement.grade import largest_sigmas, uncertain_cameras
from sfm_shapefit.judgement.judged import Judged
from sfm_shapefit.judgement.limits import CHANCE_SHARE
from sfm_shapefit.judgement.reasons import IS_ITS_DATABASE, Kind, Reason, of_model
from sfm_shapefit.judgement.trust_options import TrustOptions
from sfm_shapefit.pairs.pair_directions import DirectionStatus, PairDirections
from sfm_shapefit.placement.prior_fit import PriorFit
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.solver.solver_options import Status

_ALARMING_SHARE = 0.5  # share of pairs against the solution, or the given rotations; above, warn
_FEW_REJECTED = 0.1  # share of pairs against refined locations; below, a collapsed start does not matter
_TWOFOLD_SHARE = 0.05
"""Share of pairs on two directions among those on one or two; above, warn. It was at most 0.005 on eight
real scenes and 0.04 in drawn courtyards, which are placed well, and 0.31 before drawn facades of one house
again and again, where half of the cameras were shifted by a house without a contradiction."""
_FEWEST_TWOFOLD = 3  # pairs on two directions; fewer prove nothing

_GROSS = 4.0  # standard deviations about each axis; of 1,000 rotations, one is off by more by chance
_MEDIAN_TURN = 1.538  # standard deviations; median angle of turns that are normal about each axis


def wrong_rotations(turned_deg: FloatArray, sigma_deg: float) -> IntArray:
    """Return the images (k,) that turned by more than what was said and the scatter of most explain.

    The worst come first. Angles (n,) are NaN where unknown; rotations were said to be off by `sigma_deg`
    about each axis.
    """
    typical = np.nanmedian(turned_deg) if np.isfinite(turned_deg).any() else 0.0
    rows = np.flatnonzero(turned_deg > _GROSS * max(typical / _MEDIAN_TURN, sigma_deg))
    return rows[np.argsort(-turned_deg[rows], kind="stable")]


def rotation_warnings(turned_deg: FloatArray, names: Sequence[str], sigma_deg: float) -> Iterator[str]:
    """Yield which given rotations of `names` (n,), said to be off by `sigma_deg`, are wrong."""
    rows = wrong_rotations(turned_deg, sigma_deg).tolist()
    wrong = [f"{names[k]} (turned by {turned_deg[k]:.3g} deg)" for k in rows]
    if wrong:
        most = f"the others are off by {np.nanmedian(turned_deg):.2g} deg; see turned_deg in cameras.csv"
        yield f"{counted_are(len(wrong), 'given rotation')} wrong and corrected: {first_of(wrong)}; {most}"


def rotation_suspicions(turned_deg: FloatArray, sigma_deg: float) -> Iterator[Reason]:
    """Yield that all given rotations, said to be off by `sigma_deg`, are farther off, as of another scene."""
    typical = float(np.nanmedian(turned_deg)) / _MEDIAN_TURN if np.isfinite(turned_deg).any() else 0.0
    if typical > _GROSS * sigma_deg:
        clause = f"the rotations are {typical:.0f} degrees off, not {sigma_deg:g}: {IS_ITS_DATABASE}"
        yield of_model(Kind.INPUT, clause)


def quality_warnings(placement: Judged, options: PlacementOptions | None = None) -> Iterator[str]:
    """Yield what the user should know about a solution, found with some options, a sentence each."""
    if placement.certified.status is not Status.CONVERGED:
        yield f"the solve is not certified to the tolerance: {placement.certified.status.value}"
    if placement.certified.unique is False:
        yield "the certificate does not prove the optimum of the convex program unique"
    finish, rejected = placement.refined.finish, len(placement.rejected_pairs) / max(len(placement.pairs), 1)
    contradicting = placement.num_contradicting / max(len(placement.pairs), 1)
    adjusted = placement.adjusted_covariances  # pixels tell lengths, whatever the starts had
    is_measured = adjusted is not None and not np.isnan(adjusted).any()
    if finish.collapsed and not (is_measured or (finish.refined and rejected <= _FEW_REJECTED)):
        assert finish.disagreement is not None
        yield (
            f"two ways to find lengths disagree by {finish.disagreement:.0%}, as on long chains and with "
            "many wrong pairs" + ("" if finish.refined else _how_to_refine(options))
        )
    yield from _uncertainty_warnings(placement)
    if contradicting > _ALARMING_SHARE:
        yield f"{contradicting:.0%} of the pairs contradict the solution and are set aside"
    if placement.second_configuration is not None:
        yield placement.second_configuration.statement()


def _how_to_refine(options: PlacementOptions | None) -> str:
    """Say which option refines the starts of an unrefined answer; nothing if none in force prevents it."""
    if options is None or options.refines:
        return ""
    other = "refine=True" if not options.refine else f"objective={PlacementOptions().objective}"
    return f"; {other} refines both and compares"


def _uncertainty_warnings(placement: Judged) -> Iterator[str]:
    """Yield a warning that names the least certain camera, if any is uncertain."""
    largest, uncertain = largest_sigmas(placement), uncertain_cameras(placement)
    if np.isnan(largest).any():
        yield "standard deviations are left out: the graph is too large, or too loose, for their factor"
    if len(uncertain):
        worst = placement.graph.name_of(int(placement.cameras[np.argmax(largest)]))
        above_all = "above all " if len(uncertain) > 1 else ""
        yield (
            f"{counted_are(len(uncertain), 'camera')} uncertain by more than {CHANCE_SHARE:.0%} of the "
            f"extent, {above_all}{worst}; see sigma and trust in cameras.csv"
        )


def match_warnings(directions: PairDirections, *, may_repeat: bool) -> Iterator[str]:
    """Yield what the matches of all pairs together say against any answer, if they do.

    The tracks of a model, for which it `may_repeat` nothing, were made for one answer.
    """
    counts = directions.counts()
    usable, twofold = (counts.get(s, 0) for s in (DirectionStatus.USABLE, DirectionStatus.TWO_MOTIONS))
    if may_repeat and twofold >= _FEWEST_TWOFOLD and twofold > _TWOFOLD_SHARE * (usable + twofold):
        yield (
            f"the matches of {twofold} pairs agree on two directions each, those of {usable} on one: things "
            "move, or a facade repeats, which may shift whole groups of cameras by its period and leave no "
            "contradiction behind; compare images of neighboring cameras before trusting them"
        )
    against = counts.get(DirectionStatus.LOW_INLIER_RATIO, 0)
    if against > _ALARMING_SHARE * len(directions.pairs):
        yield (
            f"the matches of {against} of {len(directions.pairs)} pairs contradict the rotations: "
            + ("the scene repeats itself, " if may_repeat else "")
            + "rotations or intrinsics are wrong, or the matches are those of another scene"
        )


def support_warnings(names: Sequence[str]) -> Iterator[str]:
    """Yield which cameras are kept, as was asked, though their matches make no points, if any."""
    if names:
        rest = "its pose is" if len(names) == 1 else "their poses are"
        yield (
            f"{counted_are(len(names), 'camera')} kept, as min_trust=0 asks, though hardly any match makes a "
            f"point with a third image: {first_of(names)}; {rest} wrong, or the scene repeats itself"
        )


def ambiguity_warnings(placement: Judged) -> Iterator[str]:
    """Yield which cameras stand as well turned as they do as placed; pixels confirm none of them."""
    doubts, ambiguous = placement.assessment.doubts, placement.assessment.ambiguous
    if doubts is not None and ambiguous.any():
        members = np.flatnonzero(ambiguous)
        names = [placement.graph.name_of(int(placement.cameras[k])) for k in members.tolist()]
        angles = sorted({f"{angle:.0f}" for angle in doubts.angles_deg[members].tolist()}, key=float)
        by = " to ".join(dict.fromkeys((angles[0], angles[-1])))
        yield (
            f"the scene seems to repeat itself: many matches speak for turning {first_of(names)} by {by} "
            "degrees, and many against it"
        )


def graph_warnings(placement: Judged, options: PlacementOptions | None = None) -> Iterator[str]:
    """Yield what the user should know about a bare graph, all of whose placed nodes are in the answer."""
    yield from quality_warnings(placement, options)
    floor = TrustOptions().min_trust
    low = np.flatnonzero(placement.assessment.trust < floor)
    if len(low):
        yield (
            f"{len(low)} of {len(placement.cameras)} nodes have a trust below {floor:g}, above all "
            f"{_least_trusted(placement, low)}; see trust in cameras.csv"
        )


def _least_trusted(placement: Judged, rows: IntArray) -> str:
    """Return the name of the least trusted of some of the placed cameras, and why it is."""
    worst = int(rows[np.argmin(placement.assessment.trust[rows])])
    return f"{placement.graph.name_of(int(placement.cameras[worst]))} ({placement.assessment.reasons[worst]})"


def prior_warnings(fit: PriorFit | None, names: Sequence[str]) -> Iterator[str]:
    """Yield which position priors of the images `names` (n,) are wrong, if any are."""
    if fit is not None and len(fit.wrong):
        unit, units = ("m", "") if fit.is_metric else ("", ", in the priors' units")
        wrong = [f"{names[k]} ({in_unit(float(fit.off[k]), unit)} off)" for k in fit.wrong.tolist()]
        usual = in_unit(float(np.nanmedian(fit.off)), unit, digits=2)
        yield (
            f"{counted_are(len(wrong), 'position prior')} wrong, most likely: {first_of(wrong)}{units}; "
            f"half of all are within {usual}; see prior_off in cameras.csv"
        )
