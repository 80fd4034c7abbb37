"""The door to numba: kernels that are compiled once, cached on disk, and release the GIL.

Kernels take and return plain arrays and numbers. Their arithmetic is that of IEEE 754 in the written order:
no sum is reassociated, no product fused with a sum. So a kernel gives the same bits on every processor, and
as a copy inside another kernel; which copy runs depends on what was compiled and loaded in this process.

C functions of other libraries are called by address. An address changes from process to process, so it must
not be a constant of compiled code (numba would not cache it): `call_address` takes it as an argument.

What compiling costs. A kernel with eight arrays takes about 0.15 s, most of it before LLVM has begun: what
counts is the number of statements. Every kernel that calls another optimizes a copy of it again, so chains of
calls are kept short. An assignment of one array to another (`a[:] = b`), arithmetic of whole arrays and most
functions of numpy bring tens of compilations of their own, where a loop brings none. Another type of argument
is another compilation: integers are int64 and arrays writable, or read-only, wherever a kernel is called; a
literal number has a type of its own.
"""

import ctypes
import hashlib
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils, targetconfig
from numba.core.event import install_listener
from numba.extending import intrinsic, register_jitable

from sfm_shapefit.base.kernel_cache import CompileTime, KernelCache, choose_target
from sfm_shapefit.base.scipy_parts import compiled_module

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

# What all kernels have in common. Nothing calls them from C.
_OPTIONS = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}

# Functions of numpy that make an array, as far as kernels call them; numba refuses another in a kernel that
# calls none of these.
_MAKE_ARRAYS = {"arange", "array", "empty", "empty_like", "full", "ones", "zeros"}

# What Python offers to read what a Cython module exports.
_name_of = ctypes.PYFUNCTYPE(ctypes.c_char_p, ctypes.py_object)(("PyCapsule_GetName", ctypes.pythonapi))
_pointer_in = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
    ("PyCapsule_GetPointer", ctypes.pythonapi)
)

# Four float64 or eight float32: what most processors add at once.
_LANE_BYTES = 32


def _options(function: Callable[..., Any]) -> dict[str, Any]:
    """Return numba's options for a kernel: one that makes no arrays counts no references to them."""
    return _OPTIONS | {"_nrt": not _MAKE_ARRAYS.isdisjoint(function.__code__.co_names)}


def kernel(function: Kernel) -> Kernel:
    """Compile a function with numba on its first call; the machine code is cached on disk.

    TypeError if the function closes over a value: that would be part of the cache's key, and change with
    every process.
    """
    if getattr(function, "__closure__", None):
        raise TypeError(f"kernel {function.__name__} closes over a value; pass it as an argument")
    dispatcher = numba.njit(**_options(function))(function)
    dispatcher._cache = KernelCache(function)
    return cast(Kernel, dispatcher)


def inner_kernel(function: Kernel) -> Kernel:
    """Let kernels call a function: it is compiled as a part of them, and for Python stays as it is."""
    return cast(Kernel, register_jitable(**_options(function), no_cpython_wrapper=True)(function))


@contextmanager
def on_compilation(begun: Callable[[], None]) -> Iterator[None]:
    """Call `begun`, once, when a kernel begins to be compiled that the cache on disk does not have."""
    with install_listener("numba:compile", CompileTime(begun)):
        yield


def function_address(module: str, name: str) -> int:
    """Return the address, valid in this process only, of a C function that a Cython module exports.

    Args:
        module: such as "scipy.linalg.cython_blas".
        name: such as "dsyrk".
    """
    capsule = compiled_module(*module.rsplit(".", 1)).__pyx_capi__[name]  # numba would import all of scipy
    return int(_pointer_in(capsule, _name_of(capsule)))


def _call_address(_context: Any, address: Any, pointers: Any) -> Any:
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
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return builder.ptrtoint(data, context.get_value_type(types.int64))

    return types.int64(array), generate


array_address = intrinsic(_array_address)
"""In a kernel: the address of the first entry of a contiguous array, as int64."""


def _multiply_in_lanes(
    _context: Any, panel: Any, _at: Any, _leading: Any, vector: Any, _start: Any, _count: Any, sums: Any
) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        integer = context.get_value_type(types.int64)
        number = context.get_value_type(signature.args[0].dtype)
        size = context.get_abi_sizeof(number)
        lanes = ir.VectorType(number, _LANE_BYTES // size)
        flat, line, out = (
            context.make_array(signature.args[k])(context, builder, arguments[k]) for k in (0, 3, 6)
        )
        _, at, leading, _, start, count, _ = arguments
        starts = (builder.add(at, builder.mul(leading, integer(q))) for q in range(4))
        columns = [builder.gep(flat.data, [first]) for first in starts]
        row = builder.gep(line.data, [start])

        def accumulate(begin: Any, end: Any, kind: Any, step: int) -> list[Any]:
            totals = [cgutils.alloca_once_value(builder, ir.Constant(kind, None)) for _ in columns]
            with cgutils.for_range_slice(builder, begin, end, integer(step), integer) as (i, _):

                def load(pointer: Any) -> Any:
                    here = builder.bitcast(builder.gep(pointer, [i]), kind.as_pointer())
                    return builder.load(here, align=size)

                value = load(row)
                for total, column in zip(totals, columns, strict=True):
                    product = builder.fmul(load(column), value)
                    builder.store(builder.fadd(builder.load(total), product), total)
            return [builder.load(total) for total in totals]

        def add_lanes(vector: Any) -> Any:
            width = lanes.count
            while width > 1:
                width //= 2
                low, high = (
                    builder.shuffle_vector(vector, vector, _indices(range(first, first + width)))
                    for first in (0, width)
                )
                vector = builder.fadd(low, high)
            return builder.extract_element(vector, integer(0))

        whole = builder.sub(count, builder.srem(count, integer(lanes.count)))
        vectorial = accumulate(integer(0), whole, lanes, lanes.count)
        rest = accumulate(whole, count, number, 1)
        for k in range(4):
            total = builder.fadd(add_lanes(vectorial[k]), rest[k])
            builder.store(total, builder.gep(out.data, [integer(k)]))
        return context.get_dummy_value()

    number = types.int64
    return types.void(panel, number, number, vector, number, number, sums), generate


def _subtract_block(_context: Any, spread: Any, rows: Any, _row: Any, blocks: Any, _block: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        integer = context.get_value_type(types.int64)
        number = context.get_value_type(types.float64)
        lanes = ir.VectorType(number, 4)
        left, right, out = (
            context.make_array(signature.args[k])(context, builder, arguments[k]).data for k in (0, 1, 3)
        )
        right = builder.gep(right, [builder.mul(arguments[2], integer(18))])
        out = builder.gep(out, [builder.mul(arguments[4], integer(36))])

        def place(data: Any, at: int) -> Any:
            return builder.bitcast(builder.gep(data, [integer(at)]), lanes.as_pointer())

        factors = []
        for k in range(3):
            low, high = (builder.load(place(right, 6 * k + c), align=8) for c in (0, 2))
            factors.append((low, builder.shuffle_vector(high, low, _indices((2, 3, 4, 5))), high))
        for t in range(9):
            total = None
            for k in range(3):
                product = builder.fmul(builder.load(place(left, 36 * k + 4 * t), align=8), factors[k][t % 3])
                total = product if total is None else builder.fadd(total, product)
            here = place(out, 4 * t)
            builder.store(builder.fsub(builder.load(here, align=8), total), here, align=8)
        return context.get_dummy_value()

    return types.void(spread, rows, types.int64, blocks, types.int64), generate


def _indices(numbers: Iterable[int]) -> ir.Constant:
    """Return the mask of a shuffle."""
    indices = list(numbers)
    return ir.Constant(ir.VectorType(ir.IntType(32), len(indices)), indices)


multiply_in_lanes = intrinsic(_multiply_in_lanes)
"""In a kernel: the products of four columns with a vector, summed in lanes of a fixed width.

`multiply_in_lanes(panel, at, leading, vector, start, count, sums)` writes to sums[q] the sum over i < count
of panel[at + q leading + i] vector[start + i]. A sum in the written order cannot use the vectors of a
processor. These sums do, and have one order on all of them. `panel` (.,), `vector` (.,) and `sums` (4,) are
contiguous and of one type, float32 or float64.
"""


subtract_block = intrinsic(_subtract_block)
"""In a kernel: subtract the product A^T B of two 3 x 6 matrices from a 6 x 6 block, in lanes.

`subtract_block(spread, rows, k, blocks, q)` subtracts from `blocks[q]` the product whose B is `rows[k]`. Its
entries are ((A_0a B_0c + A_1a B_1c) + A_2a B_2c), and `spread[k, 6 a + c]` is A_ka. `spread` (3, 36), `rows`
(., 3, 6) and `blocks` (., 6, 6) are float64 and contiguous.
"""


@inner_kernel
def cross(a: Any, b: Any, out: Any) -> None:
    """Fill `out` (3,) with a x b."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@inner_kernel
def mix_bits(z: Any) -> Any:
    """Return a hash of 64 bits, uint64: the finalizer of splitmix64 (Steele, Lea, Flood 2014)."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))
