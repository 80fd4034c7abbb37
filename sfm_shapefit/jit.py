"""The door to numba: kernels that are compiled once, cached on disk, and release the GIL.

Kernels take and return plain arrays and numbers. Their arithmetic is that of IEEE 754 in the order in which
it is written: no sum is reassociated, no product fused with a sum. So a kernel gives the same bits on every
processor, and a copy of it inside another kernel gives the same bits as the kernel itself; which copy runs
depends on what was compiled, and what loaded from the cache, in this process.

C functions of other libraries are called by address. The address of a function changes from process
to process, so it must not be a constant of the compiled code, or the code cached on disk would be
useless (numba then refuses to cache it). `call_address` takes the address as an ordinary argument.

What compiling costs. A kernel with eight arrays takes about 0.15 s, and every kernel that calls it compiles a
copy of it again, so chains of calls are kept short. An assignment of one array to another (`a[:] = b`),
arithmetic of whole arrays and most functions of numpy bring tens of compilations of their own, where a loop
brings none. Another type of argument is another compilation: integers are int64 and arrays writable, or
read-only, wherever a kernel is called; a literal number has a type of its own.
"""

import hashlib
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, TypeVar, cast

import numba
import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types
from numba.core import cgutils, targetconfig
from numba.core.ccallback import CFunc
from numba.core.event import Listener, install_listener
from numba.extending import get_cython_function_address, intrinsic

from sfm_shapefit.kernel_cache import KernelCache, choose_target

choose_target()


def _names_without_zlib(config: Any) -> str:
    """Return a string of a compiler configuration for the names of symbols, as its own method does."""
    return hashlib.sha256(config.summary().encode()).hexdigest()


_loaded = list(sys.modules)
if "pycolmap" in _loaded and _loaded.index("pycolmap") < _loaded.index("zlib"):
    # pycolmap's library brings a zlib of its own and exports it; the system's, loaded after it, then runs
    # half of either and corrupts memory. numba compresses the names of symbols with it, so it must not.
    targetconfig.TargetConfig.get_mangle_string = _names_without_zlib

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

carray = numba.carray
"""In a leaf (see `leaf_address`): `carray(pointer, shape)` is the array behind a pointer."""

# What all kernels have in common. Nothing calls them from C.
_OPTIONS = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}


def kernel(function: Kernel) -> Kernel:
    """Compile a function with numba on its first call; the machine code is cached on disk.

    Raises:
        TypeError: if the function closes over a value. What a closure holds is part of the key of the cache,
            and the key of another kernel changes with every process: nothing would ever be found there.
    """
    if getattr(function, "__closure__", None):
        raise TypeError(f"kernel {function.__name__} closes over a value; pass it as an argument")
    dispatcher = numba.njit(**_OPTIONS)(function)
    dispatcher._cache = KernelCache(function)
    return cast(Kernel, dispatcher)


@contextmanager
def on_compilation(begun: Callable[[], None]) -> Iterator[None]:
    """Call `begun`, once, when a kernel begins to be compiled that the cache on disk does not have."""

    class First(Listener):  # type: ignore[misc]
        """Hears of kernels that are compiled, not of those that are loaded."""

        told = False

        def on_start(self, _event: Any) -> None:
            if not self.told:
                self.told = True
                begun()

        def on_end(self, _event: Any) -> None:
            """Hear of a kernel that is compiled."""

    with install_listener("numba:compile", First()):
        yield


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


def _array_address(_context: Any, array: Any) -> Any:
    """Type `array_address(array)` and generate its code."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return builder.ptrtoint(data, context.get_value_type(types.int64))

    return types.int64(array), generate


array_address = intrinsic(_array_address)
"""In a kernel: the address of the first entry of a contiguous array, as int64."""


@kernel
def mix_bits(z: Any) -> Any:
    """Return a hash of 64 bits, uint64: the finalizer of splitmix64 (Steele, Lea, Flood 2014)."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@lru_cache(maxsize=32)
def _compiled_leaf(function: Callable[..., None], dtype: str, num_arrays: int) -> Any:
    """Compile a leaf for one type, or load it from the disk cache."""
    number = numba.from_dtype(np.dtype(dtype))
    arguments = (types.CPointer(types.int64), *([types.CPointer(number)] * num_arrays))
    leaf: Any = CFunc(function, (arguments, types.void), {}, {"error_model": "numpy"})
    leaf._cache = KernelCache(function)
    leaf.compile()
    return leaf


def leaf_address(function: Callable[..., None], dtype: npt.DTypeLike, num_arrays: int) -> int:
    """Compile a small function apart from all others and return its address for `call_address`.

    The function takes pointers: one to int64 sizes, then `num_arrays` to numbers of type `dtype`. It calls no
    other kernel.
    """
    return int(_compiled_leaf(function, np.dtype(dtype).str, num_arrays).address)
