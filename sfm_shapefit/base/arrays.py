"""The array types that every module shares, the one way to freeze an array, and sums of rows by label."""

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

AnyArray = TypeVar("AnyArray", bound=npt.NDArray[Any])


def sum_by(labels: IntArray, rows: FloatArray, count: int) -> FloatArray:
    """Return the sum of the rows (m, d) of each label 0..count-1, (count, d)."""
    return np.stack([np.bincount(labels, column, minlength=count) for column in rows.T], axis=1)


def frozen(array: AnyArray) -> AnyArray:
    """Return `array` as a read-only view, so that a value object stays a value."""
    view = array.view()
    view.flags.writeable = False
    return view


Int32Array = npt.NDArray[np.int32]
UInt32Array = npt.NDArray[np.uint32]
