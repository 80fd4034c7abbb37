"""Which intrinsics were never measured, and the focal lengths that fundamental matrices know."""

from contextlib import closing

import numpy as np
import pytest

from sfm_shapefit.files.colmap.database import open_database
from sfm_shapefit.files.colmap.database_images import read_images
from sfm_shapefit.files.colmap.database_pairs import MAX_NUM_IMAGES
from sfm_shapefit.files.colmap.intrinsics import calibrate_view_graph, find_uncalibrated
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.pipeline.intrinsics import choose_intrinsics
from sfm_shapefit.scene.lens import FOCAL, Origin
from tests.scenes import RING, copied, edit_database, fingerprint, read_from

MODELS = {"SIMPLE_RADIAL": 2, "PINHOLE": 1, "OPENCV_FISHEYE": 5, "FOV": 7, "EUCM": 16}


def database_with(folder, model, params, prior):
    """The ring, whose camera is another one."""
    blob = np.array(params, dtype="<f8").tobytes().hex()
    change = f"UPDATE cameras SET model = {MODELS[model]}, params = x'{blob}', prior_focal_length = {prior}"
    return edit_database(copied(RING, folder) / "database.db", change)


def settled(path, images, wanted, **how):
    """Return what is started from, and what may change, by the matches of a database."""
    with closing(open_database(path, images.names)) as matches:
        return choose_intrinsics(images, matches, wanted, **how)


@pytest.mark.parametrize(
    ("model", "params", "prior", "origin"),
    [
        ("PINHOLE", [1150.0, 1150.0, 600.0, 450.0], 0, Origin.GUESS),
        ("PINHOLE", [1150.0, 1150.0, 600.0, 450.0], 1, None),
        ("SIMPLE_RADIAL", [1150.0, 600.0, 450.0, 0.0], 1, Origin.EXIF),
        ("SIMPLE_RADIAL", [1150.0, 600.0, 450.0, 0.01], 1, None),
        ("SIMPLE_RADIAL", [1150.0, 601.0, 450.0, 0.0], 1, None),
        ("OPENCV_FISHEYE", [1150.0, 1150.0, 600.0, 450.0, 0.0, 0.0, 0.0, 0.0], 0, Origin.GUESS),
        ("FOV", [1150.0, 1150.0, 600.0, 450.0, 0.01], 1, Origin.EXIF),
        ("FOV", [1150.0, 1150.0, 600.0, 450.0, 0.0], 1, None),
        ("EUCM", [1150.0, 1150.0, 600.0, 450.0, 0.0, 1.0], 1, Origin.EXIF),
        ("EUCM", [1150.0, 1150.0, 600.0, 450.0, 0.6, 1.0], 1, None),
    ],
)
def test_what_was_never_measured_is_told_from_what_was(tmp_path, model, params, prior, origin):
    path = database_with(tmp_path, model, params, prior)
    images = read_from(path, read_images).images
    found = {camera: one.origin for camera, one in read_from(path, find_uncalibrated, images).items()}
    assert found == ({} if origin is None else {0: origin})
    # A model whose intrinsics are not the database's got them elsewhere.
    assert read_from(path, find_uncalibrated, read_model(RING / "sparse" / "0").images) == {}
    marked, may_change = settled(path, images, "auto")
    assert [lens.origin for lens in marked.lenses] == [origin]
    assert may_change.parts[:, FOCAL].tolist() == [origin is not None]
    kept, stays = settled(path, images, "held")
    assert [lens.origin for lens in kept.lenses] == [origin]
    assert kept.lenses[0].parameters == images.lenses[0].parameters
    assert not stays.parts.any()


@pytest.mark.parametrize(("num_calibrated", "doubted"), [(0, 8), (4, 4), (5, 0)])
def test_a_calibrated_database_is_one_though_some_of_its_cameras_have_no_distortion(
    tmp_path, num_calibrated, doubted
):
    path = database_with(tmp_path, "SIMPLE_RADIAL", [1150.0, 600.0, 450.0, 0.0], 1)
    calibrated = np.array([1150.0, 600.0, 450.0, 0.01], dtype="<f8").tobytes().hex()
    rest = "model, width, height, params, prior_focal_length"
    edit_database(
        path,
        *(f"INSERT INTO cameras SELECT {k}, {rest} FROM cameras WHERE camera_id = 1" for k in range(2, 9)),
        "UPDATE images SET camera_id = image_id",
        "DELETE FROM frame_data",
        f"UPDATE cameras SET params = x'{calibrated}' WHERE camera_id <= {num_calibrated}",
    )
    found = read_from(path, find_uncalibrated, read_from(path, read_images).images)
    assert [one.origin for one in found.values()] == [Origin.EXIF] * doubted


def test_the_view_graph_knows_the_focal_length_and_the_database_stays(tmp_path):
    path = database_with(tmp_path, "PINHOLE", [1150.0, 1150.0, 600.0, 450.0], 0)
    before = fingerprint(tmp_path)
    factors = read_from(path, calibrate_view_graph, [1])
    assert all(read_from(path, calibrate_view_graph, [1]) == factors for _ in range(5))  # to the bit
    assert fingerprint(tmp_path) == before
    images = read_from(path, read_images).images
    found = images.lenses[0].longer(factors[1]).parameters
    np.testing.assert_allclose(found, [1000.0, 1000.0, 600.0, 450.0], rtol=1e-4)
    assert images.lenses[0].parameters[0] == 1150.0


@pytest.mark.parametrize("listed", [950.0, 1300.0])
def test_what_a_list_guesses_gives_way_to_what_the_view_graph_knows(tmp_path, listed):
    path = database_with(tmp_path, "PINHOLE", [1150.0, 1150.0, 600.0, 450.0], 0)
    images = read_from(path, read_images).images
    guess = images.lenses[0].longer(listed / 1150.0)
    images = images.with_lenses([guess])
    ids = frozenset({guess.id})
    found, _ = settled(path, images, "auto", listed=ids)
    np.testing.assert_allclose(found.lenses[0].parameters, [1000.0, 1000.0, 600.0, 450.0], rtol=1e-4)
    edit_database(path, "UPDATE two_view_geometries SET config = 3, F = NULL")  # which then knows nothing
    found, _ = settled(path, images, "auto", listed=ids)
    assert found.lenses[0].parameters == guess.parameters


def test_pairs_without_depth_say_nothing_of_focal_lengths(tmp_path):
    path = database_with(tmp_path, "PINHOLE", [1150.0, 1150.0, 600.0, 450.0], 0)
    # Of 16 pairs 4 have depth: five are wanted, and three tenths.
    edit_database(
        path,
        "UPDATE two_view_geometries SET config = 4 WHERE pair_id NOT IN "
        "(SELECT pair_id FROM two_view_geometries ORDER BY pair_id LIMIT 4)",
    )
    assert read_from(path, calibrate_view_graph, [1]) == {}
    edit_database(path, "UPDATE two_view_geometries SET config = 3, F = NULL")
    assert read_from(path, calibrate_view_graph, [1]) == {}


def test_pairs_that_are_left_out_say_nothing_of_focal_lengths(tmp_path):
    path = database_with(tmp_path, "PINHOLE", [1150.0, 1150.0, 600.0, 450.0], 0)
    right = read_from(path, calibrate_view_graph, [1])
    every = read_from(path, read_images).images
    ids = dict(zip(every.ids.tolist(), every.names, strict=True))
    query = "SELECT pair_id, F FROM two_view_geometries ORDER BY pair_id LIMIT 8"
    pairs = read_from(path, DatabaseFile.rows, "two_view_geometries", {("pair_id", "F"): query})
    # As a lens of twice the focal length would have it, about the same principal point.
    wider = np.array([[0.5, 0.0, 300.0], [0.0, 0.5, 225.0], [0.0, 0.0, 1.0]])
    for pair, blob in pairs:
        wrong = (wider.T @ np.frombuffer(blob).reshape(3, 3) @ wider).tobytes().hex()
        edit_database(path, f"UPDATE two_view_geometries SET F = x'{wrong}' WHERE pair_id = {pair}")
    names = [[ids[k] for k in divmod(pair, MAX_NUM_IMAGES)] for pair, _ in pairs]
    left_out = frozenset((min(ends), max(ends)) for ends in names)
    assert (
        read_from(path, calibrate_view_graph, [1], left_out)
        == right
        != read_from(path, calibrate_view_graph, [1])
    )
