"""How many threads share the work of this process."""

import os

MAX_THREADS = 256
"""Threads that may be wanted; work is cut into as many shares, so that millions would never end."""


def count_threads(asked: int = 0) -> int:
    """Return the number of threads that were wanted; 0 is one for each core that this process may use."""
    if asked:
        return asked
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return min(usable or 1, MAX_THREADS)
