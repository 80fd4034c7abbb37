"""Dense Cholesky steps inside kernels: BLAS and LAPACK through scipy's exported C functions.

All matrices are column-major blocks inside a flat array, tuples (array, offset, leading dimension), and only
lower triangles are read or written. float32 and float64 share one code: a kernel is handed the `blas_of` its
type. Addresses are arguments, so the compiled kernels stay cached on disk (`sfm_shapefit.jit`).

BLAS with two threads splits, and hence rounds, differently from BLAS with one. `one_blas_thread` holds it to
one, so that results do not depend on the number of cores.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from threadpoolctl import ThreadpoolController

from sfm_shapefit.arrays import IntArray
from sfm_shapefit.jit import array_address, call_address, function_address, inner_kernel, kernel

_POTRF, _TRSM, _SYRK, _GEMM, _TRSV = range(5)

_FLAGS = np.frombuffer(b"LRTN", dtype=np.uint8)

# One entry per thread of Python inside `one_blas_thread`; the first holds the limit.
_limits: list[Any] = []
_lock = threading.Lock()


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


class Blas(NamedTuple):
    """What the kernels below need to call BLAS and LAPACK; one per thread, for the integers are scratch."""

    routines: IntArray
    """Addresses of the routines for one type, float32 or float64."""
    flags: npt.NDArray[np.uint8]
    """Character arguments of the Fortran routines: "L", "R", "T", "N"."""
    integers: npt.NDArray[np.int32]
    """(8,) scratch that passes integers by reference."""
    scalars: npt.NDArray[Any]
    """1, -1, 0, which are passed by reference as alpha and beta."""


def blas_of(dtype: npt.DTypeLike) -> Blas:
    """Return the routines for float32 or float64, with scratch of their own."""
    addresses = _addresses("s" if np.dtype(dtype) == np.float32 else "d")
    return Blas(
        routines=np.array(addresses, dtype=np.int64),
        flags=_FLAGS,
        integers=np.zeros(8, dtype=np.int32),
        scalars=np.array([1.0, -1.0, 0.0], dtype=dtype),
    )


@kernel
def potrf(blas: Any, a: Any, order: int) -> int:
    """Factor the block a = L L^T in place; return 0, or k if the leading minor of order k is not positive."""
    entries, offset, leading = a
    integers = blas.integers
    integers[0] = order
    integers[1] = leading
    integers[2] = 0
    text, ints = array_address(blas.flags), array_address(integers)
    block = array_address(entries) + offset * entries.itemsize
    call_address(blas.routines[_POTRF], (text, ints, block, ints + 4, ints + 8))
    return int(integers[2])


@kernel
def trsm(blas: Any, triangle: Any, below: Any, rows: int, columns: int) -> None:
    """Replace the (rows, columns) block `below` by below @ inv(triangle)^T."""
    integers = blas.integers
    integers[0] = rows
    integers[1] = columns
    integers[2] = triangle[2]
    integers[3] = below[2]
    text, ints, one = array_address(blas.flags), array_address(integers), array_address(blas.scalars)
    triangle_address = array_address(triangle[0]) + triangle[1] * triangle[0].itemsize
    below_address = array_address(below[0]) + below[1] * below[0].itemsize
    pointers = (
        text + 1, text, text + 2, text + 3,
        ints, ints + 4, one, triangle_address, ints + 8, below_address, ints + 12,
    )  # fmt: skip
    call_address(blas.routines[_TRSM], pointers)


@inner_kernel
def syrk(blas: Any, a: Any, rows: int, columns: int, c: Any, accumulate: bool) -> None:
    """Subtract a a^T, a of so many rows and columns, from the lower triangle of c, or store -a a^T there."""
    integers = blas.integers
    integers[0] = rows
    integers[1] = columns
    integers[2] = a[2]
    integers[3] = c[2]
    text, ints, one = array_address(blas.flags), array_address(integers), array_address(blas.scalars)
    size = blas.scalars.itemsize
    beta = one if accumulate else one + 2 * size
    pointers = (
        text, text + 3, ints, ints + 4, one + size, array_address(a[0]) + a[1] * size, ints + 8,
        beta, array_address(c[0]) + c[1] * size, ints + 12,
    )  # fmt: skip
    call_address(blas.routines[_SYRK], pointers)


@inner_kernel
def gemm(blas: Any, left: Any, right: Any, shape: Any, c: Any, accumulate: bool) -> None:
    """Subtract left right^T from a block c, or store it negated; shape: (rows, columns, depth)."""
    integers = blas.integers
    for k in range(3):
        integers[k] = shape[k]
    integers[3], integers[4], integers[5] = left[2], right[2], c[2]
    text, ints, one = array_address(blas.flags), array_address(integers), array_address(blas.scalars)
    size = blas.scalars.itemsize
    beta = one if accumulate else one + 2 * size
    pointers = (
        text + 3, text + 2, ints, ints + 4, ints + 8, one + size,
        array_address(left[0]) + left[1] * size, ints + 12,
        array_address(right[0]) + right[1] * size, ints + 16,
        beta, array_address(c[0]) + c[1] * size, ints + 20,
    )  # fmt: skip
    call_address(blas.routines[_GEMM], pointers)


@inner_kernel
def solve_factored(blas: Any, a: Any, order: int, b: Any) -> None:
    """Solve L L^T x = b in place for one right-hand side; the array `a` holds L as one block.

    By xtrsv: xpotrs packs L for blocks of right-hand sides, which for one costs more than the solve.
    """
    integers = blas.integers
    integers[0] = order
    integers[1] = 1
    text, ints = array_address(blas.flags), array_address(integers)
    matrix, right = array_address(a), array_address(b)
    call_address(blas.routines[_TRSV], (text, text + 3, text + 3, ints, matrix, ints, right, ints + 4))
    call_address(blas.routines[_TRSV], (text, text + 2, text + 3, ints, matrix, ints, right, ints + 4))
