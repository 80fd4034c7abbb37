"""The array types that every module shares, frozen arrays, sums of rows by label, and freed memory."""

import ctypes
import os
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.errors import InputError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

_LARGE_RUN = 170_000_000  # bytes that a run has added to the process; small ones never do
_began = [230_000_000]  # bytes of the process when its run began; the program alone has as many

AnyArray = TypeVar("AnyArray", bound=npt.NDArray[Any])
Columns = TypeVar("Columns", bound=NamedTuple)


def real_numbers(requirement: str, values: npt.ArrayLike) -> FloatArray:
    """Return values as float64, or raise InputError with what is required of them."""
    try:
        given = np.asarray(values)
        if np.iscomplexobj(given):
            raise InputError(requirement)
        return np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(requirement) from error


def sum_by(labels: IntArray, rows: FloatArray, count: int) -> FloatArray:
    """Return the sum of the rows (m, d) of each label 0..count-1, (count, d)."""
    return np.stack([np.bincount(labels, column, minlength=count) for column in rows.T], axis=1)


def distinct(numbers: IntArray) -> IntArray:
    """Return the distinct ones of many numbers, ascending; numpy hashes them, for 15 times as long."""
    ordered: IntArray = np.sort(numbers, axis=None)
    is_new: BoolArray = np.append(True, ordered[1:] != ordered[:-1])[: len(ordered)]
    return ordered[is_new]


def distinct_pairs(pairs: IntArray) -> IntArray:
    """Return the distinct ones of pairs (k, 2) of numbers from 0 on, ascending."""
    size = 1 + int(pairs.max(initial=0))
    return np.stack(np.divmod(distinct(pairs @ np.array([size, 1])), size), axis=1)


def stable_order(labels: npt.NDArray[np.integer[Any]]) -> IntArray:
    """Return the rows of labels (m,) by ascending label, those of one label ascending.

    numpy sorts numbers of 16 bits by their digits, up to ten times as fast as larger ones.
    """
    above = labels - labels.min(initial=0)
    order = np.argsort(above.astype(np.uint16), kind="stable")
    while above.max(initial=0) >> 16:
        above = above >> 16
        order = order[np.argsort(above.astype(np.uint16)[order], kind="stable")]
    return order


def quantile(values: npt.NDArray[Any], share: float) -> FloatArray:
    """Return what a share in [0, 1] of values (k, ...), k > 0, does not exceed, (...); NaN where one is NaN.

    The bits are those of `np.quantile`, which takes several times as long where values are few.
    """
    last, at = len(values) - 1, share * (len(values) - 1)
    low, high = int(at), min(int(at) + 1, last)
    ordered, over = np.partition(values, (low, high, last), axis=0), at - low
    left, right = ordered[low], ordered[high]
    between = left + (right - left) * over if over < 0.5 else right - (right - left) * (1.0 - over)
    return np.where(np.isnan(ordered[last]), np.nan, between)


def rows_taken(columns: Columns, rows: IntArray | BoolArray) -> Columns:
    """Return some rows of a tuple of arrays that all have the same, in that order."""
    return columns._make(column[rows] for column in columns)


def frozen(array: AnyArray) -> AnyArray:
    """Return `array` as a read-only view, so that a value object stays a value."""
    view = array.view()
    view.flags.writeable = False
    return view


def begin_run() -> None:
    """Note how much memory the process has before a run."""
    _began[0] = _resident_bytes()


def hand_back_memory() -> None:
    """Hand back what the C library keeps of freed memory, where it is glibc on Linux and the run is large.

    glibc keeps arrays of up to 32 MB in its heap, of which only the end goes back by itself: one object that
    lives on keeps all below it. After the first placement of 2,500 images that is 345 of 837 MB. A small run
    keeps it: to be given it again takes a twentieth of its time, and where much else lives in the process,
    in a gigabyte of small objects, to look for it takes as long as the run.
    """
    if _resident_bytes() > _began[0] + _LARGE_RUN:
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # which another C library has not
        if trim is not None:
            trim(ctypes.c_size_t(0))


def _resident_bytes() -> int:
    """Return how much memory the process has; 0 where the system is not Linux."""
    told = Path("/proc/self/statm")
    return int(told.read_bytes().split()[1]) * os.sysconf("SC_PAGE_SIZE") if told.exists() else 0


Int32Array = npt.NDArray[np.int32]
UInt32Array = npt.NDArray[np.uint32]
UInt64Array = npt.NDArray[np.uint64]
IndexArray = npt.NDArray[np.integer]
"""Indices, of 32 bits where there are very many."""


def rank_within(labels: IntArray, *keys: IntArray) -> IntArray:
    """Return the rank of each entry among those of its label, by the keys, the first one first."""
    order = np.lexsort((*keys[::-1], labels))
    ranks = np.empty(len(labels), dtype=np.int64)
    ranks[order] = np.arange(len(order)) - np.searchsorted(labels[order], labels[order])
    return ranks
