"""One verdict for a model, by rules that are written down."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_shapefit import synthetic
from sfm_shapefit.commands.place import place
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.evidence import ModelEvidence
from sfm_shapefit.judgement.grade import weigh_evidence
from sfm_shapefit.judgement.graph_grade import judge_graph
from sfm_shapefit.judgement.reasons import Grade
from sfm_shapefit.judgement.support import EvidenceShares
from sfm_shapefit.pairs.pair_directions import DirectionStatus
from sfm_shapefit.placement.prior_fit import PriorFit
from sfm_shapefit.placement.second_configuration import Found, SecondConfiguration
from tests.judgement.made import group_apart, place_of, untied_group, wrong_lens
from tests.program import run
from tests.scenes import BUNDLED


@pytest.fixture
def found(ring_located):
    return ring_located


def with_assessment(found, **changes):
    placement = found.placement
    return replace(found, placement=replace(placement, assessment=replace(placement.assessment, **changes)))


def test_a_sound_model_is_good(found):
    assert found.verdict.grade is Grade.GOOD
    assert found.verdict.statement == "good"
    assert found.summary()["verdict"] == {
        "grade": "good",
        "statement": "good",
        "cameras": [],
        "reasons": [],
        "findings": [],
    }


def test_doubtful_and_left_out_cameras_are_named_the_left_out_first(found):
    trust = np.ones(len(found.kept))
    trust[[1, 2]] = 0.7, 0.65
    kept = np.ones(len(found.kept), dtype=bool)
    kept[5] = False
    verdict = replace(with_assessment(found, trust=trust), kept=kept).verdict
    names = found.images.names
    assert verdict.grade is Grade.LOOK
    assert verdict.cameras == (names[5], names[2], names[1])
    there = f"look at 2 cameras ({names[2]}, {names[1]})"
    assert verdict.statement == f"{there}; 1 image is left out ({names[5]})"


@pytest.mark.parametrize(
    ("share", "contradicting", "grade"),
    [
        (0.1, 0.49, Grade.GOOD),
        (0.4, 0.51, Grade.DO_NOT_USE),
    ],
)
def test_what_contradicts_makes_a_model_bad_and_what_sees_no_point_decides_nothing(
    found, share, contradicting, grade
):
    verdict = replace(
        found,
        support=found.support._replace(
            observations=EvidenceShares(observations=share, contradicting=contradicting)
        ),
    ).verdict
    assert verdict.grade is grade
    told = "51% of the observations contradict the cameras"
    assert verdict.reasons == (() if grade is Grade.GOOD else (told,))


def test_a_model_less_than_half_of_which_agreeing_pairs_hold_is_not_to_be_used(found):
    """However many pairs contradict: half of all matches permuted leave a right model right."""
    assert replace(found, evidence=ModelEvidence(num_held=4)).verdict.grade is Grade.GOOD
    verdict = replace(found, evidence=ModelEvidence(num_held=3)).verdict
    assert verdict.statement == "do not use: the pairs that agree hold only 3 of 8 cameras"
    assert found.evidence.num_held == 8
    assert with_assessment(found, level_deg=40.0).verdict.grade is Grade.GOOD


def test_a_model_most_of_whose_cameras_are_not_trusted_is_not_to_be_used(found):
    kept = np.arange(len(found.kept)) < len(found.kept) // 2 - 1
    assert replace(found, kept=kept, placed=found.placed.without(~kept)).verdict.is_bad


def test_pairs_that_contradict_the_rotations_count_against_a_model(found):
    """Three of four pairs of the ring say that the rotations are wrong."""
    status = tuple(
        DirectionStatus.LOW_INLIER_RATIO if k % 8 else one for k, one in enumerate(found.directions.status)
    )
    told = replace(found, directions=replace(found.directions, status=status))
    assert told.agreeing_pairs < found.agreeing_pairs


def test_one_prior_may_be_wrong_and_two_of_eight_make_a_look_worthwhile(found):
    for wrong, grade in ((1, Grade.GOOD), (2, Grade.LOOK)):
        fit = PriorFit(np.ones(len(found.images.names)), np.arange(wrong), np.zeros(0))
        verdict = replace(found, prior_fit=fit).verdict
        assert verdict.grade is grade
    assert verdict.reasons == ("2 of 8 position priors contradict where cameras stand",)


def test_rejected_pairs_that_agree_on_a_second_configuration_make_a_look_worthwhile(found):
    seen = SecondConfiguration(
        found=Found.BY_REJECTED_PAIRS, cameras=np.arange(8), num_pairs=9, num_against=20
    )
    verdict = replace(found, placement=replace(found.placement, second_configuration=seen)).verdict
    assert verdict.statement == "look: many rejected pairs agree on a second configuration"


def test_matches_that_agree_on_two_directions_make_a_look_worthwhile(found):
    twofold = tuple(
        DirectionStatus.TWO_MOTIONS if k % 3 == 0 else one for k, one in enumerate(found.directions.status)
    )
    verdict = replace(found, directions=replace(found.directions, status=twofold)).verdict
    assert verdict.grade is Grade.LOOK
    assert "facade repeats" in verdict.statement


def test_a_graph_of_noise_is_not_to_be_used():
    """Directions drawn at random agree with no placement."""
    problem = synthetic.random_graph_problem(30, 0.5, 3, q=1.0, seed=2)
    placed = place(problem.view_graph)
    verdict, level_deg = judge_graph(placed), placed.assessment.level_deg
    assert verdict.is_bad
    assert verdict.reasons == (f"the directions are {level_deg:.0f} degrees off the cameras",)


def test_strict_ends_with_code_4_where_the_verdict_is_do_not_use_and_writes_the_output(tmp_path):
    lines = (BUNDLED / "graph40.txt").read_text().splitlines()
    rng = np.random.default_rng(0)
    drawn = []
    for line in lines:
        cells = line.split()
        if len(cells) == 5 and not line.startswith("#"):
            vector = rng.standard_normal(3)
            cells[2:] = [repr(float(v)) for v in vector / np.linalg.norm(vector)]
        drawn.append(" ".join(cells))
    graph = tmp_path / "noise.txt"
    graph.write_text("\n".join(drawn) + "\n")
    assert "do not use" in run("place", graph, tmp_path / "free", "--no-report", code=0).stdout
    run("place", graph, tmp_path / "strict", "--no-report", "--strict", code=4)
    assert (tmp_path / "strict" / "locate.json").exists()
    run("place", BUNDLED / "graph40.txt", tmp_path / "sound", "--no-report", "--strict", code=0)


def test_evidence_that_the_fit_did_not_use_names_cameras_and_lowers_the_grade(found):
    names = found.images.names
    verdict = replace(found, evidence=ModelEvidence(places=(place_of(names[3]),))).verdict
    assert (verdict.grade, verdict.cameras) == (Grade.LOOK, (names[3],))

    lens = wrong_lens(found.placed.lenses[0])
    verdict = replace(found, evidence=ModelEvidence(lenses=(lens,))).verdict
    assert (verdict.grade, verdict.cameras) == (Grade.LOOK, ())  # a lens of all images names none of them
    assert verdict.reasons == ("images contradict 1 focal length",)

    verdict = replace(found, evidence=ModelEvidence(seams=(group_apart(*names[1:3]),))).verdict
    assert (verdict.grade, verdict.cameras) == (Grade.DO_NOT_USE, (names[1], names[2]))
    assert verdict.reasons == ("2 of 8 cameras stand apart from the rest",)
    assert verdict.statement == "do not use: 2 of 8 cameras stand apart from the rest"
    verdict = replace(found, evidence=ModelEvidence(seams=(group_apart(*names[1:4]),))).verdict
    assert verdict.reasons == ("3 of 8 cameras stand apart from the rest",)  # and that is said once
    rival = replace(group_apart(*names[1:4]), is_rival=True)
    verdict = replace(found, evidence=ModelEvidence(seams=(rival,))).verdict
    assert (verdict.grade, verdict.cameras) == (Grade.LOOK, names[1:4])
    assert verdict.reasons == ("3 of 8 cameras may stand apart from the rest",)
    both = ModelEvidence(seams=(group_apart(*names[2:4]), rival))
    assert replace(found, evidence=both).verdict.statement == (
        "do not use: 2 of 8 cameras stand apart from the rest"
    )


def test_a_loose_group_stands_apart_and_an_unchecked_one_is_looked_at(found):
    names = found.images.names
    for is_loose, grade, reason in (
        (True, Grade.DO_NOT_USE, "nothing says where 2 of 8 cameras are relative to the rest"),
        (False, Grade.LOOK, "nothing checks where groups of cameras are relative to one another"),
    ):
        group = untied_group(*names[1:3], is_loose=is_loose)
        verdict = replace(found, evidence=ModelEvidence(untied=(group,))).verdict
        assert (verdict.grade, verdict.cameras, verdict.reasons) == (grade, (names[1], names[2]), (reason,))
    assert verdict.statement == f"look at 2 cameras ({names[1]}, {names[2]}); {reason}"


def test_a_model_a_third_of_which_is_named_is_not_to_be_used_and_a_small_seam_is_looked_at(found):
    few, many = (ModelEvidence(places=tuple(map(place_of, found.images.names[first:5]))) for first in (3, 2))
    assert replace(found, evidence=few).verdict.grade is Grade.LOOK
    verdict = replace(found, evidence=many).verdict
    assert verdict.grade is Grade.DO_NOT_USE
    assert verdict.reasons == ("evidence speaks against 3 of 8 cameras",)
    images = replace(found.placed, lens_of=np.zeros(8, dtype=int))
    large = images.part(np.zeros(0, dtype=int))
    assert list(weigh_evidence(ModelEvidence(), large)) == []
    assert all(one.of_each for one in weigh_evidence(few, images))


def test_images_that_are_not_placed_are_told_and_count(found):
    gone = np.arange(8) < 1
    verdict = replace(found, placed=found.placed.without(gone)).verdict
    assert (verdict.grade, verdict.reasons) == (Grade.LOOK, ("only 88% of the images are placed",))
    verdict = replace(found, placed=found.placed.without(np.arange(8) < 5)).verdict
    assert (verdict.grade, verdict.reasons) == (Grade.DO_NOT_USE, ("only 38% of the images are placed",))


def test_a_camera_that_is_known_worse_than_the_scene_is_large_is_held_by_nothing(found):
    placement = found.placement
    covariances = placement.covariances.copy()
    extent = np.linalg.norm(np.ptp(placement.locations, axis=0))
    covariances[2] = (1.1 * extent) ** 2 * np.eye(3)
    covariances[3] = (0.9 * extent) ** 2 * np.eye(3)
    placement = replace(placement, adjusted_covariances=covariances)
    assert set(replace(found, placement=placement).verdict.cameras) == {found.images.names[k] for k in (2, 3)}
    known = placement.covariances
    assert np.isinf(known[2]).all()
    assert np.isfinite(np.delete(known, 2, axis=0)).all()


def test_a_graph_none_of_whose_pairs_is_checked_by_others_cannot_be_judged():
    """A triangle in the plane fits any three directions that close."""
    edges, corners = np.array([(0, 1), (0, 2), (1, 2)]), np.array([[0.0, 0.0], [1.0, 0.1], [0.3, 0.8]])
    ways = corners[edges[:, 0]] - corners[edges[:, 1]]
    verdict = judge_graph(place(ViewGraph(3, edges, ways / np.linalg.norm(ways, axis=1, keepdims=True))))
    assert verdict.statement == "cannot be judged: no pair is checked by others"
