"""Pairs measured by other processes or machines, through any `concurrent.futures` executor.

What is measured of pairs, directions or relative rotations, is a function of a batch of their matches. The
pairs of a database are cut into parts of some hundred thousand matches. A part names the file and carries the
cameras, without which matches are no rays. A worker gets it with the function, opens the file read-only for
itself, and sends back what it measured. Every pair is estimated by itself with draws of its own, and the
parts are put together in their order: the answer is that of one process, to the bit, whichever worker did
what, and however often.

A worker that dies is the executor's business: a pool of processes breaks, which is reported; dask gives the
task to another one.
"""

import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.errors import MissingExtraError
from sfm_shapefit.base.executors import Answer, WorkerError, answers
from sfm_shapefit.scene.matches import MatchBatch, MatchPart, View

MATCHES_PER_TASK = 1_000_000
"""Matches of a task; about 1.5 seconds of work for directions, and 230 MB."""
_RETRIES = 3  # times that dask gives a task to another worker; one that kills three is at fault itself


def measure_with_workers(
    view: View,
    estimate: Callable[[MatchBatch], Answer],
    clock: Clock,
    min_matches: int = 1,
    matches_per_task: int = MATCHES_PER_TASK,
) -> list[Answer]:
    """Return what the workers of the clock's executor measure of all pairs of a database, in their order.

    What estimates them is a function of a module, or a `partial` of one, so that other processes find it.
    Pairs with fewer than `min_matches` are left out. The executor is not shut down.

    Raises:
        WorkerError: if a worker died and the executor does not replace it.
        InputError: as a worker found the database.
    """
    assert clock.executor is not None
    results: list[Answer] = []
    done = 0
    work = partial(measure_part, estimate, min_matches)
    for part, measured in answers(clock.executor, work, view.parts(matches_per_task)):
        results += measured
        done += part.num_pairs
        clock.advance(done, view.num_pairs)
    return results


def measure_part(estimate: Callable[[MatchBatch], Answer], min_matches: int, part: MatchPart) -> list[Answer]:
    """Return what is measured of the pairs of a part with so many matches, a value per batch; in a worker."""
    with part.open() as view:
        return [estimate(batch) for batch in view.batches(min_matches)]


@contextmanager
def open_executor(name: str, workers: int) -> Iterator[Executor | None]:
    """Open an executor by its name, and close it in the end.

    Args:
        name: "serial" is none, "processes" a pool on this machine, "dask" a cluster on this machine, and
            "dask:ADDRESS" that of a running scheduler. Whoever can reach a scheduler can run code on its
            workers: keep it inside a trusted network.
        workers: processes on this machine.

    Raises:
        MissingExtraError: if dask is not installed.
        WorkerError: if the scheduler cannot be reached.
    """
    if name == "serial":
        yield None
    elif name == "processes":
        from multiprocessing import get_context  # spawned, because forking clashes with threads

        from sfm_shapefit.base.process_pool import ProcessPool

        with ProcessPool(workers, mp_context=get_context("spawn")) as pool:
            yield pool
    else:
        with _dask_client(workers, name.partition(":")[2]) as client:
            yield client.get_executor(retries=_RETRIES)


@contextmanager
def interrupts_wait() -> Iterator[None]:
    """Let an interrupt come at the end of the block; a cluster that is half open cannot be closed."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, _frame: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
    if came:
        raise KeyboardInterrupt


@contextmanager
def _dask_client(workers: int, scheduler: str) -> Iterator[Any]:
    """Connect to a scheduler, or start a cluster of worker processes here."""
    try:
        from distributed import Client, LocalCluster
    except ModuleNotFoundError:
        raise MissingExtraError("the executor dask", "dask.distributed", "dask") from None
    if not scheduler:
        from sfm_shapefit.base.process_pool import children_are_not_interrupted

        with ExitStack() as opened:
            with interrupts_wait(), children_are_not_interrupted():
                # The port of the dashboard is taken where another run has a cluster.
                local = LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address="127.0.0.1:0")
                client = opened.enter_context(Client(opened.enter_context(local)))
            yield client
        return
    try:
        client = Client(scheduler, timeout=10)
    except (OSError, ValueError) as error:
        raise WorkerError(f"the dask scheduler {scheduler} cannot be reached; check its address") from error
    with client:
        yield client
