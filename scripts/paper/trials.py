"""Many small problems over several processes, resumable: cells x methods x trials of the random model.

A cell is a setting of the paper's model, of which a number of trials are drawn; every method solves the same
ones. The results are kept in a file with the settings they belong to, so that an interrupted run goes on.
"""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from unittest.mock import patch

import numpy as np

from harness.driver import Kept
from harness.graphs import relative_error
from harness.process import thread_environment
from paper.baselines import locate_least_squares, locate_lud
from sfm_shapefit import ShapeFitError, UnsolvableError, place, solve
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.solver.program import differences
from sfm_shapefit.synthetic.graphs import CorruptionKind, GraphProblem, random_graph_problem

NOT_RECOVERED = 1.0
"""The error of a problem that has no unique answer, as in the paper's black cells."""
# Cells that a process takes at a time.
_BATCH = 8
# Exact recovery means an error below 1e-9.
_TOL = 1e-12


def _refine(problem: GraphProblem) -> FloatArray:
    """ShapeFit and LUD, both refined in angles, the better kept: what `locate` does."""
    placement = place(problem.view_graph, tol=_TOL, uniqueness=False)
    if len(placement.cameras) < len(problem.locations):
        raise UnsolvableError("the graph is not parallel rigid")
    return placement.locations


def _oracle(problem: GraphProblem) -> FloatArray:
    """Least squares of the pairs that are not corrupted: no method can be told more.

    Reweighted, they are of sines, which is best for small noise; under large noise that collapses, for a sine
    is small near 180 degrees too, and the first answer is kept: whichever fits the directions better.
    """
    clean, cameras = problem.view_graph.restricted_to(np.flatnonzero(~problem.corrupted))
    if len(cameras) < len(problem.locations):
        return np.full_like(problem.locations, np.nan)
    answers = [locate_least_squares(clean, reweightings=count) for count in (0, 10)]

    def misfit(locations: FloatArray) -> float:
        return float(np.sum((normalized(differences(locations, clean.edges)) - clean.directions) ** 2))

    return min(answers, key=misfit)


METHODS: dict[str, Callable[[GraphProblem], FloatArray]] = {
    "ShapeFit": lambda one: solve(one.view_graph, tol=_TOL, uniqueness=False).locations,
    "refined": _refine,
    "LUD": lambda one: locate_lud(one.view_graph),
    "least squares": lambda one: locate_least_squares(one.view_graph),
    "oracle": _oracle,
}
"""What the figures compare: each takes the graph of a problem, the oracle more, and returns locations."""


@dataclass(frozen=True, order=True)
class Cell:
    """One setting of the random model: a pixel of a figure."""

    n: int
    q: float
    sigma: float = 0.0
    p: float = 0.5
    d: int = 3
    corruption: CorruptionKind = "uniform"


@dataclass(frozen=True, eq=False)
class Results:
    """The relative errors of trials, by cells and methods."""

    cells: tuple[Cell, ...]
    methods: tuple[str, ...]
    values: FloatArray
    """(cells, methods, trials)."""

    def of(self, method: str) -> FloatArray:
        """Return the errors of a method, (cells, trials)."""
        return self.values[:, self.methods.index(method)]

    def mean_errors(self, method: str) -> FloatArray:
        """Return each cell's mean error, (cells,); an error counts as 1 at most, as in the paper's figure."""
        return np.asarray(np.minimum(self.of(method), 1.0).mean(axis=1))


def run_trials(
    cells: Sequence[Cell],
    methods: Sequence[str],
    trials: int,
    *,
    cache: Path | None = None,
    processes: int = 2,
    seed: int = 0,
) -> Results:
    """Run all trials that the cache, a file, does not hold; the largest problems go first.

    Raises:
        ValueError: if the cache belongs to other settings.
    """
    kept = Kept(cache, {"methods": list(methods), "trials": trials, "seed": seed})
    missing = sorted((cell for cell in cells if str(cell) not in kept), key=lambda cell: -cell.n)
    step = max(len(missing) // _BATCH, 1)
    batches = [missing[k::step] for k in range(step)] if missing else []
    with _pool(processes) as pool:
        running = {pool.submit(run_batch, batch, methods, trials, seed): batch for batch in batches}
        for count, done in enumerate(as_completed(running), start=1):
            for cell, values in zip(running[done], done.result(), strict=True):
                kept.get(str(cell), lambda values=values: values)
            print(f"{count} of {len(batches)} batches of cells", file=sys.stderr)
    values = np.array([kept.get(str(cell), lambda: None) for cell in cells])
    return Results(tuple(cells), tuple(methods), values)


@contextmanager
def _pool(processes: int) -> Iterator[Executor]:
    """Yield processes that are started anew, each on one thread; a single one is a thread of this one.

    They read the environment when they load numpy. Here it is as before afterwards: numba forgets for which
    processor it compiles when its part changes, and no kernel on disk would be found.
    """
    if processes == 1:
        with ThreadPoolExecutor(1) as pool:
            yield pool
        return
    spawning = ProcessPoolExecutor(processes, mp_context=get_context("spawn"))
    with patch.dict(os.environ, thread_environment(1)), spawning as pool:
        yield pool


def run_batch(cells: Sequence[Cell], methods: Sequence[str], trials: int, seed: int) -> FloatArray:
    """Return the errors of all trials of some cells; what a worker process does."""
    values = [
        [[error_of(problem, name) for name in methods] for problem in problems(cell, trials, seed)]
        for cell in cells
    ]
    return np.swapaxes(values, 1, 2)


def problems(cell: Cell, trials: int, seed: int) -> Iterator[GraphProblem]:
    """Yield the problems of a cell; each has a seed of its own, whatever else is run."""
    for k in range(trials):
        rng = np.random.default_rng([seed, cell.n, round(1e4 * cell.q), round(1e4 * cell.p), cell.d, k])
        yield random_graph_problem(
            cell.n, cell.p, cell.d, sigma=cell.sigma, q=cell.q, seed=rng, corruption=cell.corruption
        )


def error_of(problem: GraphProblem, method: str) -> float:
    """Solve one problem and return the paper's relative error."""
    try:
        return relative_error(METHODS[method](problem), problem.locations)
    except ShapeFitError:
        # Not rigid, or disconnected: the directions do not determine the locations.
        return NOT_RECOVERED
