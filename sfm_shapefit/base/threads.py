"""How many threads work; cheap to import, as options are."""

import os

MAX_THREADS = 256
"""Threads that may be wanted; work is cut into as many shares, so that millions would never end."""


def count_threads(wanted: int = 0) -> int:
    """Return the number of threads to use: as many as are wanted, or one per core for 0."""
    return wanted or min(os.cpu_count() or 1, MAX_THREADS)
