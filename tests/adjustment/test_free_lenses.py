"""Lenses in doubt: what was given pulls by its weight, and what the points do not tell is not believed."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.covariance import estimate_covariances, focal_shares
from sfm_shapefit.adjustment.freedom import Freedom
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.adjustment.solve import adjust, reprojection_errors_px
from sfm_shapefit.scene.lens import Lens
from sfm_shapefit.scene.wide_lenses import see
from tests.adjustment.made import disturb, look_at, ring_problem
from tests.structures import in_doubt

OPTIONS = AdjustmentOptions(loss_scale_px=2.0, cost_tolerance=1e-9)
TRUE_PX = 500.0


def doubted(problem, given_px, sigma, *, distortion=False):
    """All lenses of a problem in doubt, as given with another focal length, and the problem started there."""
    model, (_, *others) = problem.lenses[0].model, problem.lenses[0].parameters
    given = in_doubt(Lens(model, (given_px, *others)), sigma)
    free = Freedom(parts=np.array([True, distortion]))
    return free, free.apply(replace(problem, lenses=[given]), None)


def solve(free, problem):
    """The adjusted lens and the standard deviation of its focal length."""
    found = adjust(problem, OPTIONS, **free.overrides()).problem
    known = estimate_covariances(found, OPTIONS, **free.overrides())
    return found.lenses[0], focal_shares(found, known)[0]


def facing_a_wall(rng):
    """Cameras that look straight at a wall, side by side: any focal length fits, at its own distance."""
    problem = ring_problem(rng, 8, 200, share=1.0)
    centers = np.column_stack([np.linspace(-0.5, 0.5, 8), np.full(8, -4.0), 0.2 * (np.arange(8) % 2)])
    points = problem.points * [1.0, 0.0, 1.0]
    rotations = look_at(centers, centers + np.array([0.0, 1.0, 0.0]))
    cameras, seen = problem.cameras_seeing, problem.points_seen
    x = np.einsum("mab,mb->ma", rotations[cameras], points[seen] - centers[cameras])
    pixels = TRUE_PX * x[:, :2] / x[:, 2:] + [320.0, 240.0] + 0.3 * rng.standard_normal((len(x), 2))
    return replace(problem, centers=centers, points=points, rotations=rotations, pixels=pixels)


def test_a_weak_prior_gives_way_and_a_strong_one_holds():
    rng = np.random.default_rng(0)
    start = disturb(ring_problem(rng, noise_px=0.3), rng, 0.01, 0.002, 0.01)
    for sigma, low, high in ((0.3, 498.5, 501.5), (1e-7, 574.9, 575.1)):
        lens, _ = solve(*doubted(start, 575.0, sigma))
        assert low < lens.parameters[0] < high
    # Between: the pull of what was given balances that of the pixels.
    _, known = solve(*doubted(start, TRUE_PX, 10.0))
    lens, _ = solve(*doubted(start, 510.0, known * TRUE_PX / 510.0))
    assert lens.parameters[0] == pytest.approx(505.0, abs=3.0)


def test_errors_of_focal_lengths_are_as_large_as_their_standard_deviations():
    errors = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        problem = ring_problem(rng, 8, 60, noise_px=OPTIONS.noise_px)
        lens, sigma = solve(*doubted(problem, TRUE_PX, 0.3))
        errors.append((lens.parameters[0] / TRUE_PX - 1.0) / sigma)
    assert 0.6 < np.sqrt(np.mean(np.square(errors))) < 1.5


def test_what_the_points_do_not_tell_is_not_accepted():
    rng = np.random.default_rng(0)
    for problem, is_known in ((facing_a_wall(rng), False), (ring_problem(rng, noise_px=0.3), True)):
        free, start = doubted(problem, 510.0, 0.3)
        lens, sigma = solve(free, start)
        assert lens.is_credible(sigma) == is_known
    given = in_doubt(Lens("SIMPLE_RADIAL", (500.0, 320.0, 240.0, 0.0)))
    for focal_px, k1, sigma, is_taken in (
        (700.0, -0.3, 0.001, True),
        (700.0, -3.0, 0.001, False),
        (5000.0, 0.0, 0.001, False),
        (500.0, 0.0, np.inf, False),
    ):
        assert replace(given, parameters=(focal_px, 320.0, 240.0, k1)).is_credible(sigma) == is_taken
    # What was calibrated stays if the noise alone makes an error of its size, and goes if it cannot be right.
    calibrated = in_doubt(Lens("SIMPLE_PINHOLE", (500.0, 320.0, 240.0)), 0.01, 0.01)
    for focal_px, sigma, is_taken in ((517.0, 0.005, False), (560.0, 0.005, True), (503.0, 0.001, True)):
        assert replace(calibrated, parameters=(focal_px, 320.0, 240.0)).is_credible(sigma) == is_taken


def test_lenses_without_a_doubt_stay_to_the_bit_and_distortion_only_if_asked():
    rng = np.random.default_rng(0)
    problem = ring_problem(rng, models=("SIMPLE_RADIAL", "SIMPLE_RADIAL"), noise_px=0.3)
    given = in_doubt(Lens("SIMPLE_RADIAL", (520.0, 320.0, 240.0, 0.0)))
    start = replace(problem, lenses=[given, problem.lenses[1]])
    first = np.array([True, False])
    for distortion in (False, True):
        free = Freedom(parts=np.outer(first, [True, distortion]))
        found = adjust(free.apply(start, None), OPTIONS, **free.overrides()).problem.lenses
        assert found[1].parameters == problem.lenses[1].parameters
        assert (found[0].parameters[3] != 0.0) == distortion
        assert abs(found[0].parameters[0] - TRUE_PX) < 2.0
    assert Freedom().apply(start, None) is start
    lenses = start.lenses
    held = free.holding(first, lenses)
    assert held.parts.tolist() == [[False, True], [False, False]]
    none = {"free_focal_lengths": False, "free_distortion": False}
    assert held.holding(first, lenses).overrides() == none
    assert Freedom(parts=np.outer(first, [True, False])).holding(first, lenses).overrides() == none
    flat = [in_doubt(Lens("SIMPLE_PINHOLE", (520.0, 320.0, 240.0))), lenses[1]]
    assert free.holding(first, flat).overrides() == none


def test_a_lens_whose_focal_length_alone_is_free_does_not_bend_with_another():
    rng = np.random.default_rng(0)
    start = ring_problem(rng, models=("SIMPLE_RADIAL", "SIMPLE_RADIAL"), noise_px=0.3)
    start = replace(start, lenses=[in_doubt(lens) for lens in start.lenses])
    free = Freedom(parts=np.array([[True, False], [True, True]]))
    bends = [lens.parameters[3] for lens in start.lenses]
    found = adjust(free.apply(start, None), OPTIONS, **free.overrides()).problem.lenses
    assert [lens.parameters[3] != bend for lens, bend in zip(found, bends, strict=True)] == [False, True]


def test_a_straight_drive_tells_the_distortion_but_not_the_focal_length():
    # A focal length and a street a times as long, and k1 a^2 times as large, make the same pixels.
    rng, true_k1 = np.random.default_rng(0), -0.1
    centers = np.column_stack([np.zeros(10), np.zeros(10), 1.5 * np.arange(10)])
    points = rng.uniform([-6.0, -3.0, 4.0], [6.0, 2.0, 40.0], (500, 3))
    cameras, seen = (index.ravel() for index in np.indices((10, 500)))
    x = points[seen] - centers[cameras]
    u = x[:, :2] / x[:, 2:]
    kept = (x[:, 2] > 1.0) & (np.abs(u) < [0.64, 0.48]).all(axis=1)
    bent = u * (1.0 + true_k1 * np.sum(u**2, axis=1, keepdims=True))
    pixels = TRUE_PX * bent + [320.0, 240.0] + 0.3 * rng.standard_normal(u.shape)
    problem = AdjustmentProblem(
        rotations=np.tile(np.eye(3), (10, 1, 1)),
        centers=centers,
        points=points,
        cameras_seeing=cameras[kept],
        points_seen=seen[kept],
        pixels=pixels[kept],
        lenses=[Lens("SIMPLE_RADIAL", (TRUE_PX, 320.0, 240.0, 0.0))],
        lens_of_camera=np.zeros(10, np.int64),
    )
    given_px = 510.0
    free, start = doubted(problem, given_px, 0.3, distortion=True)
    lens, sigma = solve(free, start)
    assert not lens.is_credible(sigma)
    held = free.holding(np.ones(1, bool), start.lenses)
    options = replace(OPTIONS, **held.overrides())
    found = adjust(held.apply(replace(start, lenses=[start.lenses[0].as_given()]), None), options).problem
    focal_px, _, _, k1 = found.lenses[0].parameters
    assert focal_px == given_px
    known = estimate_covariances(found, options)
    assert focal_shares(found, known)[0] == 0.0
    sigma_k1 = known.lens_sigmas[0, 4]
    assert 0.0 < sigma_k1 < 0.1 * abs(true_k1)
    assert k1 == pytest.approx(true_k1 * (given_px / TRUE_PX) ** 2, abs=4.0 * sigma_k1)


def test_a_fisheye_is_adjusted_by_what_it_sees_behind_itself():
    rng = np.random.default_rng(3)
    lens = Lens("OPENCV_FISHEYE", (300.0, 310.0, 500.0, 500.0, 0.02, -0.01, 0.002, 0.0))
    directions = rng.standard_normal((300, 3))
    points = 5.0 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    centers = 1.5 * rng.standard_normal((8, 3))
    rotations = Rotation.random(8, random_state=3).as_matrix()
    inside = (points[None] - centers[:, None]) @ rotations.transpose(0, 2, 1)
    is_seen = inside[:, :, 2] > np.cos(np.radians(115.0)) * np.linalg.norm(inside, axis=2)
    cameras, seen = np.nonzero(is_seen)
    assert (inside[cameras, seen, 2] < 0.0).mean() > 0.2
    pixels = np.array([see(lens.row(), *ray)[:2] for ray in inside[cameras, seen]])
    truth = AdjustmentProblem(
        rotations=rotations,
        centers=centers,
        points=points,
        cameras_seeing=cameras,
        points_seen=seen,
        pixels=pixels,
        lenses=(lens,),
        lens_of_camera=np.zeros(8, np.int64),
    )
    start = replace(disturb(truth, rng), lenses=(lens.longer(1.1),))
    done = adjust(start, free_focal_lengths=True, free_distortion=True, gradient_tolerance=1e-9)
    assert np.max(reprojection_errors_px(done.problem)) < 1e-4  # NaN, behind a camera, is no error of less
    np.testing.assert_allclose(done.problem.lenses[0].parameters, lens.parameters, rtol=1e-6, atol=1e-6)
