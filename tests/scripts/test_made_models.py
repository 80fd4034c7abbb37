"""Models that the benchmark of verdicts makes: the same for the same seed, and judged as they are made."""

import numpy as np
import pytest

import sfm_shapefit
from benchmarks.made_models import FAMILIES, simple_verdicts
from sfm_shapefit.judgement.reasons import Grade


def judged(family, seed=3):
    made = FAMILIES[family](np.random.default_rng(seed))
    return made, sfm_shapefit.check(made.model, second_opinion=False)


@pytest.mark.parametrize("family", [name for name in FAMILIES if name.startswith("nothing")])
def test_a_sound_model_is_good_whatever_share_of_its_pictures_points_cover(family):
    made, found = judged(family)
    assert made.is_sound
    assert found.verdict.grade is Grade.GOOD
    if family == "nothing, object scan":
        assert np.median(found.quality.coverage) < 0.15
    assert simple_verdicts(made.model)["by error"]


def test_poses_alone_cannot_be_judged():
    found = judged("poses only")[1]
    assert found.verdict.grade is Grade.CANNOT_BE_JUDGED
    assert found.facts.next_step.command.endswith("--images IMAGES")
    assert found.verdict.cameras == ()


def test_two_scenes_in_one_are_not_good_and_swapped_lenses_are_named():
    assert judged("two scenes mixed")[1].verdict.grade is not Grade.GOOD
    made, found = judged("lenses of two devices swapped")
    assert set(found.verdict.cameras) >= made.wrong
    assert simple_verdicts(made.model) == {"by error": 1, "by thresholds": 1}


@pytest.mark.parametrize("seed", [404, 406])
def test_a_camera_that_flies_is_named_alone_though_nothing_says_how_far_it_is(seed):
    made, found = judged("one camera flies", seed)
    assert set(found.verdict.cameras) == made.wrong  # by its lever, it would lend its error to all


def test_a_seed_makes_one_model():
    first, again, other = (judged("one camera flies", seed)[0] for seed in (1, 1, 2))
    places = [
        np.array([made.model.image(k + 1).projection_center() for k in range(24)])
        for made in (first, again, other)
    ]
    assert np.array_equal(places[0], places[1])
    assert not np.array_equal(places[0], places[2])
    assert len(first.wrong) == 1
