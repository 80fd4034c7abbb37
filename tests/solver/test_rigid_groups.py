"""ShapeFit over rigid groups: the program, its dual and certificate, what hangs free, and the refinement."""

import numpy as np
import pytest

from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.commands.place import place
from sfm_shapefit.graph.groups import RigidGroups, separate
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.solver.certificate import certify
from sfm_shapefit.solver.conic import solve_conic
from sfm_shapefit.solver.program import adjoint, along, differences, scale_functional
from sfm_shapefit.solver.reduction import Pin, Reduction, factor_pinned
from sfm_shapefit.solver.solve import solve
from sfm_shapefit.solver.solver_options import SolverOptions, Status
from sfm_shapefit.solver.splitting.lud import solve_lud
from sfm_shapefit.solver.tied import largest_tied
from tests.problems import lud_over, outer, rig_problem


def centered(t):
    return t - t.mean(axis=0)


def test_reducing_is_the_adjoint_of_expanding_and_fitting_its_inverse():
    groups = rig_problem(0)[1]
    rng = np.random.default_rng(1)
    x = groups.stack(rng.normal(size=(groups.num_groups, 3)), rng.normal(size=groups.num_units))
    g = rng.normal(size=groups.offsets.shape)
    t = groups.expand(x)
    assert np.vdot(t, g) == pytest.approx(np.vdot(x, groups.reduce(g)), rel=1e-13)
    found, apart = groups.fit(t)
    np.testing.assert_allclose(found, x, atol=1e-13)
    assert apart < 1e-13
    t[4] += [0.3, 0.0, 0.0]  # of a group of three: the mean takes up a third, the scale a little
    assert 0.1 < groups.fit(t)[1] < 0.25


def test_groups_with_fixed_nodes_become_one_whole_frames_with_them():
    groups = RigidGroups(
        group_of=[0, 0, 1, 1, 2], offsets=[[0, 0, 0], [1, 0, 0], [0, 0, 0], [0, 1, 0], [0, 0, 0]]
    )
    centers = np.array([[5.0, 0, 0], [6.0, 0, 0], [9.0, 9, 9], [8.0, 1, 0], [7.0, 7, 7]])
    joined = groups.with_fixed(np.array([True, False, False, True, False]), centers)
    np.testing.assert_array_equal(joined.group_of, [0, 0, 0, 0, 1])
    # Node 2 is not fixed itself: it stands by its offset from node 3, not at its own center.
    expected = np.array([[5.0, 0, 0], [6, 0, 0], [8, 0, 0], [8, 1, 0]])
    np.testing.assert_allclose(centered(joined.offsets[:4]), centered(expected), atol=1e-14)


@pytest.mark.parametrize(
    ("labels", "offsets", "message"),
    [
        ([0, 2], np.zeros((2, 3)), "without gaps"),
        ([0, 1], np.zeros((3, 3)), "one row per node"),
        ([0, 1], np.full((2, 3), np.nan), "offset of node 0 is not finite"),
    ],
)
def test_groups_that_make_no_sense_are_refused(labels, offsets, message):
    with pytest.raises(InputError, match=message):
        RigidGroups(group_of=labels, offsets=offsets)


def written_out(edges, groups, blocks):
    """A^T D^T S D A and A, dense."""
    n, d = groups.offsets.shape
    rows = groups.num_groups + groups.num_units
    expand = np.stack([groups.expand(x.reshape(rows, d)).ravel() for x in np.eye(rows * d)], axis=1)
    baselines = np.zeros((len(edges), n))
    baselines[np.arange(len(edges)), edges[:, 0]] = 1.0
    baselines[np.arange(len(edges)), edges[:, 1]] -= 1.0
    difference = np.kron(baselines, np.eye(d)) @ expand
    stiff = (blocks @ difference.reshape(len(edges), d, -1)).reshape(len(edges) * d, -1)
    return difference.T @ stiff, expand


@pytest.mark.parametrize("metric", [True, False])
def test_the_reduced_factor_and_its_systems_solve_the_matrix_written_out(metric):
    graph, groups, _ = rig_problem(13, frames=5)
    between = outer(graph, groups)[0]
    edges, v, n = between.edges, between.directions, graph.num_nodes
    unit = (
        groups.normalize() if metric else RigidGroups(group_of=groups.group_of, offsets=0.0 * groups.offsets)
    )
    rng = np.random.default_rng(2)
    roots = rng.normal(size=(len(edges), 3, 3))
    blocks = np.eye(3) + roots @ roots.transpose(0, 2, 1)
    matrix, expand = written_out(edges, unit, blocks)
    factor = Reduction.over(edges, unit)
    factor.refactor(blocks)
    g = adjoint(rng.normal(size=v.shape), edges, n)
    x = np.linalg.pinv(matrix) @ (expand.T @ g.ravel())
    np.testing.assert_allclose(centered(factor.solve(g)), centered((expand @ x).reshape(-1, 3)), atol=1e-10)
    # Of one pinned pair, tau v v^T is taken away again.
    tau, pinned = 2.5, 4
    c = unit.reduce(scale_functional(between))
    system = factor_pinned(factor, blocks.copy(), c, Pin(pinned, edges[pinned], v[pinned], tau))
    right = unit.reduce(g)
    multiplier, x = system.solve(right, 0.7)
    np.testing.assert_allclose(matrix @ x.ravel(), (multiplier * c + right).ravel(), atol=1e-9)
    assert np.vdot(c, x) == pytest.approx(0.7, rel=1e-10)


def mixed_problem(wrong=0.2):
    """Two rigs of one unit, two pieces with units of their own, and single nodes; exact but for a share."""
    rng = np.random.default_rng(4)
    labels = np.array([0] * 4 + [1] * 4 + [2] * 8 + [3] * 8 + [4, 5, 6])
    unit_of = np.array([0, 0, 1, 2, 0, 0, 0])
    t, lengths = rng.normal(size=(len(labels), 3)), np.array([0.5, 3.0, 0.2])
    offsets = t / lengths[unit_of[labels]][:, None]
    offsets[labels > 3] = 0.0
    groups = RigidGroups(group_of=labels, offsets=offsets, unit_of=unit_of)
    edges = np.array([(i, j) for i in range(len(labels)) for j in range(i) if labels[i] != labels[j]])
    edges = edges[rng.permutation(len(edges))[:110]]
    v = normalized(t[edges[:, 0]] - t[edges[:, 1]])
    bad = rng.random(len(edges)) < wrong
    v[bad] = normalized(rng.normal(size=(int(bad.sum()), 3)))
    return ViewGraph(len(labels), edges, v), groups, t, lengths


def test_rigs_pieces_with_scales_of_their_own_and_single_cameras_are_one_program():
    graph, groups, t, lengths = mixed_problem()
    assert (groups.num_units, groups.num_groups) == (3, 7)
    result = solve(graph, SolverOptions(uniqueness=True), groups=groups)
    assert result.status is Status.CONVERGED
    assert result.unique
    x, apart = groups.fit(result.locations)
    scales = groups.split(x)[1]
    assert apart < 1e-12
    np.testing.assert_allclose(scales / scales[0], lengths / lengths[0], rtol=1e-6)
    np.testing.assert_allclose(centered(result.locations) / scales[0] * lengths[0], centered(t), atol=1e-6)
    conic = solve(graph, SolverOptions(solver="conic"), groups=groups)
    np.testing.assert_allclose(conic.locations, result.locations, atol=1e-6)
    lud = lud_over(graph, groups)
    assert groups.fit(lud)[1] < 1e-9
    found = groups.split(groups.fit(lud)[0])[1]
    np.testing.assert_allclose(found / found[0], lengths / lengths[0], rtol=0.2)


def test_a_matrix_with_several_units_is_factored_as_it_is_written_out():
    graph, groups, _, _ = mixed_problem(wrong=1.0)
    unit, edges = groups.normalize(), graph.edges
    for number in range(3):
        own = np.linalg.norm(unit.offsets[unit.units == number], axis=1)
        assert np.sqrt(np.mean(own[own > 0.0] ** 2)) == pytest.approx(1.0)
    blocks = (
        np.tile(np.eye(3), (len(edges), 1, 1))
        + 0.5 * graph.directions[:, :, None] * graph.directions[:, None]
    )
    matrix, expand = written_out(edges, unit, blocks)
    factor = Reduction.over(edges, unit)
    factor.refactor(blocks)
    g = adjoint(np.random.default_rng(0).normal(size=graph.directions.shape), edges, graph.num_nodes)
    x = np.linalg.pinv(matrix) @ (expand.T @ g.ravel())
    np.testing.assert_allclose(centered(factor.solve(g)), centered((expand @ x).reshape(-1, 3)), atol=1e-10)
    part = groups.restricted_to(np.flatnonzero(groups.units > 0))
    assert part.unit_of.tolist() == [0, 1]
    alone = part.restricted_to(np.array([0, 8]))  # one node of each: nothing tells a scale
    with pytest.raises(UnsolvableError, match="do not determine a scale"):
        Reduction.over(np.array([[0, 1]]), alone.center()).refactor(np.eye(3)[None])


def test_a_scale_that_nothing_holds_is_refused():
    graph, groups, _ = rig_problem(13, frames=5, wrong=0.0)
    between = outer(graph, groups)[0]
    edges, v = between.edges, between.directions
    factor = Reduction.over(edges, groups.normalize())
    with pytest.raises(UnsolvableError, match="do not determine a scale"):  # all may grow along the solution
        factor.refactor(np.eye(3) - v[:, :, None] * v[:, None, :])
    factor.refactor(np.broadcast_to(np.eye(3), (len(edges), 3, 3)).copy())
    assert 0.0 < factor.smallest_pivot <= 1.0


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_the_answer_is_that_of_the_conic_program_over_the_same_groups(noise):
    graph, groups, _ = rig_problem(2, noise=noise)
    result = solve(graph, groups=groups)
    locations, dual, _ = solve_conic(outer(graph, groups)[0], 1e-9, 200, groups)
    every = np.zeros_like(graph.directions)
    every[groups.joins(graph.edges)] = dual
    reference = certify(graph, centered(locations), every, groups=groups)
    assert reference.gap < 1e-9  # so the two optima agree to the sum of both gaps
    assert result.objective == pytest.approx(reference.objective, abs=1e-8)
    # The objective is sharp here: locations agree to a few times its error.
    np.testing.assert_allclose(result.locations, centered(locations), atol=1e-6)


def test_groups_of_one_node_are_the_plain_program_and_larger_ones_raise_the_optimum():
    graph, _, _ = rig_problem(3, noise=0.01)
    result = solve(graph, groups=separate(graph.num_nodes, 3))
    plain = solve(graph)
    assert result.objective == pytest.approx(plain.objective, abs=2e-8)
    np.testing.assert_allclose(result.locations, plain.locations, atol=1e-6)
    graph, groups, _ = rig_problem(4, noise=0.05)
    assert solve(graph, groups=groups).dual_bound > solve(outer(graph, groups)[0]).objective + 1e-4


def test_the_dual_balances_over_each_group_and_for_the_scale():
    graph, groups, _ = rig_problem(5, noise=0.02)
    result = solve(graph, groups=groups)
    between, kept = outer(graph, groups)
    y, w = result.dual[kept], between.weights
    total = groups.reduce(adjoint(y, between.edges, graph.num_nodes))
    wanted = result.dual_bound * groups.reduce(scale_functional(between))
    assert np.linalg.norm(y, axis=1).max() <= w.max() * (1 + 1e-14)
    assert (np.linalg.norm(y, axis=1) <= w * (1 + 1e-14)).all()
    assert np.abs(np.sum(y * between.directions, axis=1)).max() < 1e-13
    # The solver leaves 1e-13 of the degree at most; one camera alone is not balanced.
    np.testing.assert_allclose(total, wanted, atol=1e-11 * np.abs(wanted).max())
    alone = adjoint(y, between.edges, graph.num_nodes) - result.dual_bound * scale_functional(between)
    assert np.abs(alone).max() > 1e-3
    assert not result.dual[~kept].any()


def test_a_dual_that_balances_is_kept_and_any_gives_a_bound_below_the_optimum_a_near_one_a_close_one():
    graph, groups, _ = rig_problem(6, noise=0.02)
    result = solve(graph, groups=groups)
    rng = np.random.default_rng(0)
    for size, loss in ((0.0, 1e-13), (1e-4, 1e-2), (1.0, np.inf)):
        spoilt = result.dual + size * rng.normal(size=result.dual.shape)
        found = certify(graph, result.locations, spoilt, groups=groups)
        assert found.dual_bound <= result.objective
        assert found.equality_residual < 1e-11
        assert result.dual_bound - found.dual_bound < loss
        if size == 0.0:
            np.testing.assert_allclose(found.dual, result.dual, atol=1e-13)
    assert certify(graph, result.locations, 0.0 * result.dual, groups=groups).dual_bound == 0.0
    large = certify(graph, result.locations, 3.0 * result.dual, groups=groups)  # is shrunk into its balls
    assert (np.linalg.norm(large.dual, axis=1) / graph.weights).max() == pytest.approx(1.0, abs=1e-12)
    largest = (np.linalg.norm(result.dual, axis=1) / graph.weights).max()
    assert large.dual_bound == pytest.approx(result.dual_bound / largest, rel=1e-9)


def test_what_cannot_be_certified_is_refused():
    graph, groups, t = rig_problem(7, wrong=0.0)
    dual = np.zeros_like(graph.directions)
    inside = groups.group_of[graph.edges[:, 0]] == groups.group_of[graph.edges[:, 1]]
    inner = ViewGraph(graph.num_nodes, graph.edges[inside], graph.directions[inside])
    for refused, message in (
        ((graph, groups, t[1:], dual), "have shapes"),
        ((graph, groups, t, dual[1:]), "have shapes"),
        ((graph, groups, t, np.vstack([dual, dual])), "have shapes"),
        ((graph, separate(graph.num_nodes + 1, 3), t, dual), "have shapes"),
        ((graph, groups, np.where(np.arange(len(t))[:, None] == 2, np.nan, t), dual), "must be finite"),
        ((graph, groups, t, dual + np.inf), "must be finite"),
        ((inner, groups, t, dual[inside]), "no pair joins two groups"),
        ((graph, groups, t + 1e-3 * np.eye(len(t), 3), dual), "not those of rigid groups"),
        ((graph, groups, -t, dual), "L\\(T\\) <= 0"),
    ):
        with pytest.raises(InputError, match=message):
            certify(refused[0], *refused[2:], groups=refused[1])
    with pytest.raises(UnsolvableError, match="no pair joins two groups"):
        solve(inner, groups=groups)


def test_what_is_not_certified_is_not_called_converged_and_iterations_are_told_and_cancelled():
    graph, groups, _ = rig_problem(6, noise=0.02)
    seen = []
    whole = solve(graph, groups=groups, on_iteration=seen.append)
    assert [info.iteration for info in seen] == list(range(1, whole.iterations + 1))
    assert seen[-1].objective - seen[-1].dual_bound == pytest.approx(whole.gap, abs=1e-10)
    assert {info.limit for info in seen} == {100}
    cancelled = solve(graph, groups=groups, on_iteration=lambda info: info.iteration < 2)
    assert (cancelled.status, cancelled.iterations) == (Status.CANCELLED, 2)
    early = solve(graph, SolverOptions(max_iterations=2), groups=groups)
    assert (early.status, early.iterations) == (Status.MAX_ITERATIONS, 2)
    assert early.gap > SolverOptions().tol


def test_the_options_hold_over_groups_or_are_refused_in_a_sentence():
    graph, groups, _ = rig_problem(6, noise=0.02)
    result = solve(graph, groups=groups)
    conic = solve(graph, SolverOptions(solver="conic"), groups=groups)
    assert (result.method, conic.method) == ("newton", "conic")
    assert conic.objective == pytest.approx(result.objective, abs=2e-8)
    for other in (SolverOptions(), SolverOptions(threads=2), SolverOptions(solver="newton")):
        again = solve(graph, other, groups=groups)
        np.testing.assert_array_equal(again.locations, result.locations)
        np.testing.assert_array_equal(again.dual, result.dual)
    with pytest.raises(InputError, match="have no solver admm"):
        solve(graph, SolverOptions(solver="admm"), groups=groups)
    with pytest.raises(UnsolvableError, match="takes 0 MB, and only 0 MB are allowed"):
        Reduction.over(outer(graph, groups)[0].edges, groups, max_bytes=1000)


def test_a_group_that_one_pair_holds_hangs_free_two_pairs_hold_it_and_without_offsets_nothing_is_tied():
    graph, groups, _ = rig_problem(9, frames=6, share=1.0)
    ends = groups.group_of[graph.edges]
    to_last = np.flatnonzero((ends == 5).any(axis=1) & (ends[:, 0] != ends[:, 1]))
    sizes = np.bincount(groups.group_of)
    for count, expected in ((1, 5), (2, 6)):
        # Pairs of different sensors: in three dimensions two directions fix a group whose scale is known.
        kept = np.setdiff1d(np.arange(graph.num_edges), np.delete(to_last, [0, 7][:count]))
        assert len(largest_tied(graph.edges[kept], groups, sizes)) == expected
    flat = RigidGroups(group_of=groups.group_of, offsets=np.zeros_like(groups.offsets))
    assert len(largest_tied(graph.edges, flat, sizes)) == 1


def test_the_set_around_a_group_is_found_even_where_another_is_larger():
    first, groups, _ = rig_problem(11, frames=5, share=1.0)
    second = rig_problem(12, frames=3, share=1.0)[0]
    n = first.num_nodes
    edges = np.concatenate([first.edges, second.edges + n])
    both = RigidGroups(
        group_of=np.repeat(np.arange(8), 3),
        offsets=np.concatenate([groups.offsets, rig_problem(12, frames=3)[1].offsets]),
    )
    sizes = np.full(8, 3)
    np.testing.assert_array_equal(largest_tied(edges, both, sizes), range(5))
    np.testing.assert_array_equal(largest_tied(edges, both, sizes, around=6), [5, 6, 7])


def test_at_straight_baselines_the_test_at_the_solution_sees_what_the_general_one_does_not():
    # Two frames, displaced along the line on which both sensors of each stand: all directions are equal.
    groups = RigidGroups(group_of=[0, 0, 1, 1], offsets=[[0, 0, 0], [1, 0, 0], [0, 0, 0], [1, 0, 0]])
    t = groups.expand(np.array([[0.0, 0, 0], [5, 0, 0], [1, 0, 0]]))
    edges = np.array([[0, 2], [0, 3], [1, 2], [1, 3]])
    sizes = np.array([2, 2])
    assert len(largest_tied(edges, groups, sizes)) == 2
    assert len(largest_tied(edges, groups, sizes, t)) == 1


def test_lud_over_groups_stays_with_them_near_the_truth_and_over_single_nodes_is_lud():
    graph, groups, t = rig_problem(14, frames=12)  # whose optimum of LUD is exact
    locations = lud_over(outer(graph, groups)[0], groups)
    x, apart = groups.fit(locations)
    assert apart < 1e-9 * np.abs(locations).max()
    errors = np.linalg.norm(locations / groups.split(x)[1] - centered(t), axis=1)
    assert np.median(errors) < 0.02 * np.median(np.linalg.norm(centered(t), axis=1))
    graph, _, _ = rig_problem(14, noise=0.05)

    def value(t):
        baselines = differences(t, graph.edges)
        lengths = np.maximum(along(baselines, graph.directions), 1.0)
        return graph.weights @ np.linalg.norm(baselines - lengths[:, None] * graph.directions, axis=1)

    least = value(solve_lud(graph, 2000, tol=1e-9).locations)
    ours = value(lud_over(graph, separate(graph.num_nodes, 3), 1500))
    assert ours == pytest.approx(least, rel=1e-5)


def test_the_placement_has_the_errors_that_it_states():
    noise, errors, stated = 0.003, [], []
    for seed in range(3):
        graph, groups, t = rig_problem(20 + seed, frames=20, noise=noise, share=0.3)
        placed = place(MeasuredGraph(graph, groups=groups))
        errors.append(centered(placed.locations / placed.unit) - centered(t))
        stated.append(placed.assessment.sigmas / placed.unit)
        assert placed.refined.finish.refined
        assert placed.assessment.trust.min() > 0.9
        assert groups.fit(placed.locations)[1] < 1e-9
    rms, said = (float(np.sqrt(np.mean(np.square(x)))) for x in (errors, stated))
    # 180 coordinates, not independent within a frame: 60 give the ratio to about 10 %, twice that is allowed.
    assert 0.8 < rms / said < 1.25


def test_a_frame_whose_pairs_are_wrong_is_not_trusted_as_a_whole():
    graph, groups, _ = rig_problem(30, frames=10, wrong=0.05, noise=0.002)
    rng = np.random.default_rng(0)
    v = graph.directions.copy()
    touched = (groups.group_of[graph.edges] == 4).any(axis=1)
    v[touched] = normalized(rng.normal(size=v.shape))[touched]
    placed = place(MeasuredGraph(ViewGraph(graph.num_nodes, graph.edges, v, graph.weights), groups=groups))
    trust = placed.assessment.trust
    spoilt = groups.group_of[placed.cameras] == 4
    assert len(set(trust[spoilt])) == 1  # one judgement for all cameras of a frame
    assert trust[spoilt].max() < 0.5
    assert trust[~spoilt].min() > 0.9


def test_fixed_nodes_keep_their_shape_and_the_others_find_their_scale():
    rng = np.random.default_rng(5)
    t = 3.0 * rng.normal(size=(24, 3)) + [1e4, 0.0, 0.0]  # far from the origin, as in a national grid
    edges = np.stack(np.triu_indices(24, 1), axis=1)
    edges = edges[rng.random(len(edges)) < 0.5]
    v = normalized(normalized(t[edges[:, 0]] - t[edges[:, 1]]) + 0.002 * rng.normal(size=(len(edges), 3)))
    wrong = rng.random(len(edges)) < 0.2
    v[wrong] = normalized(rng.normal(size=v.shape))[wrong]
    fixed = np.arange(24) < 8
    placed = place(
        MeasuredGraph(ViewGraph(24, edges, v), groups=separate(24, 3).with_fixed(fixed, t), fixed_group=0)
    )
    still = fixed[placed.cameras]
    found = placed.locations / placed.unit
    found = found + (t[placed.cameras][still] - found[still]).mean(axis=0)
    errors = np.linalg.norm(found - t[placed.cameras], axis=1)
    assert errors[still].max() < 1e-9  # roundings of numbers of 1e4
    assert errors.max() < 0.05  # 2e-3 rad over 5, with several pairs each
    assert placed.certified.gap <= 1e-8
    # Variances that cancel leave their rounding, and its root is 1e-8.
    assert placed.assessment.sigmas[still].max() < 1e-6 * placed.assessment.sigmas[~still].min()


def test_offsets_that_the_directions_contradict_are_an_error_not_a_scale():
    graph, groups, _ = rig_problem(14, wrong=0.0)
    mirrored = RigidGroups(group_of=groups.group_of, offsets=-groups.offsets)
    with pytest.raises(UnsolvableError, match="contradict the known offsets"):
        place(MeasuredGraph(graph, groups=mirrored))


def test_where_four_of_five_pairs_are_wrong_groups_are_placed_at_the_weights_of_a_posterior():
    graph, groups, t = rig_problem(50, frames=16, wrong=0.8, noise=0.002, share=0.6)
    placed = place(MeasuredGraph(graph, groups=groups))
    assert placed.refined.finish.start == "reweighted ShapeFit"
    assert placed.refined.reweighted.solved.gap < 1e-7
    assert groups.fit(placed.locations)[1] < 1e-9
    errors = np.linalg.norm(centered(placed.locations / placed.unit) - centered(t), axis=1)
    assert np.median(errors) < 0.03  # the usual answer: 0.57
