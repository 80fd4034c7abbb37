"""A pool of processes; apart from `execution`, since most commands start none and need not load how."""

import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import Any


class ProcessPool(ProcessPoolExecutor):
    """A pool whose processes leave interrupts to this one."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit a task, for which a process may have to be started."""
        with children_are_not_interrupted():
            return super().submit(fn, *args, **kwargs)


@contextmanager
def children_are_not_interrupted() -> Iterator[None]:
    """Start threads and processes in which SIGINT is blocked.

    A terminal interrupts all processes of a command at once. The first one ends the others; what these had to
    say of it would be tracebacks.
    """
    resource_tracker.ensure_running()  # whose start would end the blocking
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
