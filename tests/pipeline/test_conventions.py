"""Inputs in other programs' conventions and resolutions: recognized, said, and never where they are right."""

import json

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import FLIP_YZ, fit_similarity
from sfm_shapefit.commands.check import check
from sfm_shapefit.commands.convert import convert
from sfm_shapefit.judgement.conventions import recognize_convention
from sfm_shapefit.judgement.reasons import Grade
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from tests.models import centers_of, posed
from tests.scenes import COURTYARD, RING, copied, edit_database

DATABASE, TRUTH = COURTYARD / "database.db", COURTYARD / "truth"
OPENGL = "OpenGL's camera axes"
AXES_OF_A_BODY = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # x ahead, y left, z up, as robots have them


def reordered(rotation):
    """The rotation of a quaternion written x, y, z, w and read as w, x, y, z."""
    return pycolmap.Rotation3d(pycolmap.Rotation3d(rotation).quat[[1, 2, 3, 0]]).matrix()


CONVENTIONS = {
    "camera-to-world": lambda rotation, center: (rotation.T, -(rotation @ center)),
    f"in {OPENGL}": lambda rotation, center: (FLIP_YZ @ rotation, center),
    f"camera-to-world, in {OPENGL}": lambda rotation, center: ((FLIP_YZ @ rotation).T, center),
    "with quaternions in the order x y z w": lambda rotation, center: (reordered(rotation), center),
    "in other axes than the camera's": lambda rotation, center: (AXES_OF_A_BODY.T @ rotation, center),
}


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_poses_in_another_convention_are_refused_as_what_they_seem_to_be(convention):
    change = CONVENTIONS[convention]
    model = posed(TRUTH, lambda _, rotation, center: change(rotation, center))
    with pytest.raises(UnsolvableError, match=f"^the poses seem to be {convention}.*: 41 of 41 pairs agree"):
        sfm_shapefit.locate(model, DATABASE)


@pytest.mark.parametrize(
    ("change", "seems"),
    [
        (lambda matrix: matrix @ np.diag([1.0, -1, -1, 1]), "in COLMAP's camera axes"),
        (np.linalg.inv, r"world-to-camera:"),
        (
            lambda matrix: np.linalg.inv(matrix @ np.diag([1.0, -1, -1, 1])),
            "world-to-camera, in COLMAP's camera axes",
        ),
    ],
)
def test_a_transforms_json_in_another_convention_is_told_in_its_own_terms(tmp_path, change, seems):
    convert(TRUTH, tmp_path / "t.json")
    content = json.loads((tmp_path / "t.json").read_text())
    for frame in content["frames"]:
        frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
    (tmp_path / "t.json").write_text(json.dumps(content))
    with pytest.raises(UnsolvableError, match=f"^the poses seem to be {seems}.*write them"):
        sfm_shapefit.locate(tmp_path / "t.json", DATABASE)


def test_a_right_answer_from_poses_in_another_convention_says_so_first():
    model = posed(RING / "sparse" / "0", lambda _, rotation, center: (FLIP_YZ @ rotation, center))
    found = sfm_shapefit.locate(model, RING / "database.db", rotations=2.0)
    assert OPENGL in found.warnings[0]
    assert found.verdict.grade is Grade.LOOK
    assert OPENGL in found.verdict.reasons[0]
    assert "database" not in found.verdict.statement
    told = check(model, RING / "database.db", second_opinion=False).verdict
    assert told.is_bad
    assert OPENGL in told.reasons[0]


def test_rotations_that_are_wrong_in_no_known_way_are_not_explained():
    rng = np.random.default_rng(3)
    order = iter(rng.permutation(centers_of(pycolmap.Reconstruction(TRUTH)).shape[0]).tolist())
    truth = pycolmap.Reconstruction(TRUTH)
    rotations = [truth.image(i).cam_from_world().rotation.matrix() for i in sorted(truth.reg_image_ids())]
    shuffled = posed(TRUTH, lambda _, __, center: (rotations[next(order)], center))
    with pytest.raises(UnsolvableError) as refused:
        sfm_shapefit.locate(shuffled, DATABASE)
    assert "seem to be" not in str(refused.value)


def test_observations_in_another_resolution_are_said_with_their_ratio():
    model = pycolmap.Reconstruction(RING / "sparse" / "0")
    (camera,) = model.cameras.values()
    for image in model.images.values():
        for point in image.points2D:
            point.xy = 0.8 * point.xy
    size = f"{round(0.8 * camera.width)} x {round(0.8 * camera.height)}"
    told = check(model).verdict
    assert told.reasons[0].startswith(f"points2D look scaled by 0.8, as those of pictures {size}")
    found = sfm_shapefit.locate(model, rotations=2.0)
    assert "scaled by 0.8" in found.warnings[0]
    assert found.warnings[0].endswith("may come of that") == (len(found.warnings) > 1)
    assert found.verdict.grade is not Grade.GOOD
    # A lens of 800 px would fit them as well, but for its principal point: none is freed.
    assert found.reconstruction.cameras[1].params.tolist() == camera.params.tolist()


def test_keypoints_of_a_picture_that_is_turned_by_90_degrees_are_told(tmp_path):
    """As where one program follows the orientation in the EXIF data, and another does not."""
    folder = copied(RING, tmp_path)
    model, database = pycolmap.Reconstruction(folder / "sparse" / "0"), folder / "database.db"
    (camera,) = model.cameras.values()

    def told():
        findings = check(model, database, second_opinion=False).verdict.findings
        return [one for one in findings if "keypoints outside the picture" in one.sentence]

    assert not told()
    width, height = camera.height, camera.width
    camera.width, camera.height, camera.params = width, height, [1000.0, 1000.0, 0.5 * width, 0.5 * height]
    values = np.array(camera.params, dtype="<f8").tobytes().hex()
    edit_database(database, f"UPDATE cameras SET width = {width}, height = {height}, params = x'{values}'")
    assert len(told()) == 1


def test_keypoints_outside_their_pictures_come_before_axes_that_they_seem_to_be_in(tmp_path):
    folder = copied(RING, tmp_path)
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    (camera,) = model.cameras.values()

    def turned(pixels):
        return np.stack([camera.height - pixels[:, 1], pixels[:, 0]], axis=1)

    for image in model.images.values():
        for point in image.points2D:
            (point.xy,) = turned(point.xy[None])
    with pycolmap.Database.open(str(folder / "database.db")) as database:
        for image in database.read_all_images():
            pixels = turned(database.read_keypoints(image.image_id)[:, :2])
            database.update_keypoints(image.image_id, pixels.astype(np.float32))
    verdict = check(model, folder / "database.db", second_opinion=False).verdict
    assert verdict.is_bad
    assert "keypoints outside the picture" in verdict.reasons[0]
    assert not any("IMU" in reason for reason in verdict.reasons)


def test_a_database_of_pictures_in_another_resolution_is_said():
    model = pycolmap.Reconstruction(RING / "sparse" / "0")
    (camera,) = model.cameras.values()
    size = f"pictures {camera.width} x {camera.height}"
    camera.rescale(0.5)
    with pytest.raises(UnsolvableError, match=f"{size} where the camera has {camera.width} x"):
        sfm_shapefit.locate(model, RING / "database.db")
    for image in model.images.values():
        for point in image.points2D:
            point.xy = 0.5 * point.xy
    assert size in check(model, RING / "database.db", second_opinion=False).verdict.reasons[0]


def test_a_wrong_focal_length_is_no_resolution():
    model = pycolmap.Reconstruction(RING / "sparse" / "0")
    (camera,) = model.cameras.values()
    camera.params = [1.25 * camera.params[0], *camera.params[1:].tolist()]
    assert "scaled" not in check(model).verdict.statement


def nowhere(model, count):
    """Return a copy of a model the first of whose frames have no position."""
    copy = pycolmap.Reconstruction(model)
    for frame_id in sorted(copy.frames)[:count]:
        frame = copy.frame(frame_id)
        frame.rig_from_world = pycolmap.Rigid3d(frame.rig_from_world.rotation, np.full(3, np.nan))
    return copy


@pytest.mark.parametrize("count", [3, 8])
def test_positions_that_are_nan_are_unknown_and_no_obstacle(tmp_path, count):
    truth = pycolmap.Reconstruction(RING / "sparse" / "0")
    for name in ("binary", "text"):
        (tmp_path / name).mkdir()
        getattr(nowhere(truth, count), f"write_{name}")(tmp_path / name)
    for model in (nowhere(truth, count), tmp_path / "binary", tmp_path / "text"):
        found = sfm_shapefit.locate(model, RING / "database.db")
        centers, right = centers_of(found.reconstruction), centers_of(truth)
        if count == 8:  # nothing tells scale and origin
            centers = fit_similarity(centers, right).apply(centers)
        # Keypoints are float32: 6e-5 px of a focal length of 1000 px, at distances of some units.
        np.testing.assert_allclose(centers, right, atol=1e-5)
        assert found.verdict.grade is Grade.GOOD


def test_what_needs_positions_takes_images_without_one_for_unposed_and_says_so(tmp_path):
    truth = pycolmap.Reconstruction(RING / "sparse" / "0")
    errors = sfm_shapefit.evaluate(nowhere(truth, 3), truth)
    assert len(errors.names) == 5
    assert errors.warnings[0].startswith("of 3 of 8 images the position is not known (NaN)")
    convert(nowhere(truth, 3), tmp_path / "model")
    assert pycolmap.Reconstruction(tmp_path / "model").num_reg_images() == 5
    told = check(nowhere(truth, 3))
    assert told.facts.num_placed == 5
    assert told.facts.warnings[0] == errors.warnings[0]
    with pytest.raises(sfm_shapefit.InputError, match=r"of 8 of 8 images the position is not known.*locate"):
        check(nowhere(truth, 8))


def test_an_image_that_is_not_placed_has_no_pose_whatever_its_position_was(tmp_path):
    last = 8  # pair_id is 2147483647 times the smaller id, plus the larger
    scene = copied(RING, tmp_path)
    edit_database(
        scene / "database.db", f"DELETE FROM two_view_geometries WHERE pair_id % 2147483647 = {last}"
    )
    found = sfm_shapefit.locate(nowhere(scene / "sparse" / "0", 8), scene / "database.db").reconstruction
    assert sorted(found.reg_image_ids()) == [i for i in sorted(found.images) if i != last]


@pytest.mark.parametrize("turns", [False, True])
def test_on_a_turntable_right_poses_are_no_convention_and_others_may_be_two(turns):
    angles = np.radians(20.0 * np.arange(8))
    cosines, sines, zeros = np.cos(angles), np.sin(angles), np.zeros(8)
    rows = [[cosines, zeros, sines], [zeros, zeros + 1.0, zeros], [-sines, zeros, cosines]]
    rotations = np.array(rows).transpose(2, 0, 1)
    i, j = np.triu_indices(8, 1)
    relative = RelativeRotations(
        pairs=np.column_stack([i, j]),
        rotations=rotations[j] @ rotations[i].transpose(0, 2, 1),
        information=np.tile(np.eye(3), (len(i), 1, 1)),
        num_matches=np.full(len(i), 100),
        weight_shares=np.ones(len(i)),
    )
    found = recognize_convention(rotations.transpose(0, 2, 1) if turns else rotations, relative, "model")
    assert (found is not None) == turns
    if found is not None:
        assert "camera-to-world" in found.clause
        assert OPENGL in found.clause
