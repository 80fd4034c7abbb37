"""How much memory and time `locate` will take, told from the counts of its input and its graph.

Every stage is linear in what it works on: keypoints, matches, pairs, edges of the graph, entries of the
factor and multiplications of the factorisation, which the symbolic analysis knows beforehand. The rates
below were fitted to runs on six sets of 25 to 10,000 images (scripts/results/endtoend.md). Memory is
counted in bytes per item, time in multiples of a small kernel that is timed on the machine at hand: some
sorting, which is bound by the scalar processor and the caches, and some multiplication of matrices, as the
stages are.

The peak is that of the worst stage, for memory is handed back between stages. What can be saved is listed
in `ECONOMIES`, the cheapest first; `choose_economy` takes the first that fits.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from sfm_shapefit.errors import InputError
from sfm_shapefit.laplacian.dense import one_blas_thread

_MB = 1e6
_REFERENCE_S = 0.017  # the kernel's time where the rates were measured
_REPETITIONS = 5

_STARTED_B = 195e6  # the interpreter with all that `locate` imports
_KERNELS_B = 110e6  # compiled code, thread pools, database pages
_SAMPLES = 96  # of each sampled direction error, two numbers each
_BLOCK = 9  # entries of a block of the factor
_STEPS = 36.0  # factorisations of both refinements together, and about as much for the convex starts

BATCH = 2_000_000
"""Matches that are read at a time where memory is no concern."""
RAYS_BYTES = 1_000_000_000
"""Of the rays of keypoints that are kept for the next pair, where memory is no concern."""
FACTOR_BYTES = 2_000_000_000
"""What one factor may take where memory is no concern."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Workload:
    """What `locate` has to work on."""

    num_images: int
    num_keypoints: int
    """Of all images."""
    num_pairs: int
    num_matches: int
    num_edges: int
    """Directions that are solved, those from cameras to points included."""
    num_nodes: int
    """Cameras and points that are solved."""
    num_sampled: int
    """Directions whose errors are sampled; 0 where they count as independent."""
    has_points: bool
    """Whether 3D points join the graph."""
    factor_entries: int
    """Blocks of the factor, its stack included; 0 where there is none."""
    factor_flops: float
    """Multiplications of the factorisation, in blocks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Economy:
    """What is given up for memory."""

    statement: str
    """What that is, for the user; empty for nothing."""
    batch: int = BATCH
    """Matches that are read at a time."""
    rays_bytes: int = RAYS_BYTES
    """Of the rays of keypoints that are kept for the next pair."""
    samples: bool = True
    """Whether the errors of directions are sampled together where keypoints are shared."""
    points: bool = True
    """Whether 3D points may join the graph."""
    factor: bool = True
    """Whether there is a factor for the refinement and the standard deviations."""


_SMALL_BATCH, _FEW_RAYS_BYTES = 200_000, 50_000_000
_BATCHES = "matches are read in small batches"
_INDEPENDENT = "directions count as independent in standard deviations"
_NO_POINTS = "no 3D points join the view graph"
_UNREFINED = "locations are neither refined nor have they standard deviations"


def _economies() -> Iterator[Economy]:
    """Yield what can be given up, the cheapest first."""
    economy = Economy(statement="")
    yield economy
    given_up: list[str] = []
    for what, changes in (
        (_BATCHES, {"batch": _SMALL_BATCH, "rays_bytes": _FEW_RAYS_BYTES}),
        (_INDEPENDENT, {"samples": False}),
        (_NO_POINTS, {"points": False}),
        (_UNREFINED, {"factor": False}),
    ):
        given_up.append(what)
        economy = replace(economy, statement=", ".join(given_up), **changes)
        yield economy


ECONOMIES = tuple(_economies())
"""The cheapest first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Forecast:
    """Peak memory and time of `locate`, by stage."""

    memory_mb: dict[str, float]
    """Peak of each stage in millions of bytes."""
    seconds: dict[str, float]
    """Processor time of each stage on this machine."""

    @property
    def peak_mb(self) -> float:
        """The largest of all stages."""
        return max(self.memory_mb.values())

    @property
    def total_s(self) -> float:
        """Processor time in all; the wall clock shows less where threads help, more where others compete."""
        return sum(self.seconds.values())

    @property
    def statement(self) -> str:
        """What to expect, a sentence for the user."""
        worst = max(self.memory_mb, key=self.memory_mb.__getitem__)
        longest = max(self.seconds, key=self.seconds.__getitem__)
        return (
            f"about {self.peak_mb:.0f} MB at most (while {worst}) and {self.total_s:.0f} s of processor time "
            f"(most of it {longest})"
        )


def forecast(work: Workload, economy: Economy = ECONOMIES[0], speed: float = 1.0) -> Forecast:
    """Return what a run will take.

    Args:
        work: what there is to do.
        economy: what is given up for memory.
        speed: of this machine, from `measure_speed`; 1 is that on which the rates were measured.
    """
    memory = {stage: size / _MB for stage, size in _peaks(work, economy).items()}
    return Forecast(
        memory_mb=memory, seconds={stage: s / speed for stage, s in _times(work, economy).items()}
    )


def choose_economy(work: Workload, limit_mb: float) -> Economy:
    """Return the cheapest economy whose forecast stays below a limit.

    Raises:
        InputError: if none does; the message has the number needed.
    """
    for economy in ECONOMIES:
        if forecast(work, economy).peak_mb <= limit_mb:
            return economy
    needed = forecast(work, ECONOMIES[-1]).peak_mb
    raise InputError(
        f"this takes about {needed:.0f} MB even with every economy, and max_memory_mb allows {limit_mb:.0f}; "
        f"raise it to {np.ceil(needed / 10.0) * 10.0:.0f} or more, or split the model"
    )


def measure_speed() -> float:
    """Return how fast this machine is, in units of the one on which the rates were measured; 0.2 s."""
    values = np.random.default_rng(0).standard_normal(200_000)
    matrix = values[: 300 * 300].reshape(300, 300)
    best = np.inf
    with one_blas_thread():
        for _ in range(_REPETITIONS):
            start = time.process_time()
            np.argsort(values, kind="stable")
            _ = matrix @ matrix
            best = min(best, time.process_time() - start)
    return _REFERENCE_S / max(best, 1e-6)


def _peaks(work: Workload, economy: Economy) -> dict[str, float]:
    """Return the bytes that are held at the peak of each stage."""
    batch = 225.0 * min(economy.batch, work.num_matches)
    model = 30e6 + 55.0 * work.num_keypoints
    rays = min(24.0 * work.num_keypoints, economy.rays_bytes)
    results = 350.0 * work.num_pairs + 3000.0 * work.num_images
    held = _STARTED_B + _KERNELS_B + model + rays + results
    peaks = {
        "reading": _STARTED_B + model + 40.0 * work.num_keypoints,
        "measuring directions": held + batch,
    }
    if work.has_points and economy.points:
        peaks["building tracks"] = held + batch + 160.0 * min(work.num_matches, 10_000_000)
    edges, nodes = _graph_size(work, economy)
    samples = 16.0 * _SAMPLES * (work.num_sampled if economy.samples else 0)
    solving = 900.0 * edges + 3000.0 * nodes
    factor = (2.2 * 8.0 * _BLOCK * work.factor_entries) if economy.factor else 0.0
    moved = 8.0 * 3 * _SAMPLES * 3.0 * nodes if samples else 0.0
    peaks["placing"] = held + solving + 2.5 * samples + moved + factor
    seeds = 66.0 * work.num_keypoints
    peaks["triangulating"] = held + 300.0 * edges + seeds + 46.0 * work.num_matches + 0.5 * batch
    return peaks


def _times(work: Workload, economy: Economy) -> dict[str, float]:
    """Return the processor seconds of each stage on the machine of reference."""
    edges, _ = _graph_size(work, economy)
    samples = work.num_sampled if economy.samples else 0
    has_points = work.has_points and economy.points
    times = {
        "reading": 1.7 + 4.5e-7 * work.num_keypoints,
        "measuring directions": 0.2 + 1.4e-6 * work.num_matches,
        "placing": 0.5
        + 8e-5 * edges
        + _STEPS * work.factor_flops * 27 / 8e9 * (2.0 if economy.factor else 1.0),
        "triangulating": 3.2e-6 * work.num_matches,
        "writing": 1.0 + 5e-5 * work.num_pairs,
    }
    if has_points:
        times["building tracks"] = 1.5e-6 * work.num_matches
    if samples:
        times["sampling errors"] = 1.7e-6 * work.num_matches + 5e-5 * samples
    return times


def _graph_size(work: Workload, economy: Economy) -> tuple[int, int]:
    """Return the edges and nodes that are solved."""
    if work.has_points and not economy.points:
        return min(work.num_edges, work.num_pairs), min(work.num_nodes, work.num_images)
    return work.num_edges, work.num_nodes
