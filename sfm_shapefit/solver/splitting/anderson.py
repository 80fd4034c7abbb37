"""Anderson acceleration of a fixed-point map x -> f(x) on edge states.

With residuals g = f(x) - x and the differences of the last few f and g, the next point is

    x+ = f - sum_j gamma_j df_j,     gamma = argmin || g - sum_j gamma_j dg_j ||_rho

in the norm in which the map of ADMM is nonexpansive, ||z||_rho^2 = sum_e rho_e ||z_e||^2. The differences
are kept in float32: their rounding is relative to steps that vanish.

Source: Walker and Ni, "Anderson acceleration for fixed-point iterations", SIAM J. Numer. Anal. 49 (2011).
"""

from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.solver.splitting.edges import EdgePasses

# Added to the Gram matrix, relative to the mean squared column: the differences are kept to 1e-7.
_REGULARIZATION = 1e-10


class Anderson:
    """The history of one accelerated iteration."""

    def __init__(self, passes: EdgePasses, shape: tuple[int, ...], memory: int) -> None:
        """Allocate `memory` pairs of differences of (m, d) states."""
        self._passes = passes
        self._df = np.empty((memory, *shape), dtype=np.float32)
        self._dg = np.empty((memory, *shape), dtype=np.float32)
        self._f = np.empty(shape)
        self._g = np.empty(shape)
        self._gram = np.zeros((memory, memory))
        self._dots = np.zeros((len(passes.data.bounds) - 1, memory, 2))
        self._count = -1

    def restart(self) -> None:
        """Forget the history: the map has changed, or the last step made things worse."""
        self._count = -1

    def advance(self, x: FloatArray, f: FloatArray, rho: FloatArray) -> FloatArray:
        """Return the accelerated point after x, written over `f` = f(x); (m, d)."""
        memory = len(self._df)
        slot = max(self._count, 0) % memory
        first = self._count < 0
        self._passes.over_chunks(
            lambda k, a, b: _remember(
                a, b, first, slot, min(self._count + 1, memory), rho, x, f,
                self._f, self._g, self._df, self._dg, self._dots[k],
            )
        )  # fmt: skip
        self._count += 1
        if first:
            return f
        used = min(self._count, memory)
        gamma = self._coefficients(slot, used)
        self._passes.over_chunks(lambda _k, a, b: _combine(a, b, gamma, self._df, f))
        return f

    def _coefficients(self, slot: int, used: int) -> FloatArray:
        """Return gamma from the new column's scalar products; the Gram matrix is kept up to date."""
        dots = self._dots[:, :used].sum(axis=0)
        self._gram[slot, :used] = self._gram[:used, slot] = dots[:, 0]
        gram = self._gram[:used, :used]
        ridge = _REGULARIZATION * np.trace(gram) / used
        if not ridge > 0.0:
            return np.zeros(used)
        return np.asarray(np.linalg.solve(gram + ridge * np.eye(used), dots[:, 1]))


@kernel
def _remember(
    first: int, last: int, is_first: bool, slot: int, used: int, rho: Any, x: Any, f: Any,
    f_before: Any, g_before: Any, df: Any, dg: Any, dots: Any,
) -> None:  # fmt: skip
    """Store the newest differences in `slot`; dots[j] = (<dg_slot, dg_j>, <g, dg_j>) for j < used."""
    d = x.shape[1]
    dots[:] = 0.0
    for begin in range(first, last, 512):  # a block stays in cache while all columns pass over it
        end = min(begin + 512, last)
        for e in range(begin, end):
            for k in range(d):
                g = f[e, k] - x[e, k]
                if not is_first:
                    df[slot, e, k] = f[e, k] - f_before[e, k]
                    dg[slot, e, k] = g - g_before[e, k]
                f_before[e, k] = f[e, k]
                g_before[e, k] = g
        if is_first:
            continue
        for j in range(used):
            with_new, with_g = 0.0, 0.0
            for e in range(begin, end):
                for k in range(d):
                    column = rho[e] * dg[j, e, k]
                    with_new += column * dg[slot, e, k]
                    with_g += column * g_before[e, k]
            dots[j, 0] += with_new
            dots[j, 1] += with_g


@kernel
def _combine(first: int, last: int, gamma: Any, df: Any, f: Any) -> None:
    """Subtract sum_j gamma_j df_j from f."""
    d = f.shape[1]
    for begin in range(first, last, 512):
        end = min(begin + 512, last)
        for j in range(len(gamma)):
            for e in range(begin, end):
                for k in range(d):
                    f[e, k] -= gamma[j] * df[j, e, k]
