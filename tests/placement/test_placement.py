"""A view graph placed: piece, solve and verdicts belong together row by row, in any dimension."""

import dataclasses

import numpy as np
import pytest

from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.commands.place import place
from sfm_shapefit.facts.rows import camera_rows, pair_rows
from sfm_shapefit.facts.warnings import quality_warnings
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.graph_grade import judge_graph
from sfm_shapefit.judgement.judged import judge
from sfm_shapefit.placement.place import Placement, place_pieces
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.solver.program import differences
from sfm_shapefit.synthetic import random_graph_problem
from tests.problems import all_pairs


def two_pieces():
    """Five cameras 0-4 after three cameras 4-6 hinged at 4; the small piece's edges come first."""
    t = np.random.default_rng(0).standard_normal((7, 3))
    edges = np.array([(4, 5), (4, 6), (5, 6), *all_pairs(5)])
    return t, edges, normalized(differences(t, edges))


@pytest.mark.parametrize("d", [2, 3])
def test_every_dimension_is_placed_and_judged(d):
    problem = random_graph_problem(24, 0.9, d=d, sigma=1e-3, q=0.1, seed=d)
    placement = place(problem.view_graph)
    outliers = ~placement.assessment.inliers
    assert outliers[problem.corrupted].all()
    # The solution is a little off where a camera has few good pairs, and then so are one or two of them.
    assert outliers[~problem.corrupted].sum() <= 2
    assert placement.assessment.sigmas.shape == (24, d)
    assert np.isfinite(placement.assessment.sigmas).all()


def test_covariances_belong_to_the_pairs_of_the_solved_piece():
    _, edges, v = two_pieces()
    bent = 5  # the third edge of the large piece
    v[bent] = normalized(v[bent] + 0.05 * np.cross(v[bent], v[bent + 1]))
    graph = ViewGraph(7, edges, v)
    sharp = np.tile((1e-3) ** 2 * np.eye(2), (len(edges), 1, 1))
    soft = sharp.copy()
    soft[bent] = 0.1**2 * np.eye(2)
    # The pair is wrong by 50 of its own sigmas, or by half of one.
    assert place(MeasuredGraph(graph, covariance=sharp)).rejected_pairs.tolist() == [edges[bent].tolist()]
    assert len(place(MeasuredGraph(graph, covariance=soft)).rejected_pairs) == 0


def test_rows_speak_of_the_whole_graph():
    t, edges, v = two_pieces()
    graph = ViewGraph(7, edges, v, names=[f"image{k}" for k in range(7)])
    placement = place(graph)
    rows = camera_rows(placement, placement.certified.locations, 2.0)
    assert [row.placed for row in rows] == [True] * 5 + [False] * 2
    assert [row.piece for row in rows] == [0] * 5 + [1, 1]
    assert rows[5].reason == "another rigid piece, hinged at image4"
    assert rows[0].sigma == pytest.approx(tuple(2.0 * placement.assessment.sigmas[0]))
    (x, y, z), (xy, xz, yz) = rows[0].sigma, rows[0].correlation
    covariance = [
        [x * x, xy * x * y, xz * x * z],
        [xy * x * y, y * y, yz * y * z],
        [xz * x * z, yz * y * z, z * z],
    ]
    np.testing.assert_allclose(covariance, 4.0 * placement.covariances[0], rtol=1e-9)
    pairs = pair_rows(placement, np.arange(len(edges)))
    assert [row.verdict for row in pairs] == ["undetermined"] * 3 + ["inlier"] * 10
    assert [row.support for row in pairs] == list(range(13))
    for row, (i, j) in zip(pairs, edges, strict=True):
        assert (row.name1, row.name2) == (f"image{i}", f"image{j}")
        np.testing.assert_allclose(row.direction, normalized(t[i] - t[j]), atol=1e-12)


def pieces_of(graph: ViewGraph) -> list[Placement]:
    return list(place_pieces(MeasuredGraph(graph), PlacementOptions()))


def test_further_pieces_are_solved_each_by_its_own_edges():
    t, edges, v = two_pieces()
    bent = 5  # in the large piece: the small one knows nothing of it
    v[bent] = normalized(v[bent] + 0.3 * np.cross(v[bent], v[bent + 1]))
    placement, further = (judge(piece, PlacementOptions()) for piece in pieces_of(ViewGraph(7, edges, v)))
    assert (further.piece, further.cameras.tolist(), further.edges.tolist()) == (1, [4, 5, 6], [0, 1, 2])
    found, true = further.locations, t[4:] - t[4:].mean(axis=0)
    scale = np.sum(found * true) / np.sum(true * true)
    np.testing.assert_allclose(found, scale * true, atol=1e-6 * scale)
    rows = camera_rows(placement, placement.locations, 1.0, [further])
    assert rows[5].reason == "another rigid piece, hinged at camera 4; see pieces/1"
    verdicts = [row.verdict for row in pair_rows(placement, np.zeros(13, dtype=int), [further])]
    assert verdicts[0] != "outlier"
    assert verdicts[bent] == "outlier"


def test_a_piece_that_no_scale_fits_is_left_out_and_a_graph_without_a_triangle_is_refused():
    _, edges, v = two_pieces()
    v[:3] = [[1.0, 0, 0], [-1.0, 0, 0], [1.0, 0, 0]]  # (4, 5), (4, 6), (5, 6): they cancel at every camera
    (placement,) = pieces_of(ViewGraph(7, edges, v))
    assert placement.cameras.tolist() == [0, 1, 2, 3, 4]
    with pytest.raises(UnsolvableError, match="no three cameras"):
        place(ViewGraph(4, [(0, 1), (1, 2), (2, 3)], np.eye(3)))


def test_directions_that_do_not_fit_together_and_mostly_contradicting_pairs_raise_the_alarm():
    noise, clean = (random_graph_problem(14, 1.0, sigma=1e-4, q=q, seed=3).view_graph for q in (1.0, 0.0))
    assert "degrees off the cameras" in judge_graph(place(noise)).statement
    placement = place(clean)
    assert list(quality_warnings(placement)) == []
    few = dataclasses.replace(placement.agreement, agrees=np.arange(clean.num_edges) % 3 == 0)
    for off_deg, warned in ((0.05, False), (5.0, True)):  # by a twentieth of a degree nothing contradicts
        residuals_deg = np.full(clean.num_edges, off_deg)
        assessment = dataclasses.replace(placement.assessment, residuals_deg=residuals_deg)
        doubted = dataclasses.replace(placement, agreement=few, assessment=assessment)
        told = [one for one in quality_warnings(doubted) if "66% of the pairs contradict the solution" in one]
        assert bool(told) == warned
