"""Work shared out among threads or to any `concurrent.futures` executor; answers come in order."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from itertools import pairwise
from typing import TypeVar

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


def made_ahead(threads: int, items: Iterator[Answer]) -> Iterator[Answer]:
    """Yield items, the next of which another thread makes meanwhile; a single thread is the caller's."""
    if threads <= 1:
        yield from items
        return
    with ThreadPoolExecutor(1) as pool:
        following = pool.submit(next, items, None)
        while (item := following.result()) is not None:
            following = pool.submit(next, items, None)
            yield item


class WorkerError(ShapeFitError):
    """A worker died, or the scheduler could not be reached."""


def answers(
    executor: Executor, work: Callable[[Task], Answer], tasks: Iterable[Task]
) -> Iterator[tuple[Task, Answer]]:
    """Yield each task with what an executor's workers make of it, in the order of the tasks.

    Args:
        executor: submits tasks, a few ahead of the answers; it is not shut down.
        work: a function of a module, so that other processes find it; what it raises is raised.
        tasks: its arguments, which are pickled on the way to other processes.

    Raises:
        WorkerError: if a worker died and the executor does not replace it.
    """
    sent: deque[tuple[Task, Future[Answer]]] = deque()
    try:
        for task in tasks:
            sent.append((task, executor.submit(work, task)))
            if len(sent) == _TASKS_AT_ONCE:
                first, future = sent.popleft()
                yield first, _answer(future)
        while sent:
            first, future = sent.popleft()
            yield first, _answer(future)
    finally:
        for _, future in sent:
            future.cancel()


def _answer(future: Future[Answer]) -> Answer:
    try:
        return future.result()
    except ShapeFitError:
        raise
    except Exception as error:
        what = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise WorkerError(
            f"a worker failed ({what}); check its memory and that it sees the database, and run again"
        ) from error
