"""Where compiled kernels are kept: found again wherever they are copied, never stale, never damaged."""

import inspect
import shutil

import llvmlite.binding as llvm
import numba
import numpy as np
import pytest
from numba.core import config

from sfm_shapefit.base import kernel_cache
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.base.kernel_cache import hear_of_kernels, is_noted, note, on_miss
from tests.program import run_python
from tests.scenes import ROOT


def double(x):
    return 2 * x


def allocate(n):
    return np.empty(n).size


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


def kept(folder):
    return sorted(path for path in folder.rglob("*") if path.is_file())


def compile_double():
    """Call a new kernel, as another process would have it; return whether it had to be compiled."""
    missed = []
    with on_miss(lambda: missed.append("missed")):
        assert kernel(double)(21) == 42
    return missed == ["missed"]


def test_a_kernel_is_compiled_once_and_found_again(folder):
    heard = []
    with hear_of_kernels(heard.append):
        assert compile_double()
        (file,) = kept(folder)
        assert not compile_double()
    assert kept(folder) == [file]
    assert heard == ["test_kernel_cache.double"] * 2
    with on_miss(lambda: pytest.fail("missed")):
        assert kernel(double)(21) == 42
    assert kernel(double)(1.5) == 3.0
    assert len(kept(folder)) == 2


def loaded_double():
    """Return a kernel that was compiled and is now loaded."""
    compile_double()
    loaded = kernel(double)
    assert loaded(21) == 42
    return loaded


def test_a_kernel_is_loaded_without_its_llvm_code_and_taken_into_another_with_it(folder, monkeypatch):
    read, parse = [], llvm.parse_bitcode
    loaded = loaded_double()
    monkeypatch.setattr(llvm, "parse_bitcode", lambda code: read.append(code) or parse(code))
    again = kernel(double)
    assert again(21) == 42
    assert read == []
    assert numba.njit(lambda x: loaded(x) + 1)(21) == 43
    assert numba.njit(lambda x: loaded(x) + 2)(21) == 44
    assert len(read) == 1


LOAD = """
import sys
sys.path.insert(0, sys.argv[1])
import made
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.base.kernel_cache import on_miss
missed = []
with on_miss(lambda: missed.append(1)):
    loaded = kernel(made.allocate)
    print(loaded(3), len(missed), "numba.np.arrayobj" in sys.modules)
try:
    loaded(-1)
except ValueError as error:
    print(error)
"""


@pytest.fixture
def load(tmp_path):
    """Return what another process says that calls `allocate`, of a module of its own."""
    source = inspect.getsource(allocate)

    def say(returns="size"):
        text = f"import numpy as np\n\n\n{source.replace('size', returns)}"
        (tmp_path / "made.py").write_text(text)
        # Bytecode is told from a source by its size and the second in which that was written.
        fresh = {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
        done = run_python("-c", LOAD, tmp_path, **fresh)
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()

    return say


def test_a_kernel_is_loaded_without_the_modules_of_the_functions_that_it_calls(load):
    negative = "negative dimensions not allowed"
    assert [load(), load()] == [["3 1 True", negative], ["3 0 False", negative]]


@pytest.mark.parametrize("content", [b"", b"no pickle", b"cut"])
def test_a_damaged_file_is_compiled_anew(folder, content):
    compile_double()
    (file,) = kept(folder)
    whole = file.read_bytes()
    file.write_bytes(content if content != b"cut" else whole[: len(whole) // 2])
    assert compile_double()
    assert not compile_double()
    assert kept(folder) == [file]


def test_another_source_leaves_nothing_of_the_earlier_one(load, tmp_path):
    assert load()[0].startswith("3 1")
    before = kept(tmp_path / "cache")
    assert load("ndim")[0].startswith("1 1")
    assert len(kept(tmp_path / "cache")) == len(before)
    assert not set(kept(tmp_path / "cache")) & set(before)


def test_a_kernel_works_where_nothing_can_be_kept(folder):
    folder.write_text("no folder")
    assert compile_double()
    assert compile_double()


def test_a_kernel_without_a_source_works(folder):
    scope = {}
    exec("def triple(x): return 3 * x", scope)
    assert kernel(scope["triple"])(14) == 42
    assert kept(folder) == []


def test_what_is_missed_once_is_looked_for_again(folder):
    compile_double()
    (file,) = kept(folder)
    aside = file.with_suffix(".aside")
    file.rename(aside)
    with on_miss(lambda: aside.rename(file)):  # as another process, which compiles it meanwhile
        assert kernel(double)(21) == 42
    assert kept(folder) == [file]


STAMP = "from sfm_shapefit.base import kernel_cache as c; print(c.stamp_of(c.PACKAGE / 'top.py'))"


def test_a_stamp_covers_what_a_module_imports_also_through_others(tmp_path):
    package = tmp_path / "sfm_shapefit"
    shutil.copytree(ROOT / "sfm_shapefit" / "base", package / "base", ignore=shutil.ignore_patterns("__py*"))
    files = {
        "__init__.py": "",
        "top.py": "from sfm_shapefit.room import pair\nfrom os import path\n",
        "room/__init__.py": "from sfm_shapefit.room.pairs import Pair\n",
        "room/pairs.py": "class Pair: ...\n",
        "other.py": "",
    }
    (package / "room").mkdir()
    for name, text in files.items():
        (package / name).write_text(text)

    def stamp():
        done = run_python("-P", "-c", STAMP, PYTHONPATH=str(tmp_path))
        assert len(done.stdout) == 13, done.stderr
        return done.stdout

    first = stamp()
    (package / "other.py").write_text("# it has no part in it")
    assert stamp() == first
    (package / "room" / "pairs.py").write_text("class Renamed: ...\n")
    assert stamp() != first


def test_a_note_holds_for_its_sources_only(folder):
    own = kernel_cache.PACKAGE / "commands"
    assert not is_noted("an example", own)
    note("an example", own)
    assert is_noted("an example", own)
    assert not is_noted("another", own)
    assert not is_noted("an example", kernel_cache.PACKAGE / "solver")


IMPORT = "import sfm_shapefit.base.jit; from numba.core import config; print(config.CPU_NAME)"


@pytest.mark.parametrize(
    ("program", "environment", "expected"),
    [
        (IMPORT, {}, kernel_cache.choose_target()),
        (IMPORT, {"NUMBA_CPU_NAME": "host"}, "None"),
        (IMPORT, {"NUMBA_CPU_NAME": "generic"}, "generic"),
    ],
    ids=["as a rule", "host", "named"],
)
def test_the_processor_is_the_portable_one_unless_something_else_is_asked_for(program, environment, expected):
    done = run_python("-c", program, **environment)
    assert done.stdout == f"{expected}\n", done.stderr


@pytest.mark.parametrize(
    ("machine", "system", "missing", "expected"),
    [
        ("x86_64", "linux", "", "x86-64-v3"),
        ("AMD64", "linux", "fma", "generic"),
        ("arm64", "darwin", "", "apple-m1"),
        ("aarch64", "linux", "", "generic"),
    ],
)
def test_the_portable_target_is_the_least_of_its_kind(machine, system, missing, expected):
    features = dict.fromkeys(("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"), True)
    assert kernel_cache.portable_target(machine, system, lambda: features | {missing: False}) == expected


START = """
import hashlib
from sfm_shapefit.solver.newton import steps
from sfm_shapefit.solver.newton.irls_start import approach
from sfm_shapefit.synthetic import random_graph_problem
graph = random_graph_problem(60, 0.3, sigma=0.02, q=0.1, seed=1).view_graph
problem, iterate, _, step = steps.allocate(graph, 3)
assert approach(problem, iterate, step)
print(hashlib.sha256(iterate.t.tobytes() + iterate.y.tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_two_processors_give_the_same_bits(tmp_path):
    """The portable one and one that cannot fuse products with sums: kernels have all their options in common,
    so that one with long sums stands for them."""
    another = "generic" if kernel_cache.choose_target() != "generic" else "host"
    portable = run_python("-c", START)
    other = run_python("-c", START, NUMBA_CPU_NAME=another, NUMBA_CACHE_DIR=str(tmp_path))
    assert other.returncode == 0, other.stderr[-500:]
    assert other.stdout == portable.stdout
    assert len(other.stdout.split()) == 1


CALL = """
import numpy as np
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.base.quaternions import rotation_vectors, rotations_of
kernel(lambda x: 2 * x)(21)  # of others
rotation_vectors(rotations_of(np.zeros((1, 3))))  # two kernels
"""


@pytest.mark.parametrize(("first", "times"), [("", 1), ("import sfm_shapefit.cli", 0)])
def test_who_calls_from_python_is_told_once_that_kernels_are_compiled(tmp_path, first, times):
    """The program says it itself."""
    done = run_python("-c", first + CALL, NUMBA_CACHE_DIR=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("sfm_shapefit: compiling kernels, once") == done.stderr.count("\n") == times
