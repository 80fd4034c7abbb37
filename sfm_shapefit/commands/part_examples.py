"""Small examples of the parts of commands that take longest to compile; see `commands.examples`."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from sfm_shapefit import solve, synthetic
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.adjustment.solve import adjust
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.rigidity.pieces import parallel_rigid_pieces
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.verdicts import assess
from sfm_shapefit.laplacian.operators import adjacency
from sfm_shapefit.laplacian.ordering import widest_level
from sfm_shapefit.refinement.angular import allocate_normal, plan_refinement, refine_angles
from sfm_shapefit.refinement.cg_normal_solver import IterativeNormal
from sfm_shapefit.rotations.annealing import anneal, follow_spanning_tree, refine_fully
from sfm_shapefit.rotations.average import average_relative_rotations, check_pairs
from sfm_shapefit.rotations.averaging_system import plan_system
from sfm_shapefit.rotations.averaging_uncertainty import estimate_sigmas
from sfm_shapefit.rotations.dual_certificate import certify_rotations
from sfm_shapefit.scene.lens import Lens
from sfm_shapefit.solver.newton.dense import solve_newton_dense
from sfm_shapefit.solver.newton.sparse import solve_newton_sparse
from sfm_shapefit.solver.splitting.linear import Resources, laplacian_factor
from sfm_shapefit.solver.splitting.lud import solve_lud
from sfm_shapefit.synthetic.rotation_graphs import rotation_problem


def drawn_graph(dimension: int = 3, num_nodes: int = 20) -> ViewGraph:
    """Return a graph of drawn edges, a tenth of them wrong."""
    return synthetic.random_graph_problem(num_nodes, 0.6, dimension, sigma=0.02, q=0.1, seed=1).view_graph


def long_graph(num_nodes: int = 300) -> ViewGraph:
    """Return a graph of a ring, a tenth of whose edges are wrong."""
    return synthetic.ring_graph_problem(num_nodes, 8.0, sigma=0.02, q=0.1, seed=1).view_graph


def solve_dense(_folder: Path) -> None:
    """Solve graphs by Newton steps: from a rough start, from least squares, and with a float32 factor."""
    for graph in (drawn_graph(), long_graph(40), drawn_graph(num_nodes=160)):
        solve(graph, threads=2)
    solve_newton_dense(long_graph(160), 1e-8, 50)


def start_by_lud(_folder: Path) -> None:
    """Solve LUD, as the second start of a placement."""
    solve_lud(drawn_graph(), certified=False)


def judge_placement(_folder: Path) -> None:
    """Judge exact locations, which takes no solver."""
    problem = synthetic.random_graph_problem(20, 0.6, sigma=0.02, q=0.1, seed=1)
    assess(MeasuredGraph(problem.view_graph), problem.locations)


def refine_in_angles(_folder: Path) -> None:
    """Refine exact locations in the angles of noisy directions."""
    problem = synthetic.random_graph_problem(20, 0.6, sigma=0.02, q=0.1, seed=1)
    graph = problem.view_graph
    plan = plan_refinement(graph)
    assert plan is not None
    for solver in (plan, IterativeNormal(graph, laplacian_factor(graph))):
        refine_angles(MeasuredGraph(graph), problem.locations, solver)


def solve_sparse(_folder: Path) -> None:
    """Solve a long graph by Newton steps, and factor one of so many entries that threads share it."""
    solve_newton_sparse(long_graph(), 1e-8, 50)
    full = synthetic.random_graph_problem(340, 1.0, sigma=0.02, seed=1).view_graph
    plan = plan_refinement(full)
    assert plan is not None
    allocate_normal(plan, 3).refactor(np.tile(np.eye(3), (full.num_edges, 1, 1)))


def solve_by_splitting(_folder: Path) -> None:
    """Solve graphs by splitting, with a factor and without."""
    for graph in (drawn_graph(), long_graph(60)):
        solve(graph, solver="admm", threads=2)
        solve(graph, solver="admm", threads=1, factor_memory_mb=0, max_iterations=20)
    solve(long_graph(500), solver="admm", threads=1, max_iterations=20)  # its factor is of float32
    exact = synthetic.ring_graph_problem(60, 8.0, q=0.1, seed=1)
    solve(exact.view_graph, solver="admm", threads=1, max_iterations=200)  # which is accelerated


def solve_iteratively(_folder: Path) -> None:
    """Solve a Laplacian without a factor, in three dimensions and two, and ask whether one is worth it."""
    graph = long_graph()
    solver = laplacian_factor(graph, Resources(threads=2, memory_bytes=0))
    solver.refactor(graph.weights)
    for dimension in (2, 3):
        solver.solve(np.arange(float(graph.num_nodes * dimension)).reshape(-1, dimension))
    widest_level(adjacency(graph.num_nodes, graph.edges))


def find_pieces(_folder: Path) -> None:
    """Find the rigid pieces of graphs that have several."""
    nodes = np.arange(40)
    ring = np.stack([nodes, (nodes + 1) % 40], axis=1)
    braced = np.concatenate([ring, np.stack([nodes, (nodes + 3) % 40], axis=1)])
    for edges in (ring, braced, braced[::2]):
        for dimension in (2, 3):
            parallel_rigid_pieces(40, edges, dimension)


def average_graphs(_folder: Path) -> None:
    """Average rotations with a factor, and as on large graphs without one."""
    edges = np.ascontiguousarray(drawn_graph().edges)
    problem = rotation_problem(20, edges)
    average_relative_rotations(20, problem.relative, threads=2)
    given = check_pairs(edges, problem.relative.rotations, problem.relative.information, None, 20)
    for is_expander in (False, True):
        system = replace(
            plan_system(20, given.pairs, given.supports, 1),
            plan=None,
            factors_blocks=False,
            is_expander=is_expander,
        )
        turns = anneal(given, system, follow_spanning_tree(given), 0.5)
        turns, last = refine_fully(given, system, turns)
        estimate_sigmas(given, system, last)
        certify_rotations(system, given.measured, given.supports, turns)


def adjust_sparsely(_folder: Path) -> None:
    """Adjust a bundle with the factor that long ones take, and as still longer ones are."""
    for solver in ("sparse", "iterative"):
        adjust(small_bundle(), linear_solver=solver, loss_scale_px=1.0, threads=2)


def small_bundle() -> AdjustmentProblem:
    """Return five cameras that see forty points."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.0, 1.0, (40, 3)) + np.array([0.0, 0.0, 5.0])
    centers = rng.uniform(-1.0, 1.0, (5, 3)) * [1.0, 1.0, 0.1]
    cameras, seen = np.divmod(np.arange(200), 40)
    rays = points[seen] - centers[cameras]
    return AdjustmentProblem(
        rotations=np.tile(np.eye(3), (5, 1, 1)),
        centers=centers + 0.01,
        points=points,
        cameras_seeing=cameras,
        points_seen=seen,
        pixels=500.0 * rays[:, :2] / rays[:, 2:] + [320.0, 240.0],
        lenses=(Lens("SIMPLE_PINHOLE", (500.0, 320.0, 240.0)),),
        lens_of_camera=np.zeros(5, dtype=np.int64),
    )
