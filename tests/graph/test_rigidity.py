"""Parallel rigidity: verdicts on named graphs, and agreement with the rank of the direction equations."""

import itertools

import numpy as np
import pytest

from sfm_shapefit.base.arrays import frozen
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.graph import rigidity
from sfm_shapefit.graph.rigidity import (
    is_parallel_rigid,
    left_out_reasons,
    parallel_rigid_pieces,
    rigid_pieces,
)
from sfm_shapefit.graph.rigidity.game import Game, contract, play
from sfm_shapefit.graph.viewgraph import ViewGraph
from tests.problems import all_pairs

DIMENSIONS = (2, 3, 4)


def cycle(n):
    return [(k, (k + 1) % n) for k in range(n)]


def ring_of_k4(count):
    """K4s in a ring, each sharing one camera with the next."""
    n = 3 * count
    return complete_union([3 * k, 3 * k + 1, 3 * k + 2, (3 * k + 3) % n] for k in range(count))


def complete_union(groups):
    return sorted({tuple(sorted(pair)) for group in groups for pair in all_pairs(group)})


HINGE = complete_union([[0, 1, 2], [2, 3, 4]])
TWO_K5_ONE_SHARED = complete_union([range(5), range(4, 9)])
TWO_K5 = complete_union([range(5), range(5, 10)])
HINGED_STRIPS = complete_union([range(5), [0, 5, 6], [5, 6, 7], [0, 8, 9], [8, 9, 7]])
K33 = [(i, j) for i in range(3) for j in range(3, 6)]
CUBE = [(a, a | 1 << k) for a in range(8) for k in range(3) if not a >> k & 1]

# Name, cameras, edges, sizes of the pieces in edges (in 3D), largest first.
NAMED_3D = [
    ("one pair", 2, [(0, 1)], [1]),
    ("triangle", 3, cycle(3), [3]),
    ("path of three", 3, [(0, 1), (1, 2)], [1, 1]),
    ("two triangles hinged", 5, HINGE, [3, 3]),
    ("K4 and a pendant", 5, [*all_pairs(4), (1, 4)], [6, 1]),
    ("4-cycle", 4, cycle(4), [4]),
    ("5-cycle", 5, cycle(5), [1] * 5),
    ("two K5 sharing one camera", 9, TWO_K5_ONE_SHARED, [10, 10]),
    ("... and one pair between them", 9, [*TWO_K5_ONE_SHARED, (0, 8)], [21]),
    ("two K5 sharing two cameras", 8, complete_union([range(5), range(3, 8)]), [19]),
    ("two K5 and one bridge", 10, [*TWO_K5, (0, 5)], [10, 10, 1]),
    ("two K5 and two bridges", 10, [*TWO_K5, (0, 5), (1, 6)], [22]),
    ("K33", 6, K33, [9]),
    ("cube", 8, CUBE, [12]),
    ("ring of 3 K4", 9, ring_of_k4(3), [18]),
    ("ring of 4 K4", 12, ring_of_k4(4), [24]),
    ("ring of 5 K4", 15, ring_of_k4(5), [6] * 5),
    # Two strips of triangles that share cameras 0 and 7; the K5 touches both, but at camera 0 only.
    ("K5 hinged to two strips that share two cameras", 10, HINGED_STRIPS, [10, 10]),
    ("two components", 8, [*all_pairs(4), *all_pairs(range(4, 7))], [6, 3]),
]


def random_graph(rng, n, num_edges):
    pairs = np.array(all_pairs(n))
    return pairs[rng.permutation(len(pairs))[: min(num_edges, len(pairs))]]


def null_space(equations, size):
    """Orthonormal basis of the null space; fails if the rank is not clear-cut."""
    _, singular, basis = np.linalg.svd(equations.reshape(-1, size))
    relative = singular / singular[0]
    # Random graphs of at most 13 cameras: true zeros are a few EPS, the rest well above 1e-7.
    assert not ((relative > 1e-12) & (relative < 1e-7)).any(), (
        "the oracle's rank is ambiguous; change its seed"
    )
    return basis[int((relative > 1e-9).sum()) :].T


def oracle_pieces(n, edges, dimension, rng):
    """Pieces as a set of frozensets of edges, from the motions that keep all directions.

    Positions are drawn at random; the motions u with P_e (u_i - u_j) = 0 for all pairs are a null
    space. A pair is implied if all these motions keep its direction. The piece of a pair (i, j) has the
    cameras whose pairs with both i and j are implied.
    """
    t = rng.normal(size=(n, dimension))
    baseline = t[:, None] - t[None, :]

    def direction_equations(i, j):
        v = baseline[i, j] / np.linalg.norm(baseline[i, j])
        return np.eye(dimension) - np.outer(v, v)

    equations = np.zeros((len(edges), dimension, n, dimension))
    for e, (i, j) in enumerate(edges):
        equations[e, :, i] = direction_equations(i, j)
        equations[e, :, j] = -equations[e, :, i]
    motions = null_space(equations, n * dimension).reshape(n, dimension, -1)
    implied = np.eye(n, dtype=bool)
    for i, j in all_pairs(n):
        turned = direction_equations(i, j) @ (motions[i] - motions[j])
        implied[i, j] = implied[j, i] = np.abs(turned).max() < 1e-9
    spanned = [implied[i] & implied[j] for i, j in edges]
    return {frozenset(f for f, (i, j) in enumerate(edges) if on[i] and on[j]) for on in spanned}


def as_sets(label):
    return {frozenset(np.flatnonzero(label == k).tolist()) for k in np.unique(label)}


def graph_of(n, edges, names=None, dimension=3):
    """A view graph with arbitrary directions: generic rigidity does not look at them."""
    directions = np.tile(np.eye(dimension)[0], (len(edges), 1))
    return ViewGraph(n, np.array(edges, dtype=np.int64).reshape(-1, 2), directions, names=names)


@pytest.mark.parametrize("dimension", DIMENSIONS)
@pytest.mark.parametrize(("name", "n", "edges", "sizes"), NAMED_3D, ids=[row[0] for row in NAMED_3D])
def test_named_graphs_agree_with_the_rank_and_fall_into_their_known_pieces(name, n, edges, sizes, dimension):
    label = parallel_rigid_pieces(n, np.array(edges), dimension)
    assert as_sets(label) == oracle_pieces(n, edges, dimension, np.random.default_rng(3))
    if dimension == 3:
        assert np.bincount(label).tolist() == sizes
        is_rigid = len(sizes) == 1 and len(np.unique(edges)) == n
        assert is_parallel_rigid(n, np.array(edges), 3) == is_rigid


@pytest.mark.parametrize("dimension", [2, 3, 4, 5, 7, 10])
def test_a_cycle_is_rigid_up_to_one_camera_more_than_dimensions(dimension):
    for n in range(3, dimension + 2):
        assert is_parallel_rigid(n, np.array(cycle(n)), dimension)
    flexible = np.array(cycle(dimension + 2))
    assert not is_parallel_rigid(dimension + 2, flexible, dimension)
    assert len(np.unique(parallel_rigid_pieces(dimension + 2, flexible, dimension))) == dimension + 2


@pytest.mark.parametrize("dimension", [2, 3, 10])
def test_a_ring_of_triangles_is_rigid_up_to_one_body_more_than_dimensions(dimension):
    for count in (dimension + 1, dimension + 2):
        n = 2 * count
        edges = complete_union([2 * k, 2 * k + 1, (2 * k + 2) % n] for k in range(count))
        label = parallel_rigid_pieces(n, np.array(edges), dimension)
        assert len(np.unique(label)) == (1 if count == dimension + 1 else count)


@pytest.mark.parametrize("dimension", DIMENSIONS)
def test_pieces_of_random_graphs_and_of_bodies_joined_at_random_agree_with_the_rank(dimension):
    rng = np.random.default_rng(100 + dimension)
    num_pieces = []
    for k in range(70):
        n = int(rng.integers(4, 14))
        if k < 50:  # from trees to well past rigid: a rigid graph has (d n - d - 1) / (d - 1) pairs or more
            edges = random_graph(rng, n, int(rng.integers(n - 1, 2 * n + 3)))
        else:
            groups = [rng.choice(n, size=int(rng.integers(2, 5)), replace=False).tolist() for _ in range(7)]
            edges = np.array(complete_union(groups))
        label = parallel_rigid_pieces(n, edges, dimension)
        pieces = oracle_pieces(n, edges.tolist(), dimension, rng)
        assert as_sets(label) == pieces
        is_rigid = len(pieces) == 1 and len(np.unique(edges)) == n
        assert is_parallel_rigid(n, edges, dimension) == is_rigid
        num_pieces.append(len(pieces))
    assert min(num_pieces) == 1  # the draw holds rigid graphs ...
    assert max(num_pieces) > 5  # ... and loose ones


def local_graph(rng, n, dimension, span):
    """Pairs of cameras at most `span` apart, about as many as rigidity needs: many pieces, many hinges."""
    per_camera = dimension / (dimension - 1) * rng.uniform(0.8, 1.6)
    first = rng.integers(n, size=int(n * per_camera))
    last = (first + rng.integers(1, span + 1, size=len(first))) % n
    return np.unique(np.sort(np.column_stack([first, last]), axis=1), axis=0)


def by_pebbles_alone(n, edges, dimension):
    """Return a label for each pair by the game on all bare pairs, without growth or smaller games."""
    set_of, is_settled = np.arange(len(edges)), False
    while not is_settled:
        united, is_settled = play(contract(n, frozen(edges), set_of, n, dimension), dimension)
        set_of = united[set_of]
    return set_of


@pytest.mark.parametrize("dimension", [2, 3, 4, 10])
@pytest.mark.parametrize(("n", "span"), [(200, 5), (200, 20), (200, 199), (700, 20)])
def test_the_shortcuts_change_nothing(dimension, n, span):
    """Of more than 500 nodes, some are left out of the first game."""
    rng = np.random.default_rng([dimension, span])
    for _ in range(12 if n == 200 else 3):
        edges = local_graph(rng, n, dimension, span)
        found = parallel_rigid_pieces(n, edges, dimension)
        assert as_sets(found) == as_sets(by_pebbles_alone(n, edges, dimension))


def random_pairs(rng, n, m):
    """Return m different pairs of n cameras, each in a random order; read-only, as those of a graph are."""
    pairs = rng.permutation(np.array(all_pairs(n)))[:m]
    return frozen(np.where(rng.random((m, 1)) < 0.5, pairs, pairs[:, ::-1]))


@pytest.mark.parametrize("seed", range(4))
def test_edges_are_joined_by_triangles_exactly_where_a_chain_of_them_leads(seed):
    n, m = 12, 22
    edges = random_pairs(np.random.default_rng(seed), n, m)
    number = {frozenset(pair): e for e, pair in enumerate(edges.tolist())}
    chain = np.arange(m)
    for triangle in itertools.combinations(range(n), 3):
        sides = [number.get(frozenset(pair), -1) for pair in all_pairs(triangle)]
        if min(sides) >= 0:
            chain[np.isin(chain, chain[sides])] = chain[sides].min()
    np.testing.assert_array_equal(chain, rigidity.growth.triangle_sets(n, edges))
    assert 1 < len(np.unique(chain)) < m


def test_a_triangle_free_graph_of_thousands_of_cameras_agrees_with_counting():
    """A flat grid of squares, in 3D: each square is a rigid 4-cycle, and neighbors share two cameras."""
    side = 40
    number = np.arange(side * side).reshape(side, side)
    across = np.column_stack([number[:, :-1].ravel(), number[:, 1:].ravel()])
    down = np.column_stack([number[:-1].ravel(), number[1:].ravel()])
    edges = np.concatenate([across, down])
    assert is_parallel_rigid(side * side, edges, 3)
    # In 2D a square shears: the grid keeps one free length for each row and column of squares.
    assert len(np.unique(parallel_rigid_pieces(side * side, edges, 2))) == len(edges)


@pytest.mark.parametrize(("flaw", "verdict"), [("none", True), ("pendant", False), ("hinge", False)])
def test_many_pairs_without_triangles_are_judged_as_few_are(flaw, verdict):
    rng = np.random.default_rng(7)
    half = 60
    left, right = np.nonzero(rng.random((half, half)) < 0.5)
    edges = np.column_stack([left, half + right])
    n = 2 * half
    if flaw == "pendant":
        edges, n = np.vstack([edges, [[0, n]]]), n + 1
    if flaw == "hinge":  # a second copy, with the last camera of the first as its first one
        edges, n = np.vstack([edges, edges + n - 1]), 2 * n - 1
    assert is_parallel_rigid(n, edges, 3) == verdict


@pytest.mark.parametrize("dimension", DIMENSIONS)
def test_labels_do_not_depend_on_order_or_orientation_of_edges_nor_the_partition_on_names(dimension):
    rng = np.random.default_rng(11)
    for _ in range(20):
        edges = random_graph(rng, 30, int(rng.integers(30, 60)))
        label = parallel_rigid_pieces(30, edges, dimension)
        order = rng.permutation(len(edges))
        flipped = np.where(rng.random((len(edges), 1)) < 0.5, edges, edges[:, ::-1])
        np.testing.assert_array_equal(parallel_rigid_pieces(30, flipped[order], dimension), label[order])
        renumbered = rng.permutation(30)[edges]
        assert as_sets(parallel_rigid_pieces(30, renumbered, dimension)) == as_sets(label)


def test_pieces_are_ordered_by_cameras_then_edges_then_first_cameras():
    square = [(10, 11), (11, 12), (12, 13), (10, 13)]
    edges = [(8, 9), (7, 9), (6, 7), *all_pairs([0, 1, 2]), (6, 8), *square, *all_pairs([3, 4, 5, 14])]
    pieces = rigid_pieces(graph_of(15, edges))
    assert [piece.nodes.tolist() for piece in pieces] == [
        [3, 4, 5, 14],  # four cameras, six pairs
        [6, 7, 8, 9],  # four cameras, four pairs, smaller first camera
        [10, 11, 12, 13],
        [0, 1, 2],
    ]
    star = rigid_pieces(graph_of(4, [(0, 3), (0, 1), (0, 2)]))
    assert [piece.nodes.tolist() for piece in star] == [[0, 1], [0, 2], [0, 3]]


def test_a_pair_given_twice_counts_once():
    edges = np.array([(0, 1), (1, 0), (1, 2), (2, 3), (3, 4), (4, 0)])
    np.testing.assert_array_equal(parallel_rigid_pieces(5, edges, 3), [0, 0, 2, 3, 4, 1])


def test_pieces_list_their_cameras_edges_and_hinges_and_follow_the_dimension():
    edges = [*all_pairs([0, 1, 2, 3]), *all_pairs([3, 4, 5]), (5, 6)]
    pieces = rigid_pieces(graph_of(8, edges))
    assert [(p.nodes.tolist(), p.edges.tolist(), p.hinges.tolist()) for p in pieces] == [
        ([0, 1, 2, 3], [0, 1, 2, 3, 4, 5], [3]),
        ([3, 4, 5], [6, 7, 8], [3]),  # 5 is shared with a single pair only
        ([5, 6], [9], [5]),
    ]
    with pytest.raises(ValueError, match="read-only"):
        pieces[0].nodes[0] = 9
    assert [len(rigid_pieces(graph_of(4, cycle(4), dimension=d))) for d in (3, 2)] == [1, 4]


def test_each_camera_that_is_left_out_has_its_reason():
    edges = [
        *all_pairs([0, 1, 2, 3, 4]),
        *all_pairs([4, 5, 6]),  # hinged at 4
        *all_pairs([6, 7, 8]),  # hinged at 6, itself left out
        (0, 9),  # pendant
        (1, 10), (10, 11), (11, 12), (12, 13), (13, 2),  # a loop that is too long
        (14, 15),  # another component
        *all_pairs([17, 18, 19]), (17, 3),  # a triangle at the end of a single pair
    ]  # fmt: skip
    graph = graph_of(20, edges)
    reasons = left_out_reasons(graph, rigid_pieces(graph))
    loose = "not rigidly tied to the largest piece"
    assert reasons == {
        5: "another rigid piece, hinged at camera 4",
        6: "another rigid piece, hinged at camera 4",
        7: "another rigid piece, hinged at camera 6",
        8: "another rigid piece, hinged at camera 6",
        9: "pendant: joined by a single pair to camera 0",
        10: loose, 11: loose, 12: loose, 13: loose,
        14: "another component", 15: "another component",
        16: "no pair",
        17: loose, 18: loose, 19: loose,
    }  # fmt: skip
    assert list(reasons) == sorted(reasons)


def test_reasons_use_names_and_a_rigid_graph_leaves_nobody_out_and_an_empty_one_everybody():
    edges = [*all_pairs([0, 1, 2, 3]), *all_pairs([3, 4, 5]), (2, 6)]
    graph = graph_of(7, edges, names=[f"{letter}.jpg" for letter in "abcdefg"])
    reasons = left_out_reasons(graph, rigid_pieces(graph))
    assert reasons[4] == "another rigid piece, hinged at d.jpg"
    assert reasons[6] == "pendant: joined by a single pair to c.jpg"
    rigid, empty = graph_of(4, all_pairs(4)), graph_of(2, [])
    assert left_out_reasons(rigid, rigid_pieces(rigid)) == {}
    assert rigid_pieces(empty) == []
    assert left_out_reasons(empty, []) == {0: "no pair", 1: "no pair"}
    assert [is_parallel_rigid(n, empty.edges, 3) for n in range(3)] == [False, True, False]


@pytest.mark.parametrize(
    ("edges", "dimension", "message"),
    [
        ([(0, 1), (2, 2)], 3, r"edge 1 \(2, 2\)"),
        ([(0, 3)], 3, r"edge 0 \(0, 3\).*0\.\.2"),
        ([(-1, 0)], 3, r"edge 0 \(-1, 0\)"),
        ([(0, 1)], 1, "dimension >= 2, got 1"),
    ],
)
def test_impossible_edges_and_dimensions_are_refused(edges, dimension, message):
    with pytest.raises(InputError, match=message):
        parallel_rigid_pieces(3, np.array(edges), dimension)


def test_a_hundred_thousand_pairs_and_a_late_pendant_are_sorted_out_exactly():
    """A sequence whose second half hangs on the first by one camera, far beyond a first pebble game."""
    half, band = 3000, 20
    chain = np.concatenate(
        [np.column_stack([np.arange(half - k), np.arange(k, half)]) for k in range(1, band + 1)]
    )
    edges = np.concatenate([chain, chain + half - 1, [[5, 2 * half - 1]]])
    label = parallel_rigid_pieces(2 * half, edges, 3)
    assert np.bincount(label).tolist() == [len(chain), len(chain), 1]
    assert label[0] == 0
    assert label[-1] == 2


def test_the_game_ends_where_the_whole_is_rigid():
    ends = np.array([[0, 1], [0, 2], [1, 2], [0, 3], [1, 3], [2, 3]])  # in the plane five of the six suffice
    game = Game(
        num_nodes=4, ends=ends, copies=np.ones(6, np.int64), owner=np.arange(6), num_sets=6, is_whole=False
    )
    united, is_final = play(game, 2)
    assert is_final
    assert not united.any()
