"""What is placed, against the best that the directions allow, on every family of graphs.

The oracle is told which directions are right and starts at the truth: least squares in angles by dense
algebra, which shares no code with what it judges.
"""

import numpy as np
import numpy.typing as npt
import pytest

from sfm_shapefit import synthetic
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.commands.place import place
from sfm_shapefit.solver.program import differences
from tests.problems import fit_angles, shape_error

NOISE = {"sigma": 0.01, "q": 0.2, "seed": 0}
Floats = npt.NDArray[np.float64]


def oracle(problem: synthetic.GraphProblem) -> Floats:
    """Return (n, d) least squares in angles over the right directions, from the truth."""
    right = ~problem.corrupted
    t = problem.locations - problem.locations.mean(axis=0)
    return fit_angles(t, problem.edges[right], problem.directions[right], 6)


USUAL = {
    "er2": lambda: synthetic.random_graph_problem(60, 0.5, **NOISE),
    "geo": lambda: synthetic.box_graph_problem(120, 30.0, **NOISE),
    "comm": lambda: synthetic.community_graph_problem(120, 40.0, **NOISE),
}
CHAINS = {
    "seq": lambda: synthetic.trajectory_graph_problem(120, 24.0, **NOISE),
    "seqv": lambda: synthetic.trajectory_graph_problem(120, 24.0, speed_ratio=4.0, **NOISE),
    "ring": lambda: synthetic.ring_graph_problem(120, 20.0, **NOISE),
    "corridor": lambda: synthetic.corridor_graph_problem(120, 20.0, **NOISE),
}


@pytest.mark.parametrize("family", USUAL)
def test_a_fifth_of_wrong_directions_costs_less_than_8_percent(family):
    problem = USUAL[family]()
    placement = place(problem.view_graph)
    best = shape_error(oracle(problem), problem.locations)
    assert len(placement.cameras) == len(problem.locations)
    assert not placement.refined.finish.collapsed
    assert shape_error(placement.locations, problem.locations) <= 1.08 * best  # measured 1.02 to 1.04
    assert shape_error(placement.certified.locations, problem.locations) > 1.5 * best


@pytest.mark.parametrize("family", CHAINS)
def test_chains_on_which_shapefit_collapses_are_placed(family):
    problem = CHAINS[family]()
    placement = place(problem.view_graph)
    finish = placement.refined.finish
    assert finish.lud is not None
    assert shape_error(placement.certified.locations, problem.locations) > 0.3
    assert finish.collapsed
    assert finish.start != "ShapeFit"
    error = shape_error(placement.locations, problem.locations)
    assert error <= 1.3 * shape_error(oracle(problem), problem.locations)  # measured 0.95 to 1.13
    assert error < shape_error(finish.lud.locations, problem.locations)


def test_strips_flown_back_and_forth_with_a_third_of_wrong_directions_and_the_plane_are_placed():
    problem = synthetic.lawn_graph_problem(200, 20.0, sigma=0.01, q=0.3, seed=0)
    placement = place(problem.view_graph)
    best = shape_error(oracle(problem), problem.locations)
    assert shape_error(placement.locations, problem.locations) <= 1.08 * best
    assert shape_error(placement.certified.locations, problem.locations) > 5.0 * best
    plane = synthetic.random_graph_problem(60, 0.5, d=2, sigma=0.01, q=0.1, seed=1)
    error = shape_error(place(plane.view_graph).locations, plane.locations)
    assert error <= 1.15 * shape_error(oracle(plane), plane.locations)  # fewer equations per unknown


def test_the_oracle_is_a_least_squares_fit():
    problem = synthetic.random_graph_problem(12, 1.0, sigma=0.02, q=0.2, seed=3)
    best = oracle(problem)
    right = ~problem.corrupted

    def cost(t: Floats) -> float:
        u = normalized(differences(t, problem.edges[right]))
        return float(np.sum((u - problem.directions[right]) ** 2))

    rng = np.random.default_rng(0)
    for _ in range(20):
        assert cost(best + 1e-3 * rng.standard_normal(best.shape)) > cost(best)


@pytest.mark.slow
def test_a_large_graph_without_order_is_refined_without_a_factor():
    """Its factor would take a third of a second a step; of two starts that are near only one is refined."""
    many = synthetic.random_graph_problem(1420, 22 / 1420, sigma=0.015, q=0.1, seed=1)
    placed = place(many.view_graph)
    refined = placed.refined
    assert refined.finish.lud is not None
    assert list(refined.finish.costs) == ["ShapeFit"]
    assert 0.01 < refined.finish.disagreement < 0.1  # below 1,500 cameras or so both would be refined
    assert refined.finish.refined
    ours, start = (shape_error(t, many.locations) for t in (placed.locations, placed.certified.locations))
    assert ours < 0.7 * start
