"""Beyond one machine: graphs placed in pieces against the whole, directions on a cluster against one process.

Each measurement is a process of its own. The error is the root mean square over cameras after shift and
scale, as a share of the scene's radius (median distance from the centre). Memory of a worker, and of the
whole, is the peak less what a process takes that has placed a small graph: packages and compiled code.
"""

import argparse
import multiprocessing
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.endtoend import command, scene_flags
from benchmarks.graphs import GraphSpec, draw, view_graph
from benchmarks.metrics import Check, number, verdict
from benchmarks.process import call, peak_memory_mb
from benchmarks.record import environment, table, write_section

HELP = "Placing in pieces against placing whole; directions on a dask cluster against one process."
ROOT = Path(__file__).parents[2]
PACKAGES = ("numpy", "scipy", "numba", "pycolmap", "distributed", "pymetis")
DEGREES = {"geo": 64.0, "comm": 67.0}
MOST_ERROR, MOST_MEMORY = 1.1, 0.25  # of the whole
WORKERS = 2
PIECE = 12_500  # cameras


@dataclass(frozen=True, slots=True, kw_only=True)
class Placed:
    """One way to place a graph."""

    error: float
    wall_s: float
    cpu_s: float
    memory_mb: float
    """Peak of the process, or of the largest worker."""
    merging_mb: float
    """Peak of the process that merges the pieces and refines the whole."""
    statement: str


class FreshProcesses(Executor):
    """Each task in a process of its own, one after the other, so that its peak of memory is its own."""

    def __init__(self) -> None:
        self.peak_mb = 0.0

    def submit(self, work: Callable[..., Any], /, *args: Any, **_: Any) -> "Future[Any]":
        future: Future[Any] = Future()
        answer, peak_mb = call(_answer_and_peak, work, *args)
        self.peak_mb = max(self.peak_mb, peak_mb)
        future.set_result(answer)
        return future


def _answer_and_peak(work: Callable[..., Any], *args: Any) -> tuple[Any, float]:
    return work(*args), peak_memory_mb()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `partitioned`."""
    parser.add_argument("--cameras", type=int, default=100_000, help="of each graph (default 1e5)")
    parser.add_argument("--families", nargs="*", default=list(DEGREES), choices=list(DEGREES))
    parser.add_argument(
        "--images", type=int, default=1000, help="of the cluster's scene, 0: none (default 1000)"
    )
    parser.add_argument("--folder", type=Path, help="where the scene is kept (default: a temporary folder)")
    parser.add_argument("--timeout", type=float, default=3600.0, help="seconds per measurement")
    parser.add_argument("--out", type=Path, default=ROOT / "scripts" / "results.md", help="file of results")


def run(args: argparse.Namespace) -> int:
    """Measure, print the section and write it; a missed limit is no failure."""
    chosen = f"--families {' '.join(args.families)} --cameras {args.cameras} --images {args.images}"
    about = environment(PACKAGES, f"python scripts/benchmark.py partitioned {chosen}")
    rows = []
    for family in args.families:
        spec = GraphSpec(family=family, n=args.cameras, degree=DEGREES[family], sigma=0.01)
        rows += graph_rows(spec, args.timeout)
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.folder or Path(temporary)
        cluster = cluster_rows(folder, args.images, args.timeout) if args.images else []
    body = "\n".join(
        [
            "## Reliability: beyond one machine\n",
            about,
            "\nIn pieces: one worker process after the other, the whole merged and refined in the parent.\n",
            table(
                ["graph", "way", "error / radius", "CPU s", "largest MB", "parent MB", "verdict", "how"], rows
            ),
            f"\nDirections of {args.images} images, {WORKERS} dask workers of one thread each:\n",
            table(["way", "s", "speed-up", "same bits"], cluster),
        ]
    )
    print(body)
    write_section(args.out, "partitioned", body)
    return 0


# --- graphs ----------------------------------------------------------------------------------------


def graph_rows(spec: GraphSpec, timeout_s: float) -> list[list[str]]:
    """Return the rows of one graph: whole, and in pieces."""
    base_mb: float = call(_small_process, timeout_s=timeout_s)
    rows, whole = [], None
    for way in ("whole", "pieces"):
        print(f"{spec}: {way}", file=sys.stderr, flush=True)
        placed: Placed = call(place_graph, spec, way == "pieces", timeout_s=timeout_s)
        checks = []
        if whole is not None:
            checks = [
                Check(name="error", value=placed.error / whole.error, limit=MOST_ERROR),
                Check(
                    name="memory",
                    value=(placed.memory_mb - base_mb) / (whole.memory_mb - base_mb),
                    limit=MOST_MEMORY,
                ),
            ]
        whole = whole or placed
        figures = [placed.cpu_s, placed.memory_mb - base_mb, placed.merging_mb - base_mb]
        error = f"{placed.error:.3e}"
        rows.append([str(spec), way, error, *map(number, figures), verdict(checks), placed.statement])
        print(rows[-1], file=sys.stderr, flush=True)
    return rows


def place_graph(spec: GraphSpec, in_pieces: bool) -> Placed:
    """Place the largest rigid body of a graph; whole with a factor of any size, or in pieces."""
    from sfm_shapefit.laplacian.operators import adjacency
    from sfm_shapefit.laplacian.partition import partition
    from sfm_shapefit.placement.partitioned import place_partitioned
    from sfm_shapefit.refinement.options import PlacementOptions
    from sfm_shapefit.refinement.starts import finish
    from sfm_shapefit.rigidity import rigid_pieces
    from sfm_shapefit.solver.solve import solve

    problem = draw(spec)
    body = max(rigid_pieces(view_graph(problem)), key=lambda piece: len(piece.nodes))
    graph, nodes = view_graph(problem).restricted_to(body.edges)
    truth = problem.locations[nodes]
    options = PlacementOptions(tol=1e-4, factor_memory=500 if in_pieces else 100_000, threads=WORKERS)
    start, used = time.perf_counter(), _cpu_s()
    executor, joined = FreshProcesses(), None
    if in_pieces:
        part_of = partition(adjacency(graph.num_nodes, graph.edges), max(4, graph.num_nodes // PIECE))
        joined = place_partitioned(graph, part_of, options, executor=executor)
    solved = solve(graph, options) if joined is None else joined.solve
    found = finish(graph, solved, options) if joined is None else joined.finish
    given_up = "a piece could not be certified, so the whole: " if in_pieces and joined is None else ""
    return Placed(
        error=_error(found.locations, truth),
        wall_s=time.perf_counter() - start,
        cpu_s=_cpu_s() - used,
        memory_mb=executor.peak_mb if in_pieces else peak_memory_mb(),
        merging_mb=peak_memory_mb(),
        statement=f"{given_up}{solved.method}: {solved.method_reason}",
    )


def _small_process() -> float:
    """Return the peak memory of a process that places a small graph."""
    place_graph(GraphSpec(family="geo", n=400, degree=20.0, sigma=0.01), in_pieces=False)
    return peak_memory_mb()


def _cpu_s() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _error(found: "np.ndarray[Any, Any]", truth: "np.ndarray[Any, Any]") -> float:
    from sfm_shapefit.geometry import fit_similarity, median_spread

    moved = fit_similarity(found, truth, rotate=False).apply(found)
    return float(np.sqrt(np.mean(np.sum((moved - truth) ** 2, axis=1)))) / median_spread(truth)


# --- a cluster -------------------------------------------------------------------------------------


def cluster_rows(folder: Path, num_images: int, timeout_s: float) -> list[list[str]]:
    """Return the rows of directions measured by one process, by a cluster, and by one that loses a worker."""
    scene = folder / f"facade{num_images}"
    if not scene.exists():
        command("synth", scene, *scene_flags(num_images))
    rows, first = [], None
    for way in ("one process", "dask", "dask, a worker killed midway"):
        print(f"directions: {way}", file=sys.stderr, flush=True)
        seconds, found = call(measure_directions, scene, way, timeout_s=timeout_s)
        first = first or (seconds, found)
        rows.append([way, number(seconds), f"{first[0] / seconds:.2f}", "yes" if found == first[1] else "no"])
    return rows


def measure_directions(scene: Path, way: str) -> tuple[float, str]:
    """Return the seconds of measuring a scene's directions, and a digest of them; warmed up."""
    import hashlib
    from contextlib import nullcontext

    from sfm_shapefit.colmap.model import read_model
    from sfm_shapefit.commands.stages.clock import Clock
    from sfm_shapefit.commands.stages.execution import open_executor
    from sfm_shapefit.commands.stages.inputs import choose_inputs, open_source
    from sfm_shapefit.commands.stages.measure import measure_directions as measured
    from sfm_shapefit.options import LocateOptions

    options = LocateOptions(threads=1)
    model_folder = scene / "sparse" / "0"
    model = read_model(model_folder)
    inputs = choose_inputs(model_folder, None, "auto")
    executor = open_executor("dask", WORKERS) if way.startswith("dask") else nullcontext(None)
    with open_source(model, inputs, 0) as source, executor as workers:
        measured(source, options, Clock(), workers)  # compiles, and starts the workers
        clock = Clock(_Killer()) if way.endswith("midway") else Clock()
        start = time.perf_counter()
        found = measured(source, options, clock, workers)
        seconds = time.perf_counter() - start
    digest = hashlib.sha256(found.directions.tobytes() + found.covariance.tobytes())
    return seconds, digest.hexdigest()


class _Killer:
    """Takes the place of a progress bar, and kills a worker of this process's cluster at the first answer."""

    def __init__(self) -> None:
        self._killed = False

    def __call__(self, _stage: str, _done: int, _total: int) -> None:
        if not self._killed:
            victim = max(child.pid or 0 for child in multiprocessing.active_children())
            os.kill(victim, signal.SIGKILL)
            self._killed = True
