"""Dense Cholesky steps inside kernels: BLAS and LAPACK through scipy's exported C functions.

All matrices are column-major blocks, given by address and leading dimension, and only lower triangles are
read or written. A kernel is handed the `blas_of` the type, float32 or float64, and is compiled once for both.
Addresses are arguments, so the compiled kernels stay cached on disk (`base/jit`). The arrays behind
them must outlive the call.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import IntArray, frozen
from sfm_shapefit.base.jit import array_address, call_address, function_address, inner_kernel, kernel

PIVOT_TOLERANCE = 64.0
"""Rounding units of the diagonal entry; smaller pivots count as zero."""

Block = tuple[int, int]
"""The address of the first entry of a matrix, and its leading dimension."""

_POTRF, _TRSM, _SYRK, _GEMM, _TRSV, _TEXT, _ONE, _MINUS_ONE, _ZERO = range(9)

# Character arguments of the Fortran routines, and numbers, all passed by reference.
_FLAGS = np.frombuffer(b"LRTN", dtype=np.uint8)
_SCALARS: dict[str, npt.NDArray[Any]] = {
    "s": np.array([1.0, -1.0, 0.0], dtype=np.float32),
    "d": np.array([1.0, -1.0, 0.0], dtype=np.float64),
}


@lru_cache(maxsize=2)
def _addresses(letter: str) -> IntArray:
    """Return addresses: xpotrf, xtrsm, xsyrk, xgemm, xtrsv for x = "s" or "d", and constant arguments."""
    blas, lapack = "scipy.linalg.cython_blas", "scipy.linalg.cython_lapack"
    routines = ((lapack, "potrf"), (blas, "trsm"), (blas, "syrk"), (blas, "gemm"), (blas, "trsv"))
    called = [function_address(module, letter + name) for module, name in routines]
    scalars = [_SCALARS[letter][k:].ctypes.data for k in range(3)]
    return frozen(np.array([*called, _FLAGS.ctypes.data, *scalars], dtype=np.int64))


class Blas(NamedTuple):
    """What the kernels below need to call BLAS and LAPACK; one per thread, for the integers are scratch."""

    addresses: IntArray
    """Addresses of the routines for one type, float32 or float64, and of their constant arguments."""
    integers: npt.NDArray[np.int32]
    """(8,) scratch that passes integers by reference."""


def blas_of(dtype: npt.DTypeLike) -> Blas:
    """Return the routines for float32 or float64, with scratch of their own."""
    letter = "s" if np.dtype(dtype) == np.float32 else "d"
    return Blas(addresses=_addresses(letter), integers=np.zeros(8, dtype=np.int32))


@kernel
def potrf(blas: Any, a: Any, order: int) -> int:
    """Factor the block a = L L^T in place; return 0, or k if the leading minor of order k is not positive."""
    at, integers = blas.addresses, blas.integers
    integers[0], integers[1], integers[2] = order, a[1], 0
    text, ints = at[_TEXT], array_address(integers)
    call_address(at[_POTRF], (text, ints, a[0], ints + 4, ints + 8))
    return int(integers[2])


@kernel
def trsm(blas: Any, triangle: Any, below: Any, rows: int, columns: int) -> None:
    """Replace the (rows, columns) block `below` by below @ inv(triangle)^T."""
    at, integers = blas.addresses, blas.integers
    integers[0], integers[1], integers[2], integers[3] = rows, columns, triangle[1], below[1]
    text, ints = at[_TEXT], array_address(integers)
    pointers = (
        text + 1, text, text + 2, text + 3,
        ints, ints + 4, at[_ONE], triangle[0], ints + 8, below[0], ints + 12,
    )  # fmt: skip
    call_address(at[_TRSM], pointers)


@kernel
def syrk(blas: Any, a: Any, rows: int, columns: int, c: Any, accumulate: bool) -> None:
    """Subtract a a^T, a of so many rows and columns, from the lower triangle of c, or store -a a^T there."""
    at, integers = blas.addresses, blas.integers
    integers[0], integers[1], integers[2], integers[3] = rows, columns, a[1], c[1]
    text, ints = at[_TEXT], array_address(integers)
    beta = at[_ONE] if accumulate else at[_ZERO]
    pointers = (text, text + 3, ints, ints + 4, at[_MINUS_ONE], a[0], ints + 8, beta, c[0], ints + 12)
    call_address(at[_SYRK], pointers)


@kernel
def gemm(blas: Any, left: Any, right: Any, shape: Any, c: Any, accumulate: bool) -> None:
    """Subtract left right^T from a block c, or store it negated; shape: (rows, columns, depth)."""
    at, integers = blas.addresses, blas.integers
    integers[0], integers[1], integers[2] = shape
    integers[3], integers[4], integers[5] = left[1], right[1], c[1]
    text, ints = at[_TEXT], array_address(integers)
    beta = at[_ONE] if accumulate else at[_ZERO]
    pointers = (
        text + 3, text + 2, ints, ints + 4, ints + 8, at[_MINUS_ONE], left[0], ints + 12, right[0], ints + 16,
        beta, c[0], ints + 20,
    )  # fmt: skip
    call_address(at[_GEMM], pointers)


@inner_kernel
def solve_factored(blas: Any, a: Any, order: int, right: int) -> None:
    """Solve L L^T x = b in place for one right-hand side, b at the address `right`; the block `a` holds L.

    By xtrsv: xpotrs packs L for blocks of right-hand sides, which for one costs more than the solve.
    """
    at, integers = blas.addresses, blas.integers
    integers[0], integers[1], integers[2] = order, a[1], 1
    text, ints = at[_TEXT], array_address(integers)
    for transposed in (text + 3, text + 2):
        call_address(at[_TRSV], (text, transposed, text + 3, ints, a[0], ints + 4, right, ints + 8))
