"""Trust: do standard deviations cover the errors, does trust rank them, are wrong rotations recognized?

Calibration: scenes of known truth, directions with known or unknown covariances, and photographed scenes
through `locate`. A standard deviation covers an error that it is not smaller than; of normal errors 68 % are.

Ranking: graphs in which some cameras are worse than others, for one of three reasons. A camera is bad if its
error is more than three times the median; the area under the curve (AUC) is the probability that a bad camera
is trusted less than a good one. Seeds without bad cameras count for nothing.

Real scenes: a rotation is wrong if it is more than 5 degrees off the truth after the best common rotation; a
camera is flagged if `locate` leaves it out. The truth of liberty* is the model that gives the rotations.
"""

import argparse
import tempfile
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from harness import ours
from harness.driver import ROOT, Benchmark, Case, if_there
from harness.graphs import view_graph
from harness.metrics import Check, Quantity, number, numbers, verdict
from harness.record import table_of

if TYPE_CHECKING:
    from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
    from sfm_shapefit.files.colmap.model import PosedModel
    from sfm_shapefit.placement.place import Placement

SETS = ("fountain-P11", "Herz-Jesus-P8", "Herz-Jesus-P25", "castle-P19", "castle-P30", "lego100")
FURTHER_SETS = ("liberty", "liberty-calibrated")
COVERAGE = (0.546, 0.816)
"""68 % within 20 %."""
LEAST_AUC = 0.9
BAD = 3.0
"""Times the median error."""
WRONG_DEG = 5.0
SHAPES = ("ring", "facade", "cloud", "courtyard")


class Graph(NamedTuple):
    """Directions between known locations."""

    locations: "FloatArray"
    edges: "IntArray"
    directions: "FloatArray"
    covariances: "FloatArray"


class Calibration(NamedTuple):
    """Errors over standard deviations of one problem."""

    name: str
    covered: float
    rms: float


class Ranking(NamedTuple):
    """How trust ranks the errors of one problem."""

    name: str
    area: float
    """Under the curve, mean of the seeds that have bad cameras."""
    num_bad: int


class Flagged(NamedTuple):
    """Which cameras of a real set were left out."""

    name: str
    num_cameras: int
    num_wrong: int
    num_caught: int
    """Wrong rotations left out."""
    num_blamed: int
    """Right rotations left out."""
    lowest_trust: float
    errors: tuple[float, float]
    """Median and mean of the others."""


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the problems of calibration and of ranking, and the real sets."""
    ratios: dict[str, Callable[[int], FloatArray]] = {
        f"graph {name}, {wrong:.0%} wrong": partial(graph_ratios, name, wrong)
        for name, wrong in product(GRAPHS, (0.0, 0.2))
    }
    ratios |= {f"scene {shape}, 25 images, 0.5 px": partial(scene_ratios, shape) for shape in SHAPES}
    found: dict[str, Case] = {n: partial(calibrate, n, ask, args.repeats) for n, ask in ratios.items()}
    found |= {name: partial(rank, name, args.repeats) for name in SPOILED}
    for name in (*SETS, *FURTHER_SETS):
        found[name] = if_there(args.data / name, partial(flag, args.data / name))
    if args.quick:
        chosen = ("graph box, 20% wrong", "scene cloud, 25 images, 0.5 px", *list(SPOILED)[:1])
        found = {name: found[name] for name in chosen}
        found["courtyard"] = partial(flag, ROOT / "data_synthetic" / "courtyard")
    return found


def calibrate(name: str, ask: "Callable[[int], FloatArray]", seeds: int) -> Calibration:
    """Return what the errors over standard deviations of all seeds say of a kind of problem."""
    ratios = np.concatenate([ask(seed) for seed in range(seeds)])
    return Calibration(name, float(np.mean(np.abs(ratios) < 1.0)), float(np.sqrt(np.mean(ratios**2))))


def error_ratios(found: "FloatArray", truth: "FloatArray", sigmas: "FloatArray") -> "FloatArray":
    """Return errors over standard deviations, centroid and scale of the held cameras brought together."""
    held = np.isfinite(sigmas).all(axis=1)
    centered, wanted = found - found[held].mean(axis=0), truth - truth[held].mean(axis=0)
    scale = np.sum(centered[held] ** 2) / np.sum(centered[held] * wanted[held])
    ratios: FloatArray = ((centered - scale * wanted)[held] / sigmas[held]).ravel()
    return ratios


def graph_ratios(name: str, wrong: float, seed: int) -> "FloatArray":
    """Return errors over standard deviations of a graph's placement."""
    graph = draw_graph(name, seed, wrong)
    return _placement_ratios(ours.place(view_graph(graph), covariance=graph.covariances), graph.locations)


def _placement_ratios(placement: "Placement", truth: "FloatArray") -> "FloatArray":
    cameras = placement.cameras
    sigmas = placement.assessment.sigmas[: len(cameras)]
    return error_ratios(placement.locations, truth[cameras], sigmas)


def scene_ratios(shape: str, seed: int) -> "FloatArray":
    """Return errors over standard deviations of a photographed scene's cameras."""
    from sfm_shapefit.synthetic import SceneOptions, make_scene
    from sfm_shapefit.synthetic.workspace import write_workspace

    options = SceneOptions(shape=shape, num_images=25, num_points=1000, seed=seed)  # type: ignore[arg-type]
    scene = make_scene(options)
    with tempfile.TemporaryDirectory() as folder:
        workspace = Path(folder) / "scene"
        write_workspace(scene, workspace)
        found = ours.locate(workspace / "sparse" / "0", min_trust=0.0)
    return _placement_ratios(found.placement, scene.centers)


def rank(name: str, seeds: int) -> Ranking:
    """Rank the cameras of spoiled graphs by their trust."""
    found = [rank_graph(SPOILED[name](seed)) for seed in range(seeds)]
    areas = [area for area, num_bad in found if num_bad]
    area = float(np.mean(areas)) if areas else float("nan")
    return Ranking(name, area, sum(num_bad for _, num_bad in found))


def area_under_curve(trust: "FloatArray", bad: "BoolArray") -> float:
    """Return the probability that a bad camera is trusted less than a good one; half for equal trust."""
    low, high = trust[bad][:, None], trust[~bad][None, :]
    return float(np.mean((low < high) + 0.5 * (low == high)))


def rank_graph(graph: Graph) -> tuple[float, int]:
    """Return the AUC of one graph, and its number of bad cameras."""
    from sfm_shapefit.base.geometry import fit_similarity_l1

    placement = ours.place(view_graph(graph), covariance=graph.covariances)
    truth = graph.locations[placement.cameras]
    found = placement.locations
    errors = np.linalg.norm(fit_similarity_l1(found, truth, rotate=False).apply(found) - truth, axis=1)
    bad = errors > BAD * np.median(errors)
    return area_under_curve(placement.assessment.trust, bad) if bad.any() else 0.0, int(bad.sum())


def _measure(locations: "FloatArray", edges: "IntArray", wrong: "BoolArray", seed: int) -> Graph:
    """Return directions with normal errors of known, varying size, and random ones where `wrong`."""
    from sfm_shapefit.base.geometry import normalized, tangent_bases

    rng = np.random.default_rng(1000 + seed)
    true = normalized(locations[edges[:, 0]] - locations[edges[:, 1]])
    sigmas = 0.01 * np.exp(0.5 * rng.standard_normal(len(edges)))
    errors = sigmas[:, None] * rng.standard_normal((len(edges), 2))
    noisy = normalized(true + np.einsum("edk,ek->ed", tangent_bases(true), errors))
    random = normalized(rng.standard_normal(true.shape))
    directions = np.where(wrong[:, None], random, noisy)
    return Graph(locations, edges, directions, sigmas[:, None, None] ** 2 * np.eye(2))


GRAPHS: dict[str, tuple[str, int, float]] = {
    "random": ("random_graph_problem", 80, 0.4),
    "box": ("box_graph_problem", 200, 20.0),
    "community": ("community_graph_problem", 200, 30.0),
}
"""Functions of `sfm_shapefit.synthetic` and their arguments."""


def draw_graph(name: str, seed: int, wrong: float = 0.0) -> Graph:
    """Return a graph of a kind, a share of whose directions is wrong."""
    from sfm_shapefit import synthetic

    function, n, density = GRAPHS[name]
    problem = getattr(synthetic, function)(n, density, q=wrong, seed=seed)
    return _measure(problem.locations, problem.edges, problem.corrupted, seed)


def _chosen(seed: int, graph: Graph) -> "BoolArray":
    """Return a tenth of the cameras of a graph."""
    rng = np.random.default_rng(2000 + seed)
    n = len(graph.locations)
    chosen: BoolArray = np.zeros(n, dtype=np.bool_)
    chosen[rng.permutation(n)[: n // 10]] = True
    return chosen


def concentrate(seed: int) -> Graph:
    """A tenth of the cameras have 70 % wrong pairs."""
    graph = draw_graph("box", seed)
    own = _chosen(seed, graph)[graph.edges].any(axis=1)
    wrong = own & (np.random.default_rng(3000 + seed).random(len(graph.edges)) < 0.7)
    return _measure(graph.locations, graph.edges, wrong, seed)


def turn_cameras(seed: int) -> Graph:
    """A tenth of the cameras are turned by 20 degrees, the directions of their pairs half as far."""
    from sfm_shapefit.base.geometry import normalized

    graph = draw_graph("box", seed)
    axes = normalized(np.random.default_rng(3000 + seed).standard_normal(graph.locations.shape))
    turns = np.where(_chosen(seed, graph)[:, None], np.radians(20.0) * axes, 0.0)
    moved = np.cross(turns[graph.edges].sum(axis=1) / 2.0, graph.directions)
    return graph._replace(directions=normalized(graph.directions + moved))


def weaken(seed: int) -> Graph:
    """A tenth of the cameras have three pairs."""
    graph = draw_graph("box", seed)
    kept = np.ones(len(graph.edges), dtype=np.bool_)
    for camera in np.flatnonzero(_chosen(seed, graph)).tolist():
        own = np.flatnonzero((graph.edges == camera).any(axis=1) & kept)
        kept[own[3:]] = False
    edges = graph.edges[kept]
    return _measure(graph.locations, edges, np.zeros(len(edges), dtype=np.bool_), seed)


SPOILED: dict[str, Callable[[int], Graph]] = {
    "10 % of the cameras with 70 % wrong pairs": concentrate,
    "10 % of the cameras turned by 20 degrees": turn_cameras,
    "10 % of the cameras with three pairs": weaken,
}


def flag(folder: Path) -> Flagged:
    """Locate the cameras of a set and compare those left out with the wrong rotations."""
    import sfm_shapefit
    from sfm_shapefit.files.colmap.model import read_model

    found = ours.locate(folder / "sparse" / "0", folder / "database.db")
    reference = next(folder / name for name in ("gt", "truth", "sparse/0") if (folder / name).is_dir())
    cameras = found.placement.cameras
    wrong = rotation_errors_deg(found.model, read_model(reference))[cameras] > WRONG_DEG
    errors = sfm_shapefit.evaluate(found.reconstruction, reference).position
    return Flagged(
        name=folder.name,
        num_cameras=len(cameras),
        num_wrong=int(np.sum(wrong)),
        num_caught=int(np.sum(wrong & ~found.kept)),
        num_blamed=int(np.sum(~wrong & ~found.kept)),
        lowest_trust=float(found.placement.assessment.trust[found.kept].min()),
        errors=(errors.median, errors.mean),
    )


def rotation_errors_deg(model: "PosedModel", truth: "PosedModel") -> "FloatArray":
    """Return the angle of each given rotation from the truth after the best common rotation, or NaN."""
    from sfm_shapefit.base.geometry import mean_rotation_l1, rotation_angles_deg

    place_of = {name: k for k, name in enumerate(truth.names)}
    common = [k for k, name in enumerate(model.names) if name in place_of]
    theirs = truth.rotations[[place_of[model.names[k]] for k in common]]
    relative = model.rotations[common].transpose(0, 2, 1) @ theirs
    errors = np.full(len(model.names), np.nan)
    errors[common] = rotation_angles_deg(relative @ mean_rotation_l1(relative).T)
    return errors


def checks(one: Calibration | Ranking | Flagged) -> list[Check]:
    """Return the limits of one case; sets whose truth gives their rotations have none."""
    if isinstance(one, Calibration):
        return [
            Check(name="covered", value=one.covered, limit=COVERAGE[0], better="higher"),
            Check(name="covered", value=one.covered, limit=COVERAGE[1]),
        ]
    if isinstance(one, Ranking):
        return [Check(name="AUC", value=one.area, limit=LEAST_AUC, better="higher")]
    if one.name not in SETS:
        return []
    least = one.num_wrong - (1 if one.num_wrong else 0)
    most = 6 if one.name == "lego100" else 0
    return [
        Check(name="wrong", value=one.num_caught, limit=least, better="higher"),
        Check(name="right", value=one.num_blamed, limit=most),
    ]


COLUMNS: dict[type, tuple[str, dict[str, Callable[[Any], str]]]] = {
    Calibration: (
        "Standard deviations",
        {
            "problem": lambda one: one.name,
            "covered": lambda one: number(one.covered),
            "rms": lambda one: number(one.rms),
        },
    ),
    Ranking: (
        "Ranking",
        {
            "problem": lambda one: one.name,
            "AUC": lambda one: number(one.area),
            "bad cameras": lambda one: str(one.num_bad),
        },
    ),
    Flagged: (
        "Wrong rotations",
        {
            "set": lambda one: one.name,
            "wrong rotations": lambda one: f"{one.num_wrong} of {one.num_cameras}",
            "flagged wrong / right": lambda one: f"{one.num_caught} / {one.num_blamed}",
            "lowest trust kept": lambda one: number(one.lowest_trust),
            "median / mean": lambda one: numbers(one.errors),
        },
    ),
}


def tables(measured: Mapping[str, Any], _args: argparse.Namespace) -> Iterator[str]:
    for kind, (heading, columns) in COLUMNS.items():
        yield f"## {heading}"
        found = [one for one in measured.values() if isinstance(one, kind)]
        yield table_of(found, columns | {"verdict": lambda one: verdict(checks(one))})


BENCHMARK = Benchmark(
    name="trust",
    title="Trust",
    cases=cases,
    checks=checks,
    tables=tables,
    quick={"repeats": 1},
    repeats=5,
    threads=2,
    quantities=(
        Quantity("covered", "1", "neither", 0.05, "share of errors within one standard deviation"),
        Quantity("rms", "1", "neither", 0.05, "of errors over standard deviations"),
        Quantity("AUC", "1", "higher", 0.02, "trust against bad cameras"),
        Quantity("flagged", "cameras", "neither", 0.0, "wrong ones / right ones left out"),
    ),
)
