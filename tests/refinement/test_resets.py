"""What the refinement throws out of the scene without the others' agreement comes back; what is far stays."""

import numpy as np
import pytest

from sfm_shapefit.base.geometry import median_spread, normalized
from sfm_shapefit.commands.place import place
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.refinement.angular import KERNEL_WIDTH
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.refinement.resets import find_strays, left_scene, openness, put_back
from sfm_shapefit.refinement.starts import refine_starts
from sfm_shapefit.solver.program import differences
from sfm_shapefit.solver.solve import solve
from sfm_shapefit.synthetic import random_graph_problem
from tests.problems import all_pairs, exact_graph, no_mixture, shape_error

N = 20


def scene(*far: int):
    """A complete graph, its places, and the same with some nodes a hundred times as far away."""
    t = np.random.default_rng(0).standard_normal((N, 3))
    graph = exact_graph(t)
    moved = t.copy()
    moved[list(far)] *= 100.0
    return graph, t, moved


def joining(graph: ViewGraph, *nodes: int):
    """Which pairs have any of the nodes, and which have two of them."""
    count = np.isin(graph.edges, nodes).sum(axis=1)
    return count > 0, count > 1


def found_strays(graph: ViewGraph, start, refined, agreeing, noise_rad=1e-4) -> list[int]:
    noise = np.full(graph.num_edges, noise_rad)
    return find_strays(graph, start, refined, agreeing, noise).tolist()


@pytest.mark.parametrize(("agreed", "found"), [(19, []), (11, []), (9, [4]), (1, [4]), (0, [4])])
def test_a_node_far_away_is_a_stray_unless_most_of_its_pairs_agree(agreed, found):
    graph, t, moved = scene(4)
    of_node, _ = joining(graph, 4)
    agreeing = ~of_node
    agreeing[np.flatnonzero(of_node)[:agreed]] = True  # of 19
    assert found_strays(graph, t, moved, agreeing) == found


@pytest.mark.parametrize("held", [False, True])
def test_strays_do_not_vouch_for_one_another_but_a_group_that_the_rest_holds_stays_whole(held):
    graph, t, moved = scene(4, 5, 6)
    of_nodes, within = joining(graph, 4, 5, 6)
    agreeing = ~of_nodes | within
    if held:
        across = np.flatnonzero(of_nodes & ~within)  # 51 pairs; node 4 alone has few agreeing ones
        agreeing[across] = graph.edges[across].min(axis=1) != 4
    assert found_strays(graph, t, moved, agreeing) == ([] if held else [4, 5, 6])


def test_one_agreeing_pair_holds_no_distance_and_nobody_strays_within_three_radii_of_the_start():
    graph, t, moved = scene(4)
    of_node, _ = joining(graph, 4)
    kept = np.sort(np.concatenate([np.flatnonzero(~of_node), np.flatnonzero(of_node)[:1]]))
    hanging = ViewGraph(N, graph.edges[kept], graph.directions[kept])
    assert found_strays(hanging, t, moved, np.ones(len(kept), dtype=bool)) == [4]
    none = np.zeros(graph.num_edges, dtype=bool)
    assert found_strays(graph, t, t, none) == []
    middle = np.median(t, axis=0)
    last = int(np.argmax(np.linalg.norm(t - middle, axis=1)))
    for share, found in ((2.5, []), (3.5, [last])):
        moved = t.copy()
        moved[last] = middle + share * (t[last] - middle)
        assert found_strays(graph, t, moved, none) == found


def test_scale_and_origin_do_not_matter_to_who_strays_nor_to_where_it_goes():
    graph, t, moved = scene(4)
    of_node, _ = joining(graph, 4)
    assert found_strays(graph, 1e-3 * t + 7.0, 50.0 * moved - 1.0, ~of_node) == [4]
    back = put_back(1e-3 * t + 7.0, 50.0 * moved - 1.0, np.array([4]))
    np.testing.assert_allclose(back, 50.0 * t - 1.0, atol=1e-9)


def test_those_that_stay_say_where_the_others_go_and_nothing_turns():
    t = np.random.default_rng(1).standard_normal((N, 3))
    moved = 2.0 * t
    moved[:12] += 1000.0  # most of them, together
    assert not left_scene(moved, t).any()
    np.testing.assert_allclose(put_back(t, moved, np.arange(12)), 2.0 * t, atol=1e-6)
    turned = t @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.abs(put_back(t, turned, np.array([3]))[3] - turned[3]).max() > 0.1  # directions know the axes


def test_cameras_without_a_right_pair_stay_in_the_scene():
    """A fifth of the cameras have three random directions each, the others a sound graph among them."""
    problem = random_graph_problem(60, 0.5, sigma=0.01, q=0.1, seed=1)
    rng = np.random.default_rng(1)
    loose = 48
    sound = problem.edges.max(axis=1) < loose
    wrong = np.array([(i, j) for j in range(loose, 60) for i in sorted(rng.choice(j, 3, replace=False))])
    edges = np.concatenate([problem.edges[sound], wrong])
    random_ones = normalized(rng.standard_normal((len(wrong), 3)))
    graph = ViewGraph(60, edges, np.concatenate([problem.directions[sound], random_ones]))
    by_mixture = place(graph)
    with no_mixture():
        found = refine_starts(MeasuredGraph(graph), solve(graph), PlacementOptions())
    for locations in (found.locations, by_mixture.locations):
        distances = np.linalg.norm(locations - np.median(locations, axis=0), axis=1)
        # A convex start has all within about 10 median distances here, and 3 times that is allowed.
        assert distances.max() < 30.0 * median_spread(locations)
        assert shape_error(locations[:loose], problem.locations[:loose]) < 0.01
    assert by_mixture.assessment.trust[loose:].max() < 0.05
    assert len(found.reset_nodes) > 0
    assert f"{len(found.reset_nodes)} thrown out of the scene and put back" in found.finish.statement()


def test_a_sound_graph_has_no_strays_and_says_how_many_pairs_changed_sides():
    problem = random_graph_problem(40, 0.5, sigma=0.02, q=0.2, seed=2)
    graph = problem.view_graph
    with no_mixture():
        found = refine_starts(MeasuredGraph(graph), solve(graph), PlacementOptions())
    assert len(found.reset_nodes) == 0
    start = solve(graph).locations if found.finish.start == "ShapeFit" else found.finish.lud.locations
    before, after = (
        np.linalg.norm(normalized(differences(t, graph.edges)) - graph.directions, axis=1)
        < KERNEL_WIDTH * np.radians(found.finish.levels_deg[0])
        for t in (start, found.locations)
    )
    assert found.finish.num_turned_pairs == np.sum(before != after) > 0
    assert (
        f"{found.finish.num_turned_pairs} directions of theirs went from agreeing" in found.finish.statement()
    )
    unrefined = refine_starts(MeasuredGraph(graph), solve(graph), PlacementOptions(refine=False))
    assert (unrefined.finish.num_turned_pairs, len(unrefined.reset_nodes)) == (0, 0)


def test_openness_is_the_error_that_triangulation_makes_at_any_scale_from_either_end():
    """Two rays a either side of their middle and s of noise: s / (sqrt 2 sin a) of their length."""
    for half_angle in (np.pi / 4, 0.1, 1e-3):
        side = np.tan(half_angle)
        t = np.array([[-side, 0.0, 0.0], [side, 0.0, 0.0], [0.0, 0.0, 1.0]])
        found = openness(t, np.array([[0, 2], [1, 2]]), np.array([2]), np.full(2, 0.01))
        error = 0.01 * np.hypot(side, 1.0) / (np.sqrt(2.0) * np.sin(half_angle))
        assert found == pytest.approx([error], rel=1e-6)
    t = np.random.default_rng(3).standard_normal((6, 3)) + np.array([[0, 0, 0]] * 3 + [[9, 0, 0]] * 3)
    edges, noise = np.array([(i, j) for i in range(3) for j in range(3, 6)]), np.linspace(0.01, 0.02, 9)
    found = openness(t, edges, np.array([3, 4, 5]), noise)
    turned = np.where(np.arange(9)[:, None] % 2, edges, edges[:, ::-1])
    other = openness(1e6 * t - 5.0, turned, np.array([3, 4, 5]), 2.0 * noise)
    np.testing.assert_allclose(other, 2.0 * found, rtol=1e-6)


def test_parallel_baselines_and_a_group_around_or_on_a_single_node_leave_distances_open():
    t = np.array([[0.0, 0, 0], [0, 0, 1], [0, 0, 5], [3, 0, 5], [-3, 4, -10]])
    noise = np.full(4, 1e-3)
    assert openness(t, np.array([[0, 2], [1, 2]]), np.array([2]), noise[:2])[0] > 1e3
    group = np.array([2, 3, 4])  # blown up around node 0, in different directions
    assert openness(t, np.array([[0, 2], [0, 3], [0, 4]]), group, noise[:3]).min() > 1e3
    assert openness(t, np.array([[0, 2], [1, 3], [0, 4], [1, 4]]), group, noise).max() < 0.05
    t = np.array([[0.0, 0, 0], [3, 0, 0], [0, 0, 5], [0, 3, 7], [2, 0, 9]])  # and hanging on node 2
    found = openness(t, np.array([[0, 2], [1, 2]]), group, noise[:2])
    assert found[0] < 0.01
    assert found[1:].min() > 1e3


def test_nodes_far_off_in_one_direction_or_around_the_rest_are_held_by_exact_directions_only():
    graph, t, moved = scene(4)  # 19 pairs in a cone of about 0.6 degrees
    everything = np.ones(graph.num_edges, dtype=bool)
    for noise_rad, found in ((1e-3, []), (0.2, [4])):
        assert found_strays(graph, t, moved, everything, noise_rad) == found
    graph, t, moved = scene(*range(12, N))
    moved[12:] *= 1e4
    for noise_rad, found in ((0.01, list(range(12, N))), (1e-9, [])):
        assert found_strays(graph, t, moved, everything, noise_rad) == found


def test_what_hangs_on_a_far_group_far_beyond_it_is_looked_at_by_itself():
    """Two far nodes that all hold, and one a thousand times as far that only these two see."""
    graph, t, moved = scene(4, 5)
    moved[6] = 1e5 * t[6]
    of_node, _ = joining(graph, 6)
    with_two, _ = joining(graph, 4, 5)
    kept = np.flatnonzero(~of_node | with_two)
    hanging = ViewGraph(N, graph.edges[kept], graph.directions[kept])
    agreeing = np.ones(len(kept), dtype=bool)
    assert found_strays(hanging, t, moved, agreeing, 1e-3) == [6]


def hung(t, edges, added, directions, sigma, seed):
    """A graph with noisy directions among known places and given ones to further nodes."""
    rng = np.random.default_rng(seed)
    v = normalized(differences(t, edges) / np.linalg.norm(differences(t, edges), axis=1)[:, None])
    v = np.concatenate([v, directions])
    v = normalized(v + sigma * rng.standard_normal(v.shape))
    return ViewGraph(int(added.max()) + 1, np.concatenate([edges, added]), v)


def flown(placement):
    """Distances from the median, in median distances."""
    t = placement.locations
    return np.linalg.norm(t - np.median(t, axis=0), axis=1) / median_spread(t)


def test_a_group_whose_directions_to_the_rest_are_parallel_within_noise_stays_and_is_not_trusted():
    """As a group of Madrid_Metropolis did, five cameras see the others in one direction, a degree off."""
    problem = random_graph_problem(40, 0.5, sigma=0.01, seed=3)
    rng = np.random.default_rng(3)
    group = rng.standard_normal((5, 3))
    inner = np.array(all_pairs(5))
    outer = np.array([(k, 40 + a) for a in range(5) for k in rng.choice(40, 2, replace=False)])
    directions = np.concatenate(
        [normalized(differences(group, inner)), np.tile([[0.0, 0.0, -1.0]], (len(outer), 1))]
    )
    added = np.concatenate([inner + 40, outer])
    found = place(hung(problem.locations, problem.edges, added, directions, 0.015, seed=3))
    assert len(found.cameras) == 45
    assert flown(found).max() < 100.0  # parallel to 0.5 deg: as far off as that makes them, and no farther
    trust = found.assessment.trust
    assert trust[40:].max() < 0.1
    assert trust[:40].min() > 0.7


def test_a_camera_of_two_nearly_parallel_pairs_stays_and_is_named():
    problem = random_graph_problem(40, 0.5, sigma=0.01, seed=4)
    directions = normalized(np.array([[0.02, 0.0, -1.0], [-0.02, 0.0, -1.0]]))  # each seen from a wrong side
    order = np.argsort(problem.locations[:, 0])
    added = np.array([[order[5], 40], [order[-5], 40]])
    found = place(hung(problem.locations, problem.edges, added, directions, 0.003, seed=4))
    assert flown(found).max() < 30.0
    assert found.assessment.trust[40] < 0.05
    assert found.assessment.reasons[40]
    assert found.assessment.trust[:40].min() > 0.7
