"""Trust by what the pairs say of rotations, on real matches of a bundled scene."""

from contextlib import closing
from dataclasses import replace

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.geometry import rotation_angles_deg
from sfm_shapefit.files.colmap.database import open_database
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.judgement.doubted import confirm_cameras, weigh_doubts
from sfm_shapefit.judgement.trust import LOW_TRUST
from sfm_shapefit.judgement.turns import Doubt
from sfm_shapefit.pairs.direction_options import DirectionOptions
from sfm_shapefit.pairs.essential import concatenate_rotations
from sfm_shapefit.pipeline.doubts import ask_pairs, ask_rotations, doubt_cameras
from sfm_shapefit.pipeline.inputs import inputs_from, see_matches
from sfm_shapefit.pipeline.measure import measure
from sfm_shapefit.pipeline.relative_rotations import measure_rotations
from sfm_shapefit.scene.lens import Lens, Origin
from tests.models import posed
from tests.problems import turn
from tests.scenes import COURTYARD, PHOTOGRAPHED, RING


@pytest.fixture(scope="module")
def photographed():
    return sfm_shapefit.locate(PHOTOGRAPHED / "sparse" / "0")


def turned(scene, chosen, angle_deg):
    """A model some of whose cameras, by their rank, are turned about one axis of the world."""
    wrong = {f"{k + 1:04d}.jpg" for k in chosen}
    back = turn([0.36, 0.48, 0.8], -angle_deg)
    changed = posed(
        scene / "sparse" / "0",
        lambda name, rotation, center: (rotation @ back if name in wrong else rotation, center),
    )
    return changed, wrong


def test_right_cameras_of_a_symmetric_scene_are_kept_and_the_group_is_named(photographed):
    found = photographed
    assert found.kept.all()
    ambiguous = np.flatnonzero(found.placement.assessment.ambiguous)
    assert [found.images.names[k] for k in ambiguous] == ["0004.jpg", "0005.jpg"]  # pixels confirm 0003.jpg
    assert any("many matches speak for turning 0004.jpg, 0005.jpg by 90 degrees" in w for w in found.warnings)
    assert set(found.verdict.cameras) == {"0004.jpg", "0005.jpg"}
    reasons = {row.name: row.reason for row in found.cameras if row.reason}
    assert set(reasons) == {"0004.jpg", "0005.jpg"}
    doubts = found.placement.assessment.doubts
    for k, reason in zip(ambiguous.tolist(), reasons.values(), strict=True):
        share = doubts.turned[k] / (doubts.placed[k] + doubts.turned[k])
        assert f"{share:.0%} of its evidence is for a turn by 90 degrees, together with 1 other" in reason


def test_confirmed_cameras_are_trusted_and_no_reason_counts_them(photographed):
    assessment = photographed.placement.assessment
    sure = assessment.ambiguous & (np.cumsum(assessment.ambiguous) == 1)
    found = confirm_cameras(assessment, sure)
    first, second = np.flatnonzero(assessment.ambiguous).tolist()
    assert found.trust[first] == LOW_TRUST
    assert found.reasons[first] == ""
    assert "other camera" not in found.reasons[second]
    assert np.flatnonzero(found.ambiguous).tolist() == [second]
    believed = confirm_cameras(replace(assessment, doubts=None), sure)
    assert believed.reasons == tuple("" if k == first else r for k, r in enumerate(assessment.reasons))


@pytest.mark.parametrize(
    ("guessed", "subject"), [(True, "its rotation, or its guessed focal length,"), (False, "its rotation")]
)
@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (Doubt.TURNED, "{} is wrong: 4 of its pairs agree on a turn by "),
        (Doubt.UNSUPPORTED, "none of its pairs agrees with it: {} may be wrong"),
    ],
)
def test_what_a_wrong_lens_explains_as_well_is_not_laid_to_the_rotation_alone(
    photographed, guessed, subject, kind, said
):
    found = photographed.placement.assessment
    doubts = replace(
        found.doubts,
        kinds=(kind,) * 16,
        num_turned=np.full(16, 4),
        turned=np.ones(16),
        placed=np.full(16, 0.1),
        guessed=np.full(16, guessed),
    )
    assert all(one.startswith(said.format(subject)) for one in weigh_doubts(found, doubts).reasons)


@pytest.mark.parametrize(
    ("lens", "expected"),
    [
        (Lens("SIMPLE_RADIAL", (9.0, 2.0, 1.0, 0.1), origin=Origin.GUESS, given=(9.0, 2.0, 1.0, 0.0)), True),
        (Lens("SIMPLE_RADIAL", (8.0, 2.0, 1.0, 0.1), origin=Origin.GUESS, given=(9.0, 2.0, 1.0, 0.0)), False),
        (Lens("SIMPLE_PINHOLE", (9.0, 2.0, 1.0), origin=Origin.GUESS), True),
        (Lens("SIMPLE_PINHOLE", (9.0, 2.0, 1.0), origin=Origin.EXIF, given=(9.0, 2.0, 1.0)), False),
        (Lens("SIMPLE_PINHOLE", (9.0, 2.0, 1.0)), False),
    ],
)
def test_a_guess_is_one_until_something_changes_it(photographed, lens, expected):
    images = photographed.images.with_lenses([lens])
    asked = concatenate_rotations([])
    found = doubt_cameras(photographed.placement, photographed.directions, asked, images)
    assert found.assessment.doubts.guessed.tolist() == 16 * [expected]


def test_every_camera_of_a_clean_scene_is_trusted(courtyard_located):
    assert courtyard_located.kept.all()
    assert set(courtyard_located.placement.assessment.doubts.kinds) == {Doubt.RIGHT}


@pytest.mark.parametrize(("chosen", "angle_deg"), [((7,), 5.0), ((9, 10, 11, 12, 13), 2.0)])
def test_turned_cameras_are_put_right_or_left_out_and_no_others(chosen, angle_deg):
    model, wrong = turned(COURTYARD, chosen, angle_deg)
    found = sfm_shapefit.locate(model, COURTYARD / "database.db")
    left_out = {row.name for row in found.cameras if not row.placed}
    assert left_out <= wrong
    truth = pycolmap.Reconstruction(COURTYARD / "sparse" / "0")
    for image in filter(lambda image: image.has_pose, found.reconstruction.images.values()):
        expected = truth.find_image_with_name(image.name).cam_from_world().rotation
        assert np.degrees((image.cam_from_world().rotation * expected.inverse()).angle()) < 0.1
    reasons = {row.name: row.reason for row in found.cameras if row.name in left_out}
    assert not reasons or any(
        "its rotation is wrong" in reason and f"{angle_deg:.0f} degrees" in reason
        for reason in reasons.values()
    )
    unadjusted = sfm_shapefit.locate(model, COURTYARD / "database.db", adjust="none")
    assert {row.name for row in unadjusted.cameras if not row.placed} == wrong


@pytest.fixture(scope="module")
def asked():
    """The courtyard with a camera that is turned, its matches, and the directions that these give."""
    model, _ = turned(COURTYARD, (7,), 5.0)
    images = read_model(model).images
    with closing(open_database(COURTYARD / "database.db", images.names)) as matches:
        source = see_matches(matches, images, inputs_from(COURTYARD / "database.db"))
        yield source, measure(source, DirectionOptions(), Clock()).directions


def angles_deg(one, other):
    return rotation_angles_deg(one.rotations.transpose(0, 2, 1) @ other.rotations)


def test_pairs_that_are_first_tried_as_given_say_the_same_of_a_turned_camera(asked):
    source, directions = asked
    anew = ask_rotations(source, directions.pairs, 1)
    as_given = ask_rotations(source, directions.pairs, 1, directions)  # as those of very many pairs are
    np.testing.assert_array_equal(as_given.pairs, anew.pairs)
    touching = (anew.pairs == 7).any(axis=1) & anew.are_sound()
    assert touching.sum() > 5
    assert angles_deg(as_given, anew)[touching].max() < 1e-3
    assert np.quantile(angles_deg(as_given, anew), 0.8) < 1e-3


def test_what_pairs_said_alone_is_the_answer_again_without_trials(asked):
    source, directions = asked
    alone = measure_rotations(source.view.matches.at(source.images.apart()))
    anew = ask_pairs(source, directions, 1)
    again = ask_pairs(replace(source, alone=alone), directions, 1)
    np.testing.assert_array_equal(again.pairs, anew.pairs)
    assert np.quantile(angles_deg(again, anew), 0.9) < 1e-3  # the same optimum, but of a few pairs of two
    by_trials = (again.rotations == anew.rotations).all(axis=(1, 2))  # from elsewhere the last digits differ
    assert by_trials.mean() < 0.1
    # Of pairs that said nothing before, and of those that fit much worse now, the trials decide.
    better = replace(alone, weight_shares=2.0 * alone.weight_shares).subset(alone.pairs[:, 0] < 5)
    found = ask_pairs(replace(source, alone=better), directions, 1)
    np.testing.assert_array_equal(found.rotations, anew.rotations)


def test_a_camera_that_is_turned_a_little_is_put_right():
    model, _ = turned(COURTYARD, (7,), 2.0)
    found = sfm_shapefit.locate(model, COURTYARD / "database.db")
    assert all(row.placed for row in found.cameras)
    assert found.cameras[7].trust > 0.9
    truth = read_model(COURTYARD / "sparse" / "0").images.rotations

    def left_deg(result):
        return rotation_angles_deg(
            read_model(result.reconstruction).images.rotations @ truth.transpose(0, 2, 1)
        )

    # Its matches tell it as well as they tell others where all are free: within four times what is usual.
    right = COURTYARD / "sparse" / "0"
    free = sfm_shapefit.locate(right, COURTYARD / "database.db", rotations="free")
    assert left_deg(found)[7] < 4.0 * np.median(left_deg(free))
    # It alone is freed; the others are exact.
    assert np.median(left_deg(found)) < 0.5 * np.median(left_deg(free))


def test_measured_rotations_are_not_doubted():
    model, _ = turned(RING, (7,), 2.0)
    found = sfm_shapefit.locate(model, RING / "database.db", rotations="held")
    assert found.placement.assessment.doubts is None
    assert "rotation" not in "".join(row.reason for row in found.cameras)
