"""What warnings say and what the verdict says go together: a doubt is a reason, and advice the verdict's."""

import ast
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sfm_shapefit
from sfm_shapefit.facts.located_warnings import located_warnings
from sfm_shapefit.facts.rows import own_camera_rows
from sfm_shapefit.facts.warnings import match_warnings, quality_warnings, support_warnings
from sfm_shapefit.judgement.evidence import ModelEvidence
from sfm_shapefit.judgement.reasons import Grade, Kind, ModelVerdict, Reason, of_each
from sfm_shapefit.pairs.pair_directions import DirectionStatus
from sfm_shapefit.placement.second_configuration import Found, SecondConfiguration
from tests.judgement.made import group_apart, opinion_with, place_of, untied_group, wrong_lens

PACKAGE = Path(sfm_shapefit.__file__).parent
ADVICE = re.compile("trust it|without a look|do not use|can(not)? be used|is sound|is good", re.IGNORECASE)
SPEAKERS = {"judgement/reasons.py", "report/first_screen.py"}
"""What says what a model is worth."""


def evidence_against(images):
    """Evidence of each kind against a model, by what it is about."""
    one, two, three, four = images.names[1:5]
    return {
        "lenses": ModelEvidence(lenses=(wrong_lens(images.lenses[0]),)),
        "places": ModelEvidence(places=(place_of(three),)),
        "seams": ModelEvidence(seams=(group_apart(one, two),)),
        "loose": ModelEvidence(untied=(untied_group(one, two),)),
        "untied": ModelEvidence(untied=(untied_group(one, two, is_loose=False),)),
        "contradicted": ModelEvidence(contradicted=(two,), contradictions={two: (9, 5)}),
        "wrong by a second opinion": ModelEvidence(second=opinion_with(wrong=(two,))),
        "undecided": ModelEvidence(second=opinion_with(undecided=(two, four))),
        "ambiguous": ModelEvidence(second=opinion_with(ambiguous=(two,))),
    }


def uncertain(found):
    covariances, extent = found.placement.covariances.copy(), np.ptp(found.placement.locations, axis=0).max()
    covariances[2] = extent**2 * np.eye(3)
    placement = replace(found.placement, adjusted_covariances=covariances)
    return replace(found, placement=placement), quality_warnings(placement)


def second_configuration(found):
    second = SecondConfiguration(found=Found.BY_A_START, cameras=np.array([1, 2]), num_pairs=9, num_against=9)
    placement = replace(found.placement, second_configuration=second)
    return replace(found, placement=placement), quality_warnings(placement)


def unsupported(found):
    told = replace(found, support=found.support._replace(unsupported=np.arange(8) == 3))
    return told, support_warnings([found.images.names[3]])


def twofold(found, status=DirectionStatus.TWO_MOTIONS):
    statuses = tuple(status if k % 3 else one for k, one in enumerate(found.directions.status))
    told = replace(found, directions=replace(found.directions, status=statuses))
    return told, match_warnings(told.directions, may_repeat=True)


def contradicting_rotations(found):
    return twofold(found, DirectionStatus.LOW_INLIER_RATIO)


DOUBTS = (uncertain, second_configuration, unsupported, twofold, contradicting_rotations)


@pytest.mark.parametrize("doubt", DOUBTS)
def test_a_warning_that_doubts_a_model_stands_over_no_good_one(ring_located, doubt):
    told, warnings = doubt(ring_located)
    assert list(warnings)
    assert told.verdict.grade is not Grade.GOOD


def test_an_image_that_is_left_out_is_named_where_it_is_listed_and_in_no_warning(ring_located):
    told = replace(ring_located, kept=np.arange(8) != 3)
    rows = {one.label: list(one.lines) for one in told.told.rows}
    assert rows["not trusted"] == ["1 image of those above; min_trust=0 keeps it"]
    assert told.verdict.cameras == (told.images.names[3],)
    assert not any(told.images.names[3] in warning for warning in located_warnings(told, ()))


def test_an_image_left_out_by_a_high_min_trust_alone_is_told_without_an_empty_reason(ring_located):
    placement = ring_located.placement
    reasons = ("", "its pairs contradict it", *placement.assessment.reasons[2:])
    doubted = replace(placement, assessment=replace(placement.assessment, reasons=reasons))
    told = own_camera_rows(doubted, np.full((8, 3), np.nan), 1.0).columns["reason"]
    assert list(told[:2]) == ["not trusted (1.00)", "not trusted (1.00): its pairs contradict it"]


def test_evidence_that_is_told_is_in_the_verdict_and_each_named_camera_has_its_reason(ring_located):
    for name, evidence in evidence_against(ring_located.placed).items():
        assert evidence.statements, name
        verdict = replace(ring_located, evidence=evidence).verdict
        assert verdict.grade is not Grade.GOOD, name
        assert {image for one in verdict.findings for image in one.images} == set(verdict.cameras)
        assert all(one.sentence for one in verdict.findings)


def test_what_stands_beside_any_grade_says_nothing_of_it(ring_located):
    agreement = replace(ring_located.placement.agreement, agrees=np.arange(len(ring_located.pairs)) % 3 == 0)
    residuals_deg = np.full(len(agreement.agrees), 5.0)
    assessment = replace(ring_located.placement.assessment, residuals_deg=residuals_deg)
    certified = replace(ring_located.placement.certified, unique=False)
    placement = replace(
        ring_located.placement, agreement=agreement, assessment=assessment, certified=certified
    )
    warnings = list(quality_warnings(placement))
    assert len(warnings) == 2
    assert not any(ADVICE.search(one) for one in warnings)
    assert replace(ring_located, placement=placement).verdict.grade is Grade.GOOD


def test_only_the_verdict_says_what_a_model_is_worth():
    """All sentences of the package, told in pieces or whole."""
    said = []
    for path in PACKAGE.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        described = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        texts = [
            node for node in ast.walk(tree) if isinstance(node, ast.Constant) and id(node) not in described
        ]
        is_told = path.parts[-2] in ("facts", "judgement", "placement", "report")
        if is_told and str(path.relative_to(PACKAGE)) not in SPEAKERS:
            said += [(path.name, node.value) for node in texts if isinstance(node.value, str)]
    assert len(said) > 1000
    assert [(name, text) for name, text in said if ADVICE.search(text)] == []


def test_the_worst_reason_decides_and_only_the_worst_are_told():
    look = Reason(kind=Kind.LENS, sentence="images contradict 1 focal length", images=("b",))
    cannot, bad = (Reason(kind=Kind.PAIRS, sentence=grade.value, grade=grade) for grade in list(Grade)[2:])
    each = of_each(Kind.POINTS, ["a"], "it sees no 3D points")
    assert ModelVerdict.weigh(()).grade is Grade.GOOD
    for findings, grade in (
        ([*each, look], "look"),
        ([look, cannot], cannot.sentence),
        ([bad, cannot], bad.sentence),
    ):
        verdict = ModelVerdict.weigh(findings)
        assert verdict.grade == grade
        assert verdict.is_usable == (grade == "look")
        assert verdict.reasons == tuple(
            one.sentence for one in findings if one.grade == grade and not one.of_each
        )
    assert ModelVerdict.weigh([*each, look]).cameras == ("a", "b")
    first = Reason(kind=Kind.INPUT, sentence="its poses are those of OpenGL")
    assert ModelVerdict.weigh([bad]).led_by(first).reasons == (first.sentence, bad.sentence)
    assert ModelVerdict.weigh(()).led_by(first).grade is Grade.LOOK
