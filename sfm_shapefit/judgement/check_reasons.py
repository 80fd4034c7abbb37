"""What speaks against a model as it stands, whatever program made it."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.wording import counted
from sfm_shapefit.judgement.evidence import ModelEvidence
from sfm_shapefit.judgement.grade import too_few_to_judge, weigh_evidence
from sfm_shapefit.judgement.pair_fits import PairFits
from sfm_shapefit.judgement.reasons import ARE_ITS_PICTURES, IS_ITS_DATABASE, Grade, Kind, Reason, of_model
from sfm_shapefit.scene.images import Images

_ROUNDING = 1e-9  # share of the largest coordinate; cameras no farther apart stand at the same place


class CheckedModel(NamedTuple):
    """A model as it stands, and what is known of it."""

    images: Images
    """The images with a pose."""
    fits: PairFits | None
    """How pairs fit; None if no pair has a match."""
    evidence: ModelEvidence
    weak: tuple[Reason, ...]
    """What is weak about how points hold images."""
    has_points: bool
    """Whether the model has any, or the matches of its pictures make some."""
    has_database: bool
    is_matched_here: bool
    """Whether the matches were made of its pictures for this."""
    num_missing: int
    """Images that the database lacks."""


def of_alike_pictures(findings: Iterable[Reason]) -> Iterator[Reason]:
    """Yield findings of pairs far apart in pose alone: where sides are alike, a sound model has them, too."""
    clause = (
        "pictures of cameras far apart contradict it, neighbors do not: the scene repeats, or it is folded"
    )
    yield of_model(Kind.REPEATED, clause)
    yield from (replace(one, grade=min(one.grade, Grade.LOOK, key=list(Grade).index)) for one in findings)


def reasons_against(model: CheckedModel) -> Iterator[Reason]:
    """Yield what speaks against a model; a weak camera that stands where another model has it is right."""
    fits, evidence, centers = model.fits, model.evidence, model.images.centers
    if np.ptp(centers, axis=0).max() <= _ROUNDING * np.abs(centers).max():
        clause = "all its cameras are at the same place; place them with sfm-shapefit locate"
        yield of_model(Kind.PLACE, clause, Grade.DO_NOT_USE)
        return
    if fits is None or not (fits.contradicts.any() or np.isfinite(fits.residuals_deg).any()):
        is_bare = not (model.has_points or model.has_database)
        clause = "no two of its images have matches that say where they are relative to each other"
        clause = "it has no 3D points, and no database was given or found" if is_bare else clause
        yield of_model(Kind.UNCHECKED, clause, Grade.CANNOT_BE_JUDGED)
    yield from too_few_to_judge(model.images.num_images)
    against = list(weigh_evidence(evidence, model.images))
    yield from against
    if fits is not None and not any(one.grade is Grade.DO_NOT_USE for one in against):
        yield from _none_agrees(fits, model)
    yield from (one for one in model.weak if not evidence.opinion.confirmed.issuperset(one.images))
    if not model.has_points:
        clause = "it has no 3D points, so that only matches support where its cameras are"
        yield of_model(Kind.POINTS, clause)
    if model.num_missing:
        clause = f"the database lacks {counted(model.num_missing, 'image')}: {IS_ITS_DATABASE}"
        yield of_model(Kind.INPUT, clause)


def _none_agrees(fits: PairFits, model: CheckedModel) -> Iterator[Reason]:
    """Yield that pairs contradict and none agrees; a model's own points tie it whatever its database is."""
    if (against := int(fits.contradicts.sum())) and not fits.agrees.any():
        whose = ARE_ITS_PICTURES if model.is_matched_here else IS_ITS_DATABASE
        question = f": {whose}" * model.has_database
        pairs = f"{counted(against, 'pair')} contradict{'s' * (against == 1)} it"
        yield of_model(Kind.INPUT, f"{pairs} and none agrees{question}", Grade.DO_NOT_USE)
