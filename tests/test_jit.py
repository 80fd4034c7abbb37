"""The door to numba: kernels compile with or without a place to cache them."""

import numba

from sfm_shapefit.jit import kernel


def test_a_kernel_works_where_nothing_can_be_cached(monkeypatch):
    plain = numba.njit

    def without_a_place_for_a_cache(**options):
        if options.pop("cache", False):
            raise RuntimeError("cannot cache function: no locator available")
        return plain(**options)

    monkeypatch.setattr(numba, "njit", without_a_place_for_a_cache)

    @kernel(exact=True)
    def twice(x):
        return 2 * x

    assert twice(21) == 42
