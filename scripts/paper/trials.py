"""Many small problems over several processes, resumable: cells x methods x trials of the random model.

A cell is a setting of the paper's model, of which a number of trials are drawn; every method solves the same
ones. The results are kept in a file with the settings they belong to, so that an interrupted run goes on.
"""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

from harness.driver import Kept
from harness.graphs import relative_error, to_unit_norm, view_graph
from harness.process import thread_environment
from paper.methods import METHODS
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import ShapeFitError
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.synthetic.graphs import Corruption, GraphProblem, random_graph_problem

NOT_RECOVERED = 1.0
"""The error of a problem that has no unique answer, as in the paper's black cells."""
# A process takes so many cells at a time.
_BATCH = 8


@dataclass(frozen=True, order=True)
class Cell:
    """One setting of the random model: a pixel of a figure."""

    n: int
    q: float
    sigma: float = 0.0
    p: float = 0.5
    d: int = 3
    corruption: Corruption = "uniform"


class Trial(NamedTuple):
    """What is recorded of one problem and one method."""

    error: float
    """The paper's relative error."""
    worst_camera: int
    """The camera that is farthest off; -1 where there is no answer."""
    wrong_share: float
    """Share of its pairs that are corrupted."""
    error_of_others: float
    """The relative error without it."""


@dataclass(frozen=True, eq=False)
class Results:
    """Trials of cells by methods."""

    cells: tuple[Cell, ...]
    methods: tuple[str, ...]
    values: FloatArray
    """(cells, methods, trials, fields of `Trial`)."""

    def of(self, method: str) -> FloatArray:
        """Return the trials of a method, (cells, trials, fields of `Trial`)."""
        return self.values[:, self.methods.index(method)]

    def mean_errors(self, method: str) -> FloatArray:
        """Return each cell's mean error, (cells,); an error counts as 1 at most, as in the paper's figure."""
        return np.asarray(np.minimum(self.of(method)[..., 0], 1.0).mean(axis=1))


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
    # The spawned workers read it when they load numpy.
    os.environ.update(thread_environment(1))
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        batches = [missing[k::step] for k in range(step)] if missing else []
        running = {pool.submit(run_batch, batch, methods, trials, seed): batch for batch in batches}
        for count, done in enumerate(as_completed(running), start=1):
            for cell, values in zip(running[done], done.result(), strict=True):
                kept.get(str(cell), lambda values=values: values)
            print(f"{count} of {len(batches)} batches of cells", file=sys.stderr)
    values = np.array([kept.get(str(cell), lambda: None) for cell in cells])
    return Results(tuple(cells), tuple(methods), values)


def run_batch(cells: Sequence[Cell], methods: Sequence[str], trials: int, seed: int) -> FloatArray:
    """Return the values of all trials of some cells; what a worker process does."""
    values = [
        [[trial(problem, METHODS[name]) for name in methods] for problem in problems(cell, trials, seed)]
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


def trial(problem: GraphProblem, method: Callable[[ViewGraph, GraphProblem], FloatArray]) -> Trial:
    """Solve one problem and compare with its truth."""
    graph = view_graph(problem)
    try:
        found = method(graph, problem)
    except ShapeFitError:
        # Not rigid, or disconnected: the directions do not determine the locations.
        return Trial(NOT_RECOVERED, -1, np.nan, NOT_RECOVERED)
    off = np.linalg.norm(to_unit_norm(found) - to_unit_norm(problem.locations), axis=1)
    worst = int(np.argmax(off))
    touching = (problem.edges == worst).any(axis=1)
    return Trial(
        relative_error(found, problem.locations),
        worst,
        float(problem.corrupted[touching].mean()),
        relative_error(np.delete(found, worst, axis=0), np.delete(problem.locations, worst, axis=0)),
    )
