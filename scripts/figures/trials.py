"""Many small problems over several processes, resumable: cells x methods x trials of the random model.

A cell is a setting of the paper's model, of which a number of trials are drawn; every method solves the same
ones. The results are kept in an npz beside the settings they belong to, so that an interrupted run goes on.
"""

import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from figures.methods import METHODS
from harness.graphs import relative_error, to_unit_norm, view_graph
from harness.process import thread_environment
from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.errors import ShapeFitError
from sfm_shapefit.synthetic.graphs import Corruption, GraphProblem, random_graph_problem
from sfm_shapefit.viewgraph import ViewGraph

NOT_RECOVERED = 1.0
"""The error of a problem that has no unique answer, as in the paper's black cells."""
_SAVE_EVERY_S = 5.0
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
    """Trials of cells by methods, each array of shape (cells, methods, trials)."""

    cells: tuple[Cell, ...]
    methods: tuple[str, ...]
    values: FloatArray
    """(cells, methods, trials, fields of `Trial`)."""
    seconds: float
    """Time of the runs that made them."""

    def mean_errors(self, method: str) -> FloatArray:
        """Return each cell's mean error, (cells,); an error counts as 1 at most, as in the paper's figure."""
        errors = self.values[:, self.methods.index(method), :, 0]
        return np.asarray(np.minimum(errors, 1.0).mean(axis=1))


def run_trials(
    cells: Sequence[Cell],
    methods: Sequence[str],
    trials: int,
    *,
    cache: Path | None = None,
    processes: int = 2,
    seed: int = 0,
) -> Results:
    """Run all trials that the cache, an npz file, does not hold, with a progress bar on stderr.

    Raises:
        ValueError: if the cache belongs to other settings.
    """
    settings = {"cells": [asdict(c) for c in cells], "methods": list(methods), "trials": trials, "seed": seed}
    values = np.full((len(cells), len(methods), trials, len(Trial._fields)), np.nan)
    spent = 0.0
    if cache is not None and cache.exists():
        values, spent = _load(cache, settings)
    missing = np.flatnonzero(np.isnan(values[..., 0]).any(axis=(1, 2)))
    start = saved = time.perf_counter()
    for rows, part in _compute(missing, cells, methods, trials, seed, processes):
        values[rows] = part
        if cache is not None and time.perf_counter() - saved > _SAVE_EVERY_S:
            saved = time.perf_counter()
            _save(cache, settings, values, spent + saved - start)
    spent += time.perf_counter() - start
    if cache is not None and len(missing):
        _save(cache, settings, values, spent)
    return Results(tuple(cells), tuple(methods), values, spent)


def _compute(
    missing: FloatArray,
    cells: Sequence[Cell],
    methods: Sequence[str],
    trials: int,
    seed: int,
    processes: int,
) -> Iterator[tuple[list[int], FloatArray]]:
    """Yield batches of rows and their values as they are done; the largest problems go first."""
    order = sorted(missing.tolist(), key=lambda k: -cells[k].n)
    if not order:
        return
    step = max(len(order) // _BATCH, 1)
    batches = [order[k::step] for k in range(step)]
    # The spawned workers read it when they load numpy.
    os.environ.update(thread_environment(1))
    columns = (TextColumn("cells"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with (
        Progress(*columns, console=Console(stderr=True)) as progress,
        ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool,
    ):
        bar = progress.add_task("trials", total=len(order))
        running = {
            pool.submit(run_batch, [cells[k] for k in batch], methods, trials, seed): batch
            for batch in batches
        }
        for done in as_completed(running):
            progress.advance(bar, len(running[done]))
            yield running[done], done.result()


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


def _load(cache: Path, settings: dict[str, object]) -> tuple[FloatArray, float]:
    """Return the values kept in a cache file and the time they took.

    Raises:
        ValueError: if the file belongs to other settings.
    """
    with np.load(cache, allow_pickle=False) as kept:
        if json.loads(str(kept["settings"])) != json.loads(json.dumps(settings)):
            raise ValueError(f"{cache} holds other settings; delete it or give another --cache")
        return np.array(kept["values"]), float(kept["seconds"])


def _save(cache: Path, settings: dict[str, object], values: FloatArray, seconds: float) -> None:
    """Write the cache in place of the old one."""
    cache.parent.mkdir(parents=True, exist_ok=True)
    partial = cache.with_name(f".{cache.stem}.partial.npz")
    np.savez_compressed(partial, settings=json.dumps(settings), values=values, seconds=seconds)
    partial.replace(cache)
