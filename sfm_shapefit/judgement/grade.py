"""One verdict for a whole model: good, look at some cameras, or do not use.

Do not use, if any of these holds:

    the pairs that agree hold less than half of the cameras in one rigid piece, also with the points that fit,
    however many contradict; of a bare graph, the residuals of its directions have a level above 6 degrees
    half or more of the observations of two or more matches contradict the cameras: they see no 3D point, and
    most of their matches miss the epipolar lines
    fewer than half of all images are in the output
    more than a tenth of the cameras stand apart from the rest (`seams`, `ties`), or elsewhere in another
    model of the same matches, which pairs support there (`second_opinion`); who stands where it does is to
    be looked at only
    evidence that the fit did not use speaks against more than a third of them (`evidence`), but for these

Look at the cameras that are placed with a trust below 0.75, that are uncertain or hang loose, that were
placed but are not in the output, that are kept though their matches make no points, that many pairs
contradict and no pixels confirm (`witnesses`), or that evidence which the fit did not use names: another
place, a seam, a wrong lens. Trust is not low where the pixels confirm a camera. Look also, though no camera
can be named, if

    the matches of many pairs agree on two directions each, as before a repeated facade
    many rejected pairs agree on a second configuration
    images, left out one by one, or the matches of pairs contradict the focal length of a lens
    fewer than 95 % of the images are placed, or stand in this one of several models
    nothing checks how a group of cameras stands to the rest, which has its cameras named (`ties`)
    two position priors and more than a tenth contradict where cameras stand (`placement.prior_fit`)
    the images can be arranged in two ways (`rotations.arrangements`), whichever was taken

Otherwise the model is good. How many of the observations see a 3D point is told, and decides nothing: on
thirteen real scenes with good rotations 53 to 99.8 % do (least of all those of facing cameras in a park, who
stand right to 0.5 % of the extent), and 45 to 100 % of the pairs agree. Wrong pairs alone, even half of all,
do not make a model bad.
"""

import enum
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Annotated, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.geometry import distances_in_spreads
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import counted, first_of
from sfm_shapefit.judgement.evidence import ModelEvidence
from sfm_shapefit.judgement.judged import Judged
from sfm_shapefit.judgement.limits import FEW, HALF, INSIDE, KNOWN_DEG, MANY, RARE, SURE_SIGMAS
from sfm_shapefit.judgement.trust import LOW_TRUST
from sfm_shapefit.judgement.uncertainty import standard_deviations
from sfm_shapefit.placement.place import SMALLEST_PIECE
from sfm_shapefit.scene.images import Images

MOST_LEVEL_DEG = SURE_SIGMAS * KNOWN_DEG  # degrees, level of agreeing residuals; see the header
IS_ITS_DATABASE = "is this the model's database?"  # ends a reason that doubts the matches, not the model
ARE_ITS_PICTURES = "are these the model's pictures?"
FEW_PLACED = 1.0 - RARE  # share of images in the output; below, the model is to be looked at


class Grade(enum.StrEnum):
    """What to do with a model."""

    GOOD = "good"
    LOOK = "look"
    DO_NOT_USE = "do not use"


class ModelVerdict(Record):
    """Whether the model can be used; the rules are in `judgement.grade`."""

    grade: Annotated[Grade, "What to do with it."]
    statement: Annotated[str, "The same in a sentence."] = ""
    cameras: Annotated[tuple[str, ...], "To be looked at, the least trusted first."]
    reasons: Annotated[tuple[str, ...], "Why the grade is not better; none if it is good."]

    def __post_init__(self) -> None:
        object.__setattr__(self, "statement", self._sentence())

    @property
    def is_bad(self) -> bool:
        """Whether the model should not be used."""
        return self.grade is Grade.DO_NOT_USE

    @property
    def doubts_database(self) -> bool:
        """Whether the matches are those of other images, as it seems."""
        return any(reason.endswith(IS_ITS_DATABASE) for reason in self.reasons)

    def led_by(self, reason: str) -> "ModelVerdict":
        """Return the verdict with a first reason, which explains others, if it is not empty."""
        if not reason:
            return self
        grade = Grade.LOOK if self.grade is Grade.GOOD else self.grade
        return replace(self, grade=grade, reasons=(reason, *self.reasons))

    def _sentence(self) -> str:
        if self.grade is Grade.GOOD:
            return "good"
        if self.grade is Grade.LOOK and self.cameras:
            what = f"look at {counted(len(self.cameras), 'camera')} ({first_of(self.cameras)})"
            return "; ".join([what, *self.reasons])
        return f"{self.grade.value}: {'; '.join(self.reasons)}"


class Shares(NamedTuple):
    """How many observations contradict, and how many images are in the output; NaN where it is not known."""

    contradicting: float = np.nan
    placed: float = np.nan
    here: float = np.nan
    """The same of all images; of several models, the others' are missing here, though they are placed."""


class Against(NamedTuple):
    """What evidence that the fit did not use says against a model."""

    cameras: tuple[str, ...]
    """Names of cameras to be looked at."""
    suspicions: tuple[str, ...]
    """A clause each, if it is to be looked at."""
    reasons: tuple[str, ...]
    """A clause each, if it is not to be used."""


NOTHING_AGAINST = Against((), (), ())


def weigh_evidence(evidence: ModelEvidence, images: Images) -> Against:
    """Return what evidence says against a model of some images; the others are not posed."""
    loose = [group.cameras for group in evidence.untied if group.is_loose]
    unchecked = [camera for group in evidence.untied for camera in group.cameras.tolist()]
    groups, second = [*(seam.cameras for seam in evidence.seams), *loose], evidence.second
    if second is not None and len(second.wrong) > 1:  # which tells where the seam of these runs
        groups = [g if second.has_most_alike(g) else np.setdiff1d(g, second.alike) for g in groups]
        groups.insert(0, second.wrong)
    apart = list(dict.fromkeys(camera for group in groups for camera in group.tolist()))
    wrong, undecided = ([], []) if second is None else (second.wrong.tolist(), second.undecided.tolist())
    alone = np.bincount(images.lens_of[images.is_posed], minlength=len(images.lenses)) == 1
    lenses = [wrong.lens for wrong in evidence.lenses]
    through = np.flatnonzero(images.is_posed & np.isin(images.lens_of, lenses) & alone[images.lens_of])
    places = [place.camera for place in evidence.places]
    named = dict.fromkeys([*apart, *wrong, *undecided, *places, *through.tolist()])
    confirmed = set() if second is None else set(second.confirmed.tolist())
    doubted = [one.camera for one in evidence.contradicted]
    doubted += [*unchecked, *([] if second is None else second.ambiguous.tolist())]
    count = int(images.is_posed.sum())
    suspicions: list[str] = []
    reasons: list[str] = []
    if apart:
        some = f"{len(apart)} of {counted(count, 'camera')} stand"
        are_loose = len(loose) == len(groups)
        clause = f"nothing says how {some} to the rest" if are_loose else f"{some} apart from the rest"
        (reasons if len(set(apart) - confirmed) > FEW * count else suspicions).append(clause)
    if len(loose) < len(evidence.untied):
        suspicions.append("nothing checks how groups of cameras stand to one another")
    held = evidence.num_held
    if held is not None and (held < HALF * count or held < SMALLEST_PIECE <= count):  # any pair holds two
        reasons.append(f"the pairs that agree hold only {held} of {counted(count, 'camera')}")
    if len(named.keys() - confirmed) > MANY * count and len(named) > len(apart):
        reasons.append(f"evidence speaks against {len(named)} of {counted(count, 'camera')}")
    if second is not None and second.has_nothing_in_common:
        suspicions.append("the model that map makes of the same database has another shape")
    if lenses:
        suspicions.append(f"images contradict {counted(len(lenses), 'focal length')}")
    cameras = tuple(images.names[camera] for camera in dict.fromkeys([*named, *doubted]))
    return Against(cameras, tuple(suspicions), tuple(reasons))


def judge_graph(placement: Judged) -> ModelVerdict:
    """Return the verdict on a placed graph, which has no observations."""
    level, against = placement.assessment.level_deg, NOTHING_AGAINST
    if level > MOST_LEVEL_DEG:
        against = Against((), (), (f"the directions are {level:.0f} degrees off the cameras",))
    return judge_model(placement, Shares(), against=against)


def judge_model(
    placement: Judged,
    shares: Shares,
    outside: Sequence[str] = (),
    suspicions: Sequence[str] = (),
    against: Against = NOTHING_AGAINST,
) -> ModelVerdict:
    """Apply the rules of the module's header.

    Args:
        placement: the evidence for pairs and cameras.
        shares: how much agrees.
        outside: names of cameras that are not in the output, or that no point supports.
        suspicions: what else speaks against the model, a clause each.
        against: what evidence that the fit did not use says.
    """
    bad = (*_reasons_against(shares), *against.reasons)
    trust, cameras = placement.assessment.trust, placement.cameras
    doubtful = trust < LOW_TRUST
    doubtful[uncertain_cameras(placement)] = True
    adjusted = placement.adjusted_covariances
    for group in placement.assessment.loose_groups:  # by the pairs; where the pixels were asked, they say
        doubtful[group.cameras] |= adjusted is None or bool(np.isnan(adjusted[group.cameras]).any())
    rows = np.flatnonzero(doubtful)
    names = [placement.graph.name_of(int(cameras[k])) for k in rows[np.argsort(trust[rows], kind="stable")]]
    named = tuple(dict.fromkeys([*outside, *against.cameras, *names]))
    unnamed = [*suspicions, *against.suspicions]
    if placement.second_configuration is not None:
        unnamed.append("many rejected pairs agree on a second configuration")
    if shares.placed < FEW_PLACED:
        unnamed.append(f"only {shares.placed:.0%} of the images are placed")
    elif shares.here < FEW_PLACED:
        unnamed.append(in_another_model(shares.here))
    reasons = bad or tuple(unnamed)
    grade = Grade.DO_NOT_USE if bad else Grade.LOOK if named or unnamed else Grade.GOOD
    return ModelVerdict(grade=grade, cameras=named, reasons=reasons)


def in_another_model(here: float) -> str:
    """Say that a model has only a share of the images that stand in some model."""
    return f"{1.0 - here:.0%} of the images stand in another model"


def _reasons_against(shares: Shares) -> Iterator[str]:
    """Yield why a model should not be used; a share that is not known is no reason."""
    if shares.contradicting >= HALF:
        yield f"{shares.contradicting:.0%} of the observations contradict the cameras"
    if shares.placed < HALF:
        yield f"only {shares.placed:.0%} of the images are placed"


def uncertain_cameras(placement: Judged) -> IntArray:
    """Return the cameras, as rows of `placement.cameras`, whose standard deviation is large for the scene."""
    if len(placement.cameras) < SMALLEST_PIECE:
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(largest_sigmas(placement) > RARE * _extent(placement.locations))


def largest_sigmas(placement: Judged) -> FloatArray:
    """Return the largest of each camera's standard deviations along the axes."""
    return np.asarray(standard_deviations(placement.covariances).max(axis=1))


def _extent(locations: FloatArray) -> float:
    """Return the diagonal of the box around locations (n, d), without those that fly far outside."""
    inside = locations[distances_in_spreads(locations, locations) <= INSIDE]
    return float(np.linalg.norm(np.ptp(inside, axis=0)))
