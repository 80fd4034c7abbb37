"""The door to numba: kernels that are compiled once, cached on disk, and release the GIL.

Kernels take and return plain arrays and numbers. `fastmath` allows fused and reassociated sums
but keeps NaN and infinity checks; pass `exact=True` where the order of a sum must be the written one.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

prange = numba.prange


def kernel(*, parallel: bool = False, exact: bool = False) -> Callable[[Kernel], Kernel]:
    """Compile a function with numba on its first call; the machine code is cached beside the source."""
    fastmath: bool | set[str] = False if exact else {"contract", "reassoc", "nsz", "arcp"}

    def decorate(function: Kernel) -> Kernel:
        options = {"cache": True, "nogil": True, "error_model": "numpy"}
        return cast(Kernel, numba.njit(parallel=parallel, fastmath=fastmath, **options)(function))

    return decorate
