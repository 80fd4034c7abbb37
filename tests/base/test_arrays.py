"""Arrays that every module shares."""

import numpy as np
import pytest

from sfm_shapefit.base.arrays import distinct, distinct_pairs, quantile, stable_order


@pytest.mark.parametrize("numbers", [[], [3], [5, -1, 5, 5, 2**62, -1, 0]])
def test_distinct_numbers_are_those_of_numpy(numbers):
    given = np.array(numbers, dtype=np.int64)
    found = distinct(given)
    np.testing.assert_array_equal(found, np.unique(given))
    assert found.dtype == np.int64
    np.testing.assert_array_equal(given, numbers)


def test_distinct_pairs_are_those_of_numpy():
    pairs = np.random.default_rng(0).integers(0, 7, (40, 2))
    np.testing.assert_array_equal(distinct_pairs(pairs), np.unique(pairs, axis=0))
    assert distinct_pairs(pairs[:0]).shape == (0, 2)


@pytest.mark.parametrize("kind", [np.int32, np.int64])
@pytest.mark.parametrize("largest", [0, 9, 2**16, 2**31 - 2])
def test_labels_are_ordered_as_by_a_stable_sort(kind, largest):
    drawn = np.random.default_rng(1).integers(-1, largest, 300, endpoint=True).astype(kind)
    for labels in (drawn, drawn[:0], np.repeat(drawn, 2)):
        np.testing.assert_array_equal(stable_order(labels), np.argsort(labels, kind="stable"))


@pytest.mark.parametrize("share", [0.0, 0.1, 1 / 3, 0.5, 0.9, 1.0])
def test_quantiles_have_the_bits_of_numpy(share):
    drawn = np.random.default_rng(2).normal(size=(12, 3))
    for values in (drawn, drawn[:1], drawn[:, 0], np.arange(7), np.where(drawn > 1.0, np.nan, drawn)):
        np.testing.assert_array_equal(quantile(values, share), np.quantile(values, share, axis=0))
