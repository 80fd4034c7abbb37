"""Residuals per lens: a pattern is told by a test of chance, and whose it is by its direction."""

import itertools

import numpy as np
import pycolmap
import pytest

from sfm_shapefit import check, evaluate, map_database
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.points import structure_of
from sfm_shapefit.judgement.lens_residuals import lens_fields
from sfm_shapefit.judgement.reasons import Grade
from tests.lens_scene import camera_of_model, write_scene
from tests.report.test_report_page import data_of, unpacked

NOISE_PX = 0.3
NONE = "No pattern: residuals point everywhere. The lens model fits."


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Twelve images of 120 points through a lens that bends outward by 3 px at their rim."""
    camera = camera_of_model("SIMPLE_RADIAL")
    camera.params = [500.0, 320.0, 240.0, 0.15]
    folder = tmp_path_factory.mktemp("scene")
    write_scene(folder, [camera], num_frames=12)
    return folder / "sparse/0"


def fields_with(scene, pattern, seed=0):
    """Return the fields of the scene where keypoints are off by noise and a pattern (k, 2) of their places.

    Places are in half heights of the picture, from its middle.
    """
    model, rng = pycolmap.Reconstruction(scene), np.random.default_rng(seed)
    for image in model.images.values():
        for point in image.points2D:
            if point.has_point3D():
                exact = image.project_point(model.points3D[point.point3D_id].xyz)
                place = (exact - [320.0, 240.0]) / 240.0
                point.xy = exact + pattern(place) + rng.normal(0.0, NOISE_PX, 2)
    read = read_model(model)
    return lens_fields(structure_of(read.arrays, read.images))


def none(place):
    return np.zeros(2)


def inward(place):
    return -2.0 * np.hypot(*place) ** 2 * place


def twisted(place):
    return np.array([-place[1], place[0]])


def slight(place):
    return 0.1 * place


@pytest.mark.parametrize(
    ("pattern", "said"),
    [
        (none, NONE),
        (inward, "They point inward at the rim, by "),
        (twisted, "not along the radius"),
        (slight, "too small to matter"),
    ],
)
def test_what_residuals_have_in_common_over_the_picture_is_said_of_the_lens(scene, pattern, said):
    (field,) = fields_with(scene, pattern)
    assert said in field.statement
    if pattern is slight:  # as large as the pattern is where the points are, whose RMS distance is 0.6
        size = float(field.statement.split("A pattern of ")[1].split()[0])
        assert size == pytest.approx(0.06, rel=0.2)
    assert field.label == "Camera 1, SIMPLE_RADIAL"
    # Cells hold 15 residuals or more; means are off by the noise of so many, of which the largest is 4 sigma,
    # and by what the pattern varies over a cell, a tenth of the picture wide.
    places = (field.places * [640.0, 480.0] - [320.0, 240.0]) / 240.0
    wanted = np.array([pattern(place) for place in places])
    assert np.abs(field.means_px - wanted).max() < 4.0 * NOISE_PX / np.sqrt(15) + 0.3 * np.abs(wanted).max()


def test_noise_is_no_pattern_whatever_its_seed(scene):
    # One of 200 would be, by the level of the test: two or more of 12 in a thousandth of the draws.
    said = [field.statement for seed in range(1, 13) for field in fields_with(scene, none, seed)]
    assert sum(one != NONE for one in said) <= 1


def test_a_lens_without_its_distortion_is_to_be_looked_at_and_the_page_draws_it(scene, tmp_path):
    model, said = pycolmap.Reconstruction(scene), {}
    for bend in (0.15, 0.0):
        model.cameras[1].params = [500.0, 320.0, 240.0, bend]
        page = tmp_path / f"{bend}.html"
        found = check(model, second_opinion=False)
        found.report(page)
        fits = [one.sentence for one in found.verdict.findings if "a lens that does not fit" in one.sentence]
        assert [one.startswith("12 images have") and "point outward by" in one for one in fits] == (
            [] if bend else [True]
        )
        (field,) = data_of(page.read_text(encoding="utf-8"))["fields"]
        said[bend] = field["statement"]
        assert len(unpacked(field["places"])) == len(unpacked(field["means"])) > 20
    assert said[0.15] == NONE
    assert "They point outward at the rim" in said[0.0]


def test_few_images_are_no_evidence_and_few_residuals_are_not_drawn(scene):
    model = pycolmap.Reconstruction(scene)
    frames = [image.frame_id for image in model.images.values()]
    for frame in frames[6:]:
        model.deregister_frame(frame)
    read = read_model(model)
    (field,) = lens_fields(structure_of(read.arrays, read.images))
    assert field.statement == "6 images are too few to tell a pattern from chance."
    for frame in frames[2:6]:
        model.deregister_frame(frame)
    read = read_model(model)
    assert lens_fields(structure_of(read.arrays, read.images)) == ()


def test_a_focal_length_far_from_the_calibration_of_the_database_is_to_be_looked_at(scene):
    model = pycolmap.Reconstruction(scene)
    model.cameras[1].params = [750.0, 320.0, 240.0, 0.0]  # for 500 px
    for database, said in ((scene.parents[1] / "database.db", True), (None, False)):
        found = check(model, database, second_opinion=False).verdict.findings
        assert (
            any("a focal length 1.50 times the one that was known" in one.sentence for one in found) == said
        )


def wall(folder, bend):
    """Write two rows of eight pictures of a wall, through a lens that the database has without its bend."""
    rng, ahead = np.random.default_rng(3), np.diag([1.0, -1.0, -1.0])
    points, poses = rng.uniform([-4.0, -4.0, -0.2], [11.0, 5.0, 0.2], (400, 3)), []
    for place in itertools.product(range(8), (0.0, 1.2), (4.0,)):
        turn = pycolmap.Rotation3d(rng.normal(0.0, 0.05, 3)).matrix() @ ahead
        poses.append(pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -turn @ (place + rng.normal(0.0, 0.1, 3))))
    camera = camera_of_model("SIMPLE_RADIAL")
    camera.params = [400.0, 320.0, 240.0, bend]
    write_scene(folder, [camera], poses=poses, points=points)
    with pycolmap.Database.open(folder / "database.db") as database:
        camera.model, camera.params = pycolmap.CameraModelId.SIMPLE_PINHOLE, [400.0, 320.0, 240.0]
        database.update_camera(camera)


@pytest.mark.parametrize("bend", [0.0, 0.1])
def test_a_distortion_that_poses_have_taken_in_is_found_with_how_far_cameras_move_by_it(tmp_path, bend):
    wall(tmp_path, bend)
    (found,) = map_database(tmp_path / "database.db").models
    found.write(tmp_path / "mapped")
    true = pycolmap.Reconstruction(tmp_path / "sparse/0")
    centers = np.array([image.projection_center() for image in true.images.values()])
    radius = np.median(np.linalg.norm(centers - np.median(centers, axis=0), axis=1))
    errors = evaluate(found, true).position
    assert (errors.median > 0.02 * radius) == bool(bend)
    for judged in (found, check(tmp_path / "mapped", second_opinion=False)):
        if not bend:
            assert judged.verdict.grade is Grade.GOOD
            continue
        (reason,) = judged.verdict.findings
        assert judged.verdict.grade is Grade.LOOK
        assert len(reason.images) == 16
        share = float(reason.sentence.split("cameras move by ")[1].split(" %")[0]) / 100.0
        assert errors.median < share * radius < errors.max  # by all but one camera in twenty
