"""Gravity as a term of the averaging: rotations get better and upright, and wrong gravities do no harm."""

import sqlite3

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

import sfm_shapefit
from harness.scenes import errors_deg
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import angle_between_deg, mean_rotation_l1, normalized
from sfm_shapefit.files.colmap.gravity import database_gravity, table_gravity
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.rotations.average import average_relative_rotations
from sfm_shapefit.rotations.gravity import DOWN, down_of, judge_gravity, refine_with_gravity
from sfm_shapefit.scene.given import Gravity
from sfm_shapefit.synthetic.rotation_graphs import rotation_problem
from tests.scenes import BUNDLED, RING, read_from

SIGMA_DEG = 0.5


def drifting_chain(num_images=60, wrong_gravities=0.0):
    """A chain whose pairs are six times as noisy as they state, with a measured gravity of each camera."""
    pairs = np.array([(i, j) for i in range(num_images) for j in range(i + 1, min(num_images, i + 4))])
    problem = rotation_problem(num_images, pairs, wrong_share=0.1, noise=6.0, seed=3)
    rng = np.random.default_rng(1)
    noise = Rotation.from_rotvec(np.radians(SIGMA_DEG) * rng.standard_normal((num_images, 3)))
    directions = noise.apply(problem.rotations @ DOWN)
    wrong = rng.uniform(size=num_images) < wrong_gravities
    directions[wrong] = normalized(rng.standard_normal((int(wrong.sum()), 3)))
    sigmas = np.full(num_images, np.radians(SIGMA_DEG))
    return problem, Gravity(np.arange(num_images), directions, sigmas), wrong


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_gravity_halves_the_errors_of_a_drifting_chain_and_wrong_ones_are_found(share):
    problem, gravity, wrong = drifting_chain(wrong_gravities=share)
    without = average_relative_rotations(60, problem.relative)
    found = refine_with_gravity(without, problem.relative, gravity)
    before, after = (np.median(errors_deg(one.rotations, problem.rotations)) for one in (without, found))
    assert after < 0.5 * before
    # A gravity that is off by sigma about two axes tilts by 1.18 sigma in the median; neighbors share theirs.
    tilts = angle_between_deg(found.rotations @ DOWN, problem.rotations @ DOWN)
    assert np.median(tilts) < 1.18 * SIGMA_DEG
    named = judge_gravity(found.rotations, gravity)[1]
    assert named[wrong].all()
    assert named[~wrong].sum() <= 1
    assert np.median(found.sigmas_deg) < np.median(without.sigmas_deg)


def test_gravities_of_which_none_is_near_their_middle_are_followed():
    """Two that lean 20 degrees to either side, by no better an instrument: their middle is down."""
    lean = np.sin(np.radians(20.0)), np.cos(np.radians(20.0))
    directions = np.array([[lean[0], lean[1], 0.0], [-lean[0], lean[1], 0.0]])
    inexact = Gravity(np.arange(2), directions, np.full(2, np.radians(40.0)))
    middle = down_of(np.tile(np.eye(3), (2, 1, 1)), inexact)
    assert angle_between_deg(middle, np.array([0.0, 1.0, 0.0])) < 1e-6  # both weigh the same
    problem, gravity, _ = drifting_chain(12)
    without = average_relative_rotations(12, problem.relative)
    rng = np.random.default_rng(2)
    far = Rotation.from_rotvec(np.radians(40.0) * normalized(rng.standard_normal((12, 3))))
    loose = gravity._replace(directions=far.apply(gravity.directions), sigmas=np.full(12, np.radians(80.0)))
    found = refine_with_gravity(without, problem.relative, loose)
    assert np.isfinite(found.rotations).all()


def test_standard_deviations_are_relative_to_the_cameras_and_not_to_the_world_whose_heading_is_free():
    problem, gravity, _ = drifting_chain(12)
    without = average_relative_rotations(12, problem.relative)
    found = refine_with_gravity(without, problem.relative, gravity)
    off = Rotation.from_matrix(found.rotations.transpose(0, 2, 1) @ problem.rotations)
    errors = np.degrees((off * off.mean().inv()).as_rotvec())
    ratio = np.sqrt(np.mean((errors / found.sigmas_deg[:, None]) ** 2))
    # Of errors of few cameras that neighbors share. With the world in the mean it was 0.26.
    assert 0.4 < ratio < 2.5


def test_one_gravity_says_too_little():
    problem, gravity, _ = drifting_chain(12)
    without = average_relative_rotations(12, problem.relative)
    assert refine_with_gravity(without, problem.relative, gravity.of(np.array([3]))) is without


def test_gravities_of_a_rig_are_those_of_its_frames():
    sensors = Rotation.random(4, random_state=0).as_matrix()
    frames = Rotation.random(2, random_state=1).as_matrix()
    frame_of_image = np.array([0, 0, 1, 1])
    own = np.einsum("kab,kbc,c->ka", sensors, frames[frame_of_image], DOWN)
    found = Gravity(np.arange(4), own, np.array([0.2, 0.1, 0.1, 0.2])).of_frames(frame_of_image, sensors)
    np.testing.assert_allclose(found.directions, frames @ DOWN, atol=1e-12)
    np.testing.assert_array_equal(found.sigmas, [0.1, 0.1])


def up_in(model):
    """The z axis of the true world in a model of the ring."""
    truth = read_model(RING / "sparse" / "0").images
    ours = [model.find_image_with_name(name).cam_from_world().rotation.matrix() for name in truth.names]
    turn = mean_rotation_l1(np.array(ours).transpose(0, 2, 1) @ truth.rotations)
    return turn[:, 2]


def test_map_delivers_an_upright_model_and_names_a_wrong_gravity():
    found = sfm_shapefit.map_database(RING / "database.db", gravity=str(BUNDLED / "gravity.txt"))
    located = found.models[0]
    # The mean of seven gravities, each 1 deg off per axis, is off by 1.18 / sqrt(7) deg in the median.
    assert angle_between_deg(up_in(located.reconstruction), np.array([0.0, 0.0, 1.0])) < 3 * 1.18 / np.sqrt(7)
    assert located.gauge.statement.endswith("; z up by 7 of 8 gravities")
    assert any("1 of 8 images contradict their rotations and have no part" in w for w in located.warnings)
    assert any("0006.jpg" in w for w in located.warnings)
    centers = [
        located.reconstruction.find_image_with_name(r.name).projection_center() for r in located.cameras
    ]
    np.testing.assert_allclose([row.center for row in located.cameras], centers, atol=1e-12)
    np.testing.assert_allclose(located.gauge.apply(located.placement.locations), centers, atol=1e-3)


def test_the_gravity_of_pose_priors_is_read(tmp_path):
    path = tmp_path / "database.db"
    path.write_bytes((RING / "database.db").read_bytes())
    images = read_model(RING / "sparse" / "0").images
    with pytest.raises(InputError, match=r"has no gravity of its images; give a table \(gravity=FILE\)"):
        read_from(path, database_gravity, images)
    with pycolmap.Database.open(path) as database:
        for image in database.read_all_images():
            prior = pycolmap.PosePrior(gravity=[0.0, 2.0, 0.0], corr_data_id=image.data_id)
            database.write_pose_prior(prior)
    found = read_from(path, database_gravity, images)
    np.testing.assert_array_equal(found.indices, np.arange(8))
    np.testing.assert_array_equal(found.directions, np.tile([0.0, 1.0, 0.0], (8, 1)))
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE pose_priors SET gravity = x'00'")
    with pytest.raises(InputError, match=r"the gravity of image .* is damaged"):
        read_from(path, database_gravity, images)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("0001.jpg 0 1", "line 1: expected the name of an image, three components"),
        ("0001.jpg 0 1 0\n0002.jpg 0 down 0", "line 2: expected the name of an image"),
        ("0001.jpg 0 0 0", "line 1: the direction must be finite and not zero"),
        ("0001.jpg 0 nan 0", "line 1: the direction must be finite"),
        ("0001.jpg 0 1 0 -2", "the standard deviation between 0.001 and 90 deg"),
        ("0001.jpg 0 1 0 1e-100", "the standard deviation between 0.001 and 90 deg"),
        ("0001.jpg 0 1 0\n0001.jpg 0 1 0", "line 2: 0001.jpg appears twice; keep one of its lines"),
        ("other.jpg 0 1 0", "has no gravity of the model's images, such as 0001.jpg"),
    ],
)
def test_a_bad_table_is_refused(tmp_path, text, said):
    (tmp_path / "gravity.txt").write_text(text)
    with pytest.raises(InputError) as refused:
        table_gravity(tmp_path / "gravity.txt", read_model(RING / "sparse" / "0").images)
    assert said in str(refused.value)


def test_a_table_may_have_a_header_and_sigmas(tmp_path):
    (tmp_path / "gravity.csv").write_text(
        "name,x,y,z,sigma\n0002.jpg,0,3,0,2\n0001.jpg,0,0,1\nno.jpg,1,0,0\n"
    )
    found = table_gravity(tmp_path / "gravity.csv", read_model(RING / "sparse" / "0").images)
    np.testing.assert_array_equal(found.directions, [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    np.testing.assert_allclose(np.degrees(found.sigmas), [1.0, 2.0])
