"""The robust refinement in angles: as good as least squares on the right directions, exact on exact data."""

from types import SimpleNamespace

import numpy as np
import pytest

from sfm_shapefit import synthetic
from sfm_shapefit.base.geometry import median_spread, normalized, tangent_bases
from sfm_shapefit.base.losses import ARCTANGENT, GEMAN_MCCLURE
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.refinement import angular
from sfm_shapefit.refinement.angular import (
    KERNEL_WIDTH,
    AngularTerms,
    information_at,
    plan_refinement,
    refine_angles,
    residual_levels,
    robust_cost,
)
from sfm_shapefit.refinement.cg_normal_solver import IterativeNormal
from sfm_shapefit.refinement.consensus import fit_mixture, residual_angles
from sfm_shapefit.solver.program import differences
from sfm_shapefit.solver.splitting.linear import laplacian_factor
from tests.problems import CountedFactor, fit_angles, shape, shape_error


def graph_of(problem: synthetic.GraphProblem, rows=slice(None)) -> ViewGraph:
    return ViewGraph(len(problem.locations), problem.edges[rows], problem.directions[rows])


def refined(graph: ViewGraph, start, covariance=None):
    plan = plan_refinement(graph)
    assert plan is not None
    return refine_angles(MeasuredGraph(graph, covariance=covariance), start, plan)


def shaken(problem: synthetic.GraphProblem, share: float, seed: int = 0):
    """The truth, each location moved by a share of the extent."""
    noise = np.random.default_rng(seed).standard_normal(problem.locations.shape)
    return problem.locations + share * median_spread(problem.locations) * noise


def test_a_node_that_nothing_holds_goes_no_farther_than_leaves_the_others_their_shape():
    problem = synthetic.random_graph_problem(60, sigma=0.01, seed=1)
    graph, directions, start = problem.view_graph, problem.directions.copy(), problem.locations.copy()
    from_first = graph.edges[:, 0] == 0
    assert not (graph.edges[:, 1] == 0).any()
    directions[from_first] = (1.0, 0.0, 0.0)  # as if infinitely far away
    start[0] = start[0] + (1e13, 0.0, 0.0)
    graph = ViewGraph(graph.num_nodes, graph.edges, directions)
    found = refined(graph, start).locations
    assert np.linalg.norm(found[0] - found[1]) < 2e6 * median_spread(found)
    assert shape_error(found[1:], problem.locations[1:]) < 0.01


def isotropic(sigma: float, graph: ViewGraph):
    return np.tile(sigma**2 * np.eye(graph.dimension - 1), (graph.num_edges, 1, 1))


@pytest.mark.parametrize(
    "problem",
    [
        synthetic.random_graph_problem(60, sigma=0.03, q=0.2, seed=1),
        synthetic.box_graph_problem(200, 30.0, sigma=0.01, q=0.2, seed=2),
        synthetic.community_graph_problem(150, 40.0, sigma=0.03, q=0.2, seed=3),
    ],
    ids=["er2", "geo", "comm"],
)
def test_a_rough_start_ends_as_well_as_knowing_the_right_directions(problem):
    """The oracle has the right directions alone and starts at the truth."""
    graph, right = problem.view_graph, graph_of(problem, ~problem.corrupted)
    oracle = shape_error(refined(right, problem.locations).locations, problem.locations)
    found = refined(graph, shaken(problem, 0.05))
    assert shape_error(found.locations, problem.locations) <= 1.08 * oracle


def test_the_kernel_costs_little_where_nothing_is_wrong():
    problem = synthetic.random_graph_problem(40, 0.6, sigma=0.03, seed=4)
    least_squares = shape_error(
        fit_angles(problem.locations, problem.edges, problem.directions, 20), problem.locations
    )
    # Measured 1.04 over families; Geman-McClure of the same width takes 1.18.
    found = refined(problem.view_graph, problem.locations).locations
    assert shape_error(found, problem.locations) <= 1.08 * least_squares


@pytest.mark.parametrize("d", [2, 3, 5])
def test_exact_directions_with_wrong_ones_among_them_give_the_truth_in_every_dimension(d):
    problem = synthetic.random_graph_problem(30, 0.9, d=d, q=0.15, seed=d)
    graph = problem.view_graph
    found = refined(graph, shaken(problem, 0.02))
    assert shape_error(found.locations, problem.locations) < 1e-9
    assert found.levels_rad == pytest.approx(1e-4 / KERNEL_WIDTH)  # it does not fall to the rounding
    assert shape_error(refined(graph, problem.locations).locations, problem.locations) < 1e-11


@pytest.mark.parametrize("seed", range(5))
def test_the_cost_is_never_above_the_start_at_the_final_levels(seed):
    problem = synthetic.random_graph_problem(30, 0.4, sigma=0.1, q=0.5, seed=seed)
    graph = problem.view_graph
    start = np.random.default_rng(seed).standard_normal((30, 3))  # nothing fits
    for t in (start, problem.locations):
        found = refined(graph, t)
        assert found.cost <= robust_cost(MeasuredGraph(graph), t, found.levels_rad)
        assert found.cost == pytest.approx(
            robust_cost(MeasuredGraph(graph), found.locations, found.levels_rad), rel=1e-12
        )


@pytest.mark.parametrize("share", [0.0, 0.05, 1.0, 10.0])
def test_no_answer_fits_worse_than_its_start(share):
    problem = synthetic.random_graph_problem(20, 0.6, sigma=0.01, q=0.1, seed=3)
    graph, start = MeasuredGraph(problem.view_graph), shaken(problem, share)
    found = refined(problem.view_graph, start)
    assert found.cost <= robust_cost(graph, start, found.levels_rad)
    again = refined(problem.view_graph, found.locations)
    assert again.cost <= robust_cost(graph, found.locations, again.levels_rad)


@pytest.mark.parametrize("seed", range(3))
def test_a_camera_whose_pairs_are_all_wrong_neither_flies_nor_drags_others_along(seed):
    problem = synthetic.random_graph_problem(40, 0.6, sigma=0.005, seed=seed)
    v = problem.directions.copy()
    ends = np.flatnonzero((problem.edges == 7).any(axis=1))
    v[ends] = normalized(np.random.default_rng(seed).standard_normal((len(ends), 3)))
    found = refined(ViewGraph(40, problem.edges, v), problem.locations)
    moved = np.linalg.norm(shape(found.locations) - shape(problem.locations), axis=1)
    extent = median_spread(shape(problem.locations))
    assert moved[7] < 2.0 * extent  # within the scene, 2 to 3 extents wide; one that flies is at 10 to 1e6
    # The others are as good among themselves as without it: noise of 0.005, about 14 pairs each.
    assert shape_error(np.delete(found.locations, 7, 0), np.delete(problem.locations, 7, 0)) < 0.005


def test_a_camera_without_any_pull_is_held_where_it_was():
    """Rejected pairs weigh next to nothing; the damping alone must not let their camera go."""
    problem = synthetic.random_graph_problem(30, 0.8, seed=1)
    graph, start = problem.view_graph, shape(problem.locations)
    terms = AngularTerms(graph, information_at(MeasuredGraph(graph), np.array([1e-4])))
    far = start.copy()
    far[3] += [0.3, -0.2, 0.1]
    plan = plan_refinement(graph)
    assert plan is not None
    factor = angular.allocate_factor(plan, 3)
    moved = angular.take_angular_step(terms, factor, angular.unit_norm(far), angular.DAMPING.least)[0]
    assert np.linalg.norm(moved - angular.unit_norm(far), axis=1)[3] < 0.2


def test_cameras_at_one_place_do_no_harm():
    problem = synthetic.random_graph_problem(25, 0.8, sigma=0.005, seed=8)
    t = problem.locations.copy()
    t[4] = t[3]
    with np.errstate(invalid="ignore"):
        v = normalized(differences(t, problem.edges))
    v[~np.isfinite(v).all(axis=1)] = [0.0, 0.6, 0.8]
    found = refined(ViewGraph(25, problem.edges, v), t)
    assert np.isfinite(found.locations).all()
    assert shape_error(found.locations, t) < 1e-2  # the one random direction drives the two a little apart


@pytest.mark.parametrize("kind", [ARCTANGENT, GEMAN_MCCLURE])
def test_the_linearisation_is_that_of_the_cost_above_and_below_the_shortest_length(kind):
    problem = synthetic.random_graph_problem(12, 1.0, sigma=0.02, seed=6)
    t = shape(problem.locations)
    graph = problem.view_graph
    floor = 1e-3 * np.median(np.linalg.norm(differences(t, graph.edges), axis=1))
    t[1] = t[0] + 0.8 * floor * np.array([0.6, 0.0, 0.8])
    information = information_at(MeasuredGraph(graph), np.array([0.05]))
    terms = AngularTerms(graph, information, kind)
    cost, _, _, per_edge = terms.linearize(t)
    assert cost == terms.cost(t)
    gradient = angular.adjoint(per_edge, graph.edges, 12)
    h = 1e-9
    for camera, axis in [(0, 0), (1, 2), (5, 1)]:
        shift = np.zeros_like(t)
        shift[camera, axis] = h
        up, down = (terms.cost(t + s * shift) for s in (1.0, -1.0))
        # Differences of a cost of some hundreds have 1e-13 / 1e-9 of rounding.
        assert gradient[camera, axis] == pytest.approx((up - down) / (2.0 * h), rel=1e-3, abs=1e-2)


def test_an_unknown_covariance_leaves_the_level_alone_to_speak():
    problem = synthetic.random_graph_problem(25, 0.6, sigma=0.01, q=0.1, seed=3)
    graph = problem.view_graph
    unknown = np.full((graph.num_edges, 2, 2), np.nan)
    with_nan = refined(graph, problem.locations, unknown)
    without = refined(graph, problem.locations)
    np.testing.assert_allclose(with_nan.locations, without.locations, atol=1e-12)
    partly = isotropic(0.01, graph)
    partly[0, 0, 1] = np.nan
    assert np.isfinite(refined(graph, problem.locations, partly).locations).all()


def test_the_metric_is_the_inverse_of_covariance_and_level():
    problem = synthetic.random_graph_problem(5, 1.0, seed=1)
    graph = problem.view_graph
    a = np.random.default_rng(0).standard_normal((graph.num_edges, 2, 2))
    covariance = a @ a.transpose(0, 2, 1)
    information = information_at(MeasuredGraph(graph, covariance=covariance), np.array([0.3]))
    bases = tangent_bases(graph.directions)
    inside = bases.transpose(0, 2, 1) @ information @ bases
    np.testing.assert_allclose(
        inside @ (covariance + 0.09 * np.eye(2)), np.tile(np.eye(2), (10, 1, 1)), atol=1e-9
    )
    along = np.einsum("ea,eab,eb->e", graph.directions, information, graph.directions)
    np.testing.assert_allclose(along, np.trace(inside, axis1=1, axis2=2) / 2.0)


def test_threads_that_share_the_pairs_change_no_bit():
    """The graph has more pairs than two slices."""
    problem = synthetic.random_graph_problem(190, 1.0, sigma=0.01, q=0.2, seed=2)
    graph = problem.view_graph
    measured, plan = MeasuredGraph(graph, covariance=isotropic(0.01, graph)), plan_refinement(graph)
    found = [refine_angles(measured, problem.locations, plan, threads=threads) for threads in (1, 2, 7)]
    fitted = [fit_mixture(measured, problem.locations, threads) for threads in (1, 2, 7)]
    for threads in (1, 2):
        np.testing.assert_array_equal(found[threads].locations, found[0].locations)
        np.testing.assert_array_equal(fitted[threads].posterior, fitted[0].posterior)


def test_shares_and_levels_of_a_mixture_are_those_of_its_own_posteriors():
    """They are so where expectation maximization ends, as closely as it ends; pairs have own variances."""
    problem = synthetic.random_graph_problem(60, 0.6, sigma=0.02, q=0.3, seed=4)
    graph = problem.view_graph
    own = np.random.default_rng(0).uniform(0.5, 1.0, graph.num_edges) * 0.01**2
    mixture = fit_mixture(MeasuredGraph(graph, covariance=own[:, None, None] * np.eye(2)), problem.locations)
    right, squares = mixture.posterior, residual_angles(graph, problem.locations) ** 2
    assert mixture.shares[0] == pytest.approx(right.mean(), rel=1e-3)
    assert mixture.shares[0] == pytest.approx(1.0 - problem.corrupted.mean(), abs=0.03)
    wanted = np.sum(right * squares / 2.0 / mixture.variances**2)
    assert wanted == pytest.approx(np.sum(right / mixture.variances), rel=1e-3)
    np.testing.assert_allclose(mixture.variances - own, mixture.variances[0] - own[0], rtol=1e-9)


def test_a_mixture_finds_the_right_pairs_whatever_the_dimension():
    """The density of right directions in 400 dimensions is beyond the largest number, or below the least."""
    problem = synthetic.random_graph_problem(20, 1.0, 400, sigma=0.001, q=0.2, seed=0)
    mixture = fit_mixture(MeasuredGraph(problem.view_graph), problem.locations)
    assert mixture.shares[0] == pytest.approx(1.0 - problem.corrupted.mean(), abs=1e-3)


def test_each_class_finds_its_own_level_and_keeps_it_while_it_is_not_fitted():
    rng = np.random.default_rng(0)
    problem = synthetic.random_graph_problem(60, 0.8, seed=1)
    classes = np.arange(len(problem.edges)) % 2
    sigma = np.where(classes == 0, 0.01, 0.001)
    noise = rng.standard_normal(problem.directions.shape)
    v = normalized(problem.directions + sigma[:, None] * noise)
    graph = ViewGraph(60, problem.edges, v)
    measured = SimpleNamespace(graph=graph, covariance=None, classes=classes)
    found = refine_angles(measured, problem.locations, plan_refinement(graph))
    # The median of 700 residuals scatters by 4 %; the share that the fit takes is even over classes only
    # roughly, as the sharp class does most of the fitting.
    assert found.levels_rad == pytest.approx([0.01, 0.001], rel=0.15)
    together = shape_error(refined(graph, problem.locations).locations, problem.locations)
    assert shape_error(found.locations, problem.locations) < 0.9 * together
    levels = opening = np.array([0.1, 0.1])
    for _ in range(3):
        levels = residual_levels(measured, found.locations, levels)
    np.testing.assert_array_equal(residual_levels(measured, found.locations, opening, 3), levels)
    nowhere = rng.standard_normal((60, 3))
    assert residual_levels(MeasuredGraph(graph), nowhere, np.array([0.01])) == pytest.approx(0.01)


def test_a_factor_that_is_too_large_is_not_planned():
    graph = graph_of(synthetic.random_graph_problem(20, 0.8, seed=1))
    assert plan_refinement(graph) is not None
    assert plan_refinement(graph, max_bytes=10) is None
    dear = synthetic.random_graph_problem(200, 0.5, d=20, seed=1).view_graph  # of 1e10 operations and more
    assert isinstance(plan_refinement(dear), IterativeNormal)


def test_without_the_factor_of_the_blocks_the_answer_is_the_same_but_for_a_share_of_the_noise():
    problem = synthetic.box_graph_problem(200, 30.0, sigma=0.01, q=0.4, seed=2)
    graph, start = problem.view_graph, shaken(problem, 0.05)
    by_factor = refined(graph, start).locations
    iterative = refine_angles(MeasuredGraph(graph), start, IterativeNormal(graph, laplacian_factor(graph)))
    assert shape_error(iterative.locations, by_factor) < 0.05 * shape_error(by_factor, problem.locations)
    assert iterative.iterations < 25


def test_a_scalar_factor_serves_until_the_weights_have_changed():
    graph = graph_of(synthetic.random_graph_problem(20, 0.8, seed=1))
    factor = CountedFactor(graph)
    normal, blocks = IterativeNormal(graph, factor), np.tile(np.eye(3), (graph.num_edges, 1, 1))
    for scales in (1.0, 7.0, np.linspace(1.0, 1.1, graph.num_edges)):
        normal.refactor(blocks * np.reshape(scales, (-1, 1, 1)))
        assert factor.refactored == 1
    normal.refactor(blocks * np.linspace(0.1, 2.0, graph.num_edges)[:, None, None])
    assert factor.refactored == 2


def test_the_answer_is_a_stationary_point_of_the_robust_cost():
    problem = synthetic.random_graph_problem(20, 0.9, sigma=0.02, q=0.15, seed=5)
    graph, measured = problem.view_graph, MeasuredGraph(problem.view_graph)
    found = refined(graph, shaken(problem, 0.05))
    scale = np.abs(found.locations).max()

    def slope(t, direction):
        up, down = (robust_cost(measured, t + h * direction, found.levels_rad) for h in (1e-5, -1e-5))
        return (up - down) / 2e-5

    rng = np.random.default_rng(0)
    for _ in range(5):
        direction = rng.standard_normal(found.locations.shape)
        direction *= scale / np.linalg.norm(direction)
        elsewhere = found.locations + 0.01 * rng.standard_normal((20, 3)) * scale
        # It ends where a step lowers the cost by no more than 3e-5 of itself.
        assert abs(slope(found.locations, direction)) < 0.02 * found.cost
        assert abs(slope(elsewhere, direction)) > 0.2 * found.cost


def test_a_direction_counts_in_its_own_metric():
    """Errors are 0.05 along one axis and 1e-3 along the other: only the metric knows which."""
    problem = synthetic.random_graph_problem(40, 0.5, seed=6)
    rng = np.random.default_rng(6)
    bases = tangent_bases(problem.directions)
    axis = np.array([0.05, 1e-3])
    angle = rng.uniform(0.0, np.pi, len(problem.edges))
    turn = np.stack(
        [np.stack([np.cos(angle), -np.sin(angle)], 1), np.stack([np.sin(angle), np.cos(angle)], 1)], 1
    )
    off = turn @ (axis * rng.standard_normal((len(angle), 2)))[:, :, None]
    graph = ViewGraph(40, problem.edges, normalized(problem.directions + (bases @ off)[:, :, 0]))
    # The bases of the measured directions are turned by the error only: the same covariance holds in them.
    covariance = turn @ np.diag(axis**2) @ turn.transpose(0, 2, 1)
    start = shaken(problem, 0.02)
    known, unknown = refined(graph, start, covariance), refined(graph, start)
    truth = problem.locations
    assert shape_error(known.locations, truth) < 0.8 * shape_error(unknown.locations, truth)


def test_origin_and_scale_of_the_start_do_not_matter_and_another_out_of_reach_ends_it_early():
    problem = synthetic.random_graph_problem(40, 0.5, sigma=0.02, q=0.2, seed=2)
    graph, plan, start = problem.view_graph, plan_refinement(problem.view_graph), shaken(problem, 0.05)
    assert plan is not None
    plain = refined(graph, start)
    moved = refined(graph, 1e4 * start + [300.0, -20.0, 7.0])
    np.testing.assert_allclose(moved.locations, plain.locations, atol=1e-7)
    assert np.linalg.norm(plain.locations) == pytest.approx(1.0)
    np.testing.assert_allclose(plain.locations.mean(axis=0), 0.0, atol=1e-15)
    best = refined(graph, problem.locations)
    again = refine_angles(MeasuredGraph(graph), start, plan, other=best.locations)
    assert again.iterations <= plain.iterations
    far = shaken(problem, 3.0)
    hopeless = refine_angles(MeasuredGraph(graph), far, plan, other=best.locations)
    assert hopeless.iterations < refined(graph, far).iterations


def test_an_edge_of_weight_two_counts_as_two():
    problem = synthetic.random_graph_problem(25, 0.5, sigma=0.02, seed=12)
    graph = problem.view_graph
    weights = np.where(np.arange(graph.num_edges) % 3 == 0, 2.0, 1.0)
    heavy = ViewGraph(25, graph.edges, graph.directions, weights)
    levels = np.array([0.01])
    single = [
        robust_cost(MeasuredGraph(graph.subset(keep)), problem.locations, levels)
        for keep in (weights == 2.0, weights == 1.0)
    ]
    total = robust_cost(MeasuredGraph(heavy), problem.locations, levels)
    assert total == pytest.approx(2.0 * single[0] + single[1])
