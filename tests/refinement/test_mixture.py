"""A mixture of noise levels: streets, folds, loose cameras, exact data, and what is placed as usual."""

import numpy as np
import pytest

from sfm_shapefit import synthetic
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import fit_similarity_l1, normalized
from sfm_shapefit.commands.place import place
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.factor import analyze, factorize
from sfm_shapefit.refinement.length_prior import LengthPrior
from sfm_shapefit.refinement.mixture import Mixture
from tests.graph_families import random_blocks
from tests.problems import no_mixture, shape_error


def corrupted(q=0.7, d=3, n=60, **noise):
    return synthetic.random_graph_problem(n, 0.5, d=d, q=q, seed=2, **noise)


def street(seed, wrong=0.3, n=120, reach=8):
    """A winding street: graph, truth, wrong pairs and sigmas, which differ by a factor of six."""
    rng = np.random.default_rng(seed)
    heading = 0.4 * np.sin(np.arange(n) / 25)
    course = np.stack([np.cos(heading), np.sin(heading), np.zeros(n)], axis=1)
    truth = np.cumsum(course * rng.uniform(0.7, 1.3, (n, 1)), axis=0) + 0.15 * rng.normal(size=(n, 3))
    edges = np.array([(i, j) for i in range(n) for j in range(i + 1, min(i + reach + 1, n))])
    sigma = 0.01 * np.exp(0.9 * rng.normal(size=len(edges)))
    v = truth[edges[:, 0]] - truth[edges[:, 1]]
    v = normalized(normalized(v) + sigma[:, None] * rng.normal(size=v.shape))
    is_wrong = rng.random(len(edges)) < wrong
    v[is_wrong] = normalized(rng.normal(size=(is_wrong.sum(), 3)))
    return ViewGraph(n, edges, v), truth, is_wrong, sigma


def four_sides(seed, n=120, reach=14, mistaken=0.3):
    """A ring round a building of four equal sides: graph, truth and wrong pairs.

    The first image of a wrong pair is another: one that sees the next side, or the last, in the same way.
    """
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * (np.arange(n) + rng.uniform(-0.4, 0.4, n)) / n
    radius = 1 + 0.05 * rng.normal(size=n)
    truth = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.05 * rng.normal(size=n)], axis=1)
    edges = np.array([(i, (i + k) % n) for i in range(n) for k in range(1, reach + 1)])
    v = normalized(truth[edges[:, 0]] - truth[edges[:, 1]])
    is_wrong = rng.random(len(edges)) < mistaken
    side = rng.choice([-1, 1], len(edges))
    other = (edges[:, 0] + side * n // 4) % n
    x, y, z = truth[other].T
    turned_back = np.stack([side * y, -side * x, z], axis=1)  # by a quarter turn
    v[is_wrong] = normalized(turned_back - truth[edges[:, 1]])[is_wrong]
    edges[is_wrong, 0] = other[is_wrong]
    first = np.unique(np.sort(edges, axis=1), axis=0, return_index=True)[1]
    v = normalized(v + 0.004 * rng.normal(size=v.shape))
    return ViewGraph(n, edges[first], v[first]), truth, is_wrong[first]


@pytest.fixture(scope="module")
def on_street():
    """A street and what the mixture makes of it."""
    made = street(0)
    return *made, place(made[0])


@pytest.mark.parametrize(("d", "q"), [(3, 0.6), (3, 0.7), (3, 0.8), (2, 0.4)])
def test_exact_directions_are_recovered_exactly_and_told_from_wrong_ones(d, q):
    problem = corrupted(q, d, n=100 if q == 0.8 else 60)
    found = place(problem.view_graph)
    assert shape_error(found.locations, problem.locations) < 1e-9
    np.testing.assert_array_equal(found.refined.posterior > 0.5, ~problem.corrupted)
    np.testing.assert_array_equal(found.agreement.agrees, ~problem.corrupted)
    assert "by a mixture of noise levels" in found.refined.finish.reason


def test_an_end_that_explains_no_pair_does_not_lead():
    problem = synthetic.random_graph_problem(60, 0.5, q=0.82, seed=8)  # its usual start ends so
    found = place(problem.view_graph)
    assert shape_error(found.locations, problem.locations) < 1e-9
    assert found.refined.finish.start == "reweighted ShapeFit"


def test_a_street_of_uneven_noise_is_placed_about_as_well_as_by_its_right_pairs_alone():
    errors = []
    for seed in range(4):
        graph, truth, is_wrong, _ = street(seed)
        with no_mixture():
            usual = place(graph)
        answers = (place(graph), place(graph.subset(~is_wrong)), usual)
        errors.append([shape_error(found.locations, truth[found.cameras]) for found in answers])
    own, right_alone, usual = np.median(errors, axis=0)
    assert own <= 1.1 * right_alone
    assert own < 0.3 * usual


@pytest.mark.parametrize("seed", [0, 1])
def test_four_equal_sides_are_folded_by_the_usual_way_and_not_by_evidence(seed):
    graph, truth, is_wrong = four_sides(seed)
    found = place(graph)
    with no_mixture():
        assert shape_error(place(graph).locations, truth) > 0.5
    assert shape_error(found.locations, truth) < 0.01
    assert np.mean(found.agreement.agrees == is_wrong) < 0.005
    rival = found.refined.rivals[0]  # the fold, with what speaks against it
    assert shape_error(rival.end.locations, truth) > 0.5
    assert rival.behind > 100.0
    assert rival.end.right_share < found.refined.posterior.mean()
    assert "at weights that are the pairs' posteriors" in found.refined.finish.reason


def test_the_posterior_tells_right_pairs_from_wrong_ones_and_standard_deviations_are_true(on_street):
    _, truth, is_wrong, sigma, found = on_street
    assert np.mean((found.refined.posterior > 0.5) == is_wrong) < 0.02
    ratios = np.sqrt(found.refined.variances[~is_wrong]) / sigma[~is_wrong]
    assert 0.5 < np.median(ratios) < 2.0  # each is known by a residual of two components
    sigmas = np.sqrt(np.trace(found.assessment.covariances, axis1=1, axis2=2))
    ours, true = found.locations - found.locations.mean(axis=0), truth - truth.mean(axis=0)
    scale = np.sum(ours * true) / np.sum(ours**2)
    z = np.sqrt(np.mean((np.linalg.norm(ours * scale - true, axis=1) / (scale * sigmas)) ** 2))
    assert 0.25 < z < 1.5  # the prior of lengths makes errors smaller, and the trust knows nothing of it


@pytest.mark.parametrize("seed", [0, 1])
def test_a_pair_that_a_loose_camera_fits_exactly_is_not_believed_for_that(seed):
    problem = corrupted(0.3, 2, n=40, sigma=0.002)
    graph, n = problem.view_graph, problem.view_graph.num_nodes
    rng = np.random.default_rng(seed)
    ends = rng.choice(n, 2, replace=False)
    loose = ViewGraph(
        n + 1,
        np.concatenate([graph.edges, [(n, ends[0]), (n, ends[1])]]),
        np.concatenate([graph.directions, normalized(rng.normal(size=(2, 2)))]),  # two lines always meet
    )
    found = place(loose)
    assert np.isfinite(found.locations).all()
    assert shape_error(found.locations[:n], problem.locations) < 0.01
    assert not found.agreement.agrees[-2:].any()
    sigmas = np.sqrt(np.trace(found.assessment.covariances, axis1=1, axis2=2))
    assert sigmas[n] > 20 * np.median(sigmas)


def test_the_answer_is_the_same_to_the_bit_for_any_number_of_threads(on_street):
    graph, *_, found = on_street
    for threads in (2, 3):
        again = place(graph, threads=threads)
        np.testing.assert_array_equal(again.locations, found.locations)
        np.testing.assert_array_equal(again.refined.variances, found.refined.variances)


def test_more_pairs_than_one_thread_takes_at_a_time_end_in_the_same_bits_near_the_truth():
    problem = corrupted(0.2, 2, n=200, sigma=0.005)
    graph = problem.view_graph
    assert graph.num_edges > 8192
    ends = []
    for threads in (1, 3):
        model = Mixture(MeasuredGraph(graph), analyze(graph.num_nodes, graph.edges), threads)
        ends.append(model.descend(problem.locations))
    for name in ("locations", "variances", "posterior", "bound"):
        np.testing.assert_array_equal(*(getattr(end, name) for end in ends))
    assert shape_error(ends[0].locations, problem.locations) < 0.005  # noise over the root of 50 pairs a node


def test_names_and_senses_of_pairs_do_not_matter(on_street):
    graph, *_, found = on_street
    rng = np.random.default_rng(0)
    names, order = rng.permutation(graph.num_nodes), rng.permutation(graph.num_edges)
    renamed = ViewGraph(graph.num_nodes, names[graph.edges][order, ::-1], -graph.directions[order])
    there = place(renamed)
    # Descents end where a step gains less than half a nat: here a quarter of the error, which is 0.019.
    assert shape_error(there.locations[names], found.locations) < 5e-3
    assert np.mean(there.agreement.agrees == found.agreement.agrees[order]) > 0.99


def test_rigid_groups_and_few_cameras_are_placed_the_usual_way():
    few = synthetic.random_graph_problem(9, 1.0, sigma=0.01, seed=1).view_graph
    problem = corrupted(0.1, n=20)
    groups = RigidGroups(
        group_of=np.repeat(np.arange(10), 2), offsets=problem.locations - problem.locations[::2].repeat(2, 0)
    )
    inside = np.flatnonzero(np.diff(groups.group_of[problem.view_graph.edges], axis=1)[:, 0] != 0)
    grouped = MeasuredGraph(problem.view_graph.subset(inside), groups=groups)
    for graph in (MeasuredGraph(few), grouped):
        found = place(graph)
        with no_mixture():
            usual = place(graph)
        np.testing.assert_array_equal(found.locations, usual.locations)
        assert found.refined.finish.reason == usual.refined.finish.reason
        assert found.refined.variances is None


def test_standard_deviations_of_the_directions_are_used():
    blind, told = 0.0, 0.0
    for seed in (1, 2, 4):
        graph, truth, is_wrong, sigma = street(seed)
        is_known = np.arange(len(sigma)) % 7 > 0
        found = place(graph, sigma=np.where(is_known, sigma, np.nan))
        blind += shape_error(place(graph).locations, truth)
        told += shape_error(found.locations, truth)
        assert (found.refined.variances >= 0.999 * sigma**2)[is_known & ~is_wrong].all()
        assert np.mean((found.refined.posterior > 0.5) == is_wrong) < 0.02
    assert told < 0.9 * blind


@pytest.mark.parametrize("objective", ["auto", "lud"])
def test_standard_deviations_and_covariances_say_the_same(objective, on_street):
    graph, _, _, sigma, _ = on_street
    covariance = sigma[:, None, None] ** 2 * np.eye(2)
    answers = [place(graph, objective=objective, sigma=given).locations for given in (sigma, covariance)]
    answers.append(place(MeasuredGraph(graph, covariance=covariance), objective=objective).locations)
    for other in answers[1:]:
        np.testing.assert_array_equal(other, answers[0])


@pytest.mark.parametrize(
    ("sigma", "message"),
    [
        (0.01, r"sigma has shape \(\); give one standard deviation, radians, for each of the 924"),
        (np.full(924, -0.01), "sigma has negative or infinite values"),
        (np.full(924, 1e200), "sigma has values beyond pi radians"),
        (np.tile(np.eye(2) * 1e300, (924, 1, 1)), "sigma has values beyond pi radians"),
        (np.tile([[1e-2, 5e-3], [0.0, 1e-2]], (924, 1, 1)), "sigma has covariances that are not symmetric"),
        (["sharp"] * 924, "sigma must be numbers"),
        (np.full(924, 0.01j), "sigma must be numbers"),
        (np.full(924, np.inf), "sigma has negative or infinite values"),
        (np.tile(np.diag([1e-4, -1e-4]), (924, 1, 1)), "sigma has negative or infinite values"),
    ],
)
def test_a_sigma_that_is_none_is_refused(sigma, message, on_street):
    with pytest.raises(InputError, match=message):
        place(on_street[0], sigma=sigma)


@pytest.mark.parametrize("block", [1, 3])
def test_the_logarithm_of_the_determinant_is_that_of_the_whole_matrix(block):
    edges = corrupted(0.0, n=30).view_graph.edges
    blocks = (
        random_blocks(len(edges), 3, 1) if block == 3 else np.random.default_rng(1).uniform(1, 2, len(edges))
    )
    plan = analyze(30, edges)
    factor = factorize(plan, blocks)
    whole = np.zeros((30 * block, 30 * block))
    for (i, j), w in zip(edges, blocks.reshape(-1, block, block), strict=True):
        a, b = slice(block * i, block * (i + 1)), slice(block * j, block * (j + 1))
        whole[a, a] += w
        whole[b, b] += w
        whole[a, b] -= w
        whole[b, a] -= w
    last = plan.permutation[-1]
    at = np.arange(block * last, block * (last + 1))
    whole[at, at] += np.trace(whole) / len(whole)
    assert factor.log_determinant() == pytest.approx(np.linalg.slogdet(whole)[1], rel=1e-12)


def test_standard_deviations_are_those_of_the_errors_where_pairs_differ_in_noise():
    rng = np.random.default_rng(0)
    squares = []
    for seed in range(4):
        problem = synthetic.random_graph_problem(60, 0.4, seed=seed)
        graph = problem.view_graph
        sigma = 0.01 * np.exp(rng.standard_normal(graph.num_edges))
        noise = sigma[:, None] * rng.standard_normal(graph.directions.shape)
        found = place(ViewGraph(60, graph.edges, normalized(graph.directions + noise)))
        fit = fit_similarity_l1(found.locations, problem.locations[found.cameras], rotate=False)
        errors = fit.apply(found.locations) - problem.locations[found.cameras]
        squares.append(np.mean(errors**2 / np.einsum("kaa->ka", found.covariances)) / fit.scale**2)
    # 720 coordinates; 1.39 where the information is that of known levels.
    assert 0.75 < np.sqrt(np.mean(squares)) < 1.25


def test_starts_that_lead_to_one_place_are_followed_there_once():
    problem = synthetic.random_graph_problem(60, 0.4, sigma=0.01, q=0.3, seed=1)
    found = place(problem.view_graph)
    assert len(set(found.refined.finish.costs.values())) == 1 < len(found.refined.finish.costs)
    assert found.refined.rivals == ()


def road(seed, speed_ratio):
    return synthetic.trajectory_graph_problem(300, 36, speed_ratio=speed_ratio, sigma=0.01, q=0.2, seed=seed)


def test_a_road_of_varying_speed_is_not_pulled_to_one_speed():
    problem = road(4, 4.0)
    found = place(problem.view_graph)
    # 0.0085 by the right pairs alone, and 0.020 where each camera's lengths count.
    assert shape_error(found.locations, problem.locations) < 0.0125


def test_a_right_pair_that_was_rejected_far_from_the_end_is_believed_again():
    problem = road(1, 4.0)
    found = place(problem.view_graph)
    lost = ~problem.corrupted & (found.refined.posterior < 0.5)
    assert lost.sum() <= 3  # noise alone; 15 are lost by the first descent


@pytest.mark.parametrize(("speed_ratio", "least", "most"), [(1.0, 1.0, 1.0), (4.0, 4.0, 40.0)])
def test_the_design_effect_is_one_where_cameras_step_alike_and_large_where_the_speed_varies(
    speed_ratio, least, most
):
    problem = road(0, speed_ratio)
    graph = problem.view_graph
    lengths = np.linalg.norm(np.diff(problem.locations[graph.edges], axis=1)[:, 0], axis=1)
    logs = np.log(lengths)
    assert least <= LengthPrior(graph).design_effect(logs - logs.mean()) <= most


def test_the_rounding_that_averages_leave_says_nothing_of_how_cameras_step():
    """Each average of four cameras that all see each other cancels as much as the one before."""
    graph = synthetic.random_graph_problem(4, 1.0, seed=0).view_graph
    logs = np.random.default_rng(0).normal(0.0, 0.4, (40, graph.num_edges))
    effects = [LengthPrior(graph).design_effect(own - own.mean()) for own in logs]
    assert max(effects) < 4.0  # 15 where rounding counts
