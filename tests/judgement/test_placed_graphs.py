"""The verdict of bare graphs: where directions alone cannot tell, `place` says so and names the cameras."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sfm_shapefit import ViewGraph, place
from sfm_shapefit.base.geometry import fit_similarity_l1
from sfm_shapefit.judgement.few_ties import barely_held, find_few_ties
from sfm_shapefit.judgement.reasons import Grade
from sfm_shapefit.placement.second_configuration import Found, find_fold, find_rival
from sfm_shapefit.refinement.starts import Rival
from sfm_shapefit.synthetic import random_graph_problem
from tests.program import run

NOISE_RAD = 0.003


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def graph_of(centers, pairs, others, rng):
    """Return the graph of the directions from `others` (m, 3) to the first camera of each pair, noisy."""
    directions = unit(centers[pairs[:, 0]] - others)
    return ViewGraph(len(centers), pairs, unit(directions + NOISE_RAD * rng.normal(size=others.shape)))


def corridor(share, seed, num_cameras=80, period=8.0, reach=10):
    """Return a bent corridor whose segments repeat: a share of the second cameras is seen a period off."""
    rng, along = np.random.default_rng(seed), np.arange(num_cameras) / 40.0
    centers = 40.0 * np.column_stack([np.sin(along), np.cos(along), 0.0 * along])
    centers += 0.3 * rng.normal(size=centers.shape)
    pairs = np.array([(i, j) for i in range(num_cameras) for j in range(i + 1, min(i + reach, num_cameras))])
    tangents = np.column_stack([np.cos(along), -np.sin(along), 0.0 * along])[pairs[:, 1]]
    shifts = rng.choice([-period, period], len(pairs)) * (rng.random(len(pairs)) < share)
    return graph_of(centers, pairs, centers[pairs[:, 1]] + shifts[:, None] * tangents, rng), centers


def four_sides(share, seed, num_cameras=60):
    """Return a ring about a scene of four equal sides: a share of cameras is seen on the wrong one."""
    rng = np.random.default_rng(seed)
    angles = 2.0 * np.pi * (np.arange(num_cameras) + rng.uniform(-0.3, 0.3, num_cameras)) / num_cameras
    centers = np.column_stack(
        [10.0 * np.cos(angles), 10.0 * np.sin(angles), 2.0 * rng.normal(size=num_cameras)]
    )
    pairs = np.column_stack(np.triu_indices(num_cameras, 1))
    apart = pairs[:, 1] - pairs[:, 0]
    near = np.minimum(apart, num_cameras - apart) <= num_cameras // 3
    pairs = pairs[near & (rng.random(len(pairs)) < 0.6)]
    sides = np.arange(num_cameras) * 4 // num_cameras
    quarters = np.where(rng.random(len(pairs)) < share, sides[pairs[:, 0]] - sides[pairs[:, 1]], 0)
    flat = centers[pairs[:, 1], :2] @ np.array([1.0, 1.0j]) * 1j**quarters
    seen = np.column_stack([flat.real, flat.imag, centers[pairs[:, 1], 2]])
    return graph_of(centers, pairs, seen, rng), quarters == 0


def crossing_streets(share, seed):
    """Return six streets of 13 cameras that cross; the noise of their pairs differs, a share is random."""
    rng, along = np.random.default_rng(seed), np.arange(13.0)
    streets = [np.column_stack([along, np.full(13, 6.0 * k), 0.0 * along]) for k in range(3)]
    centers = np.concatenate([street[:, axes] for street in streets for axes in ([0, 1, 2], [1, 0, 2])])
    centers += np.array([0.1, 0.1, 0.05]) * rng.normal(size=centers.shape)
    pairs = np.column_stack(np.triu_indices(len(centers), 1))
    is_one_street = pairs[:, 0] // 13 == pairs[:, 1] // 13
    lengths = np.linalg.norm(centers[pairs[:, 0]] - centers[pairs[:, 1]], axis=1)
    pairs = pairs[lengths < np.where(is_one_street, 4.5, 2.2)]
    noise = 0.003 * np.exp(rng.normal(size=(len(pairs), 1))) * rng.normal(size=(len(pairs), 3))
    directions = unit(unit(centers[pairs[:, 0]] - centers[pairs[:, 1]]) + noise)
    is_wrong = rng.random(len(pairs)) < share
    directions[is_wrong] = unit(rng.normal(size=(is_wrong.sum(), 3)))
    return ViewGraph(len(centers), pairs, directions), centers


def test_corridors_most_of_whose_pairs_are_a_segment_off_are_not_good_and_two_explanations_are_told():
    seen = [place(corridor(0.6, seed)[0]) for seed in range(5)]
    assert Grade.GOOD not in [placed.verdict.grade for placed in seen]
    doubled = [one for one in seen if one.second_configuration is not None]
    assert len(doubled) >= 2  # four today; in the others both starts lead to one place, most of it uncertain
    for placed in doubled:
        second = placed.second_configuration
        assert (second.found, placed.verdict.grade) == (Found.BY_A_START, Grade.DO_NOT_USE)
        assert "another placement explains the pairs nearly as well" in placed.verdict.reasons
        told = f"{second.num_pairs} pairs fit another placement of 80 cameras and not this one, which"
        assert sum(told in warning for warning in placed.warnings) == 1


@pytest.mark.parametrize(
    ("alone", "against", "is_rival"), [(60, 100, True), (100, 60, True), (40, 100, False)]
)
def test_another_end_is_a_rival_where_it_explains_more_than_half_as_many_pairs_alone(
    alone, against, is_rival
):
    problem = random_graph_problem(20, 1.0, sigma=0.01, seed=4)
    refined, m = place(problem.view_graph).refined, len(problem.edges)
    kept, theirs = np.arange(m) >= alone, (np.arange(m) < alone) | (np.arange(m) >= alone + against)
    end = SimpleNamespace(posterior=theirs.astype(float))
    for is_apart, found in ((True, is_rival), (False, False)):
        other = Rival(end=end, is_apart=is_apart, behind=0.0)
        both = replace(refined, posterior=kept.astype(float), rivals=(other,))
        rival = find_rival(both)
        assert (rival is not None) == found
        assert not found or (rival.num_pairs, rival.num_against) == (alone, against)


@pytest.mark.parametrize(("seed", "is_bad"), [(5, True), (10, True), (13, True), (8, False), (36, False)])
def test_where_streets_stand_is_doubted_where_another_start_ends_nearly_as_well(seed, is_bad):
    graph, centers = crossing_streets(0.45, seed)
    placed = place(graph)
    fitted = fit_similarity_l1(placed.locations, centers[placed.cameras], rotate=False, cap=20.0)
    apart = np.linalg.norm(fitted.apply(placed.locations) - centers[placed.cameras], axis=1)
    assert (np.median(apart) > 0.03 * 17.0) == is_bad  # of the diagonal of the town
    assert placed.verdict.is_bad == is_bad
    assert (placed.second_configuration is not None) == is_bad


@pytest.mark.parametrize(("noise", "is_known"), [(0.003, False), (0.0, True)])
def test_where_two_of_many_rays_meet_a_camera_is_known_only_if_chance_could_not_do_that(noise, is_known):
    """Camera 0 is seen by 21 others: two agree on one place, as of any 21 two do within the noise."""
    rng = np.random.default_rng(3)
    centers = rng.normal(size=(40, 3))
    pairs = np.column_stack(np.triu_indices(40, 1))
    pairs = pairs[(pairs[:, 0] > 0) | (pairs[:, 1] <= 21)]
    directions = unit(centers[pairs[:, 0]] - centers[pairs[:, 1]])
    directions = unit(directions + noise * rng.normal(size=directions.shape))
    directions[2:21] = unit(rng.normal(size=(19, 3)))
    placed = place(ViewGraph(40, pairs, directions))
    assert np.isfinite(placed.covariances[1:]).all()
    assert np.isfinite(placed.covariances[0]).all() == is_known


@pytest.mark.parametrize("seed", range(3))
def test_a_fifth_of_such_pairs_casts_no_doubt(seed):
    assert place(corridor(0.2, seed)[0]).verdict.grade is Grade.GOOD


def test_a_placement_is_a_fold_where_triangles_speak_for_most_of_what_it_rejects():
    graph, is_right = four_sides(0.4, 0)
    assert place(graph).verdict.grade is Grade.GOOD
    assert find_fold(graph, is_right) is None
    sides = graph.edges * 4 // graph.num_nodes
    inside = sides[:, 0] == sides[:, 1]  # a fold explains these pairs, and those between sides that are wrong
    fold = find_fold(graph, inside | ~is_right)
    assert (fold.found, fold.is_as_good) == (Found.BY_TRIANGLES, True)
    assert fold.num_pairs > 0.9 * np.sum(is_right & ~inside)
    noise = random_graph_problem(40, 0.6, q=0.5, seed=1)  # half of the pairs wrong at random
    assert find_fold(noise.view_graph, ~noise.corrupted) is None


def test_a_straight_line_of_cameras_whose_spacing_nothing_holds_is_not_to_be_used():
    rng = np.random.default_rng(0)
    centers = np.column_stack([np.arange(40.0) + rng.uniform(-0.4, 0.4, 40), 1e-3 * rng.normal(size=(40, 2))])
    pairs = np.array([(i, j) for i in range(40) for j in range(i + 1, min(i + 6, 40))])
    verdict = place(graph_of(centers, pairs, centers[pairs[:, 1]], rng)).verdict
    assert verdict.is_bad
    assert "cameras uncertain by more than 5% of the extent" in verdict.statement


def two_parts_and_one():
    """Return a graph of two dense parts of 15 cameras, tied by two pairs, and of one camera held one way."""
    rng = np.random.default_rng(5)
    centers = rng.normal(size=(31, 3))
    centers[15:30] += [6.0, 0.0, 0.0]
    centers[30] = centers[0] + [0.0, 0.0, 40.0]
    within = np.column_stack(np.triu_indices(15, 1))
    pairs = np.concatenate([within, within + 15, [(0, 15), (7, 22)], [(k, 30) for k in range(5)]])
    return graph_of(centers, pairs, centers[pairs[:, 1]], rng)


def test_cameras_that_few_pairs_tie_to_the_rest_are_named_with_their_uncertainty():
    graph = two_parts_and_one()
    placed = place(graph)
    assert placed.agreement.agrees.all()
    (part,) = find_few_ties(graph.num_nodes, graph.edges)
    assert part.num_pairs == 2
    assert part.cameras.tolist() == list(range(15, 30))  # the other part has one more camera
    held = barely_held(graph.num_nodes, graph.edges, graph.directions)
    assert np.flatnonzero(held).tolist() == [30]
    sentences = {one.images: one.sentence for one in placed.verdict.findings}
    tied = next(text for names, text in sentences.items() if len(names) == 15)
    assert tied.startswith("only 2 agreeing pairs tie 15 cameras to the rest, whose place is known to ± ")
    assert any("fewer than three of its agreeing pairs differ" in text for text in sentences.values())
    assert {graph.name_of(k) for k in range(15, 31)} <= set(placed.verdict.cameras)


def test_bridges_cuts_of_two_edges_and_separate_parts_are_found_and_no_others():
    ring = [(k, (k + 1) % 8) for k in range(8)]
    complete = [(i, j) for i in range(10, 15) for j in range(i + 1, 15)]
    assert [len(few.cameras) for few in find_few_ties(15, np.array(complete))] == []  # lone nodes apart
    (tail,) = find_few_ties(15, np.array(complete + ring + [(0, 10)]))
    assert (tail.cameras.tolist(), tail.num_pairs) == (list(range(8)), 1)
    (apart,) = find_few_ties(15, np.array(complete + ring))
    assert apart.num_pairs == 0
    assert find_few_ties(15, np.array(complete + ring + [(k, 10 + k % 5) for k in range(8)])) == []


def test_place_has_positions_of_all_nodes_a_verdict_and_warnings_in_python_and_on_the_command_line(tmp_path):
    problem = random_graph_problem(12, p=0.8, sigma=0.01, seed=1)
    edges = np.concatenate([problem.edges, [[0, 12]]])  # one pair does not place camera 12
    graph = ViewGraph(13, edges, np.concatenate([problem.directions, [[1.0, 0.0, 0.0]]]))
    placed = place(graph)
    assert placed.positions.shape == (13, 3)
    np.testing.assert_array_equal(placed.positions[placed.cameras], placed.locations)
    assert np.flatnonzero(np.isnan(placed.positions).any(axis=1)).tolist() == [12]
    assert placed.summary()["verdict"] == placed.verdict.statement
    lines = [
        f"{i} {j} {x!r} {y!r} {z!r}"
        for (i, j), (x, y, z) in zip(edges.tolist(), graph.directions.tolist(), strict=True)
    ]
    (tmp_path / "graph.txt").write_text("\n".join(lines) + "\n")
    told = json.loads(run("place", tmp_path / "graph.txt", tmp_path / "out", "--json", "--no-report").stdout)
    assert told["verdict"]["grade"] == placed.verdict.grade
    assert told["warnings"] == list(placed.warnings)
