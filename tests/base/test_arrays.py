"""Arrays that every module shares."""

import numpy as np
import pytest

from sfm_shapefit.base.arrays import distinct


@pytest.mark.parametrize("numbers", [[], [3], [5, -1, 5, 5, 2**62, -1, 0]])
def test_distinct_numbers_are_those_of_numpy(numbers):
    given = np.array(numbers, dtype=np.int64)
    found = distinct(given)
    np.testing.assert_array_equal(found, np.unique(given))
    assert found.dtype == np.int64
    np.testing.assert_array_equal(given, numbers)
