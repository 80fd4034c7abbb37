"""Dense Cholesky steps inside kernels: BLAS and LAPACK through scipy's exported C functions.

All matrices are column-major blocks inside a flat array: (array, offset, leading dimension), and only
lower triangles are read or written. float32 and float64 share one code: a kernel is handed the
`routine_addresses` of its type. Addresses are arguments, so the compiled kernels stay cached on disk
(`sfm_shapefit.jit`).

BLAS with two threads splits, and hence rounds, differently from BLAS with one. `one_blas_thread` holds it to
one, so that results do not depend on the number of cores.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from threadpoolctl import ThreadpoolController

from sfm_shapefit.arrays import IntArray
from sfm_shapefit.jit import array_address, call_address, function_address, kernel

_POTRF, _TRSM, _SYRK, _GEMM, _TRSV = range(5)

FLAGS = np.frombuffer(b"LRTN", dtype=np.uint8)
"""Character arguments of the Fortran routines, in one array: "L", "R", "T", "N"."""


_lock = threading.Lock()
_limits: list[Any] = []  # one entry per thread of Python inside `one_blas_thread`; the first holds the limit


@lru_cache(maxsize=1)
def _controller() -> ThreadpoolController:
    """Find the BLAS libraries of this process, once, after scipy's has been loaded."""
    _addresses("d")
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


@lru_cache(maxsize=2)
def _addresses(letter: str) -> tuple[int, ...]:
    """Return the addresses of xpotrf, xtrsm, xsyrk, xgemm and xtrsv for x = "s" or "d"."""
    blas, lapack = "scipy.linalg.cython_blas", "scipy.linalg.cython_lapack"
    routines = ((lapack, "potrf"), (blas, "trsm"), (blas, "syrk"), (blas, "gemm"), (blas, "trsv"))
    return tuple(function_address(module, letter + name) for module, name in routines)


def routine_addresses(dtype: npt.DTypeLike) -> IntArray:
    """Return the table that the kernels below take as `routines`, for float32 or float64."""
    return np.array(_addresses("s" if np.dtype(dtype) == np.float32 else "d"), dtype=np.int64)


def work_integers() -> npt.NDArray[np.int32]:
    """Return the scratch that passes integers by reference to Fortran; one per thread."""
    return np.zeros(8, dtype=np.int32)


def work_scalars(dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """Return the constants 1, -1, 0 that are passed by reference to BLAS as alpha and beta."""
    return np.array([1.0, -1.0, 0.0], dtype=dtype)


@kernel(exact=True)
def potrf(routines: Any, flags: Any, integers: Any, a: Any, offset: int, order: int, leading: int) -> int:
    """Factor the block a = L L^T in place; return 0, or k if the leading minor of order k is not positive."""
    integers[0] = order
    integers[1] = leading
    integers[2] = 0
    text, ints = array_address(flags), array_address(integers)
    block = array_address(a) + offset * a.itemsize
    call_address(routines[_POTRF], (text, ints, block, ints + 4, ints + 8))
    return int(integers[2])


@kernel(exact=True)
def trsm(
    routines: Any,
    flags: Any,
    integers: Any,
    scalars: Any,
    a: Any,
    triangle: int,
    below: int,
    rows: int,
    columns: int,
    leading: int,
) -> None:
    """Replace the (rows, columns) block at `below` by block @ inv(triangle)^T; one leading dimension."""
    integers[0] = rows
    integers[1] = columns
    integers[2] = leading
    text, ints, one = array_address(flags), array_address(integers), array_address(scalars)
    start = array_address(a)
    triangle_address = start + triangle * a.itemsize
    below_address = start + below * a.itemsize
    pointers = (
        text + 1, text, text + 2, text + 3,
        ints, ints + 4, one, triangle_address, ints + 8, below_address, ints + 8,
    )  # fmt: skip
    call_address(routines[_TRSM], pointers)


@kernel(exact=True)
def syrk(
    routines: Any,
    flags: Any,
    integers: Any,
    scalars: Any,
    a: Any,
    offset: int,
    leading_a: int,
    rows: int,
    columns: int,
    c: Any,
    offset_c: int,
    leading_c: int,
    accumulate: bool,
) -> None:
    """Subtract a a^T from the lower triangle of c, or store -a a^T there if not `accumulate`."""
    integers[0] = rows
    integers[1] = columns
    integers[2] = leading_a
    integers[3] = leading_c
    text, ints, one = array_address(flags), array_address(integers), array_address(scalars)
    size = a.itemsize
    beta = one if accumulate else one + 2 * size
    pointers = (
        text, text + 3, ints, ints + 4, one + size, array_address(a) + offset * size, ints + 8,
        beta, array_address(c) + offset_c * size, ints + 12,
    )  # fmt: skip
    call_address(routines[_SYRK], pointers)


@kernel(exact=True)
def solve_factored(routines: Any, flags: Any, integers: Any, a: Any, order: int, b: Any) -> None:
    """Solve L L^T x = b in place for one right-hand side; `a` holds L as one block.

    By xtrsv: xpotrs packs L for blocks of right-hand sides, which for one costs more than the solve.
    """
    integers[0] = order
    integers[1] = 1
    text, ints = array_address(flags), array_address(integers)
    matrix, right = array_address(a), array_address(b)
    call_address(routines[_TRSV], (text, text + 3, text + 3, ints, matrix, ints, right, ints + 4))
    call_address(routines[_TRSV], (text, text + 2, text + 3, ints, matrix, ints, right, ints + 4))
