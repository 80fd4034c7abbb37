"""The view graph: what it refuses, what it merges, and what it keeps to the last bit."""

import dataclasses
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_shapefit.base import errors
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.graph.viewgraph import ViewGraph

X, Y, Z = np.eye(3)
seeds = st.integers(0, 2**32 - 1)


def random_graph(seed: int, n: int = 12, m: int = 14, d: int = 3) -> ViewGraph:
    rng = np.random.default_rng(seed)
    edges = rng.integers(0, n, size=(m, 2))
    edges = edges[edges[:, 0] != edges[:, 1]]
    v = normalized(rng.normal(size=(len(edges), d)))
    return ViewGraph(n, edges, v, rng.uniform(0.1, 3.0, size=len(edges)), [f"{k}.jpg" for k in range(n)])


def test_a_graph_is_a_value_stored_as_given_that_neither_its_user_nor_its_inputs_can_change():
    edges, v, w = np.array([[0, 1], [2, 1]]), np.array([X, Y]), np.array([1.0, 2.5])
    graph = ViewGraph(3, edges, v, w, ["a", "b", "c"])
    edges[:], v[:], w[:] = 9, 9.0, 9.0
    np.testing.assert_array_equal(graph.edges, [[0, 1], [2, 1]])
    np.testing.assert_array_equal(graph.directions, [X, Y])
    np.testing.assert_array_equal(graph.weights, [1.0, 2.5])
    assert (graph.names, graph.num_edges, graph.dimension) == (("a", "b", "c"), 2, 3)
    assert graph.edges.dtype == np.int64
    for array in (graph.edges, graph.directions, graph.weights):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    with pytest.raises(dataclasses.FrozenInstanceError):
        graph.num_nodes = 5
    np.testing.assert_array_equal(ViewGraph(2, [(0, 1)], [X]).weights, [1.0])


def test_kernels_see_one_type_of_array_however_a_graph_was_made():
    """Each further layout, and arrays that can be written to, would be compiled for anew."""
    by_columns = np.array([X, Y, Z]).T.copy().T, np.array([[0, 1, 2], [1, 2, 0]]).T
    graph = ViewGraph(3, by_columns[1], by_columns[0])
    again = pickle.loads(pickle.dumps(ViewGraph(3, graph.edges, graph.directions, [1.0, 2.0, 3.0], "abc")))
    np.testing.assert_array_equal(again.weights, [1.0, 2.0, 3.0])
    assert again.names == ("a", "b", "c")
    for array in (graph.edges, graph.directions, again.edges, again.directions, again.weights):
        assert array.flags.c_contiguous
        assert not array.flags.writeable


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((2, [(0, 1), (1, 2)], [X, X]), r"edge 1 \(1, 2\) is outside the cameras 0\.\.1"),
        ((2, [(-1, 1)], [X]), r"edge 0 \(-1, 1\) is outside"),
        ((3, [(0, 1), (2, 2)], [X, X]), r"edge 1 \(2, 2\) joins a camera with itself"),
        ((2, [(0, 1)], [2 * X]), r"edge 0 \(0, 1\) has a direction that is not a finite unit vector"),
        ((2, [(0, 1)], [0 * X]), "not a finite unit vector"),
        ((2, [(0, 1)], [[np.nan, 0, 1]]), "not a finite unit vector"),
        ((2, [(0, 1)], [[np.inf, 0, 1]]), "not a finite unit vector"),
        ((2, [(0, 1)], [[1e200, 0, 1]]), "not a finite unit vector"),
        ((2, [(0, 1)], [X * (1 + 1.1e-6)]), "not a finite unit vector"),
        ((2, [(0, 1)], [X], [0.0]), "has a weight that is not finite and positive"),
        ((2, [(0, 1)], [X], [-1.0]), "weight"),
        ((2, [(0, 1)], [X], [np.nan]), "weight"),
        ((2, [(0, 1)], [X], [np.inf]), "weight"),
        ((2, [(0, 1)], [X], [1e300]), "has a weight outside 1e-60 to 1e\\+60; scale all weights"),
        ((2, [(0, 1)], [X], [1e-300]), "has a weight outside"),
        ((2, [(0, 1)], [X], ["heavy"]), "weights must be numbers"),
        ((2, [(0, 1)], [["x", "y", "z"]], None), "directions must be numbers"),
        ((2, [(0, 1)], [X], [1.0, 1.0]), r"weights have shape \(2,\) for 1 edges"),
        ((2, [(0, 1)], [X], 1.0), r"weights have shape \(\) for 1 edges"),
        ((2, [(0.0, 1.0)], [X]), "edges must be integers, got float64"),
        ((2, [(False, True)], [X]), "edges must be integers, got bool"),
        ((2, [(0, 1)], X), r"directions have shape \(3,\) for 1 edges"),
        ((2, [(0, 1)], [X, Y]), r"directions have shape \(2, 3\) for 1 edges"),
        ((2, [(0, 1)], [[1.0]]), r"directions have shape \(1, 1\)"),
        ((2, [(0, 1)], [X], None, ["a"]), "the graph has 2 cameras but 1 names"),
        ((-1, np.zeros((0, 2), int), np.zeros((0, 3))), "num_nodes must be a whole number >= 0, got -1"),
        ((2.5, [(0, 1)], [X]), r"num_nodes must be a whole number >= 0, got 2\.5"),
    ],
)
def test_bad_input_is_refused_by_name(arguments, message):
    with pytest.raises(errors.InputError, match=message):
        ViewGraph(*arguments)


@pytest.mark.parametrize("edges", [[[0, 2, 4], [1, 3, 5]], [0, 1, 2, 3, 4, 5], [[0, 1, 2], [3, 4, 5]]])
def test_edges_of_the_wrong_shape_are_refused_and_not_read_in_another_order(edges):
    with pytest.raises(errors.InputError, match=r"edges have shape .* shape \(m, 2\)"):
        ViewGraph(6, edges, [X, X, X])


def test_directions_printed_with_seven_digits_are_accepted_and_made_unit():
    v = np.round(normalized(np.array([[1.0, 2.0, 3.0]])), 7)
    graph = ViewGraph(2, [(0, 1)], v)
    assert np.linalg.norm(graph.directions[0]) == pytest.approx(1.0, abs=4e-16)
    assert np.linalg.norm(v[0]) != pytest.approx(1.0, abs=1e-9)


def test_a_reversed_duplicate_is_flipped_and_its_weight_added_where_it_first_stood():
    # (1, 0) with -Y is (0, 1) with Y: the sum is 3 X + 4 Y.
    graph = ViewGraph(3, [(0, 1), (1, 2), (1, 0)], [X, Z, -Y], [3.0, 1.0, 4.0])
    np.testing.assert_array_equal(graph.edges, [[0, 1], [1, 2]])
    np.testing.assert_allclose(graph.directions, [[0.6, 0.8, 0.0], Z], atol=1e-16)
    np.testing.assert_array_equal(graph.weights, [7.0, 1.0])
    graph = ViewGraph(9, [(8, 7), (5, 2), (7, 8), (0, 1), (2, 5)], [X, Y, -X, Z, -Y])
    np.testing.assert_array_equal(graph.edges, [[8, 7], [5, 2], [0, 1]])
    np.testing.assert_array_equal(graph.directions, [X, Y, Z])
    np.testing.assert_array_equal(graph.weights, [2.0, 2.0, 1.0])


def test_duplicates_that_cancel_are_refused_under_the_index_the_user_gave():
    # The pair (2, 3) is the second distinct one, but edge 3 of the input.
    with pytest.raises(errors.InputError, match=r"edge 3 \(2, 3\) is given several times"):
        ViewGraph(4, [(0, 1), (1, 0), (0, 1), (2, 3), (3, 2)], [X, -X, X, Y, Y])


def brute_force_merge(edges, v, w):
    merged: dict[tuple[int, int], list] = {}
    for (i, j), direction, weight in zip(edges.tolist(), v, w, strict=True):
        if (j, i) in merged:
            merged[j, i][0] = merged[j, i][0] - weight * direction
            merged[j, i][1] += weight
        else:
            entry = merged.setdefault((i, j), [np.zeros(v.shape[1]), 0.0])
            entry[0] = entry[0] + weight * direction
            entry[1] += weight
    totals = np.array([total for total, _ in merged.values()])
    return np.array(list(merged)), normalized(totals), np.array([weight for _, weight in merged.values()])


@given(seed=seeds, n=st.integers(2, 6), m=st.integers(1, 30), d=st.integers(2, 5))
def test_merging_agrees_with_a_plain_loop(seed, n, m, d):
    rng = np.random.default_rng(seed)
    first = rng.integers(0, n, size=m)
    edges = np.stack([first, (first + rng.integers(1, n, size=m)) % n], axis=1)
    v, w = normalized(rng.normal(size=(m, d))), rng.uniform(0.5, 2.0, size=m)
    graph = ViewGraph(n, edges, v, w)
    expected_edges, expected_v, expected_w = brute_force_merge(edges, v, w)
    np.testing.assert_array_equal(graph.edges, expected_edges)
    # Rounding of a sum of up to 30 vectors of length 2, 1e-14, over its length, which chance makes no
    # shorter than 1e-3 or so.
    np.testing.assert_allclose(graph.directions, expected_v, atol=1e-11)
    np.testing.assert_allclose(graph.weights, expected_w, rtol=1e-14)


@given(seed=seeds, data=st.data())
def test_a_restriction_maps_back_to_the_edges_it_came_from_and_the_whole_to_the_last_bit(seed, data):
    graph = random_graph(seed)
    some = st.lists(st.integers(0, graph.num_edges - 1), unique=True, max_size=graph.num_edges)
    for chosen in (np.array(data.draw(some), dtype=int), np.arange(graph.num_edges)):
        part, cameras = graph.restricted_to(chosen)
        np.testing.assert_array_equal(cameras[part.edges], graph.edges[chosen].reshape(-1, 2))
        np.testing.assert_array_equal(part.directions, graph.directions[chosen])
        np.testing.assert_array_equal(part.weights, graph.weights[chosen])
        assert (part.degrees() > 0).all()


def test_degrees_count_pairs_and_components_are_numbered_by_their_first_camera():
    graph = ViewGraph(5, [(0, 1), (1, 2), (3, 1), (1, 0)], [X, Y, Z, -X])
    np.testing.assert_array_equal(graph.degrees(), [1, 3, 1, 1, 0])
    graph = ViewGraph(6, [(5, 1), (4, 2)], [X, Y])  # lone cameras are components
    np.testing.assert_array_equal(graph.components(), [0, 1, 2, 3, 2, 1])


def test_the_order_of_elimination_is_looked_for_once():
    graph = random_graph(0)
    assert graph.elimination_tree() is graph.elimination_tree()
    assert len(graph.elimination_tree().parent) == graph.num_nodes


def test_a_graph_without_edges_has_only_lone_cameras():
    graph = ViewGraph(3, np.zeros((0, 2), dtype=int), np.zeros((0, 3)))
    assert (graph.num_edges, graph.dimension) == (0, 3)
    np.testing.assert_array_equal(graph.components(), [0, 1, 2])
    np.testing.assert_array_equal(graph.degrees(), [0, 0, 0])
    part, cameras = graph.restricted_to(np.array([], dtype=int))
    assert (part.num_nodes, part.num_edges, len(cameras)) == (0, 0, 0)
    assert len(part.components()) == 0
