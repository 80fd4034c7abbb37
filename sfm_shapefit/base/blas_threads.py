"""BLAS held to one thread, so that results do not depend on the number of cores.

BLAS with two threads splits, and hence rounds, differently from BLAS with one.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

from threadpoolctl import ThreadpoolController

from sfm_shapefit.base.scipy_parts import compiled_module

# One entry per thread of Python inside `one_blas_thread`; the first holds the limit.
_limits: list[Any] = []
_lock = threading.Lock()


@lru_cache(maxsize=1)
def _controller() -> ThreadpoolController:
    """Find the BLAS libraries of this process, once, after scipy's has been loaded."""
    compiled_module("scipy.linalg", "cython_blas")
    return ThreadpoolController()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Hold BLAS to one thread; nested and concurrent uses share one limit, lifted by the last."""
    with _lock:
        _limits.append(None if _limits else _controller().limit(limits=1, user_api="blas"))
    try:
        yield
    finally:
        with _lock:
            limit = _limits.pop(0) if len(_limits) == 1 else _limits.pop()
            if limit is not None:
                limit.restore_original_limits()
