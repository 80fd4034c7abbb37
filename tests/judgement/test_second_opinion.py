"""A second opinion: who stands elsewhere in another model, and which of the two the pairs support."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.judgement.evidence import ModelEvidence
from sfm_shapefit.judgement.grade import weigh_evidence
from sfm_shapefit.judgement.pair_fits import fit_pairs
from sfm_shapefit.judgement.reasons import Grade
from sfm_shapefit.judgement.second_opinion import compare_models
from tests.judgement.made import group_apart, opinion_with, place_of, untied_group
from tests.judgement.test_pair_fits import measured
from tests.judgement.test_seams import GROUP, N
from tests.scenes import COURTYARD


@pytest.fixture(scope="module")
def images():
    return read_model(COURTYARD / "truth").images.part(np.arange(N))


def moved(images, rows, *, shift=0.0, scale=1.0, turn_deg=0.0):
    """The images with some of them moved about their middle."""
    frames, own = images.frames, images.frame_of[rows]
    turn = Rotation.from_rotvec(np.radians(turn_deg) * np.array([0.6, 0.0, 0.8])).as_matrix()
    centers, rotations = frames.centers.copy(), frames.rotations.copy()
    about = centers[own].mean(axis=0)
    centers[own] = about + shift + scale * (centers[own] - about) @ turn.T
    rotations[own] = rotations[own] @ turn.T
    return replace(images, frames=replace(frames, centers=centers, rotations=rotations))


def rows_of(images, names):
    return sorted(map(images.names.index, names))


def in_other_axes(images):
    turn = Rotation.from_rotvec([0.4, -1.0, 2.0]).as_matrix()
    frames = images.frames
    centers = 3.0 * frames.centers @ turn.T + [5.0, -7.0, 1.0]
    return replace(images, frames=replace(frames, centers=centers, rotations=frames.rotations @ turn.T))


def compare(images, others, truth, doubted=()):
    """Compare two models by directions that are those of the truth, each in its own axes."""
    fits = fit_pairs(images.centers, measured(truth.centers))
    others, truth = in_other_axes(others), in_other_axes(truth)
    other_fits = fit_pairs(others.centers, measured(truth.centers))
    return compare_models(images, fits, others, other_fits, np.isin(np.arange(N), doubted))


@pytest.mark.parametrize("how", [{"shift": 2.0}, {"scale": 1.1}, {"turn_deg": 3.0}, {"turn_deg": 90.0}])
def test_a_group_that_is_wrong_as_a_whole_is_named_by_a_model_that_has_it_right(images, how):
    found = compare(moved(images, GROUP, **how), images, images)
    assert set(rows_of(images, found.wrong)) <= set(GROUP.tolist())
    assert len(found.wrong) >= len(GROUP) - ("scale" in how)  # one may be near the middle, which stays
    assert found.num_against > 10 * max(found.num_for, 1)
    assert set(rows_of(images, found.confirmed)) >= set(range(N)) - set(GROUP.tolist())
    assert found.usual < 1e-6


def test_what_is_wrong_in_the_other_model_says_nothing_against_this_one(images):
    found = compare(images, moved(images, GROUP, shift=2.0), images)
    assert (len(found.wrong), len(found.undecided)) == (0, 0)
    assert len(found.confirmed) == N - len(GROUP)


@pytest.mark.parametrize("how", [{}, {"shift": 1e-10}, {"turn_deg": 1e-8}])
def test_models_that_agree_have_all_cameras_confirmed(images, how):
    """Rounding, which is all that differs, is larger for some cameras than for most."""
    found = compare(moved(images, [5], **how), images, images)
    assert (found.num_common, len(found.confirmed)) == (N, N)
    assert (len(found.wrong), len(found.undecided)) == (0, 0)


@pytest.mark.parametrize(("bent", "num_confirmed"), [(0.005, N), (0.1, 0)])
def test_a_model_that_differs_as_a_whole_confirms_nobody(images, bent, num_confirmed):
    """A wrong lens stretches all that it sees along one axis; no camera stands out then."""
    frames = images.frames
    stretched = replace(images, frames=replace(frames, centers=frames.centers * [1.0 + bent, 1.0, 1.0]))
    assert len(compare(stretched, images, images).confirmed) == num_confirmed


def test_a_camera_that_the_other_model_doubts_is_not_confirmed_by_it(images):
    found = compare(moved(images, [5], shift=2.0), images, images, doubted=[5, 7])
    assert rows_of(images, found.ambiguous) == [7]  # 5 stands elsewhere, where pairs support it
    assert rows_of(images, found.wrong) == [5]
    assert sorted([*rows_of(images, found.confirmed), 5, 7]) == list(range(N))


@pytest.mark.parametrize(("wrong", "apart"), [([5], False), ([5, 6], True)])
def test_a_single_camera_elsewhere_is_no_group_that_stands_apart(images, wrong, apart):
    second = compare(moved(images, wrong, shift=2.0), images, images)
    assert rows_of(images, second.wrong) == wrong
    said = [one.sentence for one in weigh_evidence(ModelEvidence(second=second), images)]
    assert any("stand apart from the rest" in sentence for sentence in said) == apart


def test_what_it_clears_is_not_told(images):
    """Of groups on both sides of a seam the wrong one is; who stands alike in both has one place."""

    def named(*rows):
        return tuple(images.names[k] for k in rows)

    evidence = ModelEvidence(
        places=tuple(map(place_of, named(5, 7))),
        contradicted=named(5, 7),
        contradictions=dict.fromkeys(named(5, 7), (9, 5)),
        seams=tuple(group_apart(*named(*rows)) for rows in ([5, 6], [8, 9], [0, 7])),
        untied=tuple(untied_group(*named(*rows)) for rows in ([5, 6], [8, 9])),
    )
    contradicting = [
        named(*pair) for pair in ((5, 8), (6, 8), (5, 9), (4, 8), (0, 1), (2, 7), (0, 5), (6, 7))
    ]
    second = compare(moved(images, [5, 6], shift=2.0), images, images, doubted=[0, 8, 9])
    both = evidence.beside(second, contradicting)
    assert tuple(one.image for one in both.places) == both.contradicted == named(5)
    # Only half of the pairs that contradict 0 and 7 are with what is wrong.
    assert both.apart == [named(5, 6), named(0, 7), named(5, 6)]
    reasons = list(weigh_evidence(both, images))
    assert {name for one in reasons for name in one.images} == {
        *named(0, 5, 6, 7, 8, 9)
    }  # three are doubted there
    assert f"4 of {N} cameras stand apart from the rest" in [one.sentence for one in reasons]
    good = evidence.beside(replace(second, grade=Grade.GOOD), contradicting)
    assert [one.images for one in good.seams] == [named(5, 6)]  # who stands as in a good model is right
    neither = evidence.beside(replace(second, wrong=()), contradicting)
    assert (neither.seams, neither.untied) == (evidence.seams, evidence.untied)


def test_where_pairs_support_neither_nobody_is_believed(images):
    one, other = moved(images, [5], shift=2.0), moved(images, [5], shift=-2.0)
    found = compare(one, other, images)
    assert found.wrong == ()
    half = measured(images.centers)
    pairs = half.pairs
    towards = np.where((np.arange(len(pairs)) % 2 == 0)[:, None], one.centers[5], other.centers[5])
    ends = np.where((pairs == 5)[:, :, None], towards[:, None], images.centers[pairs])
    lies = ends[:, 0] - ends[:, 1]
    half = replace(half, directions=lies / np.linalg.norm(lies, axis=1, keepdims=True))
    nobody = np.zeros(N, dtype=np.bool_)
    found = compare_models(one, fit_pairs(one.centers, half), other, fit_pairs(other.centers, half), nobody)
    assert rows_of(images, found.undecided) == [5]


def test_without_cameras_in_common_there_is_no_opinion(images):
    others = replace(images, names=tuple(f"other-{name}" for name in images.names))
    assert compare(images, others, images) is None


def test_of_a_group_those_are_named_whom_the_second_opinion_names(images):
    """Pairs support neither of two places of 5 and 6; 4 stands alike in both."""
    unlike, group = ([images.names[k] for k in rows] for rows in ([5, 6], [4, 5, 6]))
    confirmed = frozenset(images.names) - {*unlike}
    second = opinion_with(undecided=tuple(unlike), confirmed=confirmed)
    evidence = ModelEvidence(seams=(group_apart(*group),), second=second)
    assert {name for one in weigh_evidence(evidence, images) for name in one.images} == {*unlike}


def test_a_camera_of_few_pairs_is_judged_by_those_of_all_that_stand_elsewhere(images):
    every = measured(images.centers)
    few = (every.pairs == 6).any(axis=1) & ~np.isin(every.pairs, [0, 1]).any(axis=1)
    truth = every.subset(np.flatnonzero(~few))  # 6 has two pairs
    wrong = moved(images, [5, 6], shift=2.0)
    fits = [fit_pairs(one.centers, truth) for one in (wrong, images)]
    found = compare_models(wrong, fits[0], images, fits[1], np.zeros(N, dtype=np.bool_))
    assert rows_of(images, found.wrong) == [5, 6]
