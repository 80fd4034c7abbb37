"""The door to numba: kernels that are compiled once, cached on disk, and release the GIL.

Kernels take and return plain arrays and numbers. `fastmath` allows fused and reassociated sums
but keeps NaN and infinity checks; pass `exact=True` where the order of a sum must be the written one.

C functions of other libraries are called by address. The address of a function changes from process
to process, so it must not be a constant of the compiled code, or the code cached on disk would be
useless (numba then refuses to cache it). `call_address` takes the address as an ordinary argument.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import get_cython_function_address, intrinsic

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

prange = numba.prange


def kernel(*, parallel: bool = False, exact: bool = False) -> Callable[[Kernel], Kernel]:
    """Compile a function with numba on its first call; the machine code is cached beside the source."""
    fastmath: bool | set[str] = False if exact else {"contract", "reassoc", "nsz", "arcp"}

    def decorate(function: Kernel) -> Kernel:
        options = {"cache": True, "nogil": True, "error_model": "numpy"}
        return cast(Kernel, numba.njit(parallel=parallel, fastmath=fastmath, **options)(function))

    return decorate


def function_address(module: str, name: str) -> int:
    """Return the address of a C function that a Cython module exports, valid in this process only.

    Args:
        module: such as "scipy.linalg.cython_blas".
        name: such as "dsyrk".
    """
    return int(get_cython_function_address(module, name))


def _call_address(_context: Any, address: Any, pointers: Any) -> Any:
    """Type `call_address(address, pointers)` and generate its code."""

    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        function, packed = arguments
        void_pointer = cgutils.voidptr_t
        items = [builder.inttoptr(p, void_pointer) for p in cgutils.unpack_tuple(builder, packed)]
        function_type = ir.FunctionType(ir.VoidType(), [void_pointer] * len(items))
        builder.call(builder.inttoptr(function, function_type.as_pointer()), items)
        return context.get_dummy_value()

    return types.void(address, pointers), generate


call_address = intrinsic(_call_address)
"""In a kernel: call the C function `void f(void*, ...)` at an integer address.

`call_address(address, (p0, p1, ...))` takes all pointers as int64, see `array_address`. The arrays
behind them must be arguments of the calling kernel or be used after the call: numba frees a local
array after its last use by name.
"""


@kernel()
def array_address(array: Any) -> int:
    """Return the address of the first entry of a contiguous array, as int64."""
    address: int = numba.int64(array.ctypes.data)
    return address
