"""Small examples of all that commands do: running them compiles every kernel, see `commands.warm_up`.

An example takes an empty folder for its files, and a fraction of a second once its kernels are compiled.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from sfm_shapefit import (
    evaluate,
    inspect,
    join,
    locate,
    map_database,
    place,
    relative_rotations,
    solve,
    synthetic,
)
from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.bundle_adjustment import adjust_thinly
from sfm_shapefit.adjustment.covariance import estimate_covariances
from sfm_shapefit.adjustment.freedom import Freedom
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.adjustment.run import begin
from sfm_shapefit.adjustment.shared_errors import estimate_center_errors
from sfm_shapefit.adjustment.solve import adjust
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.rigidity.pieces import parallel_rigid_pieces
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.verdicts import assess
from sfm_shapefit.laplacian.operators import adjacency
from sfm_shapefit.laplacian.ordering import widest_level
from sfm_shapefit.pairs.triplets import score_triplets
from sfm_shapefit.pipeline.bundle import read_bundle
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
from sfm_shapefit.synthetic import RenderOptions, SceneOptions, WorkspaceOptions
from sfm_shapefit.synthetic.rendered_workspace import write_rendered_workspace
from sfm_shapefit.synthetic.rotation_graphs import rotation_problem
from sfm_shapefit.synthetic.workspace import write_workspace
from sfm_shapefit.tracks.structure_options import StructureOptions


def _random_graph(dimension: int = 3, num_nodes: int = 20) -> ViewGraph:
    return synthetic.random_graph_problem(num_nodes, 0.6, dimension, sigma=0.02, q=0.1, seed=1).view_graph


def _long_graph(num_nodes: int = 300) -> ViewGraph:
    return synthetic.ring_graph_problem(num_nodes, 8.0, sigma=0.02, q=0.1, seed=1).view_graph


def _workspace(
    folder: Path, options: WorkspaceOptions | None = None, *, wrong: float = 0.0, num_images: int = 8
) -> Path:
    """Write images of a ring, a share of whose pairs is wrong, and return the folder of the model."""
    scene = synthetic.make_scene(
        SceneOptions(shape="ring", num_images=num_images, num_points=300, corrupted_pair_fraction=wrong)
    )
    write_workspace(scene, folder / "ring", options)
    return folder / "ring" / "sparse" / "0"


def solve_dense(_folder: Path) -> None:
    """Solve graphs by Newton steps: from a rough start, from least squares, and with a float32 factor."""
    for graph in (_random_graph(), _long_graph(40), _random_graph(num_nodes=160)):
        solve(graph, threads=2)
    solve_newton_dense(_long_graph(160), 1e-8, 50)


def start_by_lud(_folder: Path) -> None:
    """Solve LUD, as the second start of a placement."""
    solve_lud(_random_graph(), certified=False)


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


def measure_pairs(folder: Path) -> None:
    """Measure directions from matches, join tracks as nodes, and estimate relative rotations."""
    model = _workspace(folder, WorkspaceOptions(model="rotations"))
    inspect(model)
    relative_rotations(model.parents[1] / "database.db", threads=2)


def solve_sparse(_folder: Path) -> None:
    """Solve a long graph by Newton steps, and factor one of so many entries that threads share it."""
    solve_newton_sparse(_long_graph(), 1e-8, 50)
    full = synthetic.random_graph_problem(340, 1.0, sigma=0.02, seed=1).view_graph
    plan = plan_refinement(full)
    assert plan is not None
    allocate_normal(plan, 3).refactor(np.tile(np.eye(3), (full.num_edges, 1, 1)))


def solve_by_splitting(_folder: Path) -> None:
    """Solve graphs by splitting, with a factor and without."""
    for graph in (_random_graph(), _long_graph(60)):
        solve(graph, solver="admm", threads=2)
        solve(graph, solver="admm", threads=1, factor_memory_mb=0, max_iterations=20)
    solve(_long_graph(500), solver="admm", threads=1, max_iterations=20)  # its factor is of float32
    exact = synthetic.ring_graph_problem(60, 8.0, q=0.1, seed=1)
    solve(exact.view_graph, solver="admm", threads=1, max_iterations=200)  # which is accelerated


def solve_iteratively(_folder: Path) -> None:
    """Solve a Laplacian without a factor, in three dimensions and two, and ask whether one is worth it."""
    graph = _long_graph()
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


def place_graph(_folder: Path) -> None:
    """Place bare graphs with all that follows the solve, also where most pairs are wrong."""
    place(_random_graph(), threads=2)
    place(_random_graph(), objective="lud", threads=2)
    place(synthetic.random_graph_problem(40, 0.6, q=0.8, seed=1).view_graph, threads=2)


def place_long_graph(_folder: Path) -> None:
    """Place a graph that is long enough for sparse factors."""
    place(_long_graph(), threads=2)


def place_flat_graph(_folder: Path) -> None:
    """Place a graph in two dimensions, and solve it by sparse Newton steps, as large ones are."""
    graph = _random_graph(2)
    place(graph, threads=2)
    solve_newton_sparse(graph, 1e-8, 50)


def locate_model(folder: Path) -> None:
    """Locate the cameras of a model from its database, with checked tracks, and compare with the truth."""
    model = _workspace(folder, WorkspaceOptions(model="rotations"), wrong=0.2)
    found = locate(model, threads=2)
    evaluate(found.reconstruction, model.parents[1] / "truth")


def locate_from_tracks(folder: Path) -> None:
    """Locate the cameras of a model without a database, and inspect it."""
    model = _workspace(folder, WorkspaceOptions(database=False))
    locate(model, threads=1, adjust="full")
    inspect(model)


def locate_rigs(folder: Path) -> None:
    """Locate the cameras of two rigs."""
    drive = synthetic.make_rig_drive(SceneOptions(num_images=18, num_points=600, max_pairs_per_image=12))
    write_workspace(drive, folder / "drive", WorkspaceOptions(model="rotations"))
    locate(folder / "drive" / "sparse" / "0")


def locate_around_fixed(folder: Path) -> None:
    """Locate cameras around others that stay, and by priors that pull."""
    model = _workspace(folder)
    posed = read_model(model).images
    names = folder / "fixed.txt"
    names.write_text("\n".join(posed.names[:4]))
    locate(model, fix=str(names))
    rows = [f"{name} {x} {y} {z} 0.1" for name, (x, y, z) in zip(posed.names, posed.centers, strict=True)]
    (folder / "priors.txt").write_text("\n".join(rows))
    locate(model, priors=folder / "priors.txt")


def map_matches(folder: Path) -> None:
    """Map a database, and refine the rotations."""
    model = _workspace(folder, WorkspaceOptions(model="rotations"))
    map_database(model.parents[1] / "database.db")


def join_halves(folder: Path) -> None:
    """Map two halves of a ring apart, and join them by the pairs between."""
    model = _workspace(folder, WorkspaceOptions(model="rotations"), num_images=12)
    database = model.parents[1] / "database.db"
    names = read_model(model).images.names
    across = folder / "across.txt"
    across.write_text("\n".join(f"{a},{b}" for a in names[:6] for b in names[6:]))
    halves = map_database(database, without=str(across))
    paths = [half.write(folder / f"half{number}") for number, half in enumerate(halves.models)]
    join(paths, database=database)


def relate_images(folder: Path) -> None:
    """Estimate relative rotations, and score their triangles, for those who call it from Python."""
    database = _workspace(folder, WorkspaceOptions(model="rotations")).parents[1] / "database.db"
    found = relative_rotations(database, threads=2)
    score_triplets(len(found.names), found)


def average_graphs(_folder: Path) -> None:
    """Average rotations with a factor, and as on large graphs without one."""
    edges = np.ascontiguousarray(_random_graph().edges)
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


def draw_images(folder: Path) -> None:
    """Draw images."""
    options = SceneOptions(shape="ring", num_images=3, image_width=160, image_height=120)
    scene = synthetic.make_rendered_scene(options, RenderOptions())
    write_rendered_workspace(scene, folder / "drawn", WorkspaceOptions(database=False))
    synthetic.surface_points(scene, 0, np.array([[80.0, 60.0]]))


def adjust_bundle(folder: Path) -> None:
    """Adjust the tracks of a small model, and say how uncertain a bundle is, as after each placement."""
    model = read_model(_workspace(folder, WorkspaceOptions(database=False)))
    images, _, tracks = read_bundle(model.arrays)
    adjust_thinly(begin(images, tracks, StructureOptions(), Freedom()))
    adjusted = adjust(_bundle(), loss_scale_px=1.0, threads=2)
    Lens("SIMPLE_FISHEYE", (500.0, 320.0, 240.0)).rays(np.zeros((1, 2)))
    estimate_covariances(adjusted.problem)
    estimate_center_errors(adjusted.problem, AdjustmentOptions())


def adjust_sparsely(_folder: Path) -> None:
    """Adjust a bundle with the factor that long ones take, and as still longer ones are."""
    for solver in ("sparse", "iterative"):
        adjust(_bundle(), linear_solver=solver, loss_scale_px=1.0, threads=2)


def _bundle() -> AdjustmentProblem:
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
