"""Placing in pieces comes close to placing whole, says what it proves, and never tears the map silently."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.laplacian import partition as partitioning
from sfm_shapefit.laplacian.operators import adjacency
from sfm_shapefit.laplacian.partition import partition
from sfm_shapefit.placement import partitioned
from sfm_shapefit.placement.partitioned import (
    PieceSolution,
    choose_pieces,
    merge,
    place_partitioned,
    solve_piece,
)
from sfm_shapefit.placement.place import place
from sfm_shapefit.refinement.angular import Metric, plan_refinement, refine_angles
from sfm_shapefit.refinement.cg_normal_solver import IterativeNormal
from sfm_shapefit.refinement.options import PlacementOptions
from sfm_shapefit.solver.options import Status
from sfm_shapefit.synthetic import box_graph_problem, random_graph_problem
from sfm_shapefit.viewgraph import ViewGraph

SMALL = PlacementOptions(factor_memory=1)  # MB, less than any graph here takes


def graph_of(problem) -> ViewGraph:
    return ViewGraph(len(problem.locations), problem.edges, problem.directions)


def error(found, truth) -> float:
    """Return the distance from the truth after shift and scale, relative to its size."""
    a, b = (x - x.mean(axis=0) for x in (found, truth))
    a *= np.sum(a * b) / np.sum(a * a)
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


@pytest.fixture(scope="module")
def box():
    return box_graph_problem(600, 24.0, 0.01, 0.2, seed=1)


def test_pieces_refined_together_are_as_exact_as_the_whole(box):
    graph = graph_of(box)
    with ThreadPoolExecutor(2) as executor:
        found = place(graph, SMALL, executor=executor)
    whole = place(graph)
    assert found.solve.status is Status.IN_PIECES
    assert not found.solve.status.has_certificate
    assert "4 of them merged" in found.solve.method_reason
    assert found.finish.start == "pieces"
    assert found.finish.refined
    assert error(found.locations, box.locations) <= 1.1 * error(whole.locations, box.locations)


def test_an_executor_changes_nothing_where_the_factor_of_the_whole_fits(box):
    graph = graph_of(box)
    with ThreadPoolExecutor(1) as executor:
        found = place(graph, executor=executor)
    assert found.solve.status is Status.CONVERGED
    np.testing.assert_array_equal(found.locations, place(graph).locations)


def test_whole_graphs_are_left_whole(box):
    graph, random = graph_of(box), graph_of(random_graph_problem(300, 0.3, q=0.2, sigma=0.01, seed=1))
    assert choose_pieces(graph, PlacementOptions()) is None  # its factor fits
    assert choose_pieces(random, SMALL) is None  # parts would know too little: most pairs are cut
    assert (
        choose_pieces(graph, replace(SMALL, objective="shapefit")) is None
    )  # has a certificate of the whole
    assert choose_pieces(graph, SMALL) is not None


@pytest.mark.parametrize("by_metis", [True, False])
def test_parts_are_about_equal_and_few_pairs_are_cut(box, by_metis, monkeypatch):
    if by_metis:
        pytest.importorskip("pymetis")
    else:
        monkeypatch.setattr(partitioning, "find_spec", lambda _name: None)
    part_of = partition(adjacency(600, box.edges), 4)
    sizes = np.bincount(part_of)
    assert len(sizes) == 4
    assert sizes.min() > 0.8 * sizes.mean()
    cut = np.mean(part_of[box.edges[:, 0]] != part_of[box.edges[:, 1]])
    assert cut < 0.45  # 0.75 by chance


def solution(cameras, locations) -> PieceSolution:
    return PieceSolution(cameras=cameras, locations=locations, gap=0.0, seconds=0.0)


def test_merging_finds_scales_and_shifts_in_spite_of_wrong_cameras():
    rng = np.random.default_rng(0)
    truth = rng.standard_normal((60, 3))
    parts = [np.arange(0, 30), np.arange(20, 50), np.arange(40, 60)]
    pieces = []
    for k, part in enumerate(parts):
        t = truth[part] * (0.5 + k) + rng.standard_normal(3)
        t[-3:] += 2.0 * rng.standard_normal((3, 3))  # of ten that it shares
        pieces.append(solution(part, t))
    graph = ViewGraph(60, np.array([[0, 1]]), np.array([[1.0, 0.0, 0.0]]))
    merged, num_merged, num_spread = merge(graph, tuple(pieces))
    assert (num_merged, num_spread) == (3, 0)
    right = np.concatenate([np.arange(0, 20), np.arange(30, 37)])
    assert error(merged[right], truth[right]) < 1e-9


def test_pieces_that_share_too_few_cameras_are_not_merged_and_their_cameras_start_at_neighbours():
    rng = np.random.default_rng(1)
    truth = rng.standard_normal((30, 3))
    pieces = tuple(solution(p, truth[p]) for p in (np.arange(0, 20), np.arange(17, 30)))
    edges = np.array([[k, k + 1] for k in range(29)])
    graph = ViewGraph(30, edges, np.tile([1.0, 0.0, 0.0], (29, 1)))
    merged, num_merged, num_spread = merge(graph, pieces)
    assert (num_merged, num_spread) == (1, 10)
    np.testing.assert_array_equal(merged[20], merged[19])  # the neighbour that is placed


def test_a_part_that_falls_apart_is_several_pieces(box):
    graph = graph_of(box)
    along = np.argsort(np.argsort(box.locations[:, 0])) // 120
    found = place_partitioned(graph, np.where(along == 4, 0, along), SMALL)  # both ends are one part
    assert found is not None
    assert len(found.pieces) == found.num_merged == 5
    assert found.num_spread == 0
    assert error(found.finish.locations, box.locations) < 0.0011  # 0.00094 as a whole
    assert max(piece.gap for piece in found.pieces) < 1e-8


def test_where_a_piece_cannot_be_certified_the_whole_is_placed(box, monkeypatch):
    graph, solved = graph_of(box), []

    def loose(task):
        solved.append(task)
        pieces = solve_piece(task)
        return [replace(piece, gap=0.1 if len(solved) == 2 else piece.gap) for piece in pieces]

    monkeypatch.setattr(partitioned, "solve_piece", loose)
    parts = choose_pieces(graph, SMALL)
    assert place_partitioned(graph, parts, SMALL) is None
    assert len(solved) == 2  # the others are not waited for
    solved.clear()
    with ThreadPoolExecutor(1) as executor:
        found = place(graph, SMALL, executor=executor)
    assert found.solve.status is Status.CONVERGED
    assert found.solve.method_reason.endswith("one of them could not be certified")
    np.testing.assert_array_equal(found.locations, place(graph, SMALL).locations)


def test_a_graph_of_which_no_piece_is_rigid_is_refused():
    graph = ViewGraph(3, np.array([[0, 1], [1, 2]]), np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    with pytest.raises(UnsolvableError, match="no piece has four rigid cameras"):
        place_partitioned(graph, np.zeros(3, dtype=np.int64), SMALL)


def test_steps_without_a_factor_end_where_steps_with_one_do(box):
    graph = graph_of(box)
    metric = Metric(None, np.zeros(graph.num_edges, dtype=np.int64))
    rng = np.random.default_rng(2)
    start = box.locations + 0.02 * rng.standard_normal(box.locations.shape)
    exact = refine_angles(graph, start, metric, plan_refinement(graph))
    found = refine_angles(graph, start, metric, IterativeNormal(graph))
    assert found.cost <= 1.001 * exact.cost
    assert error(found.locations, box.locations) < 1.02 * error(exact.locations, box.locations)
