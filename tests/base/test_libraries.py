"""The large packages: loaded by a thread before they are imported, and without what they only ask for."""

import subprocess
import sys

import pytest

PROGRAM = """
import sys, threading, zlib
from sfm_shapefit.base.libraries import load_ahead
load_ahead({package!r})
for thread in threading.enumerate()[1:]:
    thread.join()
loaded = [line for line in open("/proc/self/maps") if "/pycolmap/_core" in line]
print(bool(loaded), "pycolmap" in sys.modules)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not list what is loaded")
@pytest.mark.parametrize(("package", "is_loaded"), [("pycolmap", True), ("json", False), ("absent", False)])
def test_a_library_is_loaded_and_its_package_is_not_imported(package, is_loaded):
    words = [sys.executable, "-c", PROGRAM.format(package=package)]
    found = subprocess.run(words, capture_output=True, text=True, check=True)
    assert (found.stdout, found.stderr) == (f"{is_loaded} False\n", "")


IMPORTED = """
import sys
from sfm_shapefit.base.libraries import import_packages
if {first!r}:
    __import__({first!r})
import_packages()
print([name in sys.modules for name in ("numba", "scipy", "yaml")])
import scipy, yaml, sfm_shapefit.base.jit
"""


@pytest.mark.parametrize(("first", "loaded"), [("", [True, False, False]), ("yaml", [True, False, True])])
def test_numba_is_imported_without_what_it_only_asks_for_and_others_find_it(first, loaded):
    pytest.importorskip("yaml", reason="comes with dask, which is an extra")
    done = subprocess.run(
        [sys.executable, "-c", IMPORTED.format(first=first)], capture_output=True, text=True, check=True
    )
    assert done.stdout == f"{loaded}\n"
