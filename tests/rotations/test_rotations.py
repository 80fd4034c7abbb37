"""Refining given rotations on the matches: the residual's derivatives, the minimum, and who may turn."""

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

import sfm_shapefit
from peers.colmap import average_rotations
from sfm_shapefit.colmap.model import read_model, with_turned_cameras
from sfm_shapefit.directions.matches import RayMatches
from sfm_shapefit.geometry import normalized, rotation_angles_deg
from sfm_shapefit.rotations import joint_refinement as epipolar
from sfm_shapefit.rotations.acceptance import refine_rotations
from sfm_shapefit.rotations.joint_refinement import State, at_state
from tests.problems import all_pairs
from tests.scenes import COURTYARD, RING, real_scene

PIXEL = 1e-3  # angle of a pixel in radians
N = 10


def turned_scene(errors_deg, pairs=None, noise_px=0.0, matches=60, seed=0):
    """Cameras on a ball around a cloud of points; camera k's rays are turned by a rotation of errors_deg[k].

    Returns the matches, the true centers, and the turns (n, 3, 3) that undo the errors.
    """
    rng = np.random.default_rng(seed)
    n = len(errors_deg)
    pairs = np.asarray(all_pairs(n) if pairs is None else pairs, dtype=np.int64)
    centers = 6.0 * normalized(rng.standard_normal((n, 3)))
    axes = normalized(rng.standard_normal((n, 3)))
    errors = Rotation.from_rotvec(np.radians(errors_deg)[:, None] * axes).as_matrix()
    rays = ([], [])
    for pair in pairs:
        points = rng.standard_normal((matches, 3))
        for side, camera in enumerate(pair):
            true = normalized(points - centers[camera])
            true = normalized(true + noise_px * PIXEL * rng.standard_normal(true.shape))
            rays[side].append(true @ errors[camera].T)
    found = RayMatches(
        pairs=pairs,
        offsets=np.arange(len(pairs) + 1, dtype=np.int64) * matches,
        rays_i=np.concatenate(rays[0]),
        rays_j=np.concatenate(rays[1]),
        pixel_angles=np.full(len(pairs), PIXEL),
    )
    return found, centers, errors.transpose(0, 2, 1)


def relative_errors_deg(turns, truth):
    """Angles by which turns differ from the true ones, after the best common rotation."""
    apart = truth.transpose(0, 2, 1) @ turns
    common = Rotation.from_matrix(apart).mean().as_matrix()
    return rotation_angles_deg(common.T @ apart)


def moved(state, pair, step):
    """The state after a step in the 9 unknowns of one pair; of C_i - C_j the whole step moves C_i."""
    steps = np.zeros((len(state.centers), 6))
    steps[pair[0], :3], steps[pair[1], :3], steps[pair[0], 3:] = step[:3], step[3:6], step[6:]
    return state.move(steps)


def test_the_gradient_is_the_slope_of_the_cost_and_the_matrix_that_of_least_squares():
    matches, centers, _ = turned_scene(np.full(4, 0.5), noise_px=1.0)
    state = State(np.tile(np.eye(3), (4, 1, 1)), centers)
    wide = 1e4  # px: the Cauchy loss is the square, up to (r / scale)^2 / 2 = 1e-6 at 15 px
    normal = at_state(matches, state, wide)
    h = 1e-5
    for p, pair in enumerate(matches.pairs):
        ahead, behind = (
            [at_state(matches, moved(state, pair, sign * h * axis), wide) for axis in np.eye(9)]
            for sign in (1.0, -1.0)
        )
        slopes = [(a.costs[p] - b.costs[p]) / (2.0 * h) for a, b in zip(ahead, behind, strict=True)]
        size = np.abs(normal.vectors[p]).max()
        np.testing.assert_allclose(normal.vectors[p], slopes, atol=1e-5 * size)  # truncation, h^2 r'''/6
        # Gauss-Newton leaves out r r'', which is of the order of the residual's angle, some px of 1e-3 rad.
        bends = [(a.vectors[p] - b.vectors[p]) / (2.0 * h) for a, b in zip(ahead, behind, strict=True)]
        np.testing.assert_allclose(normal.matrices[p], bends, atol=0.05 * np.abs(normal.matrices[p]).max())


def test_exact_matches_bring_every_rotation_back():
    errors_deg = np.linspace(0.2, 1.0, N)
    matches, centers, truth = turned_scene(errors_deg)
    rough = centers + 0.05 * np.random.default_rng(1).standard_normal(centers.shape)
    found = refine_rotations(matches, rough)
    assert found.updated.all()
    # The prior pulls a turn back by its curvature over the matches', 4 / (0.3 deg)^2 over 1e2 / PIXEL^2.
    assert relative_errors_deg(found.turns, truth).max() < 0.01
    assert (found.angles_deg > 0.1).all()


def test_right_rotations_stay_as_right_as_the_noise_allows():
    matches, centers, truth = turned_scene(np.zeros(N), noise_px=0.5)
    found = refine_rotations(matches, centers)
    # 9 pairs of 60 matches at 0.5 px: 0.5 PIXEL / sqrt(540) = 0.0012 deg about the viewing axis. Turns about
    # the others are nearly undone by moving the center: they show by the square of the cloud's apparent size,
    # 1 / 6, as 36 times that, 0.045 deg; the worst of 10 cameras is at 2 sigma.
    assert relative_errors_deg(found.turns, truth).max() < 0.1


@pytest.mark.parametrize("wrong_deg", [0.0, 1.0])
def test_one_wrong_rotation_among_right_ones_is_mended_alone_and_right_ones_stay_to_the_bit(wrong_deg):
    # 200 matches per pair: 30 parameters of 9000 residuals gain 0.3 % of the cost.
    errors_deg = np.where(np.arange(N) == 3, wrong_deg, 0.0)
    matches, centers, truth = turned_scene(errors_deg, noise_px=0.5, matches=200, seed=1)
    found = refine_rotations(matches, centers)
    assert np.flatnonzero(found.updated).tolist() == [3] * (wrong_deg > 0.0)
    right = np.delete(found.turns, 3, axis=0)
    np.testing.assert_array_equal(right, np.tile(np.eye(3), (N - 1, 1, 1)))
    assert relative_errors_deg(found.turns, truth)[3] < 0.1  # of 1 deg; see above for the noise's part


def test_a_camera_with_two_pairs_keeps_its_rotation_to_the_bit():
    pairs = [*all_pairs(N - 1), (0, N - 1), (1, N - 1)]
    matches, centers, _ = turned_scene(np.full(N, 0.4), pairs)
    found = refine_rotations(matches, centers)
    assert not found.updated[-1]
    assert found.updated[:-1].all()
    np.testing.assert_array_equal(found.turns[-1], np.eye(3))
    assert found.angles_deg[-1] == 0.0


def one_heavy_wrong_pair():
    """Right rotations, but one pair of 3000 matches sees camera 0 turned by 2 deg; its others have 20."""
    matches, centers, _ = turned_scene(np.zeros(N), noise_px=0.3, matches=20)
    heavy, _, _ = turned_scene(np.zeros(N), pairs=[[0, 1]], noise_px=0.3, matches=3000)
    turn = Rotation.from_rotvec(np.radians([0.0, 0.0, 2.0])).as_matrix()
    others = matches.offsets[1]
    combined = RayMatches(
        pairs=matches.pairs,
        offsets=np.append(0, matches.offsets[1:] + 3000 - others),
        rays_i=np.concatenate([heavy.rays_i @ turn.T, matches.rays_i[others:]]),
        rays_j=np.concatenate([heavy.rays_j, matches.rays_j[others:]]),
        pixel_angles=matches.pixel_angles,
    )
    return combined, centers


def test_a_single_pair_turns_no_camera_however_many_matches_it_has():
    matches, centers = one_heavy_wrong_pair()
    found = refine_rotations(matches, centers)
    free = epipolar.minimize(
        matches,
        State(np.tile(np.eye(3), (N, 1, 1)), centers),
        8.0,
        epipolar.TurnPrior(np.radians(1.0), np.ones(N, dtype=bool)),
    )
    angles = rotation_angles_deg(free.turns)
    assert angles[:2].max() > 0.5  # the pair alone would turn its cameras
    np.testing.assert_array_equal(found.turns[:2], np.tile(np.eye(3), (2, 1, 1)))


def test_the_sparse_system_has_the_dense_ones_answer(monkeypatch):
    pairs = [pair for pair in all_pairs(N) if pair[1] - pair[0] <= 4]
    matches, centers, _ = turned_scene(np.full(N, 0.5), pairs, noise_px=0.3)
    dense = refine_rotations(matches, centers)
    monkeypatch.setattr(epipolar, "_DENSE_UNKNOWNS", 0)
    sparse = refine_rotations(matches, centers)
    # Steps end at a relative fall of 1e-6; both take the same ones up to rounding.
    np.testing.assert_allclose(sparse.turns, dense.turns, atol=1e-9)
    np.testing.assert_array_equal(sparse.updated, dense.updated)


def random_turns(n, sigma_deg, seed):
    vectors = np.radians(sigma_deg) * np.random.default_rng(seed).standard_normal((n, 3))
    return Rotation.from_rotvec(vectors).as_matrix()


def test_turned_cameras_stay_where_they_are_and_the_input_stays_as_it_is():
    model = read_model(RING / "sparse" / "0")
    turns = random_turns(model.num_images, 1.0, 0)
    turns[0] = np.eye(3)
    turned = with_turned_cameras(model, turns)
    np.testing.assert_allclose(turned.rotations, model.rotations @ turns.transpose(0, 2, 1), atol=1e-14)
    np.testing.assert_allclose(turned.centers, model.centers, atol=1e-13)
    first, other = model.image_ids[:2].tolist()
    before, after = model.reconstruction, turned.reconstruction
    for image_id, same in ((first, True), (other, False)):
        old, new = (m.image(image_id).cam_from_world().rotation.quat for m in (before, after))
        assert np.array_equal(old, new) is same
    given = pycolmap.Reconstruction(RING / "sparse" / "0")
    np.testing.assert_array_equal(
        given.image(other).cam_from_world().rotation.quat, before.image(other).cam_from_world().rotation.quat
    )


@pytest.fixture(scope="module")
def turned_courtyard():
    """The courtyard's model with rotations that are off by 0.2 deg per axis, but for the first camera's."""
    model = read_model(COURTYARD / "sparse" / "0")
    turns = random_turns(model.num_images, 0.2, 4)
    turns[0] = np.eye(3)
    return with_turned_cameras(model, turns).reconstruction


def test_refined_rotations_are_closer_to_the_truth_and_others_stay_to_the_bit(turned_courtyard):
    database, truth = COURTYARD / "database.db", COURTYARD / "truth"
    usual = sfm_shapefit.locate(turned_courtyard, database)
    found = sfm_shapefit.locate(turned_courtyard, database, refine_rotations=True)
    plain, refined = (sfm_shapefit.evaluate(one.reconstruction, truth) for one in (usual, found))
    assert refined.rotation_deg.median < 0.25 * plain.rotation_deg.median
    assert refined.position.median < 0.5 * plain.position.median
    assert refined.rotation_deg.max <= plain.rotation_deg.max
    told = found.summary()["rotation_refinement"]
    assert told["num_updated"] + told["num_kept"] == found.model.num_images
    assert told["num_updated"] == np.count_nonzero(found.turned_deg) > 15
    assert 0.1 < told["median_change_deg"] < 1.0
    assert told["max_change_deg"] == found.turned_deg.max()
    assert usual.turned_deg is None
    assert usual.summary()["rotation_refinement"] is None
    for image_id, turned in zip(found.model.image_ids.tolist(), found.turned_deg > 0.0, strict=True):
        given, kept, ours = (
            one.image(image_id).cam_from_world().rotation.quat
            for one in (turned_courtyard, usual.reconstruction, found.reconstruction)
        )
        np.testing.assert_array_equal(kept, given)
        assert np.array_equal(ours, given) is not bool(turned)


def test_the_models_own_tracks_serve_as_well():
    model = read_model(RING / "sparse" / "0")
    turned = with_turned_cameras(model, random_turns(model.num_images, 0.2, 1)).reconstruction
    options = {"directions": "tracks"}
    plain = sfm_shapefit.locate(turned, **options)
    refined = sfm_shapefit.locate(turned, refine_rotations=True, **options)
    truth = RING / "sparse" / "0"
    before, after = (sfm_shapefit.evaluate(one.reconstruction, truth) for one in (plain, refined))
    assert after.rotation_deg.median < 0.25 * before.rotation_deg.median


def test_averaged_rotations_of_a_real_scene_get_better():
    scene = real_scene("fountain-P11")
    model = average_rotations(scene / "database.db", scene / "sparse" / "0")
    found = sfm_shapefit.locate(model, scene / "database.db", refine_rotations=True)
    errors = sfm_shapefit.evaluate(found.reconstruction, scene / "gt")
    assert errors.position.median < 0.003
    assert errors.position.max < 0.008
