"""Sparse linear algebra of graph Laplacians, against scipy's matrices and its splu."""

import threading
import time
import tracemalloc
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu
from threadpoolctl import threadpool_info

from harness.graphs import laplacian_matrix
from sfm_shapefit.base.blas_threads import one_blas_thread
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.laplacian import ordering
from sfm_shapefit.laplacian.approximate import JacobiPreconditioner, approximate_cholesky, conjugate_gradients
from sfm_shapefit.laplacian.factor import allocate_factor, analyze, factorize
from sfm_shapefit.laplacian.front_memory import FrontMemory
from sfm_shapefit.laplacian.operators import LaplacianOperator, Workers, adjacency
from sfm_shapefit.laplacian.symbolic import SymbolicFactor, elimination_tree
from sfm_shapefit.solver.program import differences
from tests.graph_families import FAMILIES, random_blocks, random_weights
from tests.program import run_python

Array = npt.NDArray[np.float64]
EPS = np.finfo(np.float64).eps
SIZES = {"geo": (400, 15.0), "er": (200, 8.0), "comm": (900, 20.0), "seq": (500, 12.0)}


def family(name: str, seed: int = 1) -> tuple[int, npt.NDArray[np.int64], Array]:
    """Number of nodes, edges and locations of a small connected graph of a family."""
    n, degree = SIZES[name]
    edges, t = FAMILIES[name](n, degree, seed)
    chain = np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)  # connects what chance left apart
    return n, np.unique(np.concatenate([edges, chain]), axis=0), t


def weights_of(edges, block: int, seed: int) -> Array:
    return random_weights(len(edges), seed) if block == 1 else random_blocks(len(edges), block, seed)


def system(name: str):
    """Edges of a family, weights, their matrix, and three right-hand sides."""
    n, edges, _ = family(name)
    w = random_weights(len(edges), 1)
    return edges, w, laplacian_matrix(n, edges, w), balanced_rhs((n, 3), 2)


def grid(rows: int, columns: int) -> npt.NDArray[np.int64]:
    """Edges of a grid whose nodes are numbered row by row."""
    k = np.arange(rows * columns).reshape(rows, columns)
    pairs = [(k[:, :-1], k[:, 1:]), (k[:-1], k[1:])]
    return np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in pairs])


def across(v: Array) -> Array:
    """Projectors across directions."""
    v = normalized(v)
    return np.eye(3) - v[:, :, None] * v[:, None, :]


def balanced_rhs(shape: tuple[int, ...], seed: int) -> Array:
    """Right-hand sides orthogonal to the constants."""
    r = np.random.default_rng(seed).normal(size=shape)
    return r - r.mean(axis=0)


def assert_same_up_to_constants(x: Array, y: Array, rtol: float) -> None:
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    error = np.linalg.norm(x - y) / np.linalg.norm(y)
    assert error <= rtol, f"solutions differ by {error:.1e} of their norm (limit {rtol:.1e})"


def splu_solution(laplacian: csc_array, block: int, rhs: Array) -> Array:
    """Solve L x = rhs by splu, the last node grounded by removal."""
    size = laplacian.shape[0] - block
    x = np.zeros_like(rhs.reshape(laplacian.shape[0], -1))
    x[:size] = splu(laplacian[:size, :size].tocsc()).solve(rhs.reshape(laplacian.shape[0], -1)[:size])
    return x.reshape(rhs.shape)


@pytest.mark.parametrize("edges", [[[0, 3]], [[-1, 1]], [[0, 1], [2, 2]]])
def test_an_edge_that_leaves_the_graph_or_is_a_loop_is_refused(edges):
    with pytest.raises(InputError, match=rf"edge {len(edges) - 1} .* two different nodes of 0\.\.2"):
        analyze(3, np.array(edges))


def true_counts(n: int, edges: npt.NDArray[np.int64], order: npt.NDArray[np.int64]) -> list[int]:
    """Column counts of L by playing the elimination game on sets."""
    neighbors = [set() for _ in range(n)]
    for i, j in edges:
        neighbors[i].add(j)
        neighbors[j].add(i)
    counts = []
    for v in order:
        star = neighbors[v]
        counts.append(len(star) + 1)
        for u in star:
            neighbors[u] |= star - {u}
            neighbors[u].discard(v)
    return counts


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 40), density=st.floats(0.0, 0.4))
def test_predicted_fill_is_that_of_the_elimination_game(seed, n, density):
    rng = np.random.default_rng(seed)
    i, j = np.triu_indices(n, 1)
    kept = rng.uniform(size=len(i)) < density
    edges = np.stack([i[kept], j[kept]], axis=1)
    edges = np.concatenate([edges, edges[: len(edges) // 3, ::-1]])  # repeated pairs must not matter
    tree = elimination_tree(adjacency(n, edges), rng.permutation(n))
    counts = true_counts(n, edges, tree.permutation)
    assert tree.counts.tolist() == counts
    assert tree.num_nonzeros == sum(counts)
    assert tree.flops == sum(c * c for c in counts)


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(2, 60),
    extra=st.floats(0.0, 0.3),
    block=st.sampled_from([1, 2, 3]),
    columns=st.integers(1, 5),
)
def test_solutions_agree_with_splu_on_any_connected_graph_and_order(seed, n, extra, block, columns):
    rng = np.random.default_rng(seed)
    i, j = np.triu_indices(n, 1)
    kept = rng.uniform(size=len(i)) < extra
    tree = np.stack([np.arange(1, n), rng.integers(np.arange(1, n))], axis=1)
    edges = np.concatenate([tree, np.stack([i[kept], j[kept]], axis=1)])  # some edges repeat: weights add
    w = weights_of(edges, block, seed)
    rhs = balanced_rhs((n, columns) if block == 1 else (n, block, columns), seed)
    x = factorize(analyze(n, edges, rng.permutation(n)), w).solve(rhs)
    # Paths of up to 60 edges with weights within a factor 10: condition below 1e5.
    assert_same_up_to_constants(x, splu_solution(laplacian_matrix(n, edges, w), block, rhs), 1e5 * EPS)


@pytest.mark.parametrize("name", sorted(FAMILIES))
@pytest.mark.parametrize("block", [1, 3])
def test_every_family_is_solved_to_rounding(name, block):
    n, edges, _ = family(name)
    w = weights_of(edges, block, 3)
    rhs = balanced_rhs((n, 3) if block == 1 else (n, block, 2), 4)
    factor = factorize(analyze(n, edges), w)
    matrix = laplacian_matrix(n, edges, w)
    x = factor.solve(rhs)
    flat = (n * block, -1)
    residual = np.linalg.norm(matrix @ x.reshape(flat) - rhs.reshape(flat)) / np.linalg.norm(rhs)
    assert residual < 1e-11  # seq has condition 1e4; the others stay near 1e-14
    assert 1e-6 < factor.smallest_pivot <= 1.0


def test_single_precision_loses_digits_only_and_refinement_regains_them():
    n, edges, _ = family("geo")
    w = random_weights(len(edges), 3)
    rhs = balanced_rhs((n, 3), 4)
    plan = analyze(n, edges)
    exact = factorize(plan, w).solve(rhs)
    factor = factorize(plan, w, np.float32)
    matrix = laplacian_matrix(n, edges, w)
    assert factor.panels.dtype == np.float32
    x = factor.solve(rhs)
    first = np.linalg.norm(x - exact) / np.linalg.norm(exact)
    assert 1e-9 < first < 1e-4
    for _ in range(2):
        x += factor.solve(rhs - matrix @ x)
    assert_same_up_to_constants(x, exact, 1e-12)


def test_refactoring_in_place_gives_the_bits_of_a_fresh_factor_and_grounding_changes_no_difference():
    n, edges, _ = family("geo")
    plan = analyze(n, edges)
    w, rhs = random_weights(len(edges), 2), balanced_rhs((n, 3), 0)
    used, fresh = factorize(plan, random_weights(len(edges), 1)), factorize(plan, w)
    used.refactor(w)
    np.testing.assert_array_equal(used.panels, fresh.panels)
    np.testing.assert_array_equal(used.solve(rhs), fresh.solve(rhs))
    light, heavy = (factorize(plan, w, ground=g).solve(rhs) for g in (0.01, 1e3))
    assert_same_up_to_constants(light, heavy, 1e-9)
    np.testing.assert_allclose(light[plan.permutation[-1]], 0.0, atol=1e-9 * np.abs(light).max())


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_disconnected_graph_is_refused_not_answered(dtype):
    n, edges, _ = family("geo")
    both = np.concatenate([edges, edges + n])
    with pytest.raises(UnsolvableError, match="singular"):
        factorize(analyze(2 * n, both), random_weights(len(both), 1), dtype)


def test_a_pendant_camera_makes_the_projected_laplacian_singular_and_is_named():
    n, edges, t = family("geo")
    edges = np.concatenate([edges, [[0, n]]])
    t = np.concatenate([t, [[0.5, 0.5, 1.0]]])
    v = normalized(differences(t, edges))
    v[:-1] += 0.1 * np.random.default_rng(0).normal(size=v[:-1].shape)  # else t itself is in the null space
    projectors = across(v)
    with pytest.raises(UnsolvableError, match=rf"singular at node {n} "):
        factorize(analyze(n + 1, edges), projectors)
    factorize(analyze(n, edges[:-1]), projectors[:-1])  # without it, all is well


def test_bad_weights_and_arrays_of_the_wrong_shape_are_refused():
    n, edges, _ = family("er")
    factor = factorize(analyze(n, edges), random_weights(len(edges), 1))
    for bad in (np.nan, np.inf, -1e3):
        weights = np.where(np.arange(len(edges)) == 7, bad, random_weights(len(edges), 1))
        with pytest.raises(UnsolvableError, match="weights are not positive"):
            factor.refactor(weights)
    with pytest.raises(ValueError, match="weights have shape"):
        factor.refactor(np.ones(3))
    with pytest.raises(ValueError, match="rhs has shape"):
        factor.solve(np.ones(n + 1))


def test_memory_is_predicted_before_it_is_allocated():
    n, edges, _ = family("geo")
    plan = analyze(n, edges)
    for block, dtype in ((1, np.float64), (3, np.float32)):
        tracemalloc.start()
        factor = allocate_factor(plan, block, dtype)
        allocated = tracemalloc.get_traced_memory()[0]
        w = weights_of(edges, block, 1)
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        factor.refactor(w)
        stack = tracemalloc.get_traced_memory()[1] - before
        tracemalloc.stop()
        predicted = plan.num_bytes(block, dtype)
        # Beside panels and stack: the diagonal, (n, b^2) float64, and small change of the call.
        assert predicted <= allocated + stack < predicted + 8 * n * block**2 + 200_000
    assert plan.num_nonzeros <= plan.panel_pointers[-1]


@pytest.fixture(scope="module", params=["tasks", "strips"])
def divided(request) -> tuple[npt.NDArray[np.int64], SymbolicFactor]:
    """Edges and plan of a graph whose factor has tasks, or a front large enough for strips."""
    if request.param == "tasks":
        edges, _ = FAMILIES["geo"](6000, 40.0, 1)
    else:
        edges, _ = FAMILIES["er"](2000, 20.0, 1)
    plan = analyze(int(edges.max()) + 1, edges, "metis")
    assert len(plan.tasks) > 2 if request.param == "tasks" else plan.largest_front > 800
    return edges, plan


def test_the_widest_level_of_a_grid_is_its_diagonal_and_of_a_box_about_its_separator():
    assert ordering.widest_level(adjacency(600, grid(20, 30))) == 20  # from a corner, diagonals
    edges, _ = FAMILIES["geo"](6000, 40.0, 1)
    plan = analyze(6000, edges, "metis")
    root = plan.first[-1] - plan.first[-2]
    # METIS's separator is 0.75 of the level; columns are merged into the root.
    assert 0.5 < root / ordering.widest_level(adjacency(6000, edges)) < 1.3


def test_tasks_are_disjoint_subtrees_and_the_rest_is_above_them(divided):
    plan = divided[1]
    covered = np.concatenate([np.arange(*run) for run in (*plan.tasks, *plan.above)])
    np.testing.assert_array_equal(np.sort(covered), np.arange(plan.num_supernodes))
    for begin, end in plan.tasks:  # closed: parents stay inside, up to the root
        assert (plan.parent[begin : end - 1] < end).all()
        assert not np.isin(plan.parent[:begin], np.arange(begin, end)).any()
    units = plan.units
    for s in np.flatnonzero(plan.parent >= 0):
        unit, above = plan.unit_of[[s, plan.parent[s]]]
        assert units[unit, 0] <= s < units[unit, 1]
        assert unit == above or unit in plan.needs[above]
    assert all(unit > max(below, default=-1) for unit, below in enumerate(plan.needs))


@pytest.mark.parametrize("seed", range(3))
def test_update_matrices_never_overlap_while_they_wait_whatever_the_order_of_units(divided, seed):
    plan, rng = divided[1], np.random.default_rng(seed)
    threads = 3 if seed else 1
    memory, areas = FrontMemory(plan, threads), np.diff(plan.row_pointers) ** 2
    waiting, running, done = {}, {}, set[int]()
    while len(done) < len(plan.units):
        ready = [u for u, below in enumerate(plan.needs) if done >= {*below} and u not in done | {*running}]
        if ready and len(running) < memory.num_arenas:
            unit = ready[0] if threads == 1 else rng.choice(ready)
            running[unit] = memory.room(unit, memory.leaving[unit], memory.entering[unit])
            running[unit].__enter__()
            waiting |= dict.fromkeys(range(*plan.units[unit]), unit)
            placed = sorted((memory.offsets[s], memory.offsets[s] + areas[s], s) for s in waiting if areas[s])
            assert placed[-1][1] <= memory.size
            for (_, end, first), (begin, _, second) in pairwise(placed):
                # In one unit a front may lie where those that it has used up were.
                assert end <= begin or waiting[first] == waiting[second]
        else:
            unit = rng.choice(list(running))
            running.pop(unit).__exit__(None, None, None)
            done.add(unit)
            left = {*memory.leaving[unit]}
            used = {*memory.entering[unit]}
            waiting = {s: u for s, u in waiting.items() if (u != unit or s in left) and s not in used}


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_threads_change_no_bit_of_a_factor_with_tasks_and_strips(divided, dtype):
    edges, plan = divided
    w = random_weights(len(edges), 1)
    rhs = balanced_rhs((plan.num_nodes, 3), 2)
    factors = [allocate_factor(plan, 1, dtype, threads=threads) for threads in (1, 2, 3)]
    for factor in factors:
        factor.refactor(w[::-1])  # a factor is used again and again
        factor.refactor(w)
    for factor in factors[1:]:
        assert factor.smallest_pivot == factors[0].smallest_pivot
        many = np.tile(rhs, 7)  # threads share these, and not the tree
        np.testing.assert_array_equal(factor.solve(many), np.tile(factors[0].solve(rhs), 7))
        np.testing.assert_array_equal(factor.solve(rhs), factors[0].solve(rhs))
    matrix = laplacian_matrix(plan.num_nodes, edges, w)
    residual = np.linalg.norm(matrix @ factors[0].solve(rhs) - rhs) / np.linalg.norm(rhs)
    assert residual < 1e4 * np.finfo(dtype).eps  # 30 in float64, 1e3 in float32 (condition number 1e3)


def test_a_matrix_of_blocks_that_are_not_symmetric_is_solved_whichever_way_its_edges_are_listed():
    n, edges, _ = family("seq")
    rng = np.random.default_rng(0)
    edges = np.where(rng.random((len(edges), 1)) < 0.5, edges, edges[:, ::-1])
    off_diagonal = rng.normal(size=(len(edges), 2, 2))
    matrix = np.zeros((n, 2, n, 2))
    matrix[edges[:, 0], :, edges[:, 1], :] = off_diagonal
    matrix[edges[:, 1], :, edges[:, 0], :] = off_diagonal.transpose(0, 2, 1)
    diagonal = np.tile(np.abs(matrix).sum(axis=(1, 2, 3)).max() * np.eye(2), (n, 1, 1))  # it dominates
    matrix[np.arange(n), :, np.arange(n), :] = diagonal
    factor, right = allocate_factor(analyze(n, edges), 2), rng.normal(size=(n, 2))
    assert factor.refactor_blocks(diagonal, off_diagonal)
    expected = np.linalg.solve(matrix.reshape(2 * n, 2 * n), right.ravel())
    np.testing.assert_allclose(
        factor.solve(right).ravel(), expected, rtol=0, atol=1e-13 * np.abs(right).max()
    )


def test_a_singular_graph_is_found_by_tasks_and_by_strips_alike(divided):
    edges, plan = divided
    for supernode in (0, plan.above[-1][1] - 1):
        node = plan.permutation[plan.first[supernode]]
        w = random_weights(len(edges), 1)
        w[(edges == node).any(axis=1)] = 0.0  # a node that hangs on nothing
        factor = allocate_factor(plan, threads=2)
        with pytest.raises(UnsolvableError, match=f"singular at node {node} "):
            factor.refactor(w)


@pytest.mark.parametrize("columns", [1, 3])
def test_the_operator_multiplies_by_the_laplacian_whatever_the_threads(columns):
    edges, _ = FAMILIES["geo"](3000, 40.0, 1)
    w = random_weights(len(edges), 1)
    x = balanced_rhs((3000, columns), 1)
    products = [LaplacianOperator(adjacency(3000, edges), w, Workers(k))(x) for k in (1, 2)]
    np.testing.assert_array_equal(*products)
    exact = laplacian_matrix(3000, edges, w) @ x
    np.testing.assert_allclose(products[0], exact, atol=1e-7 * np.abs(exact).max() * 3)  # float32 weights


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_workers_run_jobs_once_those_that_they_need_have_ended(threads):
    done, needs = [], [[below for below in (2 * k - 20, 2 * k - 19) if 0 <= below < k] for k in range(20)]
    assert sum(map(len, needs)) == 19  # those of a tree

    def job(k):
        def run():
            assert {*needs[k]} <= {*done}
            done.append(k)
            if k == failing:
                raise ValueError(f"job {k}")

        return run

    failing = None
    Workers(threads).run_after([job(k) for k in range(20)], needs)
    assert sorted(done) == list(range(20))
    done, failing = [], 12
    with pytest.raises(ValueError, match="job 12"):
        Workers(threads).run_after([job(k) for k in range(20)], needs)
    assert not {k for k in range(20) if 12 in needs[k]} & {*done}


def test_jobs_may_hand_out_jobs_though_no_helper_is_free():
    workers, done = Workers(2), []
    workers.run([lambda: workers.run([lambda: done.append(1)] * 2)] * 4)
    assert len(done) == 8


def test_a_failure_ends_threads_that_wait_for_what_will_not_come():
    def fail():
        time.sleep(0.05)  # the other thread waits by now
        raise ValueError("job 0")

    failures = []

    def run():
        try:
            Workers(2).run_after([fail, fail], [[], [0]])
        except ValueError as failure:
            failures.append(str(failure))

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(60.0)  # else it would wait for ever
    assert failures == ["job 0"]


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_workers_run_every_job_once_and_raise_what_the_first_failed_one_raised(threads):
    done = []

    def job(k):
        def run():
            done.append(k)
            if k in failing:
                raise ValueError(f"job {k}")

        return run

    failing = ()
    Workers(threads).run([job(k) for k in range(20)])
    assert sorted(done) == list(range(20))
    failing = (7, 3, 15)
    with pytest.raises(ValueError, match="job 3"):
        Workers(threads).run([job(k) for k in range(20)])


@pytest.mark.parametrize("n", [1, 2])
def test_the_smallest_graphs_are_solved(n):
    edges = np.array([[1, 0]])[: n - 1]
    factor = factorize(analyze(n, edges), np.full(n - 1, 2.0), ground=1.0)
    rhs = np.array([1.0, -1.0])[:n] * (n - 1)
    x = factor.solve(rhs)
    np.testing.assert_allclose(x - x.mean(), rhs / 4.0, atol=4 * EPS)


@pytest.mark.parametrize("name", sorted(FAMILIES))
def test_every_ordering_is_a_permutation_and_beats_a_random_order(name):
    n, edges, _ = family(name)
    rng = np.random.default_rng(5)
    graph = adjacency(n, edges)
    random = elimination_tree(graph, rng.permutation(n)).flops
    orders = [ordering.minimum_degree_order(graph), ordering.metis_order(graph)]
    for order in orders:
        np.testing.assert_array_equal(np.sort(order), np.arange(n))
    # Random graphs have no small separators: dissection is no better there than chance.
    useful = orders[:1] if name == "er" else orders
    for order in useful:
        assert elimination_tree(graph, order).flops < 0.7 * random


def test_the_automatic_order_is_the_one_of_least_work():
    n, edges, _ = family("seq")
    graph = adjacency(n, edges)
    best = ordering.best_order(graph)
    tried = [ordering.best_order(graph, m).flops for m in ("metis", "minimum-degree")]
    assert best.flops == min(tried)
    assert tried[0] != tried[1]


@pytest.mark.parametrize("name", FAMILIES)
def test_the_order_of_elimination_is_the_better_of_metis_and_minimum_degree_where_either_helps(name):
    n, edges, _ = family(name)
    graph = adjacency(n, edges)
    metis, by_degree = (
        elimination_tree(graph, order(graph)).flops
        for order in (ordering.metis_order, ordering.minimum_degree_order)
    )
    best = ordering.best_order(graph).flops
    assert best <= metis
    assert best <= by_degree or name != "seq"  # on bands it can win


def test_dissection_halves_a_grid_and_orders_a_graph_with_repeated_edges_as_well():
    graph = adjacency(1600, grid(40, 40))
    # George's dissection has 31/4 n log2(side) entries to first order (7.75 * 1600 * 5.3 = 66,000); the
    # row-by-row order has side^3 = 64,000. Small grids do better than the asymptote.
    assert elimination_tree(graph, ordering.metis_order(graph)).num_nonzeros < 40_000
    n, edges, _ = family("geo")
    graph = adjacency(n, np.concatenate([edges, edges[:5]]))
    order = ordering.metis_order(graph)
    np.testing.assert_array_equal(np.sort(order), np.arange(n))
    assert elimination_tree(graph, order).flops < 2 * ordering.best_order(graph, "minimum-degree").flops


@pytest.mark.parametrize("name", sorted(FAMILIES))
def test_approximate_cholesky_needs_few_iterations(name):
    edges, w, matrix, rhs = system(name)
    factor = approximate_cholesky(adjacency(len(rhs), edges), w, seed=1)
    result = conjugate_gradients(lambda x: matrix @ x, factor, rhs, tol=1e-10)
    assert result.converged
    assert result.iterations <= 30  # 25 on sequences of 1e4 nodes, 15-19 elsewhere, at any size
    assert_same_up_to_constants(result.x, splu_solution(matrix, 1, rhs), 1e-6)


def test_approximate_cholesky_of_a_tree_is_exact_and_elsewhere_the_seed_decides_the_sample():
    rng = np.random.default_rng(0)
    n = 300
    edges = np.stack([np.arange(1, n), rng.integers(np.arange(1, n))], axis=1)
    w = random_weights(n - 1, 1)
    rhs = balanced_rhs((n, 2), 2)
    x = approximate_cholesky(adjacency(n, edges), w, seed=0).solve(rhs)
    # Fractions are float32, but on a tree each is exactly 1: a leaf has one neighbor.
    assert_same_up_to_constants(x, splu_solution(laplacian_matrix(n, edges, w), 1, rhs), 1e-10)
    n, edges, _ = family("er")
    w, graph = random_weights(len(edges), 1), adjacency(n, edges)
    first, again, other = (approximate_cholesky(graph, w, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.fractions, again.fractions)
    np.testing.assert_array_equal(first.permutation, again.permutation)
    assert not np.array_equal(first.rows, other.rows)


def test_the_sampled_laplacian_is_right_on_average():
    # Eliminate the hub of a star: the mean of the sampled edges is the clique w_i w_j / W.
    w = np.array([1.0, 2.0, 3.0, 4.0])
    edges = np.stack([np.zeros(4, np.int64), np.arange(1, 5)], axis=1)
    ring = np.array([[1, 2], [2, 3], [3, 4], [4, 1], [1, 3], [2, 4]])
    all_edges = np.concatenate([edges, ring])
    # Heavy ring edges raise the other nodes' degrees to 4 + 3, so that the hub (degree 4) goes first.
    repeated = np.concatenate([all_edges, ring, ring])
    weights = np.concatenate([w, np.full(18, 1e-9)])
    graph = adjacency(5, repeated)
    mean = np.zeros((5, 5))
    draws = 4000
    for seed in range(draws):
        f = approximate_cholesky(graph, weights, seed)
        assert f.permutation[0] == 0
        lower = np.eye(5)
        for k in range(5):
            part = slice(f.pointers[k], f.pointers[k + 1])
            lower[f.rows[part], k] = -f.fractions[part]
        back = np.argsort(f.permutation)
        mean += (lower * f.pivots @ lower.T)[np.ix_(back, back)] / draws
    exact = laplacian_matrix(5, repeated, weights).toarray()
    # Entries have a standard deviation below 1: 4 sigma of the mean is 4 / sqrt(4000) = 0.063.
    np.testing.assert_allclose(mean, exact, atol=0.065)


def test_jacobi_is_enough_on_random_graphs_and_not_on_sequences_where_a_limit_is_reported():
    iterations = {}
    for name, limit in (("er", 10_000), ("seq", 10_000), ("seq", 2)):
        _, _, matrix, rhs = system(name)
        jacobi = JacobiPreconditioner(matrix.diagonal())
        result = conjugate_gradients(lambda x, a=matrix: a @ x, jacobi, rhs, tol=1e-8, max_iterations=limit)
        iterations[name, limit] = result.iterations
        assert result.converged == (limit > 2) == (result.residual <= 1e-8)
    assert iterations["er", 10_000] < 40 < iterations["seq", 10_000]
    assert iterations["seq", 2] == 2


def test_the_projected_laplacian_is_solved_with_the_scalar_factor():
    n, edges, t = family("geo")
    v = normalized(differences(t, edges))
    projectors = across(v + 0.3 * np.random.default_rng(0).normal(size=v.shape))
    plan = analyze(n, edges)
    rhs = balanced_rhs((n, 3), 1)
    matrix = laplacian_matrix(n, edges, projectors)
    result = conjugate_gradients(
        lambda x: (matrix @ x.ravel()).reshape(n, 3),
        factorize(plan, np.ones(len(edges)), np.float32),
        rhs,
        tol=1e-12,
        coupled_nodes=len(rhs),
    )
    assert result.converged
    assert result.iterations < 60  # 30-40 at any size
    assert_same_up_to_constants(result.x, factorize(plan, projectors).solve(rhs), 1e-8)


CHILD = """
import hashlib
import numpy as np
from tests.graph_families import geo, random_weights
from sfm_shapefit.laplacian.factor import analyze, factorize
edges, t = geo(2000, 20.0, 1)
plan = analyze(2000, edges, "minimum-degree")
for dtype in (np.float32, np.float64):
    factor = factorize(plan, random_weights(len(edges), 1), dtype)
    print(hashlib.sha256(factor.solve(t - t.mean(axis=0)).tobytes()).hexdigest())
"""


def test_blas_threads_do_not_change_a_bit():
    one, two = (run_python("-c", CHILD, OPENBLAS_NUM_THREADS=str(threads)).stdout for threads in (1, 2))
    assert one == two
    assert len(set(one.split())) == 2


def test_blas_threads_are_restored_after_nested_limits():
    def threads() -> list[int]:  # of scipy's BLAS; other packages of the process may have their own
        blas = [library for library in threadpool_info() if library["user_api"] == "blas"]
        return [library["num_threads"] for library in blas if "scipy" in library["filepath"]]

    before = threads()
    assert before
    with one_blas_thread(), one_blas_thread():
        assert set(threads()) == {1}
    assert threads() == before
