"""The door to numba: what is compiled, and what is found on disk."""

import ast
from collections import Counter

import numba
import numpy as np
import pytest
from numba.core.event import install_listener

from sfm_shapefit.base import jit
from sfm_shapefit.base.jit import inner_kernel, kernel, multiply_in_lanes, on_compilation
from sfm_shapefit.base.kernel_cache import CompileTime
from tests.program import run_python
from tests.scenes import ROOT


def test_a_kernel_works_where_nothing_can_be_cached(monkeypatch):
    plain = numba.njit

    def without_a_place_for_a_cache(*function, cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return plain(*function, **options)

    monkeypatch.setattr(numba, "njit", without_a_place_for_a_cache)

    @kernel
    def twice(x):
        return 2 * x

    assert twice(21) == 42


def sum_in_lanes(products):
    """Add numbers in lanes of 32 bytes, then the lanes by halves, then what is left."""
    width = 32 // products.itemsize
    whole = len(products) - len(products) % width
    lanes, rest = np.zeros(width, products.dtype), products.dtype.type(0)
    for chunk in products[:whole].reshape(-1, width):
        lanes = lanes + chunk
    while len(lanes) > 1:
        lanes = lanes[: len(lanes) // 2] + lanes[len(lanes) // 2 :]
    for product in products[whole:]:
        rest = rest + product
    return lanes[0] + rest


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_sums_in_lanes_have_one_order_on_every_processor(dtype):
    @numba.njit
    def multiply(panel, at, leading, vector, start, count, sums):
        multiply_in_lanes(panel, at, leading, vector, start, count, sums)

    rng = np.random.default_rng(0)
    panel, vector = (rng.normal(size=size).astype(dtype) for size in (400, 90))
    for count in (0, 1, 7, 8, 32, 61):
        sums = np.full(4, np.nan, dtype)
        multiply(panel, 5, 95, vector, 2, count, sums)
        for q in range(4):
            assert sums[q] == sum_in_lanes(panel[5 + 95 * q :][:count] * vector[2 : 2 + count])


def test_compilations_are_told_once_and_only_where_there_are_any():
    fresh, other = numba.njit(lambda x: x + 1), numba.njit(lambda x: x - 1)  # neither is on disk
    told = []
    with on_compilation(lambda: told.append("compiling")):
        assert fresh(1) == 2
        assert other(1) == 0
    assert told == ["compiling"]
    with on_compilation(lambda: told.append("again")):
        assert fresh(2) == 3
    assert told == ["compiling"]


@inner_kernel
def reciprocal(x):
    if x == 0:
        raise ValueError("no reciprocal")
    return 1.0 / x


def test_an_inner_kernel_is_compiled_once_and_only_as_a_part_of_others():
    compiled = []
    names = CompileTime()
    names.on_start = lambda event: compiled.append(event.data["dispatcher"].py_func.__name__)
    with install_listener("numba:compile", names):
        for callee in (
            numba.njit(lambda x: 2 * reciprocal(x)),
            numba.njit(lambda x: np.full(3, reciprocal(x))),
        ):
            assert np.all(callee(0.5) == callee.py_func(0.5))
            with pytest.raises(ValueError, match="no reciprocal"):
                callee(0.0)
    assert compiled.count("reciprocal") == 1


def test_only_kernels_that_make_arrays_count_references_to_them():
    def first(x):
        return x[0]

    def room(n):
        return np.empty(n)

    assert [kernel(one).targetoptions["_nrt"] for one in (first, room)] == [False, True]
    assert (kernel(first)(np.ones(2)), kernel(room)(3).shape) == (1.0, (3,))


def test_a_kernel_that_closes_over_a_value_is_refused():
    """Its key in the cache on disk would hold that value: for another kernel, one of this process only."""
    factor = 2
    with pytest.raises(TypeError, match="closes over a value"):
        kernel(lambda x: factor * x)


COMPILE = """
from sfm_shapefit.base.jit import kernel, on_compilation
def plus_one(x):
    return x + 1
assert kernel(plus_one)(1) == 2
"""


@pytest.mark.parametrize(
    "program",
    [f"import pycolmap\n{COMPILE}", "import sfm_shapefit, pycolmap, zlib; zlib.compress(bytes(10**6))"],
    ids=["pycolmap first", "this package first"],
)
def test_memory_stays_sound_whichever_of_pycolmap_and_this_package_is_imported_first(program, tmp_path):
    """pycolmap exports a zlib of its own; the system's, loaded after it, corrupts memory."""
    (tmp_path / "program.py").write_text(program)
    done = run_python(tmp_path / "program.py", NUMBA_CACHE_DIR=str(tmp_path))
    assert done.returncode == 0, done.stderr[-500:]


def is_kernel(function):
    return any(ast.unparse(d) in ("kernel", "inner_kernel") for d in function.decorator_list)


def crossings(modules):
    """Yield each call from Python of a kernel that is annotated to return a NamedTuple; modules: by name."""
    nodes = {name: list(ast.walk(ast.parse(source))) for name, source in modules.items()}
    functions = {name: [n for n in nodes[name] if isinstance(n, ast.FunctionDef)] for name in nodes}
    classes = [n for name in nodes for n in nodes[name] if isinstance(n, ast.ClassDef)]
    named = {c.name for c in classes if "NamedTuple" in map(ast.unparse, c.bases)}
    risky = {
        (name, function.name)
        for name in functions
        for function in functions[name]
        if is_kernel(function)
        and named & {n.id for n in ast.walk(function.returns or ast.Pass()) if isinstance(n, ast.Name)}
    }
    for name, inside in nodes.items():
        imports = [n for n in inside if isinstance(n, ast.ImportFrom)]
        known = {alias.name for n in imports for alias in n.names if (n.module, alias.name) in risky}
        known |= {function.name for function in functions[name] if (name, function.name) in risky}
        for function in functions[name]:
            if not is_kernel(function):
                calls = (n.func for n in ast.walk(function) if isinstance(n, ast.Call))
                yield from (f.id for f in calls if isinstance(f, ast.Name) and f.id in known)


def test_no_kernel_hands_a_named_tuple_to_python():
    """Numba makes it by Python code inside native code, where an interrupt is a segmentation fault."""
    files = {path: path.read_text(encoding="utf-8") for path in (ROOT / "sfm_shapefit").rglob("*.py")}
    modules = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts): text
        for path, text in files.items()
        if "NamedTuple" in text or "kernel" in text or "/solver/" in str(path)
    }
    assert list(crossings(modules)) == []
    sin = "class P(NamedTuple): pass\n@kernel\ndef f() -> tuple[int, P]: pass\ndef g(): return f()"
    assert list(crossings({"a": sin, "b": "from a import f\ndef h(): return f()"})) == ["f", "f"]


def rank(index):
    """The number of indices of a subscript."""
    return len(index.elts) if isinstance(index, ast.Tuple) else 1


def arrays_in_slices(source):
    """Yield the statements of kernels that write an array to a slice or a row, or change an array at once.

    A row is told by a name that takes more indices elsewhere in the kernel.
    """
    functions = (n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef))
    for function in filter(is_kernel, functions):
        inside = list(ast.walk(function))
        ranks = Counter()
        for n in inside:
            if isinstance(n, ast.Subscript):
                ranks[ast.unparse(n.value)] = max(ranks[ast.unparse(n.value)], rank(n.slice))
        for statement in inside:
            if isinstance(statement, ast.Assign):
                written = [n for target in statement.targets for n in ast.walk(target)]
                is_filled = ast.unparse(statement.value) in ("0.0", "zero")
            elif isinstance(statement, ast.AugAssign):
                written, is_filled = [statement.target], False
                if isinstance(statement.target, ast.Name) and ranks[statement.target.id]:
                    yield ast.unparse(statement)
            else:
                continue
            parts = [n for n in written if isinstance(n, ast.Subscript) and isinstance(n.ctx, ast.Store)]
            sliced = any(isinstance(n, ast.Slice) for part in parts for n in ast.walk(part.slice))
            if (sliced or any(rank(n.slice) < ranks[ast.unparse(n.value)] for n in parts)) and not is_filled:
                yield ast.unparse(statement)


@pytest.mark.parametrize(
    ("sin", "harmless"),
    [
        ("a[:] = b", "a[:] = 0.0"),
        ("a[:] += b", "a[0] += b[0]"),
        ("a[0] = b[1]; a[0, 0] = 1.0", "a[0] = b[1]"),
        ("a[0, 1] = b[1]; c = a[0, 1, 0]", "a[0, 1] = b[1]"),
        ("a += b; c = a[0]", "a += b"),
        ("c, a[1:] = b", "c, a[1] = b"),
    ],
)
def test_a_search_finds_what_writes_an_array(sin, harmless):
    kernel = "@kernel\ndef f(a, b): {}"
    assert len(list(arrays_in_slices(kernel.format(sin)))) == 1
    assert list(arrays_in_slices(kernel.format(harmless))) == []


def test_no_kernel_writes_an_array_to_a_slice_or_a_row():
    """Numba compiles the words of its error with it, for 3 s; a loop over the entries takes no time."""
    texts = (path.read_text(encoding="utf-8") for path in (ROOT / "sfm_shapefit").rglob("*.py"))
    assert [s for text in texts if "kernel" in text for s in arrays_in_slices(text)] == []


def makes_arrays(expression):
    return any(
        isinstance(n, ast.Call) and ast.unparse(n.func).removeprefix("np.") in jit._MAKE_ARRAYS
        for n in ast.walk(expression)
    )


def returns_an_array(function):
    """Return whether a kernel returns what it has from a function of numpy that makes arrays."""
    made = {
        name.id
        for n in ast.walk(function)
        if isinstance(n, ast.Assign) and makes_arrays(n.value)
        for target in n.targets
        for name in ast.walk(target)
        if isinstance(name, ast.Name)
    }
    returned = [n.value for n in ast.walk(function) if isinstance(n, ast.Return) and n.value]
    parts = [part for value in returned for part in getattr(value, "elts", [value])]
    return any(makes_arrays(part) or ast.unparse(part) in made for part in parts)


def leaks(sources):
    """Yield each kernel that makes no array but has one from another: nobody counts who still uses it."""
    nodes = [n for source in sources for n in ast.walk(ast.parse(source))]
    kernels = [n for n in nodes if isinstance(n, ast.FunctionDef) and is_kernel(n)]
    giving = {function.name for function in kernels if returns_an_array(function)}
    for function in kernels:
        called = {ast.unparse(n.func) for n in ast.walk(function) if isinstance(n, ast.Call)}
        if called & giving and not makes_arrays(function):
            yield function.name


def test_a_kernel_that_has_an_array_from_another_counts_references():
    texts = (path.read_text(encoding="utf-8") for path in (ROOT / "sfm_shapefit").rglob("*.py"))
    assert list(leaks(text for text in texts if "kernel" in text)) == []
    sin = "@kernel\ndef f(n):\n    a, b = np.empty(n), 1\n    return a, b\n@kernel\ndef g(): return f(3)[1]"
    assert list(leaks([sin])) == ["g"]


INTERRUPTED = """
import signal
import numpy as np
from sfm_shapefit.solver.newton.dense import solve_newton_dense
from sfm_shapefit.solver.newton.sparse import solve_newton_sparse
from sfm_shapefit.synthetic import random_graph_problem
from sfm_shapefit.graph.viewgraph import ViewGraph
drawn = random_graph_problem(40, 0.5, d=3, sigma=0.1, q=0.3, seed=1)
graph = ViewGraph(40, drawn.edges, drawn.directions)
caught = 0

def origin(error):
    return error if error.__cause__ is None else origin(error.__cause__)

for solve in (solve_newton_dense, solve_newton_sparse):
    solve(graph, 1e-8, 50)
    for delay in np.linspace(2e-4, 2e-2, 60):
        try:
            signal.signal(signal.SIGALRM, signal.default_int_handler)
            signal.setitimer(signal.ITIMER_REAL, delay)
            for _ in range(100):
                solve(graph, 1e-8, 50)
        except (KeyboardInterrupt, SystemError) as error:  # numba makes arrays by some Python code, too
            if not isinstance(origin(error), KeyboardInterrupt):
                raise
            caught += 1
print(caught)
"""


def test_an_interrupt_during_a_solve_is_an_interrupt():
    done = run_python("-c", INTERRUPTED)
    assert (done.returncode, done.stdout) == (0, "120\n"), done.stderr
