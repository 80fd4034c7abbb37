"""The verdict on a bare view graph, of which nothing but directions speaks; the rules of `grade` hold too.

Do not use, if any of these holds:

    the residuals of its directions have a level above 6 degrees
    another placement explains the pairs nearly as well, or triangles speak for most of the pairs that it
    rejects (`placement.second_configuration`)
    most cameras are uncertain by more than a tenth of the extent
    more than a third of the cameras has agreeing pairs of fewer than three directions, and a tenth of all is
    uncertain: along crossing streets of 300 cameras, 27 % or fewer are held so badly where the median error
    is below 1 % of the extent, and 30 to 41 % where it is above 3 %

Look at the cameras that few pairs tie to the rest (`few_ties`). It cannot be judged if no pair is checked by
others.
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.wording import counted
from sfm_shapefit.judgement.few_ties import FewTies, barely_held, find_few_ties
from sfm_shapefit.judgement.grade import Shares, judge_model, sigmas_of_extent
from sfm_shapefit.judgement.judged import Judged
from sfm_shapefit.judgement.limits import (
    CHANCE_SHARE,
    KNOWN_DEG,
    LOCAL_SHARE,
    MOST_AGAINST,
    RIVAL_SHARE,
    SURE_SIGMAS,
)
from sfm_shapefit.judgement.reasons import Grade, Kind, ModelVerdict, Reason, of_each, of_model
from sfm_shapefit.judgement.verdicts import Verdict

_MOST_LEVEL_DEG = SURE_SIGMAS * KNOWN_DEG  # degrees, level of agreeing residuals; see the header


def judge_graph(placement: Judged) -> ModelVerdict:
    """Return the verdict on a placed graph, which has no observations."""
    level, assessment, reasons = placement.assessment.level_deg, placement.assessment, list[Reason]()
    graph, agrees, count = placement.measured_part().graph, placement.agreement.agrees, len(placement.cameras)
    edges, shares = graph.edges[agrees], sigmas_of_extent(placement)
    is_barely_held = barely_held(graph.num_nodes, edges, graph.directions[agrees])[:count]  # without points
    if level > _MOST_LEVEL_DEG:
        clause = f"the directions are {level:.0f} degrees off the cameras"
        reasons.append(of_model(Kind.PAIRS, clause, Grade.DO_NOT_USE))
    elif np.mean(shares > LOCAL_SHARE) > RIVAL_SHARE or (
        np.mean(shares > CHANCE_SHARE) > LOCAL_SHARE and np.mean(is_barely_held) > MOST_AGAINST
    ):
        some = f"{np.sum(shares > CHANCE_SHARE)} of {counted(count, 'camera')}"
        clause = f"the pairs that agree leave {some} uncertain by more than {CHANCE_SHARE:.0%} of the extent"
        reasons.append(of_model(Kind.UNCERTAIN, clause, Grade.DO_NOT_USE))
    if all(assessment.verdict(k) is Verdict.UNDETERMINED for k in placement.pairs.tolist()):
        reasons.append(of_model(Kind.UNCHECKED, "no pair is checked by others", Grade.CANNOT_BE_JUDGED))
    names = [graph.name_of(k) for k in range(count)]
    ties = [] if graph.num_nodes > count else find_few_ties(count, edges)  # points tie cameras, too
    few_ties = _tell_few_ties(ties, is_barely_held, shares, names)
    return judge_model(placement, Shares(), reasons, few_ties)


def _tell_few_ties(
    parts: Iterable[FewTies], is_barely_held: BoolArray, shares: FloatArray, names: Sequence[str]
) -> Iterator[Reason]:
    """Yield which cameras few agreeing pairs tie to the rest; uncertainties are `shares` of the extent."""
    for part in parts:
        some = f"{counted(part.num_pairs, 'agreeing pair')} {'ties' if part.num_pairs == 1 else 'tie'}"
        clause = f"only {some} {len(part.cameras)} cameras to the rest, {_known_to(shares[part.cameras])}"
        yield of_model(Kind.UNCHECKED, clause, images=[names[k] for k in part.cameras.tolist()])
    for k in np.flatnonzero(is_barely_held).tolist():
        clause = f"fewer than three of its agreeing pairs differ in direction, {_known_to(shares[[k]])}"
        yield from of_each(Kind.UNCHECKED, [names[k]], clause)


def _known_to(shares: FloatArray) -> str:
    """Say how well cameras of some standard deviations, which are shares of the extent, are placed."""
    largest, place = float(shares.max()), "so that its place" if len(shares) == 1 else "whose place"
    if np.isnan(largest):
        return f"{place} is not checked"
    known = f"known to ± {100.0 * largest:.2g} % of the extent" if largest < 1.0 else "not determined"
    return f"{place} is {known}"
