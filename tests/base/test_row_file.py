"""Rows in a temporary file, and rows that are looked up: the same numbers as of an array."""

import resource

import numpy as np
import pytest

from sfm_shapefit import InputError
from sfm_shapefit.base.row_file import Gathered, RowFile, Widened

WANTED = np.random.default_rng(0).integers(0, 2**32, (1000, 2), dtype=np.uint32)


def written(rows, step=300):
    """A file of rows that were written some at a time."""
    file = RowFile(rows.shape, dtype=rows.dtype)
    for first in range(0, len(rows), step):
        file[first : first + step] = rows[first : first + step].astype(np.int64)
    return file


def test_slices_of_a_file_are_those_of_an_array_and_are_written_over():
    file, expected = written(WANTED), WANTED.copy()
    assert (len(file), file.dtype) == (1000, np.uint32)
    file[250:260] = expected[250:260] = np.arange(20).reshape(10, 2)
    for rows in (slice(None), slice(0, 0), slice(250, 700), slice(900, 2000), slice(1500, 1600)):
        np.testing.assert_array_equal(file[rows], expected[rows])
    assert len(file) == 1000
    assert file[:].flags.writeable
    assert len(RowFile((5, 2), dtype=np.int64)[:]) == 0


def test_a_full_folder_is_told_with_what_to_do():
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
        with pytest.raises(InputError, match=r"no room for 0 MB of matches .*; set TMPDIR to a folder"):
            written(WANTED)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_rows_that_are_looked_up_are_those_of_a_copy():
    source, rows = np.arange(20.0).reshape(10, 2), np.array([7, 0, 7, 3], dtype=np.int32)
    found, copy = Gathered(source, rows), source[rows]
    assert len(found) == 4
    for chosen in (slice(None), slice(1, 3), np.array([True, False, False, True]), np.array([2, 1]), 3):
        np.testing.assert_array_equal(found[chosen], copy[chosen])


def test_numbers_of_32_bits_are_given_as_64():
    stored = np.array([[0.1, 2.0], [3.0, 4.0]], dtype=np.float32)
    assert Widened(stored)[:, 0].dtype == np.float64
    np.testing.assert_array_equal(Widened(stored)[1], [3.0, 4.0])
