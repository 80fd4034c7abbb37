"""Each stage of `check` alone: from the ring as it stands, or a little off, not from other stages."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sfm_shapefit.base.clock import Clock
from sfm_shapefit.facts.check_result import OtherModel
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.points import points_of
from sfm_shapefit.judgement.evidence import ModelEvidence
from sfm_shapefit.judgement.image_quality import find_weak_images
from sfm_shapefit.judgement.pair_fits import fit_pairs
from sfm_shapefit.judgement.reasons import Grade, Kind, of_each
from sfm_shapefit.pairs.direction_options import DirectionOptions
from sfm_shapefit.pipeline.bundle import points_of_pictures
from sfm_shapefit.pipeline.referee import (
    CheckState,
    compare_with_other,
    finish_check,
    fit_directions,
    gather_evidence_against,
    grade_model,
    read_structure,
)
from tests.judgement.made import opinion_with
from tests.pipeline.made import FOLDER, directions_of, opened

MODEL = read_model(FOLDER)
TRUTH = MODEL.images


def moved(camera, share=0.3):
    """The places of the ring's cameras, one of them a share of the way to a camera across."""
    centers = TRUTH.centers.copy()
    centers[camera] += share * (TRUTH.centers[(camera + 4) % 8] - TRUTH.centers[camera])
    return centers


def state_of(source, **found):
    """The ring with its points and exact directions, and with what else stages are said to have found."""
    state = CheckState(model=MODEL, source=source, options=DirectionOptions(), evidence=ModelEvidence())
    state = replace(state, fits=fit_pairs(TRUTH.centers, directions_of(TRUTH)))
    return replace(read_structure(state, Clock()), **found)


def test_structure_has_the_models_points_and_names_images_that_few_of_them_hold_or_that_they_miss():
    with opened() as source:
        state = state_of(source)
    assert state.structure.points.num_points == MODEL.num_points
    assert state.weak == ()
    counts, errors = state.quality.num_points.copy(), state.quality.errors_px.copy()
    counts[2], errors[5] = 29, 0.76
    few = replace(state.quality, num_points=counts, errors_px=errors)
    weak = list(find_weak_images(TRUTH, few))
    assert [one.images for one in weak] == [(TRUTH.names[2],), (TRUTH.names[5],)]
    assert weak[0].sentence == "it sees only 29 3D points"
    assert "its reprojection error is 0.8 px" in weak[1].sentence


def test_directions_fit_the_true_cameras_and_contradict_one_that_stands_elsewhere():
    with opened() as source:
        right = fit_directions(state_of(source, fits=None), Clock()).fits
        away = replace(MODEL, images=TRUTH.placed(np.arange(8), moved(2)))
        wrong = fit_directions(state_of(source, fits=None, model=away), Clock()).fits
    assert right.agrees.all()
    assert wrong.contradicts.any()
    assert (wrong.directions.pairs[wrong.contradicts] == 2).any(axis=1).all()


def test_points_of_pictures_are_those_that_agreeing_pairs_see_where_the_cameras_stand():
    with opened() as source:
        fits = fit_pairs(TRUTH.centers, directions_of(TRUTH, source.view.pairs))
        every = points_of_pictures(source, fits).points
        without = replace(fits, contradicts=(fits.directions.pairs == 2).any(axis=1))
        some = points_of_pictures(source, without).points
    known = points_of(MODEL.arrays, TRUTH)
    nearest = cKDTree(known.xyz).query(every.xyz)[0]
    assert np.median(nearest) < 1e-3 * np.ptp(TRUTH.centers)
    assert 2 in every.images
    assert 2 not in some.images
    assert some.num_points > 100


def test_evidence_names_the_camera_that_pairs_put_elsewhere():
    with opened() as source:
        fits = fit_pairs(moved(2), directions_of(TRUTH, source.view.pairs))
        evidence = gather_evidence_against(state_of(source, fits=fits), Clock()).evidence
    assert {*(one.image for one in evidence.places), *evidence.contradicted} == {TRUTH.names[2]}
    assert evidence.seams == ()


@pytest.mark.parametrize("confirmed", [True, False])
def test_a_single_camera_that_another_model_has_elsewhere_counts_unless_the_pixels_confirm_it(
    confirmed, ring_mapped
):
    """The pairs support the other place; the pixels see the points, or not where these are turned over."""
    others = TRUTH.placed(np.arange(8), moved(2))
    directions = directions_of(others)
    fits = fit_pairs(others.centers, directions)
    with opened() as source:
        state = state_of(source, fits=fit_pairs(TRUTH.centers, directions))
        if not confirmed:
            points = replace(state.structure.points, xyz=-state.structure.points.xyz)
            state = replace(state, structure=replace(state.structure, points=points))
        other = OtherModel(others, fits, np.zeros(8, dtype=np.bool_), ring_mapped, 0)
        second = compare_with_other(replace(state, other=other)).evidence.second
        assert compare_with_other(state) is state
    assert [*second.wrong, *second.undecided] == ([] if confirmed else [TRUTH.names[2]])
    assert second.folder == "0"


def test_a_weak_image_that_stands_where_another_model_has_it_is_not_named():
    weak = of_each(Kind.POINTS, TRUTH.names, "it sees no 3D points")
    with opened() as source:
        state = state_of(source, weak=weak)
        assert set(grade_model(state, Clock()).verdict.cameras) == set(TRUTH.names)
        evidence = ModelEvidence(second=opinion_with(confirmed=frozenset(TRUTH.names)))
        confirmed = grade_model(replace(state, evidence=evidence), Clock())
    assert confirmed.verdict.cameras == ()
    assert confirmed.verdict.grade is Grade.GOOD


def test_pairs_that_leave_everything_open_do_not_contradict_a_model_and_those_that_only_contradict_do():
    with opened() as source:
        state = state_of(source)
        nowhere = np.zeros_like(state.fits.agrees)
        undecided = replace(state, fits=replace(state.fits, agrees=nowhere, contradicts=nowhere))
        against = replace(state, fits=replace(state.fits, agrees=nowhere, contradicts=~nowhere))
        assert grade_model(undecided, Clock()).verdict.grade is Grade.GOOD
        verdict = grade_model(against, Clock()).verdict
        assert grade_model(replace(state, fits=None), Clock()).verdict.grade is Grade.CANNOT_BE_JUDGED
    assert "contradict it and none agrees: is this the model's database?" in verdict.statement


def test_the_result_has_a_row_for_each_camera_and_pair_and_the_figures_of_the_state():
    weak = of_each(Kind.POINTS, TRUTH.names[3:4], "it sees no 3D points")
    with opened() as source:
        state = grade_model(state_of(source, weak=weak), Clock())
        found = finish_check(state, Clock())
    assert [row.reason for row in found.cameras] == ["it sees no 3D points" * (k == 3) for k in range(8)]
    assert len(found.pairs) == len(state.fits.directions.pairs) == found.facts.num_pairs
    assert found.verdict is state.verdict
    assert found.facts.num_points == MODEL.num_points
