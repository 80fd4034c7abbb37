"""One verdict for a whole model: good, look at some cameras, cannot be judged, or do not use.

Do not use, if any of these holds:

    the pairs that agree hold less than half of the cameras in one rigid piece, also with the points that fit,
    however many contradict
    no more pairs agree than join the cameras, and as many contradict (half as many: look)
    half or more of the observations of two or more matches contradict the cameras: they see no 3D point, and
    most of their matches miss the epipolar lines
    fewer than half of all images are in the output
    more than a tenth of the cameras stand apart from the rest (`seams`, `ties`), or elsewhere in another
    model of the same matches, which pairs support there (`second_opinion`); who stands where it does is to
    be looked at only, and so is a group that repeated structure explains as well
    evidence that the fit did not use speaks against more than a third of them (`evidence`), but for these
    more than a tenth of the images, and two or more, have lenses that cannot be (`lenses`)

Look at the cameras that are placed with a trust below 0.75, that are uncertain or hang loose, that were
placed but are not in the output, that are kept though their matches make no points, that many pairs
contradict and no pixels confirm (`witnesses`), or that evidence which the fit did not use names: another
place, a seam, a wrong lens, a lens, a place or a rig that hardly can be (`lenses`, `flights`, `rig_offsets`).
Trust is not low where the pixels confirm a camera. Look also, though no camera can be named, if

    the matches of many pairs agree on two directions each, as before a repeated facade
    many rejected pairs agree on a second configuration
    images, left out one by one, or the matches of pairs contradict the focal length of a lens
    fewer than 95 % of the images are placed, or stand in this one of several models
    nothing checks how a group of cameras stands to the rest, which has its cameras named (`ties`)
    two position priors and more than a tenth contradict where cameras stand (`placement.prior_fit`)
    the images can be arranged in two ways (`rotations.arrangements`), whichever was taken

It cannot be judged, unless it is not to be used, if nothing checks it: it has two cameras only, or no pair
says how two of them stand to each other, as where poses come without points and database. Bare graphs have
rules of their own besides (`graph_grade`).

Otherwise the model is good. How many of the observations see a 3D point is told, and decides nothing: on
thirteen real scenes with good rotations 53 to 99.8 % do (least of all those of facing cameras in a park, who
stand right to 0.5 % of the extent), and 45 to 100 % of the pairs agree. Wrong pairs alone, even half of all,
do not make a model bad.
"""

from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray, distinct
from sfm_shapefit.base.geometry import extent_of
from sfm_shapefit.base.wording import counted
from sfm_shapefit.judgement.evidence import ModelEvidence, how_far
from sfm_shapefit.judgement.judged import Judged
from sfm_shapefit.judgement.limits import (
    CHANCE_SHARE,
    LOCAL_SHARE,
    MOST_AGAINST,
    RIVAL_SHARE,
    SMALLEST_SHAPE,
)
from sfm_shapefit.judgement.reasons import Grade, Kind, ModelVerdict, Reason, of_each, of_model
from sfm_shapefit.judgement.trust import LOW_TRUST
from sfm_shapefit.judgement.uncertainty import standard_deviations
from sfm_shapefit.placement.place import SMALLEST_PIECE
from sfm_shapefit.scene.images import Images

OTHER_PLACE = "pairs agree on another place of it"
"""Said of a camera of `ModelEvidence.places`, which tells more."""
FEW_PLACED = 1.0 - CHANCE_SHARE  # share of images in the output; below, the model is to be looked at


class Shares(NamedTuple):
    """How many observations contradict, and how many images are in the output; NaN where it is not known."""

    contradicting: float = 0.0
    placed: float = np.nan
    placed_here: float = np.nan
    """Share of all images that are in this model; images of other models of `map` count as missing here."""


def weigh_evidence(evidence: ModelEvidence, images: Images) -> Iterator[Reason]:
    """Yield what evidence says against a model of some images; the others are not posed."""
    second, count = evidence.opinion, int(images.is_posed.sum())
    apart, clause = _find_apart(evidence)
    places = [place.image for place in evidence.places]
    alone = np.bincount(images.lens_of[images.is_posed], minlength=len(images.lenses)) == 1
    lenses = [wrong.camera for wrong in evidence.lenses]
    is_through = images.is_posed & np.isin(images.camera_ids, lenses) & alone[images.lens_of]
    through = images.names_of(np.flatnonzero(is_through))
    named = {*apart, *second.wrong, *second.undecided, *places, *through}

    if apart:
        clause = clause.format(f"{len(apart)} of {counted(count, 'camera')}")
        grade = (
            Grade.DO_NOT_USE if len(_without(apart, second.confirmed)) > LOCAL_SHARE * count else Grade.LOOK
        )
        yield of_model(Kind.APART, clause, grade, apart)
    rivals = [name for seam in evidence.seams if seam.is_rival for name in seam.images if name not in named]
    if rivals := list(dict.fromkeys(rivals)):
        clause = f"{len(rivals)} of {counted(count, 'camera')} may stand apart from the rest"
        yield of_model(Kind.APART, clause, images=rivals)
    held = evidence.num_held
    if held is not None and (
        held < RIVAL_SHARE * count or held < SMALLEST_PIECE <= count
    ):  # any pair holds two
        clause = f"the pairs that agree hold only {held} of {counted(count, 'camera')}"
        yield of_model(Kind.PAIRS, clause, Grade.DO_NOT_USE)
    else:
        yield from _too_few_agree(evidence, images)
    if len(named - second.confirmed) > MOST_AGAINST * count and len(named) > len(apart):
        clause = f"evidence speaks against {len(named)} of {counted(count, 'camera')}"
        yield of_model(Kind.PLACE, clause, Grade.DO_NOT_USE)
    elsewhere = "it is elsewhere in the model that map made of the same matches"
    yield from of_each(
        Kind.SECOND_OPINION, _without(second.wrong, apart), f"{elsewhere}, which pairs support"
    )
    yield from of_each(
        Kind.SECOND_OPINION, second.undecided, f"{elsewhere}, and no pairs support either place"
    )
    yield from of_each(Kind.PLACE, places, OTHER_PLACE)
    if lenses:
        clause = f"images contradict {counted(len(lenses), 'focal length')}"
        yield of_model(Kind.LENS, clause, images=through)
    if evidence.shape is not None and evidence.shape.images:
        clause = f"its own points leave the shape open, {how_far(evidence.shape.largest)}"
        yield of_model(Kind.UNCERTAIN, clause, images=evidence.shape.images)
    yield from _weigh_oddities(evidence, count)
    for name in evidence.contradicted:
        num_pairs, num_against = evidence.contradictions[name]
        clause = f"{num_against} of its {num_pairs} pairs contradict its place"
        yield from of_each(Kind.PAIRS, [name], clause)
    if unchecked := _without([name for group in evidence.untied for name in group.images], apart):
        clause = "nothing checks where groups of cameras are relative to one another"
        if len(unchecked) == 1:
            clause = "nothing checks where one camera is relative to the rest"
        yield of_model(Kind.UNCHECKED, clause, images=unchecked)
    clause = "another place or rotation of it has at least half as much evidence as this one"
    yield from of_each(Kind.SECOND_OPINION, second.ambiguous, clause)
    if second.has_nothing_in_common:
        yield of_model(Kind.APART, "the model that map makes of the same matches has another shape")


def _too_few_agree(evidence: ModelEvidence, images: Images) -> Iterator[Reason]:
    """Yield that no more pairs agree than join the cameras, and half as many contradict, or as many.

    Where matches are noise, or what they see moves, each pair is one more false pose, and those that joined
    the cameras agree.
    """
    agreeing, against = evidence.sides
    joining = 0 < agreeing < len(distinct(images.frame_of[images.is_posed]))
    if joining and against >= RIVAL_SHARE * agreeing:
        clause = f"{counted(against, 'pair')} contradict{'s' * (against == 1)} it"
        clause = f"{clause}, and only {agreeing} agree{'s' * (agreeing == 1)}, too few to check it"
        yield of_model(Kind.PAIRS, clause, Grade.DO_NOT_USE if against >= agreeing else Grade.LOOK)


def _weigh_oddities(evidence: ModelEvidence, num_posed: int) -> Iterator[Reason]:
    """Yield which lenses and places hardly can be: few images each by itself, more as one."""
    few = max(LOCAL_SHARE * num_posed, 1)
    are_many = sum(len(one.images) for one in evidence.odd if one.cannot_be) > few
    for one in sorted(evidence.odd, key=lambda one: -len(one.images)):
        number = len(one.images)
        is_bad = one.cannot_be and are_many
        if is_bad or number > few:
            clause = f"{counted(number, 'image')} {'has' if number == 1 else 'have'} {one.what}"
            grade = Grade.DO_NOT_USE if is_bad else Grade.LOOK
            yield of_model(one.kind, clause, images=one.images, grade=grade)
        else:
            for name, what in zip(one.images, one.of_each, strict=True):
                yield from of_each(one.kind, [name], f"it has {what}")


def _find_apart(evidence: ModelEvidence) -> tuple[list[str], str]:
    """Return the images that stand apart, and a clause on how many ({}) do."""
    loose, second = [group.images for group in evidence.untied if group.is_loose], evidence.opinion
    groups = [*(seam.images for seam in evidence.seams if not seam.is_rival), *loose]
    if len(second.wrong) + len(second.undecided) > 1:  # which tell where seams run
        groups = [g if second.has_most_alike(g) else _without(g, second.alike) for g in groups]
    if len(second.wrong) > 1:
        groups.insert(0, second.wrong)
    clause = "{} stand apart from the rest"
    if len(loose) == len(groups):
        clause = "nothing says where {} are relative to the rest"
    return list(dict.fromkeys(name for group in groups for name in group)), clause


def _without(names: Sequence[str], others: Collection[str]) -> tuple[str, ...]:
    return tuple(name for name in names if name not in others)


def too_few_to_judge(num_cameras: int) -> Iterator[Reason]:
    """Yield that nothing checks a model, if it has so few cameras."""
    if num_cameras < SMALLEST_SHAPE:
        clause = "it has two cameras only, so that nothing checks their poses and lenses"
        yield of_model(Kind.UNCHECKED, clause, Grade.CANNOT_BE_JUDGED)


def judge_model(
    placement: Judged, shares: Shares, before: Iterable[Reason] = (), after: Iterable[Reason] = ()
) -> ModelVerdict:
    """Apply the rules of the module's header.

    Args:
        placement: the evidence for pairs and cameras.
        shares: how much agrees.
        before: what else speaks against the model, whose cameras are named first.
        after: the same, named last.
    """
    doubted = *before, *_doubtful_cameras(placement), *after
    if (second := placement.second_configuration) is not None:
        grade = Grade.DO_NOT_USE if second.is_as_good else Grade.LOOK
        doubted = *doubted, of_model(Kind.REPEATED, second.clause, grade)
    return ModelVerdict.weigh([*doubted, *_weigh_shares(shares)])


def _doubtful_cameras(placement: Judged) -> Iterator[Reason]:
    """Yield what speaks against each camera by its trust, its uncertainty and how loose it hangs."""
    trust, reasons = placement.assessment.trust, placement.assessment.reasons
    found = dict[int, tuple[Kind, str]]()
    for group in placement.assessment.loose_groups:  # by the pairs; where the pixels were asked, they say
        adjusted = placement.adjusted_covariances
        if adjusted is None or np.isnan(adjusted[group.cameras]).any():
            found |= dict.fromkeys(group.cameras.tolist(), (Kind.UNCERTAIN, str(group.cause.value)))
    uncertain = Kind.UNCERTAIN, f"it is uncertain by more than {CHANCE_SHARE:.0%} of the extent"
    found |= dict.fromkeys(uncertain_cameras(placement).tolist(), uncertain)
    low = np.flatnonzero(trust < LOW_TRUST).tolist()
    found |= {k: (Kind.TRUST, reasons[k] or "pairs speak against it") for k in low}
    for k in sorted(found, key=lambda k: (trust[k], k)):
        kind, clause = found[k]
        yield from of_each(kind, [placement.graph.name_of(int(placement.cameras[k]))], clause)


def in_another_model(here: float) -> Reason:
    """Say that a model has only a share of the images that stand in some model."""
    return of_model(Kind.LEFT_OUT, f"{1.0 - here:.0%} of the images are in another model")


def _weigh_shares(shares: Shares) -> Iterator[Reason]:
    """Yield what too small or too large a share says against a model; one that is not known says nothing."""
    if shares.contradicting >= RIVAL_SHARE:
        clause = f"{shares.contradicting:.0%} of the observations contradict the cameras"
        yield of_model(Kind.PAIRS, clause, Grade.DO_NOT_USE)
    if shares.placed < FEW_PLACED:
        grade = Grade.DO_NOT_USE if shares.placed < RIVAL_SHARE else Grade.LOOK
        yield of_model(Kind.LEFT_OUT, f"only {shares.placed:.0%} of the images are placed", grade)
    elif shares.placed_here < FEW_PLACED:
        yield in_another_model(shares.placed_here)


def uncertain_cameras(placement: Judged) -> IntArray:
    """Return the cameras, as rows of `placement.cameras`, whose standard deviation is large for the scene."""
    if len(placement.cameras) < SMALLEST_PIECE:
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(sigmas_of_extent(placement) > CHANCE_SHARE)


def sigmas_of_extent(placement: Judged) -> FloatArray:
    """Return the same as `largest_sigmas` as shares of the extent."""
    extent = max(extent_of(placement.locations), float(np.finfo(float).tiny))
    with np.errstate(over="ignore"):  # where all stand in one place
        return np.asarray(largest_sigmas(placement) / extent)


def largest_sigmas(placement: Judged) -> FloatArray:
    """Return the largest of each camera's standard deviations along the axes."""
    return np.asarray(standard_deviations(placement.covariances).max(axis=1))
