"""What no method may notice: turned axes, other labels, flipped pairs, a weight of two as two pairs."""

from typing import NamedTuple

import numpy as np
import pytest

from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.refinement.angular import plan_refinement, refine_angles
from sfm_shapefit.solver.newton.dense import solve_newton_dense
from sfm_shapefit.solver.newton.sparse import solve_newton_sparse
from sfm_shapefit.solver.solve import solve
from sfm_shapefit.solver.solver_options import SolverOptions
from sfm_shapefit.solver.splitting.lud import solve_lud
from tests.problems import lud_over, outer, rig_problem, shape


class Problem(NamedTuple):
    """Noisy pairs with a fifth wrong, and the rigid groups, which the methods for single cameras ignore."""

    graph: ViewGraph
    groups: RigidGroups

    def with_pairs(self, edges, directions, weights):
        return self._replace(graph=ViewGraph(self.graph.num_nodes, edges, directions, weights))


def refine(problem):
    graph = problem.graph
    return refine_angles(MeasuredGraph(graph), solve(graph).locations, plan_refinement(graph)).locations


METHODS = {
    "newton dense": lambda p: solve_newton_dense(p.graph, 1e-9, 100)[0],
    "newton sparse": lambda p: solve_newton_sparse(p.graph, 1e-9, 100)[0],
    "admm": lambda p: solve(p.graph, SolverOptions(solver="admm", tol=1e-9)).locations,
    "lud": lambda p: solve_lud(p.graph, 5000, tol=1e-12, certified=False).locations,
    "angles": refine,
    "groups, newton": lambda p: solve(p.graph, SolverOptions(tol=1e-9), groups=p.groups).locations,
    "groups, lud": lambda p: lud_over(p.graph, p.groups, 5000),
}


@pytest.fixture(scope="module")
def problem():
    graph, groups, _ = rig_problem(41, noise=0.03, share=0.7)
    return Problem(outer(graph, groups)[0], groups)


@pytest.fixture(scope="module")
def answers(problem):
    return {name: shape(run(problem)) for name, run in METHODS.items()}


def check(answers, name, changed, undo=lambda t: t):
    """The answer to a changed problem, taken back, is the answer to the problem.

    The optima are unique and sharp: a fifth of the pairs is wrong, the others leave little room within 1e-9.
    """
    np.testing.assert_allclose(undo(shape(METHODS[name](changed))), answers[name], atol=1e-6)


@pytest.mark.parametrize("name", METHODS)
def test_turned_axes_turn_the_answer(name, problem, answers):
    turn = np.linalg.qr(np.random.default_rng(4).standard_normal((3, 3)))[0]
    graph, groups = problem
    turned = problem.with_pairs(graph.edges, graph.directions @ turn.T, graph.weights)._replace(
        groups=RigidGroups(group_of=groups.group_of, offsets=groups.offsets @ turn.T)
    )
    check(answers, name, turned, lambda t: t @ turn)


@pytest.mark.parametrize("name", METHODS)
def test_other_labels_and_another_order_of_the_pairs_change_nothing(name, problem, answers):
    graph, groups = problem
    rng = np.random.default_rng(5)
    nodes, pairs = rng.permutation(graph.num_nodes), rng.permutation(graph.num_edges)
    where = np.argsort(nodes)
    names = rng.permutation(groups.num_groups)
    relabeled = problem.with_pairs(
        nodes[graph.edges[pairs]], graph.directions[pairs], graph.weights[pairs]
    )._replace(groups=RigidGroups(group_of=names[groups.group_of[where]], offsets=groups.offsets[where]))
    check(answers, name, relabeled, lambda t: t[nodes])


@pytest.mark.parametrize("name", METHODS)
def test_a_pair_may_be_written_the_other_way_round(name, problem, answers):
    graph = problem.graph
    flip = np.random.default_rng(6).random((graph.num_edges, 1)) < 0.5
    edges = np.where(flip, graph.edges[:, ::-1], graph.edges)
    directions = np.where(flip, -graph.directions, graph.directions)
    check(answers, name, problem.with_pairs(edges, directions, graph.weights))


@pytest.mark.parametrize("name", METHODS)
def test_only_the_ratios_of_weights_matter(name, problem, answers):
    graph = problem.graph
    check(answers, name, problem.with_pairs(graph.edges, graph.directions, 1e4 * graph.weights))


# The levels of the refinement in angles are medians over pairs, so that a repeated pair counts there twice.
@pytest.mark.parametrize("name", [name for name in METHODS if name != "angles"])
def test_weight_two_is_a_pair_given_twice(name, problem, answers):
    graph = problem.graph
    again = np.arange(0, graph.num_edges, 3)
    weights = graph.weights.copy()
    weights[again] *= 2.0
    weighted = shape(METHODS[name](problem.with_pairs(graph.edges, graph.directions, weights)))
    assert np.abs(weighted - answers[name]).max() > 1e-3  # weights matter at all
    rows = np.concatenate([np.arange(graph.num_edges), again])
    repeated = problem.with_pairs(graph.edges[rows], graph.directions[rows], graph.weights[rows])
    check({name: weighted}, name, repeated)


@pytest.mark.parametrize("name", METHODS)
def test_all_directions_against_their_pairs_mirror_the_answer(name, problem, answers):
    graph, groups = problem
    mirrored = problem.with_pairs(graph.edges, -graph.directions, graph.weights)._replace(
        groups=RigidGroups(group_of=groups.group_of, offsets=-groups.offsets)
    )
    check(answers, name, mirrored, np.negative)
