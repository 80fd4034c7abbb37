"""Covariances of the frames against the inverse of the whole normal matrix, and against drawn noise."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.covariance import estimate_covariances
from sfm_shapefit.adjustment.gauge import free_similarities, small_similarities
from sfm_shapefit.adjustment.layout import lay_out
from sfm_shapefit.adjustment.problem import RotationPrior, isotropic_information
from sfm_shapefit.adjustment.solve import adjust, linearize_all, values_of
from sfm_shapefit.laplacian.operators import Workers
from sfm_shapefit.scene.known_positions import KnownPositions
from tests.adjustment.made import observed, ring_problem
from tests.adjustment.test_derivatives import whole_matrix

PLAIN = AdjustmentOptions(loss_scale_px=None, noise_px=0.5)


def expected_covariances(problem, options, num_free):
    """Covariances of the nodes from the whole matrix, the centers' similarity held by constraints."""
    layout = lay_out(problem, options)
    normal = linearize_all(problem, layout, values_of(problem), options, Workers(1))
    matrix = whole_matrix(layout, normal)
    size = len(matrix)
    motions = small_similarities(problem.rotations, problem.centers, problem.centers.mean(axis=0))
    motions = motions[:, :, np.isin(np.arange(7), {0: [], 4: [0, 1, 2, 6], 7: list(range(7))}[num_free])]
    motions[:, 3:] = 0.0
    held = np.zeros((layout.num_nodes, 6, motions.shape[2]))
    held[layout.node_of_frame[layout.node_of_frame >= 0]] = motions[layout.node_of_frame >= 0]
    constraints = np.zeros((size, num_free))
    constraints[: layout.num_unknowns] = held[layout.active]
    bordered = np.block([[matrix, constraints], [constraints.T, np.zeros((num_free, num_free))]])
    inverse = options.noise_px**2 * np.linalg.inv(bordered)[: layout.num_unknowns, : layout.num_unknowns]
    rows = np.cumsum(layout.active).reshape(layout.active.shape) - 1
    return layout, inverse, rows


@pytest.mark.parametrize("solver", ["dense", "sparse", "iterative"])
@pytest.mark.parametrize("case", ["free", "held", "weighted", "fixed", "lenses", "anchored"])
def test_covariances_are_blocks_of_the_inverse_of_the_whole_matrix(case, solver):
    models = ("OPENCV", "SIMPLE_RADIAL")
    problem = ring_problem(np.random.default_rng(0), 8, 60, models=models, share=0.8)
    options, num_free, n = replace(PLAIN, linear_solver=solver), 7, 8
    if case == "held":
        options, num_free = replace(options, hold_rotations=True), 4
    if case == "lenses":
        options = replace(options, free_focal_lengths=True, free_distortion=True)
    if case == "fixed":
        problem, num_free = replace(problem, fixed=np.arange(n) < 2), 0
    information = isotropic_information(np.full(n, 1e-3))
    if case == "weighted":
        prior = RotationPrior(rotations=problem.rotations, information=information)
        problem, num_free = replace(problem, rotation_prior=prior), 4
    if case == "anchored":
        prior = KnownPositions(np.arange(n), problem.centers, information)
        problem, num_free = replace(problem, center_prior=prior), 0
    found = estimate_covariances(problem, options)
    assert free_similarities(problem, options).shape[1] == num_free
    assert (found.lens_sigmas > 0.0).any() == (case == "lenses")
    layout, inverse, rows = expected_covariances(problem, options, num_free)
    for frame in range(n):
        node = layout.node_of_frame[frame]
        blocks = {"centers": slice(0, 3), "rotations": slice(3, 6)}
        for name, slots in blocks.items():
            block = getattr(found, name)[frame]
            if node < 0 or not layout.active[node, slots].all():
                np.testing.assert_array_equal(block, np.zeros((3, 3)))
                continue
            own = inverse[np.ix_(rows[node, slots], rows[node, slots])]
            np.testing.assert_allclose(block, own, atol=1e-6 * np.abs(own).max())
    for lens, value in np.argwhere(layout.lens_slots >= 0):
        row = rows[layout.node_of_lens[lens], layout.lens_slots[lens, value]]
        assert found.lens_sigmas[lens, value] == pytest.approx(np.sqrt(inverse[row, row]), rel=1e-5)


def test_drawn_noise_scatters_as_the_covariances_say():
    exact = ring_problem(np.random.default_rng(0), 6, 40, noise_px=0.0)
    rng = np.random.default_rng(1)
    centers, turns = [], []
    for _ in range(120):
        pixels = exact.pixels + PLAIN.noise_px * rng.standard_normal(exact.pixels.shape)
        found = adjust(replace(exact, pixels=pixels), PLAIN).problem
        centers.append(found.centers - exact.centers)
        turns.append(Rotation.from_matrix(found.rotations @ exact.rotations.transpose(0, 2, 1)).as_rotvec())
    expected = estimate_covariances(exact, PLAIN)
    # A variance of 120 draws is off by sqrt(2 / 120) = 13 %, the mean of 18 of them by 3 % and more,
    # for neighbors are correlated.
    for drawn, covariances in ((centers, expected.centers), (turns, expected.rotations)):
        ratios = np.var(np.array(drawn), axis=0) / np.einsum("naa->na", covariances)
        assert 0.88 < ratios.mean() < 1.12
        assert ratios.min() > 0.55
        assert ratios.max() < 1.6


def test_what_nothing_sees_is_not_a_number_and_moves_nothing_else():
    problem = ring_problem(np.random.default_rng(0), 8, 60)
    found = estimate_covariances(observed(problem, problem.cameras_seeing != 7), PLAIN)
    assert np.isnan(found.centers[7]).all()
    assert np.isnan(found.rotations[7]).all()
    assert np.isfinite(found.centers[:7]).all()


def test_points_of_one_view_say_nothing():
    problem = ring_problem(np.random.default_rng(0), 8, 60)
    k = problem.num_points
    extra = replace(
        problem,
        points=np.concatenate([problem.points, [[0.1, 0.2, 0.3]]]),
        cameras_seeing=np.append(problem.cameras_seeing, 2),
        points_seen=np.append(problem.points_seen, k),
        pixels=np.concatenate([problem.pixels, [[300.0, 200.0]]]),
    )
    np.testing.assert_allclose(
        estimate_covariances(extra, PLAIN).centers, estimate_covariances(problem, PLAIN).centers, rtol=1e-6
    )


@pytest.mark.parametrize("count", [0, 2])
def test_frames_that_nearly_nothing_holds_do_not_lend_their_errors_to_the_others(count):
    problem = ring_problem(np.random.default_rng(1), 12, 200, share=0.8)
    rows = np.arange(problem.num_observations)
    seen_by = [rows[problem.cameras_seeing == k] for k in range(count)]
    dropped = np.concatenate([rows[:0], *(own[4:] for own in seen_by)])
    few = observed(problem, np.setdiff1d(rows, dropped))
    without = observed(problem, np.setdiff1d(rows, np.concatenate([rows[:0], *seen_by])))
    found = estimate_covariances(few, PLAIN)
    assert found.deciding.tolist() == [k >= count for k in range(12)]
    sizes, alone = (
        np.sqrt(np.einsum("naa->n", estimate_covariances(one, PLAIN).centers)) for one in (few, without)
    )
    np.testing.assert_allclose(sizes[count:], alone[count:], rtol=0.05)
    assert (sizes[:count] > 5.0 * sizes[count:].max()).all()


def test_centers_relative_to_frames_that_are_told_are_known_relative_to_these():
    problem, deciding = ring_problem(np.random.default_rng(1), 12, 200, share=0.8), np.arange(12) < 4
    found = estimate_covariances(problem, PLAIN, deciding=deciding)
    np.testing.assert_array_equal(found.deciding, deciding)
    sizes = np.einsum("naa->n", found.centers)
    assert sizes[deciding].max() < sizes[~deciding].min()


def test_a_scene_far_from_its_origin_has_the_same_covariances_where_rotations_are_held():
    """The scale moves its frames by a million units, and one another by one: a ratio of squares of 1e-12."""
    problem, held = (
        ring_problem(np.random.default_rng(1), 12, 200, share=0.8),
        replace(PLAIN, hold_rotations=True),
    )
    shift = np.array([1e6, 0.0, 0.0])
    far = replace(problem, centers=problem.centers + shift, points=problem.points + shift)
    near, there = (estimate_covariances(one, held).centers for one in (problem, far))
    np.testing.assert_allclose(there, near, rtol=1e-2, atol=1e-3 * np.abs(near).max())
