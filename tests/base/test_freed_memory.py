"""Freed memory goes back to the system, though what lives on stands above it in the heap."""

import ctypes
import platform
import resource
from pathlib import Path

import numpy as np
import pytest

from sfm_shapefit.base.arrays import begin_run, hand_back_memory


def resident_bytes():
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * resource.getpagesize()


@pytest.mark.parametrize(
    ("count", "already", "is_large"), [(4_000, 0, True), (2_000, 0, False), (2_000, 30_000_000, False)]
)
@pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="only glibc keeps freed memory that can be asked for"
)
def test_memory_below_an_array_that_lives_on_is_handed_back_by_a_large_run(count, already, is_large):
    held = np.ones(already)  # by the process before the run, however much that is
    ctypes.CDLL(None).malloc_trim(ctypes.c_size_t(0))  # what else was freed: the arrays would take its place
    begin_run()
    # Below 128 KiB, arrays are always made in the heap.
    arrays = [np.ones(8_000) for _ in range(count)]
    before = resident_bytes()
    last = arrays.pop()
    del arrays
    hand_back_memory()
    is_less = before - resident_bytes() > 0.9 * (count - 1) * last.nbytes
    assert is_less == is_large
    del held
