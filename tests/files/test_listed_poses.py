"""Lists of poses: the axes of each format, names found in a database, and what is refused."""

import json
import shutil

import numpy as np
import pycolmap
import pytest

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.listed_poses import read_list
from sfm_shapefit.files.nerf import read_nerf
from sfm_shapefit.files.tum import read_tum
from sfm_shapefit.pipeline.convert import convert
from tests.models import poses_of
from tests.scenes import COURTYARD, edit_database

DATABASE, TRUTH = COURTYARD / "database.db", COURTYARD / "truth"
# The camera looks along the world's +x with +z up; backwards is -x. See test_model_formats.
R = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
MATRIX = [[0, 0, -1, 1], [-1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]]


def nerf_file(folder, frame=None, **content):
    frame = {"file_path": "./train/a", "transform_matrix": MATRIX} | (frame or {})
    (folder / "transforms.json").write_text(json.dumps({"frames": [frame], **content}))
    return folder / "transforms.json"


def test_transforms_json_is_read_in_opengls_axes_whatever_the_scale_of_its_world(tmp_path):
    scaled = (2.5 * np.array(MATRIX)).tolist()
    for matrix in (MATRIX, MATRIX[:3], scaled):
        found = read_nerf(nerf_file(tmp_path, {"transform_matrix": matrix}))
        np.testing.assert_allclose(found.rotations, [R], atol=1e-15)
        np.testing.assert_allclose(found.centers, [np.array(matrix)[:3, 3]])


@pytest.mark.parametrize(
    ("frame", "content", "shares"),
    [
        ({}, {"fl_x": 50, "fl_y": 60, "w": 100, "h": 80}, [0.5, 0.75]),
        ({"fl_x": 60, "w": 100}, {"fl_x": 50, "w": 200}, [0.6, np.nan]),
        ({}, {"camera_angle_x": 2 * np.arctan(0.5)}, [1.0, np.nan]),
        ({}, {"fl_x": 50}, [np.nan, np.nan]),
    ],
)
def test_focal_lengths_are_those_of_the_frame_or_of_all_or_unknown(tmp_path, frame, content, shares):
    np.testing.assert_allclose(read_nerf(nerf_file(tmp_path, frame, **content)).focal_shares, [shares])


@pytest.mark.parametrize("kind", ["transforms.json", "poses.tum"])
def test_a_models_poses_come_back_by_the_names_of_its_images(tmp_path, kind):
    convert(TRUTH, tmp_path / kind)
    found = read_list(tmp_path / kind, DATABASE)[0]
    truth = poses_of(pycolmap.Reconstruction(TRUTH))
    assert poses_of(found).keys() == truth.keys()
    for name, pose in poses_of(found).items():
        np.testing.assert_allclose(pose, truth[name], atol=1e-12)


def test_guessed_focal_lengths_are_those_of_the_list_at_the_databases_size_and_measured_ones_stay(tmp_path):
    database = tmp_path / "database.db"
    shutil.copyfile(DATABASE, database)
    names = sorted(image.name for image in pycolmap.Reconstruction(TRUTH).images.values())[:3]
    frames = [
        {"file_path": f"images_4/{name}", "transform_matrix": MATRIX, "fl_x": fl, "w": 100}
        for name, fl in zip(names, (110, 90, 120), strict=True)
    ]
    (tmp_path / "poses.json").write_text(json.dumps({"frames": frames}))
    assert read_list(tmp_path / "poses.json", database)[1] == frozenset()
    edit_database(database, "UPDATE cameras SET prior_focal_length = 0")
    found, guessed, _ = read_list(tmp_path / "poses.json", database)
    (camera,) = found.cameras.values()
    assert guessed == {camera.camera_id}
    assert camera.mean_focal_length() == pytest.approx(1.1 * camera.width)
    assert len(found.reg_image_ids()) == 3


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.diag([1, 1, -1, 1]).tolist(), r"frames\[0\]/transform_matrix is no pose"),  # a mirror
        (np.diag([1, 2, 1, 1]).tolist(), "is no pose: its first three columns are no rotation"),
        ([[1, 0, 0, 0]], "is no pose"),
        ([[0] * 4] * 4, "is no pose"),
        ([[1, 0, 0]] * 4, r"transform_matrix\[0\] is no list of 4 numbers"),
    ],
)
def test_a_matrix_that_is_no_pose_is_refused_by_its_key(tmp_path, matrix, message):
    with pytest.raises(InputError, match=message):
        read_nerf(nerf_file(tmp_path, {"transform_matrix": matrix}))


def test_a_trajectory_may_have_commas_and_comments(tmp_path):
    (tmp_path / "poses.txt").write_text("# stamp, then pose\n\n1.5, 1 2 3, 0 0 0 1,  # the start\n")
    found = read_tum(tmp_path / "poses.txt")
    assert found.names == ("1.5",)
    np.testing.assert_array_equal(found.centers, [[1.0, 2.0, 3.0]])


@pytest.mark.parametrize("line", ["1 2 3", "1 2 3 4 0 0 0 0", "1 2 3 4 0 0 0 nan", "time x y z 0 0 0 1"])
def test_a_line_that_is_none_of_a_trajectory_is_refused_by_its_number(tmp_path, line):
    (tmp_path / "poses.txt").write_text(f"# a comment\n1 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(InputError, match=r"poses\.txt, line 3: expected timestamp"):
        read_tum(tmp_path / "poses.txt")


def test_lists_without_images_matches_or_a_file_are_refused_in_a_sentence(tmp_path):
    file = nerf_file(tmp_path)
    with pytest.raises(InputError, match=r"in common: \./train/a in the one, 0001\.jpg in the other"):
        read_list(file, DATABASE)
    with pytest.raises(InputError, match="poses but no matches; give the database"):
        read_list(file, None)
    with pytest.raises(InputError, match=r"nothing\.json does not exist"):
        read_list(tmp_path / "nothing.json", DATABASE)
    (tmp_path / "other.json").write_text("[]")
    with pytest.raises(InputError, match="has no key 'frames'"):
        read_list(tmp_path / "other.json", DATABASE)
