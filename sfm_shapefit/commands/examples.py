"""Small examples of all that commands do: running them compiles every kernel, see `commands.warm_up`.

An example takes an empty folder for its files, and a fraction of a second once its kernels are compiled.
"""

from pathlib import Path

import numpy as np

from sfm_shapefit import evaluate, inspect, join, locate, map_database, place, relative_rotations, synthetic
from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.bundle_adjustment import adjust_thinly
from sfm_shapefit.adjustment.covariance import estimate_covariances
from sfm_shapefit.adjustment.freedom import Freedom
from sfm_shapefit.adjustment.run import begin
from sfm_shapefit.adjustment.shared_errors import estimate_center_errors
from sfm_shapefit.adjustment.solve import adjust
from sfm_shapefit.commands.part_examples import drawn_graph, long_graph, small_bundle
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.pairs.triplets import score_triplets
from sfm_shapefit.pipeline.bundle import read_bundle
from sfm_shapefit.scene.lens import Lens
from sfm_shapefit.solver.newton.sparse import solve_newton_sparse
from sfm_shapefit.synthetic import RenderOptions, SceneOptions, WorkspaceOptions
from sfm_shapefit.synthetic.rendered_workspace import write_rendered_workspace
from sfm_shapefit.synthetic.workspace import write_workspace
from sfm_shapefit.tracks.structure_options import StructureOptions


def _workspace(
    folder: Path, options: WorkspaceOptions | None = None, *, wrong: float = 0.0, num_images: int = 8
) -> Path:
    """Write images of a ring, a share of whose pairs is wrong, and return the folder of the model."""
    scene = synthetic.make_scene(
        SceneOptions(shape="ring", num_images=num_images, num_points=300, corrupted_pair_fraction=wrong)
    )
    write_workspace(scene, folder / "ring", options)
    return folder / "ring" / "sparse" / "0"


def measure_pairs(folder: Path) -> None:
    """Measure directions from matches, join tracks as nodes, and estimate relative rotations."""
    model = _workspace(folder, WorkspaceOptions(model="rotations"))
    inspect(model)
    relative_rotations(model.parents[1] / "database.db", threads=2)


def place_graph(_folder: Path) -> None:
    """Place bare graphs with all that follows the solve, also where most pairs are wrong."""
    place(drawn_graph(), threads=2)
    place(drawn_graph(), objective="lud", threads=2)
    place(synthetic.random_graph_problem(40, 0.6, q=0.8, seed=1).view_graph, threads=2)


def place_long_graph(_folder: Path) -> None:
    """Place a graph that is long enough for sparse factors."""
    place(long_graph(), threads=2)


def place_flat_graph(_folder: Path) -> None:
    """Place a graph in two dimensions, and solve it by sparse Newton steps, as large ones are."""
    graph = drawn_graph(2)
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
    adjusted = adjust(small_bundle(), loss_scale_px=1.0, threads=2)
    Lens("SIMPLE_FISHEYE", (500.0, 320.0, 240.0)).rays(np.zeros((1, 2)))
    estimate_covariances(adjusted.problem)
    estimate_center_errors(adjusted.problem, AdjustmentOptions())
