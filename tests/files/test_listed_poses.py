"""Lists of poses: the axes of each format, names found in a database, and what is refused."""

import json
import shutil

import numpy as np
import pycolmap
import pytest

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.commands.convert import convert
from sfm_shapefit.commands.evaluate import evaluate
from sfm_shapefit.commands.locate import locate
from sfm_shapefit.files.colmap.listed_poses import read_by_itself, read_list
from sfm_shapefit.files.colmap.reconstructions import reconstruction_of
from sfm_shapefit.files.listed_names import find_images
from sfm_shapefit.files.nerf import read_nerf
from sfm_shapefit.files.tum import read_tum
from tests.models import poses_of
from tests.program import run
from tests.scenes import COURTYARD, RING, copied, edit_database

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
    found = reconstruction_of(read_list(tmp_path / kind, DATABASE)[0])
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
    found = reconstruction_of(found)
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


def given_names(database, names):
    """Give the images of a database that a test owns, in their order, other names."""
    by_id = [
        f"UPDATE images SET name = '{name}' WHERE image_id = {k}" for k, name in enumerate(names, start=1)
    ]
    rename = ["UPDATE images SET name = 'old ' || name", *by_id]
    return edit_database(database, *rename)


STAMPS = [1305031102.175304 + 0.033 * k for k in range(8)]
NANOSECONDS = [1403636579763555584 + k for k in range(8)]  # which double precision cannot tell apart
WAYS_TO_NUMBER = {
    "exponents": ([f"{k:04d}.jpg" for k in range(5, 13)], [f"{k:.18e}" for k in range(5, 13)]),
    "a prefix": ([f"frame_{k:06d}.png" for k in range(5, 13)], [str(k) for k in range(5, 13)]),
    "time stamps": ([f"rgb/{k:.6f}.png" for k in STAMPS], [f"{k:.18e}" for k in STAMPS]),
    "nanoseconds": ([f"{k}.png" for k in NANOSECONDS], [str(k) for k in NANOSECONDS]),
    "seconds of nanoseconds": (
        [f"{10**8 * k}.png" for k in range(14036365797, 14036365805)],
        [f"{k / 10:.9f}" for k in range(14036365797, 14036365805)],
    ),
}


@pytest.mark.parametrize("way", WAYS_TO_NUMBER)
def test_a_time_stamp_is_the_image_of_the_same_number_however_both_are_written(tmp_path, way):
    names, stamps = WAYS_TO_NUMBER[way]
    database = given_names(copied(RING, tmp_path) / "database.db", names)
    convert(RING / "sparse" / "0", tmp_path / "plain.tum")
    lines = [line.split() for line in (tmp_path / "plain.tum").read_text().splitlines()[1:]]
    listed = [" ".join([stamp, *line[1:]]) for stamp, line in zip(stamps, lines, strict=True)]
    (tmp_path / "list.tum").write_text("\n".join(listed[2:]))
    found, truth = (
        poses_of(reconstruction_of(read_list(tmp_path / "list.tum", database)[0])),
        poses_of(pycolmap.Reconstruction(RING / "sparse" / "0")),
    )
    assert sorted(found) == sorted(names[2:])
    for name, pose in zip(names[2:], [truth[name] for name in sorted(truth)][2:], strict=True):
        np.testing.assert_allclose(found[name], pose, atol=1e-12)


def test_two_entries_of_one_image_are_refused_and_whole_names_come_first(tmp_path):
    names = ("a/1.jpg", "b/2.jpg")
    np.testing.assert_array_equal(find_images(tmp_path, ["x/a/1.jpg", "2", "3"], names), [0, 1, -1])
    np.testing.assert_array_equal(find_images(tmp_path, ["a/1.jpg", "right/1.jpg"], names), [0, -1])
    for listed, both in (
        (["1", "1.0"], "1 and 1.0"),
        (["left/1.jpg", "right/1.jpg"], "left/1.jpg and right/1.jpg"),
    ):
        with pytest.raises(InputError, match=f"{both} are both the image a/1.jpg; keep one"):
            find_images(tmp_path, listed, names)


def test_a_trajectory_comes_back_by_the_numbers_at_the_end_of_names(tmp_path):
    names = [f"frame_{k:04d}.png" for k in (3, 10, 11, 12, 20, 21, 22, 40)]
    scene = copied(RING, tmp_path)
    given_names(scene / "database.db", names)
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    for image_id, name in enumerate(names, start=1):
        model.image(image_id).name = name
    convert(model, tmp_path / "poses.tum")
    found = poses_of(reconstruction_of(read_list(tmp_path / "poses.tum", scene / "database.db")[0]))
    for name, pose in poses_of(model).items():
        np.testing.assert_allclose(found[name], pose, atol=1e-12)


def test_a_header_names_the_columns_as_in_tables_of_euroc(tmp_path):
    rotation = "p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],v_RS_R_x [m]"
    (tmp_path / "data.csv").write_text(
        f"#timestamp, {rotation}\n1403636579763555584,1,2,3,0.5,-0.5,0.5,0.5,9\n"
    )
    (tmp_path / "own.tum").write_text(
        "timestamp tx ty tz qx qy qz qw\n1403636579763555584 1 2 3 -0.5 0.5 0.5 0.5\n"
    )
    table, plain = read_tum(tmp_path / "data.csv"), read_tum(tmp_path / "own.tum")
    assert table.names == plain.names == ("1403636579763555584",)
    np.testing.assert_array_equal(table.rotations, plain.rotations)
    np.testing.assert_array_equal(table.centers, plain.centers)


def test_quaternions_of_nearly_length_1_are_normalized_and_said_and_others_refused(tmp_path):
    (tmp_path / "poses.tum").write_text("1 0 0 0 0 0 0 1.01\n2 0 0 0 0 0 0 1\n")
    found = read_tum(tmp_path / "poses.tum")
    np.testing.assert_array_equal(found.rotations, [np.eye(3)] * 2)
    assert found.notes[0].startswith(
        "1 rotation quaternion is normalized, the worst of norm 1.01 instead of 1"
    )
    (tmp_path / "poses.tum").write_text("1 0 0 0 0 0 0 3\n")
    with pytest.raises(InputError, match="line 1: expected"):
        read_tum(tmp_path / "poses.tum")


LENSES = {
    "SIMPLE_PINHOLE": [900.5, 321.0, 239.0],
    "PINHOLE": [900.5, 901.25, 321.0, 239.0],
    "SIMPLE_RADIAL": [900.5, 321.0, 239.0, 0.1],
    "RADIAL": [900.5, 321.0, 239.0, 0.1, 0.0],
    "OPENCV": [900.5, 901.25, 321.0, 239.0, 0.1, 0.0, 1e-3, -2e-3],
    "FULL_OPENCV": [900.5, 901.25, 321.0, 239.0, 0.1, 0.0, 1e-3, -2e-3, 0.3, 0.0, 0.0, 0.0],
    "SIMPLE_FISHEYE": [300.5, 321.0, 239.0],
    "FISHEYE": [300.5, 301.25, 321.0, 239.0],
    "SIMPLE_RADIAL_FISHEYE": [300.5, 321.0, 239.0, 0.1],
    "RADIAL_FISHEYE": [300.5, 321.0, 239.0, 0.1, 0.0],
    "OPENCV_FISHEYE": [300.5, 301.25, 321.0, 239.0, 0.1, 0.0, 1e-3, -2e-3],
}


def test_lenses_come_back_whole_from_transforms_json_each_with_its_image(tmp_path):
    model = pycolmap.Reconstruction()
    for k, (kind, params) in enumerate(LENSES.items(), start=1):
        camera = pycolmap.Camera(model=kind, params=params, width=640, height=480, camera_id=k)
        model.add_camera_with_trivial_rig(camera)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0, 0, 1])), np.array([float(k), 0, k * k]))
        model.add_image_with_trivial_frame(pycolmap.Image(name=f"{k:02d}.jpg", camera_id=k, image_id=k), pose)
    convert(model, tmp_path / "transforms.json")
    convert(tmp_path / "transforms.json", tmp_path / "back")
    back = pycolmap.Reconstruction(tmp_path / "back")
    found = {image.name: back.camera(image.camera_id) for image in back.images.values()}
    for (_, camera), name in zip(sorted(model.cameras.items()), sorted(found), strict=True):
        own = found[name]
        assert (own.model_name, own.params.tolist()) == (camera.model_name, camera.params.tolist())
        assert (own.width, own.height) == (640, 480)


SIZE = {"w": 640, "h": 480}
# All coefficients, whatever the model, as colmap2nerf of instant-ngp writes them.
_NGP = {"fl_x": 500.0, "fl_y": 500.0, "cx": 300.0, "cy": 250.0, "k1": 0.1, "k2": 0, "k3": 0, "k4": 0}
NGP = SIZE | _NGP | {"p1": 0, "p2": 0, "is_fisheye": False, "aabb_scale": 16}
ANGLES = SIZE | {"camera_angle_x": 2 * np.arctan(0.64), "camera_angle_y": 2 * np.arctan(0.48)}


@pytest.mark.parametrize(
    ("content", "model", "params"),
    [
        (NGP, "OPENCV", [500, 500, 300, 250, 0.1, 0, 0, 0]),
        (NGP | {"is_fisheye": True}, "OPENCV_FISHEYE", [500, 500, 300, 250, 0.1, 0, 0, 0]),
        (NGP | {"camera_model": "SIMPLE_RADIAL"}, "SIMPLE_RADIAL", [500, 300, 250, 0.1]),
        (NGP | {"camera_model": "PINHOLE", "k1": 0}, "PINHOLE", [500, 500, 300, 250]),
        (NGP | {"camera_model": "EQUIRECTANGULAR", "h": 320}, "EQUIRECTANGULAR", [640, 320]),
        (ANGLES, "PINHOLE", [500, 500, 320, 240]),
        (NGP | {"camera_model": "FISHEYE624"}, None, None),
        (NGP | {"w": None}, None, None),
    ],
)
def test_a_lens_is_the_model_of_colmap_that_its_keys_make(tmp_path, content, model, params):
    (lens,) = read_nerf(nerf_file(tmp_path, **content)).lenses
    if model is None:
        assert lens is None
    else:
        assert lens.model == model
        np.testing.assert_allclose(lens.parameters, params, rtol=1e-12)


def test_a_distortion_that_no_model_of_colmap_has_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"frames\[0\] has a distortion that no lens of COLMAP has"):
        read_nerf(nerf_file(tmp_path, **SIZE, fl_x=500, k4=0.1))


def test_a_calibrated_list_replaces_the_whole_guess_of_a_database_at_its_size(tmp_path):
    database = edit_database(
        copied(COURTYARD, tmp_path) / "database.db", "UPDATE cameras SET prior_focal_length = 0"
    )
    given = pycolmap.Reconstruction(TRUTH)
    (camera,) = given.cameras.values()
    half = pycolmap.Camera(
        model="OPENCV", width=camera.width // 2, height=camera.height // 2, params=[1.0] * 8
    )
    half.params = [350.5, 352.0, 0.5 * half.width + 3.0, 0.5 * half.height, 0.05, 0.0, 1e-3, 0.0]
    frames = [
        {"file_path": f"images_2/{image.name}", "transform_matrix": MATRIX} for image in given.images.values()
    ]
    keys = dict(zip(("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"), half.params.tolist(), strict=True))
    (tmp_path / "t.json").write_text(
        json.dumps({"frames": frames, "w": half.width, "h": half.height, **keys})
    )
    found, guessed, _ = read_list(tmp_path / "t.json", database)
    half.rescale(camera.width, camera.height)
    (own,) = reconstruction_of(found).cameras.values()
    assert guessed == frozenset()
    assert own.model_name == "OPENCV"
    np.testing.assert_allclose(own.params, half.params, rtol=1e-12)


def test_images_are_those_of_the_list_and_what_the_database_lacks_is_said(tmp_path):
    names = sorted(image.name for image in pycolmap.Reconstruction(TRUTH).images.values())[:3]
    frames = [
        {"file_path": f".\\images\\{name}", "transform_matrix": MATRIX} for name in [*names, "other.jpg"]
    ]
    (tmp_path / "t.json").write_text(json.dumps({"frames": frames}))
    found, _, notes = read_list(tmp_path / "t.json", DATABASE)
    assert sorted(found.images.names) == names
    assert notes == ("the database lacks 1 image of t.json: .\\images\\other.jpg",)


def test_the_world_is_that_before_the_transform_that_was_applied(tmp_path):
    plain = read_nerf(nerf_file(tmp_path))
    applied = np.array([[1.0, 0, 0, 4], [0, 0, 1, 5], [0, -1, 0, 6]])
    moved = np.vstack([applied, [0, 0, 0, 1]]) @ np.array(MATRIX)
    moved[:3, 3] *= 2.0
    found = read_nerf(
        nerf_file(
            tmp_path,
            {"transform_matrix": moved.tolist()},
            applied_transform=applied.tolist(),
            applied_scale=2,
        )
    )
    np.testing.assert_allclose(found.rotations, plain.rotations, atol=1e-15)
    np.testing.assert_allclose(found.centers, plain.centers, atol=1e-12)


@pytest.mark.parametrize("kind", ["transforms.json", "poses.tum"])
def test_lists_are_input_of_evaluate_and_check_too(tmp_path, kind):
    convert(RING / "sparse" / "0", tmp_path / kind)
    for errors in (
        evaluate(tmp_path / kind, RING / "sparse" / "0"),
        evaluate(RING / "sparse" / "0", tmp_path / kind),
    ):
        assert len(errors.names) == 8
        assert errors.position.max < 1e-12 * errors.extent
    told = run("check", tmp_path / kind, "--database", RING / "database.db", "--no-second-opinion", code=0)
    assert "8 of 8 images placed" in told.stdout
    assert "give the database" in run("check", tmp_path / kind, code=3).stderr


def test_a_list_without_lenses_is_converted_to_what_needs_none(tmp_path):
    convert(RING / "sparse" / "0", tmp_path / "poses.tum")
    convert(tmp_path / "poses.tum", tmp_path / "again.tum")
    assert len(read_by_itself(tmp_path / "again.tum").images.names) == 8
    with pytest.raises(InputError, match=r"poses\.tum has no whole lens of 1 "):
        convert(tmp_path / "poses.tum", tmp_path / "transforms.json")


def test_transforms_json_names_the_points_that_stand_beside_it(tmp_path):
    convert(RING / "sparse" / "0", tmp_path / "scene.json")
    named = json.loads((tmp_path / "scene.json").read_text())["ply_file_path"]
    head = (tmp_path / named).read_bytes().partition(b"end_header")[0].decode()
    assert f"element vertex {pycolmap.Reconstruction(RING / 'sparse' / '0').num_points3D()}" in head
    with pytest.raises(InputError, match="scene"):
        convert(RING / "sparse" / "0", tmp_path / "scene.json")


def test_known_poses_without_points_are_enough_beside_a_database(tmp_path):
    truth = pycolmap.Reconstruction(RING / "sparse" / "0")
    blank = pycolmap.Reconstruction(truth)
    for point_id in list(blank.point3D_ids()):
        blank.delete_point3D(point_id)
    (tmp_path / "text").mkdir()
    blank.write_text(tmp_path / "text")
    convert(truth, tmp_path / "half.tum")
    lines = (tmp_path / "half.tum").read_text().splitlines()[1:6]
    (tmp_path / "half.tum").write_text("\n".join(line.replace(" ", ", ") for line in lines))
    for given, count in ((tmp_path / "text", 8), (tmp_path / "half.tum", 5)):
        found = locate(given, RING / "database.db")
        assert len(found.reconstruction.reg_image_ids()) == count
        assert found.reconstruction.num_points3D() > 100
        assert evaluate(found, truth).position.max < 1e-5
