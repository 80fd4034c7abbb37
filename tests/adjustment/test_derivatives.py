"""Gradients and Jacobians of the adjustment against central differences, for every block and lens model."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.layout import SLOTS, lay_out
from sfm_shapefit.adjustment.lone_points import settle_points
from sfm_shapefit.adjustment.priors import sum_priors
from sfm_shapefit.adjustment.problem import LensPrior, RotationPrior, isotropic_information
from sfm_shapefit.adjustment.residuals import linearize, reprojection_residuals
from sfm_shapefit.adjustment.solve import linearize_all, move, values_of
from sfm_shapefit.laplacian.operators import Workers
from sfm_shapefit.scene.known_positions import KnownPositions
from tests.adjustment.made import LENSES, disturb, observed, ring_problem

STEP = 1e-5  # central differences are off by its square times third derivatives, 1e-9 of the first ones here
ALL_FREE = AdjustmentOptions(loss_scale_px=2.0, free_focal_lengths=True, free_distortion=True)
ONE = Workers(1)


def small_problem(model, *, sensors=2, seed=0):
    """A problem far from its minimum, so that no derivative vanishes."""
    rng = np.random.default_rng(seed)
    return disturb(ring_problem(rng, 3, 8, models=(model,), sensors=sensors, share=0.8), rng)


def with_priors(problem, rng):
    n = problem.num_frames
    turns = Rotation.from_rotvec(0.3 * rng.standard_normal((n, 3))).as_matrix()
    roots = rng.standard_normal((2, n, 3, 3))
    information = 1e3 * roots @ roots.transpose(0, 1, 3, 2)
    return replace(
        problem,
        rotation_prior=RotationPrior(rotations=turns @ problem.rotations, information=information[0]),
        center_prior=KnownPositions(
            np.arange(n), problem.centers + 0.1 * rng.standard_normal((n, 3)), information[1]
        ),
        lens_prior=LensPrior(
            values=np.array([1.1 * lens.values() for lens in problem.lenses]),
            information=rng.uniform(
                0.0, [100.0, 100.0, 1.0, 1.0, 1e6, 1e6, 1e6, 1e6], (len(problem.lenses), 8)
            ),
        ),
    )


def steps_of(layout, k, size):
    """The steps of nodes and points that move unknown k alone."""
    nodes, points = np.zeros((layout.num_nodes, SLOTS)), np.zeros((layout.num_points, 3))
    if k < layout.num_unknowns:
        node, slot = np.argwhere(layout.active)[k]
        nodes[node, slot] = size
    else:
        points.ravel()[k - layout.num_unknowns] = size
    return nodes, points


def differences(layout, values, function):
    """Central differences of a function of the values by every unknown, nodes first."""
    columns = []
    for k in range(layout.num_unknowns + 3 * layout.num_points):
        ends = [function(move(layout, values, *steps_of(layout, k, sign * STEP))) for sign in (1.0, -1.0)]
        columns.append((ends[0] - ends[1]) / (2.0 * STEP))
    return np.array(columns)


def whole_matrix(layout, normal):
    """The whole normal matrix of all unknowns, nodes first."""
    n, k = layout.num_nodes, layout.num_points
    nodes = np.zeros((n, SLOTS, n, SLOTS))
    nodes[np.arange(n), :, np.arange(n), :] = normal.nodes
    for (i, j), block in zip(layout.links, normal.links, strict=True):
        nodes[i, :, j, :] += block
        nodes[j, :, i, :] += block.T
    cross, points = np.zeros((n, SLOTS, k, 3)), np.zeros((k, 3, k, 3))
    cross[layout.entry_node, :, layout.entry_point, :] = normal.entries.transpose(0, 2, 1)
    packed = normal.points[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    points[np.arange(k), :, np.arange(k), :] = packed
    taken = layout.active.ravel()
    a = nodes.reshape(n * SLOTS, n * SLOTS)[np.ix_(taken, taken)]
    w = cross.reshape(n * SLOTS, 3 * k)[taken]
    return np.block([[a, w], [w.T, points.reshape(3 * k, 3 * k)]])


def assert_normal_matrix_is_that_of_differences(problem):
    layout, values = lay_out(problem, ALL_FREE), values_of(problem)
    jacobian = differences(layout, values, lambda v: reprojection_residuals(problem, v).ravel())
    expected = jacobian @ jacobian.T
    found = whole_matrix(layout, linearize(layout, values, None, ONE))
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=1e-7)


@pytest.mark.parametrize("model", LENSES)
def test_the_normal_matrix_is_that_of_differences_of_the_residuals(model):
    assert_normal_matrix_is_that_of_differences(small_problem(model))


@pytest.mark.parametrize("free", [[-1, 0], [0, 1]])
def test_the_normal_matrix_of_free_sensors_is_that_of_differences(free):
    problem = small_problem("OPENCV")
    problem = replace(problem, rig=replace(problem.rig, free_sensor_of_camera=np.tile(free, 3)))
    layout = lay_out(problem, ALL_FREE)
    # The first sensor's offset tells the scale; where it is free too, the longest keeps its length.
    assert (layout.scale_sensor >= 0) == (min(free) == 0)
    assert layout.num_unknowns == 3 * 6 + 6 + sum(6 for k in free if k >= 0) - (layout.scale_sensor >= 0)
    assert_normal_matrix_is_that_of_differences(problem)


@pytest.mark.parametrize("scale", [None, 2.0])
@pytest.mark.parametrize("model", LENSES)
def test_the_gradient_is_that_of_differences_of_the_cost(model, scale):
    problem = with_priors(small_problem(model), np.random.default_rng(1))
    options = replace(ALL_FREE, loss_scale_px=scale)
    layout, values = lay_out(problem, options), values_of(problem)

    def cost(at):
        return settle_points(layout, at, scale, ONE, 0)[1] + sum_priors(problem, at, options.noise_px)

    expected = differences(layout, values, cost)
    normal = linearize_all(problem, layout, values, options, ONE)
    found = np.concatenate([normal.node_gradients[layout.active], normal.point_gradients.ravel()])
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


def test_the_curvature_of_the_loss_is_exact_where_it_bends_up():
    # Along a residual of square s = c^2 u the loss has second derivative w (1 - u) / (1 + u), across it w.
    problem = small_problem("PINHOLE", sensors=0)
    layout, values = lay_out(problem, ALL_FREE), values_of(problem)
    scale = 10.0 * float(np.abs(reprojection_residuals(problem, values)).max())
    residuals = reprojection_residuals(problem, values)
    squares = np.sum(residuals**2, axis=1)
    w = 1.0 / (1.0 + squares / scale**2)
    along = w**2 * (1.0 - squares / scale**2)
    jacobian = differences(layout, values, lambda v: reprojection_residuals(problem, v).ravel())
    j = jacobian.reshape(len(jacobian), -1, 2)
    unit = residuals / np.sqrt(squares)[:, None]
    weights = w[:, None, None] * np.eye(2) + (along - w)[:, None, None] * unit[:, :, None] * unit[:, None, :]
    expected = np.einsum("koa,oab,lob->kl", j, weights, j)
    found = whole_matrix(layout, linearize(layout, values, scale, ONE, 0.1))
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / size, expected / size, atol=1e-7)


def test_a_point_behind_its_camera_adds_nothing_and_counts_as_a_focal_length():
    problem = small_problem("SIMPLE_RADIAL", sensors=0)
    behind = replace(problem, points=problem.points.copy())
    away = 2.0 * problem.centers[0]  # behind camera 0, which looks at the origin, in front of others
    behind.points[0] = away
    layout, values = lay_out(behind, ALL_FREE), values_of(behind)
    residuals = reprojection_residuals(behind, values)
    lost = np.isnan(residuals[:, 0])
    assert (lost == ((behind.cameras_seeing == 0) & (behind.points_seen == 0))).all()
    squares = np.where(lost, 500.0**2, np.sum(residuals**2, axis=1))
    assert settle_points(layout, values, 2.0, ONE, 0)[1] == pytest.approx(
        0.5 * 4.0 * np.log1p(squares / 4.0).sum()
    )
    without = linearize(lay_out(observed(behind, ~lost), ALL_FREE), values, 2.0, ONE)
    found = linearize(layout, values, 2.0, ONE)
    np.testing.assert_array_equal(found.points, without.points)
    np.testing.assert_allclose(found.nodes, without.nodes, rtol=1e-14)


def test_isotropic_information_of_an_infinite_sigma_is_none():
    found = isotropic_information(np.array([0.5, np.inf]))
    np.testing.assert_array_equal(found, [4.0 * np.eye(3), np.zeros((3, 3))])
