"""Trust: do standard deviations cover the errors, does trust rank them, are wrong rotations recognised?

Calibration: scenes of known truth, directions with known or unknown covariances, and photographed scenes
through `locate`. A standard deviation covers an error that it is not smaller than; of normal errors 68 % are.

Ranking: graphs in which some cameras are worse than others, for one of three reasons. A camera is bad if its
error is more than three times the median; the area under the curve (AUC) is the probability that a bad camera
is trusted less than a good one. Seeds without bad cameras count for nothing.

Real scenes: a rotation is wrong if it is more than 5 degrees off the truth after the best common rotation; a
camera is flagged if `locate` leaves it out. The truth of liberty* is the model that gives the rotations.
"""

import argparse
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.metrics import Check, Quantity, number, verdict
from benchmarks.record import environment, legend, table, write_section

if TYPE_CHECKING:
    from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
    from sfm_shapefit.colmap.model import PosedModel
    from sfm_shapefit.placement.place import Placement
    from sfm_shapefit.synthetic.options import Shape

HELP = "Standard deviations against errors, trust against errors, wrong rotations recognised."
ROOT = Path(__file__).parents[2]
PACKAGES = ("numpy", "scipy", "numba", "pycolmap")
SETS = ("fountain-P11", "Herz-Jesus-P8", "Herz-Jesus-P25", "castle-P19", "castle-P30", "lego100")
FURTHER_SETS = ("liberty", "liberty-calibrated")
COVERAGE = (0.546, 0.816)  # 68 % within 20 %
LEAST_AUC = 0.9
BAD = 3.0  # times the median error
WRONG_DEG = 5.0
SHAPES: "tuple[Shape, ...]" = ("ring", "facade", "cloud", "courtyard")

QUANTITIES = (
    Quantity(
        name="covered",
        unit="1",
        better="neither",
        rel_tol=0.05,
        meaning="share of coordinate errors within one standard deviation; 0.546 to 0.816 is asked",
    ),
    Quantity(
        name="rms", unit="1", better="neither", rel_tol=0.05, meaning="of errors over standard deviations"
    ),
    Quantity(name="AUC", unit="1", better="higher", rel_tol=0.02, meaning="trust against bad cameras"),
    Quantity(
        name="flagged",
        unit="cameras",
        better="neither",
        rel_tol=0.0,
        meaning="wrong ones / right ones left out",
    ),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Graph:
    """Directions between known locations."""

    locations: "FloatArray"
    edges: "IntArray"
    directions: "FloatArray"
    covariances: "FloatArray"


# --- the subcommand --------------------------------------------------------------------------------


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `trust`."""
    parser.add_argument("--seeds", type=int, default=5, help="seeds of each synthetic problem (default 5)")
    parser.add_argument(
        "--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the real sets"
    )
    parser.add_argument("--out", type=Path, default=ROOT / "scripts" / "results.md", help="file of results")


def run(args: argparse.Namespace) -> int:
    """Measure, print the section and write it; a missed limit is no failure."""
    about = environment(PACKAGES, f"python scripts/benchmark.py trust --seeds {args.seeds}")
    parts = [
        "## Trust\n",
        about,
        "\n### Standard deviations\n",
        calibration_table(args.seeds),
        "\n### Ranking\n",
        ranking_table(args.seeds),
        "\n### Wrong rotations\n",
        real_table(args.data),
        "\n### Columns\n",
        legend(QUANTITIES),
    ]
    body = "\n".join(parts)
    print(body)
    write_section(args.out, "trust", body)
    return 0


# --- calibration -----------------------------------------------------------------------------------


def calibration_table(seeds: int) -> str:
    """Return the table of errors over standard deviations."""
    rows = []
    for name, draw in GRAPHS.items():
        for wrong in (0.0, 0.2):
            print(f"calibrating {name}, {wrong:.0%} wrong", file=sys.stderr, flush=True)
            ratios = [_graph_ratios(draw(seed, wrong)) for seed in range(seeds)]
            rows.append(_calibration_row(f"graph {name}, {wrong:.0%} wrong", ratios))
    for shape in SHAPES:
        print(f"calibrating scene {shape}", file=sys.stderr, flush=True)
        ratios = [_scene_ratios(shape, seed) for seed in range(seeds)]
        rows.append(_calibration_row(f"scene {shape}, 25 images, 0.5 px", ratios))
    header = ["problem", "covered", "rms", "verdict"]
    return table(header, rows)


def _calibration_row(name: str, found: "list[FloatArray]") -> list[str]:
    ratios = np.concatenate(found)
    covered = float(np.mean(np.abs(ratios) < 1.0))
    checks = [
        Check(name="covered", value=covered, limit=COVERAGE[0], better="higher"),
        Check(name="covered", value=covered, limit=COVERAGE[1]),
    ]
    return [name, number(covered), number(float(np.sqrt(np.mean(ratios**2)))), verdict(checks)]


def error_ratios(found: "FloatArray", truth: "FloatArray", sigmas: "FloatArray") -> "FloatArray":
    """Return errors over standard deviations, centroid and scale of the held cameras brought together."""
    held = np.isfinite(sigmas).all(axis=1)
    centred, wanted = found - found[held].mean(axis=0), truth - truth[held].mean(axis=0)
    scale = np.sum(centred[held] ** 2) / np.sum(centred[held] * wanted[held])
    ratios: FloatArray = ((centred - scale * wanted)[held] / sigmas[held]).ravel()
    return ratios


def _graph_ratios(graph: Graph) -> "FloatArray":
    from sfm_shapefit.placement.place import place
    from sfm_shapefit.viewgraph import ViewGraph

    given = ViewGraph(len(graph.locations), graph.edges, graph.directions)
    return _placement_ratios(place(given, covariance=graph.covariances), graph.locations)


def _placement_ratios(placement: "Placement", truth: "FloatArray") -> "FloatArray":
    cameras = placement.cameras
    sigmas = placement.assessment.sigmas[: len(cameras)]
    return error_ratios(placement.locations, truth[cameras], sigmas)


def _scene_ratios(shape: "Shape", seed: int) -> "FloatArray":
    import sfm_shapefit
    from sfm_shapefit.options import LocateOptions
    from sfm_shapefit.synthetic import SceneOptions, make_scene
    from sfm_shapefit.synthetic.workspace import write_workspace

    scene = make_scene(SceneOptions(shape=shape, num_images=25, num_points=1000, seed=seed))
    with tempfile.TemporaryDirectory() as folder:
        workspace = Path(folder) / "scene"
        write_workspace(scene, workspace)
        found = sfm_shapefit.locate(workspace / "sparse" / "0", options=LocateOptions(min_trust=0.0))
    return _placement_ratios(found.placement, scene.centers)


# --- ranking ---------------------------------------------------------------------------------------


def ranking_table(seeds: int) -> str:
    """Return the table of AUCs."""
    rows = []
    for name, spoil in SPOILED.items():
        print(f"ranking, {name}", file=sys.stderr, flush=True)
        found = [_ranked(spoil(seed)) for seed in range(seeds)]
        known = [(area, bad) for area, bad in found if bad]
        area = float(np.mean([area for area, _ in known])) if known else float("nan")
        check = Check(name="AUC", value=area, limit=LEAST_AUC, better="higher")
        rows.append([name, number(area), str(sum(bad for _, bad in known)), verdict([check])])
    return table(["problem", "AUC", "bad cameras", "verdict"], rows)


def area_under_curve(trust: "FloatArray", bad: "BoolArray") -> float:
    """Return the probability that a bad camera is trusted less than a good one; half for equal trust."""
    low, high = trust[bad][:, None], trust[~bad][None, :]
    return float(np.mean((low < high) + 0.5 * (low == high)))


def _ranked(graph: Graph) -> tuple[float, int]:
    """Return the AUC of one graph, and its number of bad cameras."""
    from sfm_shapefit.geometry import fit_similarity_l1
    from sfm_shapefit.placement.place import place
    from sfm_shapefit.viewgraph import ViewGraph

    placement = place(
        ViewGraph(len(graph.locations), graph.edges, graph.directions), covariance=graph.covariances
    )
    truth = graph.locations[placement.cameras]
    found = placement.locations
    errors = np.linalg.norm(fit_similarity_l1(found, truth, rotate=False).apply(found) - truth, axis=1)
    bad = errors > BAD * np.median(errors)
    return area_under_curve(placement.assessment.trust, bad) if bad.any() else 0.0, int(bad.sum())


# --- synthetic problems ----------------------------------------------------------------------------


def _measured(locations: "FloatArray", edges: "IntArray", wrong: "BoolArray", seed: int) -> Graph:
    """Return directions with normal errors of known, varying size, and random ones where `wrong`."""
    from sfm_shapefit.geometry import normalized, tangent_bases

    rng = np.random.default_rng(1000 + seed)
    true = normalized(locations[edges[:, 0]] - locations[edges[:, 1]])
    sigmas = 0.01 * np.exp(0.5 * rng.standard_normal(len(edges)))
    errors = sigmas[:, None] * rng.standard_normal((len(edges), 2))
    noisy = normalized(true + np.einsum("edk,ek->ed", tangent_bases(true), errors))
    random = normalized(rng.standard_normal(true.shape))
    return Graph(
        locations=locations,
        edges=edges,
        directions=np.where(wrong[:, None], random, noisy),
        covariances=sigmas[:, None, None] ** 2 * np.eye(2),
    )


def _random(seed: int, wrong: float) -> Graph:
    from sfm_shapefit.synthetic import random_graph_problem

    problem = random_graph_problem(80, 0.4, q=wrong, seed=seed)
    return _measured(problem.locations, problem.edges, problem.corrupted, seed)


def _box(seed: int, wrong: float) -> Graph:
    from sfm_shapefit.synthetic import box_graph_problem

    problem = box_graph_problem(200, 20.0, q=wrong, seed=seed)
    return _measured(problem.locations, problem.edges, problem.corrupted, seed)


def _community(seed: int, wrong: float) -> Graph:
    from sfm_shapefit.synthetic import community_graph_problem

    problem = community_graph_problem(200, 30.0, q=wrong, seed=seed)
    return _measured(problem.locations, problem.edges, problem.corrupted, seed)


GRAPHS: dict[str, Callable[[int, float], Graph]] = {"random": _random, "box": _box, "community": _community}


def _chosen(seed: int, graph: Graph) -> "BoolArray":
    """Return a tenth of the cameras of a graph."""
    rng = np.random.default_rng(2000 + seed)
    n = len(graph.locations)
    chosen: BoolArray = np.zeros(n, dtype=np.bool_)
    chosen[rng.permutation(n)[: n // 10]] = True
    return chosen


def concentrated(seed: int) -> Graph:
    """A tenth of the cameras have 70 % wrong pairs."""
    graph = _box(seed, 0.0)
    own = _chosen(seed, graph)[graph.edges].any(axis=1)
    wrong = own & (np.random.default_rng(3000 + seed).random(len(graph.edges)) < 0.7)
    return _measured(graph.locations, graph.edges, wrong, seed)


def turned(seed: int) -> Graph:
    """A tenth of the cameras are turned by 20 degrees, the directions of their pairs half as far."""
    from sfm_shapefit.geometry import normalized

    graph = _box(seed, 0.0)
    axes = normalized(np.random.default_rng(3000 + seed).standard_normal(graph.locations.shape))
    turns = np.where(_chosen(seed, graph)[:, None], np.radians(20.0) * axes, 0.0)
    moved = np.cross(turns[graph.edges].sum(axis=1) / 2.0, graph.directions)
    return Graph(
        locations=graph.locations,
        edges=graph.edges,
        directions=normalized(graph.directions + moved),
        covariances=graph.covariances,
    )


def weak(seed: int) -> Graph:
    """A tenth of the cameras have three pairs."""
    graph = _box(seed, 0.0)
    kept = np.ones(len(graph.edges), dtype=np.bool_)
    for camera in np.flatnonzero(_chosen(seed, graph)).tolist():
        own = np.flatnonzero((graph.edges == camera).any(axis=1) & kept)
        kept[own[3:]] = False
    edges = graph.edges[kept]
    return _measured(graph.locations, edges, np.zeros(len(edges), dtype=np.bool_), seed)


SPOILED: dict[str, Callable[[int], Graph]] = {
    "10 % of the cameras with 70 % wrong pairs": concentrated,
    "10 % of the cameras turned by 20 degrees": turned,
    "10 % of the cameras with three pairs": weak,
}


# --- real scenes -----------------------------------------------------------------------------------


def real_table(data: Path) -> str:
    """Return the table of cameras left out of the real scenes that are at hand."""
    rows = []
    for name in (*SETS, *FURTHER_SETS):
        if not (data / name).is_dir():
            rows.append([name, "-", "-", "-", "-", "not at hand"])
            continue
        print(f"locating {name}", file=sys.stderr, flush=True)
        rows.append(_real_row(data / name))
    header = [
        "set",
        "wrong rotations",
        "flagged wrong / right",
        "lowest trust kept",
        "median / mean",
        "verdict",
    ]
    return table(header, rows)


def _real_row(scene: Path) -> list[str]:
    import sfm_shapefit
    from sfm_shapefit.colmap.model import read_model

    found = sfm_shapefit.locate(scene / "sparse" / "0", scene / "database.db")
    reference = scene / "gt" if (scene / "gt").is_dir() else scene / "sparse" / "0"
    truth = read_model(reference)
    cameras = found.placement.cameras
    wrong = rotation_errors_deg(found.model, truth)[cameras] > WRONG_DEG
    errors = sfm_shapefit.evaluate(found.reconstruction, reference).position
    caught, blamed = int(np.sum(wrong & ~found.kept)), int(np.sum(~wrong & ~found.kept))
    checks = []
    if scene.name in SETS:
        least = int(np.sum(wrong)) - (1 if wrong.any() else 0)
        most = 6 if scene.name == "lego100" else 0
        checks = [
            Check(name="wrong", value=caught, limit=least, better="higher"),
            Check(name="right", value=blamed, limit=most),
        ]
    lowest = float(found.placement.assessment.trust[found.kept].min())
    return [
        scene.name,
        f"{int(np.sum(wrong))} of {len(cameras)}",
        f"{caught} / {blamed}",
        number(lowest),
        f"{number(errors.median)} / {number(errors.mean)}",
        verdict(checks),
    ]


def rotation_errors_deg(model: "PosedModel", truth: "PosedModel") -> "FloatArray":
    """Return the angle of each given rotation from the truth after the best common rotation, or NaN."""
    from sfm_shapefit.geometry import mean_rotation_l1, rotation_angles_deg

    place_of = {name: k for k, name in enumerate(truth.names)}
    common = [k for k, name in enumerate(model.names) if name in place_of]
    theirs = truth.rotations[[place_of[model.names[k]] for k in common]]
    relative = model.rotations[common].transpose(0, 2, 1) @ theirs
    errors = np.full(len(model.names), np.nan)
    errors[common] = rotation_angles_deg(relative @ mean_rotation_l1(relative).T)
    return errors
