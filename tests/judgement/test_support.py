"""What of the observations agrees with the cameras, what contradicts them, and what merely sees no point."""

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit import LocateOptions
from sfm_shapefit.adjustment.given_rotations import RotationWeight
from sfm_shapefit.adjustment.run import GivenPoses
from sfm_shapefit.facts.grade import Grade
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.judgement.support import (
    ObservationCounts,
    count_observations,
    images_without_support,
)
from sfm_shapefit.pipeline import seed
from sfm_shapefit.pipeline.inputs import choose_inputs, open_source
from tests.scenes import RING


@pytest.fixture(scope="module")
def found():
    return sfm_shapefit.locate(RING / "sparse" / "0", RING / "database.db")


def judge(structure):
    model, options = read_model(RING / "sparse" / "0"), LocateOptions()
    inputs = choose_inputs(RING / "sparse" / "0", RING / "database.db", "auto")
    with open_source(model, inputs, options) as source:
        batches = source.view.batches()
        return count_observations(structure, model, batches, options.max_reprojection_error_px).shares()


def test_observations_of_right_cameras_agree(found):
    shares = judge(found.reconstruction)
    assert shares.agreeing == found.agreeing_observations > 0.9
    assert shares.contradicting == found.contradicting_observations < 0.01


def test_observations_without_a_point_contradict_only_cameras_that_are_wrong(found):
    structure = pycolmap.Reconstruction(found.reconstruction)
    for point in list(structure.points3D):
        structure.delete_point3D(point)
    bare = judge(structure)
    assert bare.agreeing == 0.0
    assert bare.contradicting < 0.05

    for frame in structure.reg_frame_ids():
        pose = structure.frame(frame).rig_from_world
        turn = pycolmap.Rotation3d(np.array([0.0, 0.0, 0.1 * (frame % 3)])) * pose.rotation
        structure.frame(frame).rig_from_world = pycolmap.Rigid3d(turn, pose.translation)
    assert judge(structure).contradicting > 0.5


def test_a_weight_follows_its_frames_when_some_are_left_out():
    weight = RotationWeight(sigma_rad=0.1, frame_sigmas_rad=np.array([0.1, 0.7, 0.2]))
    of_all = weight.among(np.array([4, 5, 9]), 10)
    given = GivenPoses(weight=of_all).of(np.array([5, 8, 9]))
    assert given.weight.frame_sigmas_rad.tolist() == [0.7, 0.1, 0.2]
    held = RotationWeight(hold=True)
    assert GivenPoses(weight=held.among(np.array([4, 5]), 10)).of(np.array([5, 9])).weight == held


def counts_of(structure, checked, agreeing):
    ids = np.array(sorted(structure.reg_image_ids()))
    return ObservationCounts(
        image_ids=ids, checked=np.array(checked), agreeing=np.array(agreeing), contradicting=np.zeros(8, int)
    )


def test_a_camera_whose_matches_make_no_points_goes_and_others_stay(found):
    structure = pycolmap.Reconstruction(found.reconstruction)
    names = [structure.image(i).name for i in sorted(structure.reg_image_ids())]
    # Of 100 that could, 4 is chance and 5 is not; of 29, none says nothing.
    counts = counts_of(structure, [100, 100, 29, *[100] * 5], [4, 5, 0, *[90] * 5])
    without = images_without_support(structure, counts)
    assert [structure.image(i).name for i in without] == names[:1]


def test_frames_that_are_fixed_stay_and_so_do_all_where_hardly_any_is_left(found):
    structure = pycolmap.Reconstruction(found.reconstruction)
    first = structure.image(min(structure.reg_image_ids())).frame_id
    assert images_without_support(structure, counts_of(structure, [100] * 8, [0, *[90] * 7]), [first]) == {}
    assert images_without_support(structure, counts_of(structure, [100] * 8, [0] * 6 + [90] * 2)) == {}
    assert structure.num_reg_images() == 8


def test_it_is_named_and_can_be_kept(monkeypatch):
    def count(structure, *given):
        counts = count_observations(structure, *given)
        counts.agreeing[2] = 0
        return counts

    monkeypatch.setattr(seed, "count_observations", count)
    found = sfm_shapefit.locate(RING / "sparse" / "0", RING / "database.db")
    name = found.model.names[2]
    row = next(row for row in found.cameras if row.name == name)
    assert not row.placed
    assert "hardly any of its matches makes a point" in row.reason
    assert found.verdict.grade is Grade.LOOK
    assert name in found.verdict.cameras
    assert any(name in warning and "--min-trust 0" in warning for warning in found.warnings)
    assert name in found.summary()["few_points"]

    kept = sfm_shapefit.locate(RING / "sparse" / "0", RING / "database.db", min_trust=0.0)
    assert all(row.placed for row in kept.cameras)
    assert [row.name for row in kept.cameras if row.reason] == [name]
    assert name in kept.verdict.cameras
    assert any(name in warning and "kept, as --min-trust 0 asks" in warning for warning in kept.warnings)
