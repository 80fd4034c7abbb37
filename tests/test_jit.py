"""The door to numba: kernels compile with or without a place to cache them."""

import os
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from sfm_shapefit.jit import kernel, on_compilation

ROOT = Path(__file__).parents[1]


def test_a_kernel_works_where_nothing_can_be_cached(monkeypatch):
    plain = numba.njit

    def without_a_place_for_a_cache(*function, **options):
        if function:  # numba's own use, as a bare decorator
            return plain(*function)
        if options.pop("cache", False):
            raise RuntimeError("cannot cache function: no locator available")
        return plain(**options)

    monkeypatch.setattr(numba, "njit", without_a_place_for_a_cache)

    @kernel(exact=True)
    def twice(x):
        return 2 * x

    assert twice(21) == 42


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


COMPILE = """
from sfm_shapefit.jit import kernel, on_compilation
def plus_one(x):
    return x + 1
assert kernel()(plus_one)(1) == 2
"""


@pytest.mark.parametrize(
    "program",
    [f"import pycolmap\n{COMPILE}", "import sfm_shapefit, pycolmap, zlib; zlib.compress(bytes(10**6))"],
    ids=["pycolmap first", "this package first"],
)
def test_memory_stays_sound_whichever_of_pycolmap_and_this_package_is_imported_first(program, tmp_path):
    """pycolmap exports a zlib of its own; the system's, loaded after it, corrupts memory."""
    (tmp_path / "program.py").write_text(program)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, str(tmp_path / "program.py")],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-500:]
