"""The unknowns x of a Newton step, t = A x, and the factored matrix of their equations.

A is the identity (`Reduction` itself), or it places the nodes of rigid groups
(`sfm_shapefit.solver.rigs.reduced.RigidReduction`). Along the solution itself the matrix tends to singular
whatever the data, for the objective is homogeneous. So one pair is pinned: with M = A^T D^T S D A and
q = A^T D^T of v_e at that pair,

    M' = M + tau q q^T,    M x = M' x - tau q <q, x>,

so that with a = M'^-1 c and p = M'^-1 q the step is lambda a + sigma p + M'^-1 (right-hand side), where
lambda and sigma = tau <q, x> solve the two equations <c, x> = what is wanted, <q, x> = sigma / tau.
Translations are taken away by grounding one node.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.laplacian.cholesky import CholeskyFactor


class Reduction:
    """The map A from unknowns to locations, here the identity, and memory for a factor of A^T D^T S D A."""

    def __init__(self, factor: CholeskyFactor) -> None:
        """Keep the sparse factor behind it, which says what a factorization and a solve cost."""
        self.factor = factor

    def expand(self, x: FloatArray, /) -> FloatArray:
        """Return A x, (n, d)."""
        return x

    def reduce(self, g: FloatArray, /) -> FloatArray:
        """Return A^T g for g (n, d), in the shape of x."""
        return g

    def refactor(self, blocks: FloatArray, /) -> None:
        """Factor the matrix of the blocks S_e, (m, d, d), or raise UnsolvableError."""
        self.factor.refactor(blocks)

    def solve_reduced(self, right: FloatArray, /) -> FloatArray:
        """Return x for a right-hand side in the shape of x."""
        return self.factor.solve(right)

    def solve_two_reduced(self, first: FloatArray, second: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        """Return x for two right-hand sides, in one pass over the factor."""
        both = self.factor.solve(np.stack([first, second], axis=2))
        return np.ascontiguousarray(both[:, :, 0]), np.ascontiguousarray(both[:, :, 1])


class System(NamedTuple):
    """The matrix M' = M + tau q q^T factored, and what answers M x = lambda c + g, <c, x> = given."""

    reduction: Reduction
    a: FloatArray
    """M'^-1 c, in the shape of x."""
    p: FloatArray
    """M'^-1 q, in the shape of x."""
    rows: FloatArray
    """(2, length of x), c and q, reduced."""
    matrix: FloatArray
    """(2, 2), of the equations for lambda and sigma."""

    def solve(self, right: FloatArray, length: float) -> tuple[float, FloatArray]:
        """Return lambda and x with M x = lambda c + right, <c, x> = length."""
        z = self.reduction.solve_reduced(right)
        unknown = np.linalg.solve(self.matrix, np.array([length, 0.0]) - self.rows @ z.ravel())
        return float(unknown[0]), np.asarray(unknown[0] * self.a + unknown[1] * self.p + z)

    def balance(self, total: FloatArray) -> tuple[float, FloatArray]:
        """Return lambda and h with M h = total - lambda c, <q, h> = 0."""
        z = self.reduction.solve_reduced(total)
        multiplier = float(self.rows[1] @ z.ravel()) / float(self.rows[1] @ self.a.ravel())
        return multiplier, np.asarray(z - multiplier * self.a)


class Pin(NamedTuple):
    """The pair that is pinned."""

    pair: int
    nodes: npt.NDArray[np.integer[Any]]
    """(2,) i and j."""
    v: FloatArray
    stiffness: float
    """tau."""


def factor_pinned(reduction: Reduction, blocks: FloatArray, c: FloatArray, pin: Pin) -> System | None:
    """Factor the matrix of the blocks with one pair pinned; None if it is not positive definite.

    Args:
        reduction: its factor is overwritten.
        blocks: (m, d, d) S_e; tau v v^T is added to the pinned pair's.
        c: A^T D^T (w v), in the shape of x.
        pin: which pair.
    """
    at_nodes = np.zeros_like(reduction.expand(c))
    at_nodes[pin.nodes] = pin.v, -pin.v
    q = reduction.reduce(at_nodes)
    blocks[pin.pair] += pin.stiffness * np.outer(pin.v, pin.v)
    try:
        reduction.refactor(blocks)
    except UnsolvableError:
        return None
    a, p = reduction.solve_two_reduced(c, q)
    rows = np.stack([c.ravel(), q.ravel()])
    matrix = rows @ np.stack([a.ravel(), p.ravel()], axis=1) - np.diag([0.0, 1.0 / pin.stiffness])
    if not (np.isfinite(matrix).all() and abs(np.linalg.det(matrix)) > 0.0):
        return None
    return System(reduction, a, p, rows, matrix)
