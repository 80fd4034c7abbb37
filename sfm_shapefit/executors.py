"""Work shared out to any `concurrent.futures` executor, in order, and reported where a worker dies."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future
from typing import TypeVar

from sfm_shapefit.errors import ShapeFitError

Task = TypeVar("Task")
Answer = TypeVar("Answer")


class WorkerError(ShapeFitError):
    """A worker died, or the scheduler could not be reached."""


def answers(executor: Executor, work: Callable[[Task], Answer], tasks: Iterable[Task]) -> Iterator[Answer]:
    """Yield what an executor's workers make of each task, in the order of the tasks.

    Args:
        executor: submits tasks; it is not shut down.
        work: a function of a module, so that other processes find it.
        tasks: its arguments, which are pickled on the way to other processes.

    Raises:
        WorkerError: if a worker died and the executor does not replace it.
        ShapeFitError: as a worker raised it.
    """
    futures = [executor.submit(work, task) for task in tasks]
    try:
        for future in futures:
            yield _answer(future)
    finally:
        for future in futures:
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
