"""Freed memory goes back to the system, though what lives on stands above it in the heap."""

import platform
import resource
from pathlib import Path

import numpy as np
import pytest

from sfm_shapefit.base.arrays import hand_back_memory


def resident_bytes():
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * resource.getpagesize()


@pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="only glibc keeps freed memory that can be asked for"
)
def test_memory_below_an_array_that_lives_on_is_handed_back():
    np.ones(55_000_000)  # a process that has never been large keeps its memory
    # Below 128 KiB, arrays are always made in the heap.
    arrays = [np.ones(8_000) for _ in range(2_000)]
    before = resident_bytes()
    last = arrays.pop()
    del arrays
    hand_back_memory()
    assert before - resident_bytes() > 0.9 * 1_999 * last.nbytes
