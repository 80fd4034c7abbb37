"""The array types that every module shares, and the one way to freeze an array."""

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

AnyArray = TypeVar("AnyArray", bound=npt.NDArray[Any])


def frozen(array: AnyArray) -> AnyArray:
    """Return `array` as a read-only view, so that a value object stays a value."""
    view = array.view()
    view.flags.writeable = False
    return view
