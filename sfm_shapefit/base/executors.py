"""Work shared out among threads, or among the workers of a cluster; answers come in order."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol, TypeVar

import numpy as np

from sfm_shapefit.base.arrays import AnyArray, IntArray
from sfm_shapefit.base.errors import ShapeFitError

Advance = Callable[[int, int], None]
"""Called with the work done so far and the work in all."""

Task = TypeVar("Task")
Answer = TypeVar("Answer")

_RANGES_A_THREAD = 4  # ranges of items for each thread; with one, slow items would hold up the others
_TASKS_AT_ONCE = 32  # tasks submitted ahead of the answers; bounds the memory that they take


def nobody(_done: int, _total: int) -> None:
    """Hear of progress, and tell no one."""


def in_threads(threads: int, work: Callable[[Task], Answer], tasks: Iterable[Task]) -> Iterator[Answer]:
    """Yield what `work` makes of each task, in the order of the tasks; a single thread is the caller's."""
    if threads <= 1:  # where memory is short, Python waits for ever for a thread that could not begin
        yield from map(work, tasks)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(work, tasks)


def in_ranges(threads: int, count: int, work: Callable[..., object], *given: object) -> None:
    """Call `work(begin, end, *given)` for ranges that make up `count` items, each of which it fills."""
    number = min(count, _RANGES_A_THREAD * threads if threads > 1 else 1)
    cuts = (count * k // number for k in range(number + 1)) if number else ()
    for _ in in_threads(threads, lambda cut: work(*cut, *given), pairwise(cuts)):
        pass


def in_slices(threads: int, count: int, size: int, work: Callable[..., object], *given: object) -> None:
    """Call `work(begin, end, *given)` for slices of `size` items, which do not depend on the threads."""
    cuts = [(begin, min(begin + size, count)) for begin in range(0, count, size)]
    for _ in in_threads(min(threads, len(cuts)), lambda cut: work(*cut, *given), cuts):
        pass


def gathered(threads: int, array: AnyArray, rows: IntArray) -> AnyArray:
    """Return array[rows]; threads share the rows."""
    found: AnyArray = np.empty_like(array, shape=(len(rows), *array.shape[1:]))

    def gather(begin: int, end: int) -> None:
        found[begin:end] = array.take(rows[begin:end], axis=0)

    in_ranges(threads, len(rows), gather)
    return found


def overlapped(threads: int, work: Callable[[Task], Answer], tasks: Iterable[Task]) -> Iterator[Answer]:
    """Yield what `work`, which shares itself out among threads, makes of each task, in their order.

    What of one task no thread can share is done beside the next task, of which the caller's thread makes and
    others work on no more than one ahead. A single thread is the caller's.
    """
    if threads <= 1:
        yield from map(work, tasks)
        return
    with ThreadPoolExecutor(2) as pool:
        waiting: deque[Future[Answer]] = deque()
        for task in tasks:
            waiting.append(pool.submit(work, task))
            if len(waiting) == 2:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


class WorkerError(ShapeFitError):
    """A worker died too often, or the scheduler could not be reached."""


class Cluster(Protocol):
    """Workers elsewhere; `pipeline.execution` has those of dask."""

    def submit(self, work: Callable[..., Answer], *given: Any) -> Any:
        """Return a future of `work(*given)`, whose arguments may be futures; what is lost is made anew."""


@dataclass(frozen=True, slots=True, eq=False)
class Crew:
    """Who shares the work of a run: threads of this process, and the workers of a cluster, if there is one.

    Answers do not depend on who works, as long as `work` is a function of its arguments alone. On a cluster
    it is one of a module, so that other processes find it, and what it is given and returns is pickled.
    """

    threads: int
    """Threads of this process."""
    cluster: Cluster | None = None
    divides: bool = False
    """Whether adjustments of any size are divided, for memory."""

    @property
    def threads_of_task(self) -> int:
        """Threads that one task may take; workers take several tasks at once instead."""
        return self.threads if self.cluster is None else 1

    def keep(self, work: Callable[..., Answer], *given: Iterable[Any]) -> list[Any]:
        """Return what `work` makes of each task, or where that is kept, to be an argument of other tasks.

        Args:
            work: a function.
            given: its arguments, one item of each for a task.
        """
        if self.cluster is None:
            return list(map(work, *given))
        with _failures_told():
            return [self.cluster.submit(work, *task) for task in zip(*given, strict=True)]

    def share(self, value: Answer) -> Any:
        """Return a value, or where it is kept, as an argument of many tasks; it is sent once."""
        return self.keep(_same, [value])[0]

    def stream(self, work: Callable[..., Answer], *given: Iterable[Any]) -> Iterator[Answer]:
        """Yield what `work` makes of each task, in their order; arguments as of `keep`, which may be kept.

        Raises:
            WorkerError: if a task failed on a cluster again and again.
        """
        if self.cluster is None:
            yield from map(work, *given)
            return
        sent: deque[Any] = deque()
        try:
            for task in zip(*given, strict=True):
                with _failures_told():
                    sent.append(self.cluster.submit(work, *task))
                if len(sent) == _TASKS_AT_ONCE:
                    yield _answer(sent.popleft())
            while sent:
                yield _answer(sent.popleft())
        finally:
            for future in sent:
                future.cancel()


HERE = Crew(0)
"""The threads of this process, one per core."""


def _same(value: Answer) -> Answer:
    return value


def _answer(future: Any) -> Any:
    with _failures_told():
        return future.result()


@contextmanager
def _failures_told() -> Iterator[None]:
    """Raise what a cluster raises in one sentence; what the work itself says passes as it is."""
    from asyncio import CancelledError  # which a run without a cluster has no use for, and loads for long

    try:
        yield
    except ShapeFitError:
        raise
    except (Exception, CancelledError) as error:
        what = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise WorkerError(
            f"the workers failed ({what}); look at their logs and memory, and at the scheduler, and run again"
        ) from error
