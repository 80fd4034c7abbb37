"""Libraries are loaded by a thread before they are imported, and only they."""

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
