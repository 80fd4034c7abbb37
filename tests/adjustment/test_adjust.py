"""The adjustment's answers: what is held stays, what is weighted is between, and the gauge is the start's."""

import signal
import threading
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit.adjustment import solve as adjustment_solve
from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.covariance import estimate_covariances
from sfm_shapefit.adjustment.gauge import free_similarities, restore_gauge, small_similarities
from sfm_shapefit.adjustment.layout import lay_out
from sfm_shapefit.adjustment.lone_points import settle_points
from sfm_shapefit.adjustment.problem import AdjustmentProblem, LensPrior, RotationPrior, isotropic_information
from sfm_shapefit.adjustment.residuals import reprojection_residuals
from sfm_shapefit.adjustment.run import without_lone_frames
from sfm_shapefit.adjustment.solve import Ending, adjust, frames_not_gained, reprojection_errors_px, values_of
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import fit_similarity
from sfm_shapefit.laplacian.operators import Workers
from sfm_shapefit.scene.known_positions import KnownPositions
from sfm_shapefit.scene.lens import Lens
from sfm_shapefit.tracks.triangulation import TriangulatedPoints
from tests.adjustment.made import LENSES, disturb, look_at, observed, ring_problem

TIGHT = AdjustmentOptions(cost_tolerance=0.0, gradient_tolerance=1e-12, loss_scale_px=2.0)


def make_start(seed=0, *, fixed=(), **kwargs):
    """The truth with noisy pixels, and the same problem started elsewhere."""
    rng = np.random.default_rng(seed)
    truth = ring_problem(rng, **kwargs)
    flags = np.zeros(truth.num_frames, np.bool_)
    flags[list(fixed)] = True
    truth = replace(truth, fixed=flags)
    return truth, disturb(truth, rng, center=0.02, rotation_rad=0.003, point=0.02)


def error(problem, truth):
    """Mean distance of centers after the best similarity."""
    fit = fit_similarity(problem.centers, truth.centers)
    return float(np.linalg.norm(fit.apply(problem.centers) - truth.centers, axis=1).mean())


def test_it_ends_at_a_stationary_point_that_is_as_good_as_the_noise():
    truth, start = make_start()
    found = adjust(start, TIGHT)
    assert found.converged
    assert found.gradient_norm < 1e-7
    assert (np.diff(found.costs) < 0.0).all()
    assert found.cost < adjust(truth, TIGHT).costs[0]  # better than the truth, which noise has moved away
    # half a pixel of 500 px at a distance of 4 is 4e-3; a camera's depth is worse, its 100 points are many
    assert error(found.problem, truth) < 4e-3
    assert error(start, truth) > 2e-2
    misses = reprojection_errors_px(found.problem)
    assert 0.5 < np.sqrt(np.mean(misses**2) / 2.0) / 0.5 < 1.0


@pytest.mark.parametrize("loss", [None, 1.0])
def test_exact_pixels_give_the_exact_scene(loss):
    truth, start = make_start(noise_px=0.0)
    found = adjust(start, replace(TIGHT, loss_scale_px=loss))
    assert error(found.problem, truth) < 1e-9


def test_held_rotations_stay_to_the_bit_and_centers_become_right():
    truth, start = make_start()
    start = replace(start, rotations=truth.rotations)
    answer = adjust(start, replace(TIGHT, hold_rotations=True))
    found = answer.problem
    np.testing.assert_array_equal(found.rotations, truth.rotations)
    assert answer.gradient_norm < 1e-7  # of what may move
    assert error(found, truth) < error(adjust(start, TIGHT).problem, truth)  # exact rotations are worth much


@pytest.mark.parametrize("hold", [False, True])
@pytest.mark.parametrize("fixed", [(3,), (0, 5), (1, 2, 7)])
def test_fixed_frames_stay_to_the_bit(fixed, hold):
    truth, start = make_start(fixed=fixed)
    found = adjust(start, replace(TIGHT, hold_rotations=hold)).problem
    for name in ("rotations", "centers"):
        np.testing.assert_array_equal(getattr(found, name)[list(fixed)], getattr(start, name)[list(fixed)])
    moved = np.linalg.norm(found.centers - start.centers, axis=1) > 0.0
    assert moved.sum() == truth.num_frames - len(fixed)


@pytest.mark.parametrize("solver", ["dense", "sparse", "iterative"])
def test_everything_fixed_leaves_points_to_adjust(solver):
    truth, start = make_start(fixed=range(12))
    found = adjust(start, replace(TIGHT, linear_solver=solver))
    assert found.gradient_norm < 1e-7
    off = np.linalg.norm(found.problem.points - truth.points, axis=1)
    assert np.median(off) < 0.2 * np.median(np.linalg.norm(start.points - truth.points, axis=1))
    assert not estimate_covariances(found.problem, linear_solver=solver).centers.any()


def test_a_tiny_sigma_equals_held_rotations_and_a_huge_one_free_ones():
    _, start = make_start()

    def weighted(sigma_rad):
        information = isotropic_information(np.full(start.num_frames, sigma_rad))
        prior = RotationPrior(rotations=start.rotations, information=information)
        return adjust(replace(start, rotation_prior=prior), TIGHT).problem

    held, free = adjust(start, replace(TIGHT, hold_rotations=True)).problem, adjust(start, TIGHT).problem
    np.testing.assert_allclose(weighted(1e-8).centers, held.centers, atol=1e-6)
    loose = weighted(1e4)
    np.testing.assert_allclose(fit_similarity(loose.centers, free.centers).apply(loose.centers), free.centers,
                               atol=1e-6)  # fmt: skip
    between = adjust(start, TIGHT).problem.rotations - start.rotations
    assert 0.1 < np.linalg.norm(weighted(1e-3).rotations - start.rotations) / np.linalg.norm(between) < 0.99


def test_a_center_prior_of_tiny_sigma_holds_and_sets_scale_and_origin():
    truth, start = make_start()
    known = np.array([0, 4, 8])
    aims = 3.0 * truth.centers + 5.0
    prior = KnownPositions(known, aims[known], isotropic_information(np.full(3, 1e-6)))
    begin = replace(start, centers=3.0 * start.centers + 5.0, points=3.0 * start.points + 5.0)
    found = adjust(replace(begin, center_prior=prior), TIGHT).problem
    np.testing.assert_allclose(found.centers[known], aims[known], atol=1e-5)
    assert error(found, truth) < 0.01


@pytest.mark.parametrize("hold", [False, True])
def test_the_gauge_is_that_of_the_start(hold):
    _, start = make_start()
    found = adjust(start, replace(TIGHT, hold_rotations=hold)).problem
    fit = fit_similarity(found.centers, start.centers, rotate=not hold)
    np.testing.assert_allclose([fit.scale, *fit.translation, *fit.rotation.ravel()],
                               [1.0, 0.0, 0.0, 0.0, *np.eye(3).ravel()], atol=1e-12)  # fmt: skip


@pytest.mark.parametrize("fixed", [(), (2,)])
@pytest.mark.parametrize("far", [-40.0, 3.0, 500.0])
def test_the_gauge_holds_where_a_camera_ran_far_away(far, fixed):
    _, start = make_start(fixed=fixed)
    centers = start.centers.copy()
    centers[0] *= far
    values = values_of(replace(start, centers=centers))
    free = free_similarities(start, TIGHT)
    found = restore_gauge(start, values, free).centers
    moves = small_similarities(start.rotations, found, start.centers.mean(axis=0))[:, :3] @ free
    left = np.einsum("nai,na->i", moves, start.centers - found)
    sizes = np.sqrt(np.sum(moves**2, axis=(0, 1)) * np.sum((start.centers - found) ** 2))
    assert np.abs(left / sizes).max() < 1e-9
    before = np.sum((start.centers - centers) ** 2)
    assert np.sum((start.centers - found) ** 2) < before


def test_one_fixed_frame_leaves_the_scale_which_stays():
    _, start = make_start(fixed=(2,))
    found = adjust(start, TIGHT).problem
    arms, before = found.centers - found.centers[2], start.centers - start.centers[2]
    assert np.sum(arms * before) / np.sum(arms * arms) == pytest.approx(1.0, abs=1e-12)


def edge_px(lens):
    """Where a ray near the edge of the image meets it."""
    fx, fy, cx, cy, k1, k2, p1, p2 = lens.values()
    u, v = 0.25, 0.15
    s = u * u + v * v
    radial = 1.0 + k1 * s + k2 * s * s
    x = u * radial + 2.0 * p1 * u * v + p2 * (s + 2.0 * u * u)
    y = v * radial + 2.0 * p2 * u * v + p1 * (s + 2.0 * v * v)
    return np.array([fx * x + cx, fy * y + cy])


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"])
def test_a_wrong_focal_length_and_distortion_are_found(model):
    truth, start = make_start(models=(model,), noise_px=0.1)
    lens = truth.lenses[0]
    wrong = list(lens.parameters)
    wrong[0] *= 1.03
    if len(wrong) != 3 and wrong[-1] != 240.0:
        wrong[-1] += 0.01
    start = replace(start, lenses=[Lens(model, tuple(wrong))])
    found = adjust(start, replace(TIGHT, free_focal_lengths=True, free_distortion=True)).problem.lenses[0]
    # .1 px on 1200 observations: a focal length to .1 px / sqrt(1200) / .2 of it; k1 and k2 only together
    np.testing.assert_allclose(found.parameters[0], lens.parameters[0], rtol=1e-3)
    np.testing.assert_allclose(edge_px(found), edge_px(lens), atol=0.3)
    assert np.abs(edge_px(start.lenses[0]) - edge_px(lens)).max() > 3.0
    held = adjust(start, TIGHT).problem.lenses[0]
    assert held == start.lenses[0]
    fixed = replace(start, lenses=[replace(start.lenses[0], fixed=True)])
    stays = adjust(fixed, replace(TIGHT, free_focal_lengths=True, free_distortion=True)).problem.lenses[0]
    assert stays.parameters == start.lenses[0].parameters


def test_a_fifth_of_wrong_observations_moves_nearly_nothing_under_cauchy():
    truth, start = make_start()
    rng = np.random.default_rng(7)
    wrong = rng.random(start.num_observations) < 0.2
    pixels = np.where(wrong[:, None], rng.uniform(0.0, 600.0, start.pixels.shape), start.pixels)
    spoiled = replace(start, pixels=pixels)
    clean = error(adjust(start, TIGHT).problem, truth)
    assert error(adjust(spoiled, TIGHT).problem, truth) < 2.0 * clean
    assert error(adjust(spoiled, replace(TIGHT, loss_scale_px=None)).problem, truth) > 10.0 * clean


@pytest.mark.parametrize("hold", [False, True])
@pytest.mark.parametrize("free", [False, True])
def test_dense_and_sparse_systems_give_the_same(hold, free):
    _, start = make_start(models=("OPENCV", "SIMPLE_RADIAL"))
    options = replace(TIGHT, hold_rotations=hold, free_focal_lengths=free, free_distortion=free)
    dense = adjust(start, replace(options, linear_solver="dense")).problem
    sparse = adjust(start, replace(options, linear_solver="sparse")).problem
    extent = np.ptp(dense.centers, axis=0).max()
    np.testing.assert_allclose(sparse.centers, dense.centers, atol=1e-9 * extent)
    np.testing.assert_allclose(sparse.points, dense.points, atol=1e-9 * extent)


@pytest.mark.parametrize("bend", [0.02, 0.2])
def test_a_factor_of_32_bits_leads_where_a_dense_one_leads_on_a_long_row(bend):
    """Its condition grows with the fourth power of the number of cameras."""
    _, start = make_bent_row(150, bend)
    sparse, dense = (adjust(start, TIGHT, linear_solver=one).problem.centers for one in ("sparse", "dense"))
    np.testing.assert_allclose(sparse, dense, atol=1e-6 * np.ptp(dense))


@pytest.mark.parametrize("solver", ["dense", "sparse", "iterative"])
def test_entries_given_up_while_a_system_is_factored_change_nothing(monkeypatch, solver):
    _, start = make_start()
    kept = adjust(start, TIGHT, linear_solver=solver)
    monkeypatch.setattr(adjustment_solve, "MANY_ENTRIES", 0)
    given_up = adjust(start, TIGHT, linear_solver=solver)
    np.testing.assert_array_equal(given_up.problem.centers, kept.problem.centers)
    np.testing.assert_array_equal(given_up.problem.points, kept.problem.points)


@pytest.mark.parametrize("solver", ["dense", "sparse", "iterative"])
def test_threads_do_not_change_one_bit(solver):
    """Enough cameras for strips of a dense factor, and observations for several chunks of points."""
    _, start = make_start(num_cameras=48, num_points=400, models=("OPENCV", "PINHOLE"))
    options = AdjustmentOptions(linear_solver=solver, free_focal_lengths=True, max_iterations=4)
    found = [adjust(start, options, threads=threads) for threads in (1, 2, 3, 7)]
    known = [
        (one.costs, one.problem.centers, one.problem.points, known.centers, known.rotations)
        for one, threads in zip(found, (1, 2, 3, 7), strict=True)
        for known in [estimate_covariances(one.problem, options, threads=threads)]
    ]
    for other in known[1:]:
        for expected, array in zip(known[0], other, strict=True):
            np.testing.assert_array_equal(array, expected)


def test_the_order_of_observations_matters_to_rounding_only():
    _, start = make_start()
    order = np.random.default_rng(0).permutation(start.num_observations)
    shuffled = observed(start, order)
    np.testing.assert_allclose(adjust(shuffled, TIGHT).problem.centers, adjust(start, TIGHT).problem.centers,
                               atol=1e-9)  # fmt: skip
    np.testing.assert_array_equal(reprojection_errors_px(shuffled), reprojection_errors_px(start)[order])


def test_a_camera_without_observations_and_a_point_behind_all_are_held():
    _, start = make_start()
    n, k = start.num_frames, start.num_points
    extra = AdjustmentProblem(
        rotations=np.concatenate([start.rotations, look_at(np.full((1, 3), 9.0), np.zeros((1, 3)))]),
        centers=np.concatenate([start.centers, np.full((1, 3), 9.0)]),
        points=np.concatenate([start.points, 3.0 * start.centers[:1]]),
        cameras_seeing=np.concatenate([start.cameras_seeing, [0]]),
        points_seen=np.concatenate([start.points_seen, [k]]),
        pixels=np.concatenate([start.pixels, [[0.0, 0.0]]]),
        lenses=start.lenses,
        lens_of_camera=np.zeros(n + 1, np.int64),
        fixed=np.arange(n + 1) < 2,  # a gauge, so that nothing moves with everything
    )
    for solver in ("dense", "sparse", "iterative"):
        found = adjust(extra, replace(TIGHT, linear_solver=solver))
        assert found.converged
        np.testing.assert_array_equal(found.problem.centers[n], extra.centers[n])
        np.testing.assert_array_equal(found.problem.points[k], extra.points[k])
        assert error(replace(found.problem, fixed=[], centers=found.problem.centers), extra) < 0.1


def test_a_frame_that_was_led_away_from_a_better_pose_is_told_from_those_that_gained():
    _, start = make_start()
    found = adjust(start, TIGHT).problem
    assert not frames_not_gained(start, found, 2.0).any()
    away = found.centers.copy()
    away[3] += [0.5, 0.0, 0.0]
    np.testing.assert_array_equal(
        np.flatnonzero(frames_not_gained(start, replace(found, centers=away), 2.0)), [3]
    )


def test_a_frame_that_sees_a_single_point_has_no_part_in_it_and_the_point_stays_where_others_see_it():
    # Frame 3 sees point 1 alone, which is then left to frame 2, and this with point 2 alone.
    found = TriangulatedPoints(
        points=np.eye(3), tracks=np.arange(3), points_seen=np.array([0, 0, 1, 1, 2, 2, 2, -1])
    )
    frames = np.array([0, 1, 2, 3, 0, 1, 2, 3])
    kept = without_lone_frames(found, frames, 2)
    assert kept.points_seen.tolist() == [0, 0, -1, -1, 1, 1, -1, -1]
    assert kept.tracks.tolist() == [0, 2]
    assert without_lone_frames(kept, frames, 2) is kept


def test_points_of_one_view_do_no_harm():
    _, start = make_start()
    single = start.points_seen < 20
    first = np.zeros(start.num_observations, np.bool_)
    first[np.unique(start.points_seen, return_index=True)[1]] = True
    kept = ~single | first
    thin, rest = observed(start, kept), observed(start, ~single)
    found, expected = adjust(thin, TIGHT).problem, adjust(rest, TIGHT).problem
    np.testing.assert_allclose(found.centers, expected.centers, atol=1e-6)


def test_a_limit_of_iterations_keeps_the_best_values_so_far():
    _, start = make_start()
    limited = adjust(start, replace(TIGHT, max_iterations=3))
    assert limited.ending is Ending.MAX_ITERATIONS
    assert not limited.converged
    assert limited.iterations == 3
    assert limited.cost < limited.costs[0]


def make_bent_row(num_cameras, bend):
    """The truth of cameras in a row along a wall, with noisy pixels, and the same bent to a parabola."""
    rng = np.random.default_rng(0)
    half = 0.25 * num_cameras
    centers = np.linspace([0.0, 0.0, 0.0], [2.0 * half, 0.0, 0.0], num_cameras)
    points = rng.uniform([0.0, 3.0, -1.0], [2.0 * half, 5.0, 1.0], (6 * num_cameras, 3))
    cameras, seen = np.nonzero(np.abs(points[:, 0] - centers[:, :1]) < 1.0)
    truth = AdjustmentProblem(
        rotations=look_at(centers, centers + np.array([0.0, 1.0, 0.0])),
        centers=centers,
        points=points,
        cameras_seeing=cameras,
        points_seen=seen,
        pixels=np.zeros((len(cameras), 2)),
        lenses=(Lens("SIMPLE_PINHOLE", LENSES["SIMPLE_PINHOLE"]),),
        lens_of_camera=np.zeros(num_cameras, dtype=np.int64),
    )
    exact = reprojection_residuals(truth, values_of(truth))
    truth = replace(truth, pixels=exact + 0.5 * rng.standard_normal(exact.shape))
    along = centers[:, 0] / half - 1.0
    turns = Rotation.from_euler("z", np.arctan(2.0 * bend / half * along[:, None])).as_matrix()
    start = replace(
        truth,
        rotations=truth.rotations @ turns.transpose(0, 2, 1),
        centers=centers + bend * along[:, None] ** 2 * [0.0, 1.0, 0.0],
        points=points + bend * (points[:, :1] / half - 1.0) ** 2 * [0.0, 1.0, 0.0],
    )
    return truth, start


def test_a_long_row_is_straightened_with_little_damping_that_the_usual_holds_back():
    _, start = make_bent_row(num_cameras=100, bend=0.1)
    minimum = adjust(start, TIGHT).problem
    usual, little = (
        error(adjust(start, loss_scale_px=2.0, cost_tolerance=1e-4, first_damping=damping).problem, minimum)
        for damping in (1e-4, 1e-8)
    )
    # A row of 100 bends with about 1e-8 of a camera's curvature: held back by one, free with the other.
    assert usual > 0.1 * error(start, minimum)
    assert little < 0.01 * error(start, minimum)


def test_points_that_step_by_themselves_spare_joint_steps_where_cameras_are_near():
    truth, _ = make_start()
    near = adjust(truth, TIGHT, loss_scale_px=0.25).problem
    off = disturb(near, np.random.default_rng(5), center=0.0, rotation_rad=0.0, point=0.05)
    alone, joint = (
        adjust(off, loss_scale_px=0.25, cost_tolerance=1e-5, settles_points=settles)
        for settles in (True, False)
    )
    assert alone.iterations < 0.5 * joint.iterations
    assert alone.cost <= joint.cost * (1.0 + 1e-4)


def test_no_step_of_a_point_by_itself_raises_its_loss():
    truth, _ = make_start()
    off = disturb(truth, np.random.default_rng(6), center=0.05, rotation_rad=0.01, point=2.0)
    layout, values = lay_out(off, AdjustmentOptions()), values_of(off)
    workers = Workers(1)
    costs = [settle_points(layout, values, 1.0, workers, steps)[1] for steps in range(12)]
    points, _ = settle_points(layout, values, 1.0, workers, 12)
    assert (np.diff(costs) <= 0.0).all()
    assert costs[-1] < 0.9 * costs[0]
    before, after = (
        np.bincount(
            off.points_seen,
            np.log1p(np.nan_to_num(reprojection_errors_px(replace(off, points=at)), nan=500.0) ** 2),
        )
        for at in (off.points, points)
    )
    assert (after <= before * (1.0 + 1e-12)).all()


def test_steps_that_would_raise_the_cost_are_refused():
    truth, _ = make_start()
    start = disturb(truth, np.random.default_rng(3), center=2.0, rotation_rad=0.3, point=1.0)  # hopeless
    found = adjust(start, replace(TIGHT, loss_scale_px=None))
    assert found.iterations > len(found.costs) + 5
    assert (np.diff(found.costs) < 0.0).all()
    assert found.ending is Ending.STALLED or found.gradient_norm < 1e-6


def test_no_observation_is_said():
    _, start = make_start()
    none = np.zeros(0, np.int64)
    with pytest.raises(InputError, match="no observation"):
        adjust(replace(start, cameras_seeing=none, points_seen=none, pixels=np.zeros((0, 2))))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"centers": np.full((12, 3), np.nan)}, "not finite"),
        ({"rotations": np.tile(2.0 * np.eye(3), (12, 1, 1))}, "orthonormal"),
        ({"rotations": np.tile(np.diag([1.0, 1.0, -1.0]), (12, 1, 1))}, "orthonormal"),
        ({"points": np.zeros((3, 3))}, "point index"),
        ({"lens_of_camera": np.ones(12, np.int64)}, "lens index"),
        ({"lens_of_camera": np.zeros(11, np.int64)}, "rig's arrays have shapes"),
        ({"fixed": np.zeros(3, np.bool_)}, "fixed has shape"),
        ({"points_seen": np.zeros(3, np.int64)}, "points_seen has shape"),
    ],
)
def test_a_wrong_problem_is_refused_by_name(change, message):
    _, start = make_start()
    with pytest.raises(InputError, match=message):
        replace(start, **change)


def test_wrong_priors_lenses_and_options_are_refused():
    _, start = make_start()
    n = start.num_frames
    with pytest.raises(InputError, match="positive semidefinite"):
        replace(
            start, center_prior=KnownPositions(np.arange(n), start.centers, np.tile(-np.eye(3), (n, 1, 1)))
        )
    with pytest.raises(InputError, match="rotation prior must have 12"):
        replace(
            start, rotation_prior=RotationPrior(rotations=np.eye(3)[None], information=np.zeros((1, 3, 3)))
        )
    with pytest.raises(InputError, match="lens prior must have 1 x 8"):
        replace(start, lens_prior=LensPrior(values=np.ones((1, 8)), information=np.full((1, 8), -1.0)))
    with pytest.raises(InputError, match="undistort it"):
        replace(start, lenses=[Lens("EQUIRECTANGULAR", (1200.0, 600.0))])
    with pytest.raises(InputError, match="4 finite"):
        replace(start, lenses=[Lens("PINHOLE", (1.0, 2.0, np.nan, 0.0))])
    with pytest.raises(InputError, match="not positive"):
        replace(start, lenses=[Lens("PINHOLE", (1.0, -2.0, 0.0, 0.0))])
    for wrong in (
        {"loss_scale_px": 0.0},
        {"noise_px": np.inf},
        {"threads": -1},
        {"linear_solver": "lu"},
        {"first_damping": -1e-4},
    ):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))} must"):
            AdjustmentOptions(**wrong)
    with pytest.raises(TypeError, match="did you mean hold_rotations"):
        adjust(start, hold_rotation=True)


def test_the_answer_shows_itself():
    _, start = make_start()
    found = adjust(start, max_iterations=1)
    assert "12 frames" in repr(found)
    assert "max_iterations" in repr(found)
    assert found.summary()["num_observations"] == start.num_observations


@pytest.mark.parametrize("hold", [False, True])
def test_a_moved_and_scaled_world_gives_the_moved_and_scaled_answer(hold):
    _, start = make_start()
    options = replace(TIGHT, hold_rotations=hold)
    turn = look_at(np.array([[1.0, 2.0, 0.5]]), np.zeros((1, 3)))[0]

    def move(points):
        return 40.0 * points @ turn.T + [5e4, -2e4, 300.0]

    elsewhere = replace(
        start,
        rotations=start.rotations @ turn.T,
        centers=move(start.centers),
        points=move(start.points),
    )
    here, there = adjust(start, options), adjust(elsewhere, options)
    # Coordinates of 5e4 are exact to 7e-12, a minimum to the root of the cost's rounding, 1e-7 of the scene.
    np.testing.assert_allclose(there.problem.centers, move(here.problem.centers), atol=40.0 * 1e-6)
    assert there.cost == pytest.approx(here.cost, rel=1e-10)


def test_the_sparse_system_is_chosen_for_many_cameras_and_agrees_with_the_dense_one():
    _, start = make_start(num_cameras=520, num_points=150, share=0.03)
    options = AdjustmentOptions(max_iterations=1, noise_px=0.5)
    assert lay_out(start, options).num_unknowns > 3000
    auto = adjust(start, options).problem
    np.testing.assert_array_equal(
        auto.centers, adjust(start, options, linear_solver="sparse").problem.centers
    )
    dense = adjust(start, options, linear_solver="dense").problem
    np.testing.assert_allclose(auto.centers, dense.centers, atol=1e-9 * 8.0)
    assert not np.array_equal(auto.centers, dense.centers)  # rounding tells that two ways were gone


@pytest.mark.parametrize("threads", [1, 2])
def test_an_interrupt_ends_an_adjustment_after_the_slices_at_hand(threads):
    _, start = make_start(num_cameras=60, num_points=4000)
    endless = replace(TIGHT, threads=threads, max_iterations=10_000, loss_scale_px=0.01, cost_tolerance=0.0)
    adjust(start, endless, max_iterations=1)  # loads the kernels

    def adjust_forever():
        while True:
            adjust(start, endless)

    # The signal comes while kernels run without the GIL; Python hears of it between two of them.
    timer = threading.Timer(0.2, partial(signal.raise_signal, signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        adjust_forever()
    timer.join()
