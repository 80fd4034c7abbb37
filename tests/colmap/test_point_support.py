"""What of the observations agrees with the cameras, what contradicts them, and what merely sees no point."""

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit import LocateOptions
from sfm_shapefit.adjustment.given_rotations import RotationWeight
from sfm_shapefit.colmap.bundle_adjustment import GivenPoses
from sfm_shapefit.colmap.model import read_model
from sfm_shapefit.colmap.point_support import judge_observations
from sfm_shapefit.commands.stages.inputs import choose_inputs, open_source
from tests.scenes import RING


@pytest.fixture(scope="module")
def found():
    return sfm_shapefit.locate(RING / "sparse" / "0", RING / "database.db")


def judge(structure):
    model, options = read_model(RING / "sparse" / "0"), LocateOptions()
    inputs = choose_inputs(RING / "sparse" / "0", RING / "database.db", "auto")
    with open_source(model, inputs, options) as source:
        return judge_observations(structure, model, source.batches(), options.max_reprojection_error_px)


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
    given = GivenPoses(weight=weight, weight_frames=(4, 5, 9))
    assert given.weight_of((5, 8, 9)).frame_sigmas_rad.tolist() == [0.7, 0.1, 0.2]
    assert GivenPoses(weight=RotationWeight(hold=True)).weight_of((5, 9)) == RotationWeight(hold=True)
