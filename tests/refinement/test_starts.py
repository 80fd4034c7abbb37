"""Two starts, one answer: which is kept, what is said of it, and what is never touched."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_shapefit import synthetic
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.commands.place import place
from sfm_shapefit.facts.warnings import quality_warnings
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.refinement.starts import COLLAPSED, Start, choose_start, disagreement, refine_starts
from sfm_shapefit.solver.program import differences
from sfm_shapefit.solver.solve import solve
from tests.problems import no_mixture, shape_error


@pytest.fixture(scope="module", autouse=True)
def one_level():
    with no_mixture():
        yield


def finished(problem, **options):
    graph, settings = problem.view_graph, PlacementOptions(**options)
    return refine_starts(MeasuredGraph(graph), solve(graph, settings.solver), settings)


@pytest.fixture(scope="module")
def chain():
    """A video of 200 cameras on which ShapeFit collapses."""
    return synthetic.trajectory_graph_problem(200, 36.0, sigma=0.01, q=0.2, seed=1, speed_ratio=4.0)


@pytest.fixture(scope="module")
def expander():
    return synthetic.random_graph_problem(40, 0.6, sigma=0.02, q=0.2, seed=1)


def test_shapefit_collapses_on_a_long_chain_and_the_placement_does_not(chain):
    found = finished(chain)  # the families of test_recovery are placed by this start, where they collapse
    assert found.finish.disagreement > COLLAPSED
    assert "disagree" in found.finish.reason
    assert found.finish.statement().startswith("LUD, refined in angles")
    assert shape_error(found.locations, chain.locations) < 0.05
    assert found.finish.costs["LUD"] < found.finish.costs["ShapeFit"]


def test_where_both_starts_agree_nothing_is_said_of_a_collapse_and_the_scale_is_the_solvers(expander):
    graph, found = expander.view_graph, finished(expander)
    assert not found.finish.collapsed
    assert "not by a collapse" in found.finish.reason
    assert shape_error(found.locations, expander.locations) < 0.02
    assert found.finish.costs["LUD"] == pytest.approx(found.finish.costs["ShapeFit"], rel=1e-3)
    along = np.sum(differences(found.locations, graph.edges) * graph.directions, axis=1)
    assert along.mean() == pytest.approx(1.0)
    np.testing.assert_allclose(found.locations.mean(axis=0), 0.0, atol=1e-12)


def test_of_many_cameras_one_of_two_starts_that_agree_is_refined(chain):
    many = synthetic.box_graph_problem(1000, 20.0, sigma=0.002, q=0.05, seed=1)
    found = finished(many)
    assert list(found.finish.costs) == ["ShapeFit"]
    assert found.finish.lud is not None
    assert "only one is refined" in found.finish.reason
    assert shape_error(found.locations, many.locations) < 1e-3
    assert list(finished(many, objective="lud").finish.costs) == ["ShapeFit", "LUD"]
    assert len(finished(chain).finish.costs) == 2


def test_the_certified_answer_is_given_to_the_bit_if_asked_and_warned_of_on_a_chain(chain):
    graph = chain.view_graph
    options = PlacementOptions(objective="shapefit")
    placement = place(graph, options)
    assert np.array_equal(placement.locations, placement.certified.locations)
    assert not placement.refined.finish.refined
    assert placement.refined.finish.start == "ShapeFit"
    assert "as asked" in placement.refined.finish.statement()
    (warning,) = (w for w in placement.warnings if "two ways to find lengths disagree" in w)
    assert "objective=auto" in warning
    unrefined = " ".join(place(graph, refine=False).warnings)
    assert "refine=True refines" in unrefined
    assert "objective=" not in unrefined  # it is in force
    adjusted = replace(placement, adjusted_covariances=np.zeros((len(placement.cameras), 3, 3)))
    assert not any("two ways to find lengths disagree" in w for w in quality_warnings(adjusted))


def test_lud_is_taken_if_asked_and_without_refinement_the_better_start_as_it_is(chain, expander):
    found = finished(expander, objective="lud")
    assert (found.finish.start, found.finish.refined) == ("LUD", True)
    median, largest = found.finish.moved_median, found.finish.moved_max
    assert 0.0 < median < largest < 1.0
    assert f"{median:.2%}" in found.finish.statement()
    raw = finished(expander, objective="lud", refine=False)
    assert raw.finish.statement() == "LUD, not refined: LUD, as asked"
    better = finished(chain, refine=False)
    for unrefined in (raw, better):
        assert shape_error(unrefined.locations, unrefined.finish.lud.locations) < 1e-12
        assert (unrefined.finish.start, unrefined.finish.refined, unrefined.finish.moved_max) == (
            "LUD",
            False,
            0.0,
        )


TRIANGLE = ViewGraph(3, [(0, 1), (1, 2), (2, 0)], normalized(np.eye(3) - np.roll(np.eye(3), -1, axis=0)))


def start(name: str, locations=None) -> Start:
    there = np.eye(3) if locations is None else locations
    return Start(name=name, locations=there, refined=None, reset_nodes=np.empty(0, dtype=np.int64))


@pytest.mark.parametrize(
    ("costs", "apart", "kept", "word"),
    [
        ((100.0, 99.0), 0.1, "LUD", "not by a collapse"),
        ((100.0, 100.0), 0.1, "ShapeFit", "not by a collapse"),
        ((100.0, 100.0 - 1e-9), 0.1, "ShapeFit", "not by a collapse"),  # lower by rounding alone
        ((100.0, 100.05), 1.0, "LUD", "alike"),  # within a thousandth: the one that cannot collapse
        ((99.95, 100.0), 1.0, "LUD", "alike"),
        ((100.0, 101.0), 1.0, "ShapeFit", "better"),
        ((101.0, 100.0), 1.0, "LUD", "better"),
    ],
)
def test_the_lower_cost_is_kept_and_a_tie_of_disagreeing_starts_goes_to_lud(costs, apart, kept, word):
    starts = [start("ShapeFit"), start("LUD")]
    by_name = dict(zip(("ShapeFit", "LUD"), costs, strict=True))
    chosen, reason = choose_start(TRIANGLE, starts, by_name, apart, PlacementOptions())
    assert chosen.name == kept
    assert word in reason


def test_a_start_whose_cameras_stand_in_one_point_is_not_kept_whatever_it_costs():
    graph = ViewGraph(5, [(0, 1), (1, 2), (2, 3), (3, 4), (4, 0)], normalized(np.eye(5)[:, :3] + 0.1))
    spread = np.random.default_rng(0).standard_normal((5, 3))
    point = 1e-9 * spread
    point[0] = spread[0]
    for lengths, kept in ((point, "LUD"), (spread, "ShapeFit")):
        starts = [start("ShapeFit", lengths), start("LUD", spread)]
        chosen, _ = choose_start(graph, starts, {"ShapeFit": 90.0, "LUD": 100.0}, 5.0, PlacementOptions())
        assert chosen.name == kept


@pytest.mark.parametrize("objective", ["auto", "lud"])
def test_without_a_second_start_shapefit_is_kept_and_the_reason_says_so(objective):
    found = finished(synthetic.random_graph_problem(2, 1.0, seed=1), objective=objective)  # two cameras
    assert found.finish.start == "ShapeFit"
    assert found.finish.lud is None
    assert found.finish.disagreement is None
    assert not found.finish.collapsed
    assert "no second start" in found.finish.reason


@pytest.mark.parametrize("d", [2, 3])
def test_noise_free_answers_are_exact_and_not_made_worse(d):
    problem = synthetic.random_graph_problem(30, 0.9, d=d, q=0.1, seed=d)
    graph = problem.view_graph
    certified = solve(graph)
    found = refine_starts(MeasuredGraph(graph), certified, PlacementOptions())
    assert shape_error(found.locations, problem.locations) < 1e-9
    # Rounding apart: the certified answer is exact to 1e-9 itself, or better.
    errors = [shape_error(x.locations, problem.locations) for x in (found, certified)]
    assert errors[0] <= errors[1] + 1e-12


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("n", [2, 3, 4])
def test_the_smallest_graphs_are_finished(n, d):
    problem = synthetic.random_graph_problem(n, 1.0, d=d, sigma=1e-3, seed=2)
    found = finished(problem)
    assert np.isfinite(found.locations).all()
    assert shape_error(found.locations, problem.locations) < 0.02
    assert (found.finish.lud is None) == (n == 2)


def test_too_large_a_factor_is_refused_with_the_reason(expander):
    found = finished(synthetic.box_graph_problem(400, 24.0, seed=1), factor_memory_mb=1)  # MB
    assert not found.finish.refined
    assert found.finish.statement().endswith("not refined, since the factor for that would be too large")
    assert "too large" not in finished(expander, refine=False).finish.reason  # nobody asked for it


def test_disagreement_is_blind_to_scale_sees_stretched_lengths_and_is_finite_at_one_place():
    t = np.arange(40.0)[:, None] * [1.0, 0.2, 0.1]
    graph = ViewGraph(40, [(i, i + 1) for i in range(39)], normalized(np.tile([-1.0, -0.2, -0.1], (39, 1))))
    assert disagreement(graph, t, 5.0 * t + 1.0) < 1e-12
    stretched = np.concatenate([t[:20], t[19] + 4.0 * (t[20:] - t[19])])
    # Half of the node lengths are 4 times as long: the deviation of a fair coin of log 4 is log(4) / 2.
    assert disagreement(graph, t, stretched) == pytest.approx(np.log(4.0) / 2.0, rel=0.02)
    assert np.isfinite(disagreement(graph, np.minimum(t, t[1]), t))


def test_a_straight_street_is_placed_by_its_points_and_not_without_them():
    street = synthetic.street_problem(60, 10, seed=3)
    n = street.num_cameras
    graph = ViewGraph(len(street.locations), street.edges, street.directions)
    joint = place(MeasuredGraph(graph, covariance=street.covariance, num_points=graph.num_nodes - n))
    assert shape_error(joint.locations, street.locations[joint.cameras]) < 0.01
    pairs = (street.edges < n).all(axis=1)
    bare = place(
        MeasuredGraph(
            ViewGraph(n, street.edges[pairs], street.directions[pairs]), covariance=street.covariance[pairs]
        )
    )
    assert shape_error(bare.locations, street.locations[bare.cameras]) > 0.03
    # 0.01 and 0.001 rad over sqrt(3), and some excess
    pair_level, ray_level = joint.refined.finish.levels_deg
    assert pair_level == pytest.approx(0.33, rel=0.5)
    assert ray_level == pytest.approx(0.033, rel=0.5)


def test_a_second_start_without_a_bound_stands_where_the_one_with_it_stands(expander):
    graph = MeasuredGraph(expander.view_graph)
    solved, options = solve(expander.view_graph), PlacementOptions()
    proved, start = (
        refine_starts(graph, solved, options, certified=certified) for certified in (True, False)
    )
    assert (start.locations == proved.locations).all()
    assert start.finish.lud.dual_bound == 0.0 < proved.finish.lud.dual_bound
