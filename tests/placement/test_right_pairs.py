"""What is certain if the pairs that are taken for right are right."""

from dataclasses import replace

import numpy as np

from sfm_shapefit import synthetic
from sfm_shapefit.commands.place import place, place_graph_file
from sfm_shapefit.placement.right_pairs import examine_right_pairs
from sfm_shapefit.solver.solver_options import SolverOptions
from tests.problems import shape_error


def test_right_pairs_that_are_rigid_have_one_certified_optimum_which_is_the_truth(tmp_path):
    problem = synthetic.random_graph_problem(60, 0.5, q=0.7, seed=4)
    graph = problem.view_graph
    rows = np.c_[graph.edges, graph.directions]
    path = tmp_path / "graph.txt"
    np.savetxt(path, rows, fmt="%d %d" + 3 * " %.17g")
    found = place_graph_file(path)
    right, told = found.right_pairs, found.facts.right_pairs
    np.testing.assert_array_equal(right.edges, np.flatnonzero(~problem.corrupted))
    assert shape_error(right.solved.locations, problem.locations) < 1e-9
    assert told.rigid
    assert told.num_right == np.sum(~problem.corrupted)
    assert told.solve.unique
    assert "has one optimum, certified to" in told.statement
    assert told.statement in str(found.told)
    posterior = np.array([row.scores.posterior for row in found.pairs])
    np.testing.assert_array_equal(posterior > 0.5, ~problem.corrupted)


def test_right_pairs_that_leave_a_camera_loose_are_said_not_to_be_rigid():
    problem = synthetic.random_graph_problem(40, 0.5, q=0.2, seed=4)
    graph = problem.view_graph
    placed = place(graph)
    posterior = placed.refined.posterior.copy()
    held = np.flatnonzero((graph.edges == 0).any(axis=1) & (posterior > 0.5))
    posterior[held[1:]] = 0.1  # one right pair is left, along which camera 0 slides
    loose = replace(placed, refined=replace(placed.refined, posterior=posterior))
    right = examine_right_pairs(loose, SolverOptions())
    assert right.num_fixed == 39
    assert not right.rigid
    assert right.solved is None
    assert "they alone fix 39 of 40 nodes" in right.statement


def test_a_graph_without_wrong_pairs_keeps_its_own_certificate():
    placed = place(synthetic.random_graph_problem(20, 0.6, q=0.0, seed=4).view_graph)
    assert examine_right_pairs(placed, SolverOptions()).solved is placed.certified
