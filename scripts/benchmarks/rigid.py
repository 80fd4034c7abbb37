"""Rigid pieces of large graphs: seconds and memory of finding them.

Each graph is drawn here, and its pairs are handed to a fresh process, so that its peak memory is that of the
imports, the pairs and the search alone.
"""

import argparse
import statistics
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.graphs import GraphSpec, draw
from benchmarks.metrics import Check, Quantity, number, verdict
from benchmarks.process import call, peak_memory_mb, thread_environment
from benchmarks.record import environment, legend, table, write_section

if TYPE_CHECKING:
    from sfm_shapefit.arrays import IntArray

HELP = "Rigid pieces of large graphs: seconds and memory."
ROOT = Path(__file__).parents[2]
PACKAGES = ("numpy", "numba")
REPEATS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """A graph in 3D, and what finding its pieces may take."""

    spec: GraphSpec
    seconds: float | None = None
    peak_mb: float | None = None


PROBLEMS = {
    **{
        f"{family}-10000": Problem(spec=GraphSpec(family=family, n=10_000, degree=degree), seconds=0.5)
        for family, degree in (("geo", 32.0), ("seq", 36.0), ("comm", 45.0))
    },
    "er-10000, few triangles": Problem(spec=GraphSpec(family="er", n=10_000, degree=20.0)),
    **{
        f"{family}-100000": Problem(
            spec=GraphSpec(family=family, n=100_000, degree=degree), seconds=20.0, peak_mb=1000.0
        )
        for family, degree in (("geo", 53.0), ("seq", 60.0), ("comm", 62.0))
    },
}

QUANTITIES = (
    Quantity(
        name="pieces",
        unit="1",
        better="neither",
        rel_tol=0.0,
        meaning="of three cameras or more; single pairs",
    ),
    Quantity(
        name="seconds (CPU)",
        unit="s",
        better="lower",
        rel_tol=0.3,
        meaning=f"wall-clock of `parallel_rigid_pieces`, median of {REPEATS} (processor time), one thread",
    ),
    Quantity(
        name="peak",
        unit="MB",
        better="lower",
        rel_tol=0.05,
        meaning="resident memory of the process: imports, the pairs, and the search",
    ),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Search:
    """What finding the pieces of one graph gave and took."""

    cameras: int
    pairs: int
    pieces: int
    single_pairs: int
    seconds: float
    cpu_s: float
    peak_mb: float


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rigidity`."""
    parser.add_argument("--out", type=Path, default=ROOT / "scripts" / "results.md", help="file of results")


def run(args: argparse.Namespace) -> int:
    """Measure, print the section and write it; a missed limit is no failure."""
    about = environment(PACKAGES, "python scripts/benchmark.py rigidity")
    measured = {}
    for name, problem in PROBLEMS.items():
        edges = draw(problem.spec).edges
        measured[name] = call(search, problem.spec.n, edges, environment=thread_environment(1))
        print(f"{name}: {measured[name]}", file=sys.stderr, flush=True)
    body = section(measured, about)
    print(body)
    write_section(args.out, "rigidity", body)
    return 0


def search(num_cameras: int, edges: "IntArray") -> Search:
    """Find the pieces in 3D a few times, after a small graph that loads the compiled code."""
    import numpy as np

    from sfm_shapefit.rigidity import parallel_rigid_pieces

    parallel_rigid_pieces(5, np.array([[0, 1], [1, 2], [2, 3], [3, 4], [4, 0]]), 3)
    wall, cpu = [], []
    for _ in range(REPEATS):
        start, used = time.perf_counter(), time.process_time()
        labels = parallel_rigid_pieces(num_cameras, edges, 3)
        wall.append(time.perf_counter() - start)
        cpu.append(time.process_time() - used)
    sizes = np.bincount(labels)
    return Search(
        cameras=num_cameras,
        pairs=len(edges),
        pieces=int(np.sum(sizes > 1)),
        single_pairs=int(np.sum(sizes == 1)),
        seconds=statistics.median(wall),
        cpu_s=statistics.median(cpu),
        peak_mb=peak_memory_mb(),
    )


def section(measured: dict[str, Search], about: str) -> str:
    """Return the section of the file of results."""
    rows = []
    for name, found in measured.items():
        problem, checks = PROBLEMS[name], []
        if problem.seconds is not None:
            checks.append(Check(name="seconds", value=found.seconds, limit=problem.seconds))
        if problem.peak_mb is not None:
            checks.append(Check(name="peak", value=found.peak_mb, limit=problem.peak_mb))
        rows.append(
            [
                name,
                str(found.cameras),
                str(found.pairs),
                f"{found.pieces}; {found.single_pairs}",
                f"{number(found.seconds)} ({number(found.cpu_s)})",
                number(found.peak_mb),
                verdict(checks),
            ]
        )
    header = ["graph", "cameras", "pairs", "pieces; single pairs", "seconds (CPU)", "peak, MB", "verdict"]
    parts = ["## Rigidity", about, table(header, rows), "### What the columns mean", legend(QUANTITIES)]
    return "\n\n".join(part.strip() for part in parts)
