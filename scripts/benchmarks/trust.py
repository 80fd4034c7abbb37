"""Trust: do standard deviations cover the errors, does trust rank them, are wrong rotations recognized?

Calibration: graphs of known truth and covariances, and made scenes through `locate`, as they are placed. A
standard deviation covers an error that it is not smaller than; of normal errors 68 % are.

Ranking: graphs in which some cameras are worse than others, for one of three reasons. A camera is bad if its
error is more than three times the median; the area under the curve (AUC) is the probability that a bad camera
is trusted less than a good one. Seeds without bad cameras count for nothing.

Real scenes: a rotation is wrong if it is more than 5 degrees off the truth after the best common rotation; a
camera is flagged if `locate` leaves it out. The truth of liberty* is the model that gives the rotations.
"""

import argparse
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

import sfm_shapefit
from harness.driver import ROOT, Benchmark, Case, on_sets
from harness.record import Row, at_least, at_most
from harness.scenes import WRONG_DEG, rotation_errors_deg, temporary_scene
from sfm_shapefit import ViewGraph, synthetic
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.geometry import fit_similarity_l1, normalized, tangent_bases
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.judgement.judged import Judged

SETS = ("fountain-P11", "Herz-Jesus-P8", "Herz-Jesus-P25", "castle-P19", "castle-P30", "lego100")
FURTHER_SETS = ("liberty", "liberty-calibrated")
COVERAGE = (0.546, 0.816)
"""68 % within 20 %."""
LEAST_AUC = 0.9
BAD = 3.0
"""Times the median error."""
SHAPES = ("ring", "facade", "cloud", "courtyard")


class Graph(NamedTuple):
    """Directions between known locations."""

    locations: FloatArray
    edges: IntArray
    directions: FloatArray
    covariances: FloatArray

    def place(self) -> Judged:
        """Place its cameras."""
        graph = ViewGraph(len(self.locations), self.edges, self.directions)
        return sfm_shapefit.place(MeasuredGraph(graph, covariance=self.covariances))


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the problems of calibration and of ranking, and the real sets."""
    ratios: dict[str, Callable[[int], FloatArray]] = {
        f"graph {name}, {wrong:.0%} wrong": partial(graph_ratios, name, wrong)
        for name, wrong in product(GRAPHS, (0.0, 0.2))
    }
    ratios |= {f"scene {shape}, 25 images, 0.5 px": partial(scene_ratios, shape) for shape in SHAPES}
    found: dict[str, Case] = {n: partial(calibrate, n, ask, args.repeats) for n, ask in ratios.items()}
    found |= {name: partial(rank, name, args.repeats) for name in SPOILED}
    if args.quick:
        chosen = ("graph box, 20% wrong", "scene cloud, 25 images, 0.5 px", *list(SPOILED)[:1])
        bundled = on_sets(ROOT / "data_synthetic", ("courtyard",), flag)
        return {name: found[name] for name in chosen} | bundled
    return found | on_sets(args.data, (*SETS, *FURTHER_SETS), flag)


def calibrate(name: str, ask: Callable[[int], FloatArray], seeds: int) -> Row:
    """Return what the errors over standard deviations of all seeds say of a kind of problem."""
    ratios = np.concatenate([ask(seed) for seed in range(seeds)])
    covered, rms = float(np.mean(np.abs(ratios) < 1.0)), float(np.sqrt(np.mean(ratios**2)))
    checks = at_least(covered=(covered, COVERAGE[0])) + at_most(covered=(covered, COVERAGE[1]))
    return Row({"problem": name, "covered": covered, "rms": rms}, checks, "Standard deviations")


def error_ratios(found: FloatArray, truth: FloatArray, sigmas: FloatArray) -> FloatArray:
    """Return errors over standard deviations, centroid and scale of the held cameras brought together."""
    held = np.isfinite(sigmas).all(axis=1)
    centered, wanted = found - found[held].mean(axis=0), truth - truth[held].mean(axis=0)
    scale = np.sum(centered[held] ** 2) / np.sum(centered[held] * wanted[held])
    ratios: FloatArray = ((centered - scale * wanted)[held] / sigmas[held]).ravel()
    return ratios


def graph_ratios(name: str, wrong: float, seed: int) -> FloatArray:
    """Return errors over standard deviations of a graph's placement."""
    graph = draw_graph(name, seed, wrong)
    return _placement_ratios(graph.place(), graph.locations)


def scene_ratios(shape: str, seed: int) -> FloatArray:
    """Return errors over standard deviations of a made scene's cameras."""
    options = {"shape": shape, "num_images": 25, "num_points": 1000, "seed": seed}
    with temporary_scene(options) as (scene, folder):
        found = sfm_shapefit.locate(folder / "sparse" / "0", min_trust=0.0)
        return _placement_ratios(found.placement, scene.centers)


def _placement_ratios(placement: Judged, truth: FloatArray) -> FloatArray:
    cameras = placement.cameras
    return error_ratios(placement.locations, truth[cameras], placement.assessment.sigmas[: len(cameras)])


def rank(name: str, seeds: int) -> Row:
    """Rank the cameras of spoiled graphs by their trust."""
    found = [rank_graph(SPOILED[name](seed)) for seed in range(seeds)]
    areas = [area for area, num_bad in found if num_bad]
    area = float(np.mean(areas)) if areas else float("nan")
    cells = {"problem": name, "AUC": area, "bad cameras": sum(num_bad for _, num_bad in found)}
    return Row(cells, at_least(AUC=(area, LEAST_AUC)), "Ranking")


def area_under_curve(trust: FloatArray, bad: BoolArray) -> float:
    """Return the probability that a bad camera is trusted less than a good one; half for equal trust."""
    low, high = trust[bad][:, None], trust[~bad][None, :]
    return float(np.mean((low < high) + 0.5 * (low == high)))


def rank_graph(graph: Graph) -> tuple[float, int]:
    """Return the AUC of one graph, and its number of bad cameras."""
    placement = graph.place()
    truth, found = graph.locations[placement.cameras], placement.locations
    errors = np.linalg.norm(fit_similarity_l1(found, truth, rotate=False).apply(found) - truth, axis=1)
    bad = errors > BAD * np.median(errors)
    return area_under_curve(placement.assessment.trust, bad) if bad.any() else 0.0, int(bad.sum())


def _measure(locations: FloatArray, edges: IntArray, wrong: BoolArray, seed: int) -> Graph:
    """Return directions with normal errors of known, varying size, and random ones where `wrong`."""
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
    function, n, density = GRAPHS[name]
    problem = getattr(synthetic, function)(n, density, q=wrong, seed=seed)
    return _measure(problem.locations, problem.edges, problem.corrupted, seed)


def _chosen(seed: int, graph: Graph) -> BoolArray:
    """Return a tenth of the cameras of a graph."""
    n = len(graph.locations)
    return np.isin(np.arange(n), np.random.default_rng(2000 + seed).permutation(n)[: n // 10])


def concentrate(seed: int) -> Graph:
    """A tenth of the cameras have 70 % wrong pairs."""
    graph = draw_graph("box", seed)
    own = _chosen(seed, graph)[graph.edges].any(axis=1)
    wrong = own & (np.random.default_rng(3000 + seed).random(len(graph.edges)) < 0.7)
    return _measure(graph.locations, graph.edges, wrong, seed)


def turn_cameras(seed: int) -> Graph:
    """A tenth of the cameras are turned by 20 degrees, the directions of their pairs half as far."""
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


def flag(folder: Path) -> Row:
    """Locate the cameras of a set and compare those left out with the wrong rotations.

    Sets whose truth gives their rotations have no limits.
    """
    found = sfm_shapefit.locate(folder / "sparse" / "0", folder / "database.db")
    reference = next(folder / name for name in ("gt", "truth", "sparse/0") if (folder / name).is_dir())
    cameras = found.placement.cameras
    wrong = rotation_errors_deg(found.images, read_model(reference).images)[cameras] > WRONG_DEG
    errors = sfm_shapefit.evaluate(found.reconstruction, reference).position
    num_wrong, caught = int(wrong.sum()), int(np.sum(wrong & ~found.kept))
    blamed = int(np.sum(~wrong & ~found.kept))
    cells = {
        "set": folder.name,
        "wrong rotations": f"{num_wrong} of {len(cameras)}",
        "flagged wrong / right": [caught, blamed],
        "lowest trust kept": float(found.placement.assessment.trust[found.kept].min()),
        "median / mean": [errors.median, errors.mean],
    }
    checks = at_least(wrong=(caught, max(num_wrong - 1, 0)))
    checks += at_most(right=(blamed, 6 if folder.name == "lego100" else 0))
    return Row(cells, checks if folder.name in SETS else (), "Wrong rotations")


BENCHMARK = Benchmark(
    name="trust",
    title="Trust",
    cases=cases,
    quick={"repeats": 1},
    repeats=5,
    threads=2,
    columns={
        "covered": "1; share of errors within one standard deviation",
        "rms": "1; of errors over standard deviations",
        "AUC": "1; trust against bad cameras",
        "flagged": "cameras; wrong ones / right ones left out",
    },
)
