"""The normal matrix of groups, A^T D^T S D A, factored: a block Laplacian with one dense row for the scale.

Over x = (f, s) the matrix of edge blocks S_e is

    [ K    h   ]     K    the Laplacian of S_e on the graph of groups, repeated pairs added up
    [ h^T  eta ]     h    at each group the sum of its signed S_e (o_i - o_j)
                     eta  sum_e (o_i - o_j)^T S_e (o_i - o_j)

K is factored in d x d blocks, sparse as the graph of groups is; what remains for s is the Schur complement
eta - h^T K^-1 h. Translations are taken away by grounding one group.

Along the solution itself the matrix tends to singular, whatever the data. `System` therefore works with the
matrix of S_e + tau v v^T for one pinned pair and takes that term away again, exactly, as `newton.sparse`
does.
"""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.laplacian.cholesky import CholeskyFactor, allocate_factor, analyse
from sfm_shapefit.solver.rigs.groups import RigidGroups

_LEAST_SCHUR = 1e-13  # of eta: what is left of s when all groups may move, below which it is rounding


class ReducedFactor:
    """Memory for the factor of A^T D^T S D A; `refactor` overwrites it, `solve` reads it.

    It answers in locations, A (A^T D^T S D A)^-1 A^T g, so that whatever works with a Laplacian of cameras
    works with groups.
    """

    def __init__(self, edges: IntArray, groups: RigidGroups) -> None:
        """Plan the factorisation.

        Args:
            edges: (m, 2) pairs of nodes, each of two different groups, which they connect.
            groups: of the nodes; offsets best centred.
        """
        self.groups = groups
        self._ends = np.ascontiguousarray(groups.group_of[edges])
        self._offsets = groups.offsets[edges[:, 0]] - groups.offsets[edges[:, 1]]
        self._metric = bool(self._offsets.any())
        dimension = groups.offsets.shape[1]
        self.factor: CholeskyFactor = allocate_factor(analyse(groups.num_groups, self._ends), dimension)
        self.smallest_pivot = 0.0
        """Least pivot relative to its diagonal entry, that of s included; see `refactor`."""

    def refactor(self, blocks: FloatArray) -> None:
        """Factor the matrix of the blocks (m, d, d).

        Raises:
            UnsolvableError: if it is not positive definite to working precision.
        """
        self.factor.refactor(blocks)
        self.smallest_pivot = self.factor.smallest_pivot
        bent = np.einsum("eab,eb->ea", blocks, self._offsets)
        self._row = self._at_groups(bent)
        eta = float(np.vdot(bent, self._offsets))
        if not self._metric:
            self._column, self._schur = np.zeros_like(self._row), np.inf
            return
        self._column = self.factor.solve(self._row)
        self._schur = eta - float(np.vdot(self._row, self._column))
        if not self._schur > _LEAST_SCHUR * eta:
            raise UnsolvableError("the offsets inside the groups do not determine a scale")
        self.smallest_pivot = min(self.smallest_pivot, self._schur / eta)

    def solve_reduced(self, right: FloatArray) -> FloatArray:
        """Return the x (B d + 1,) with (A^T D^T S D A) x = right; s stays 0 without offsets."""
        z = self.factor.solve(right[:-1].reshape(self._row.shape))
        s = (right[-1] - float(np.vdot(self._row, z))) / self._schur
        return np.append((z - s * self._column).ravel(), s)

    def solve(self, right: FloatArray) -> FloatArray:
        """Return A x for the x of the right-hand side A^T right, both (n, d)."""
        return self.groups.expand(self.solve_reduced(self.groups.reduce(right)))

    def _at_groups(self, values: FloatArray) -> FloatArray:
        """Return the sum of the signed values (m, d) at each group, (B, d)."""
        count, ends = self.groups.num_groups, self._ends
        sums = [
            np.bincount(ends[:, 0], column, minlength=count)
            - np.bincount(ends[:, 1], column, minlength=count)
            for column in values.T
        ]
        return np.stack(sums, axis=1)


class System(NamedTuple):
    """The matrix M' = M + tau q q^T factored, and what answers M x = lambda c + g, <c, x> = given."""

    factor: ReducedFactor
    a: FloatArray
    """(B d + 1,) M'^-1 c."""
    p: FloatArray
    """(B d + 1,) M'^-1 q."""
    rows: FloatArray
    """(2, B d + 1), c and q, reduced."""
    matrix: FloatArray
    """(2, 2), of the equations for lambda and sigma."""

    def solve(self, right: FloatArray, length: float) -> tuple[float, FloatArray]:
        """Return lambda and x with M x = lambda c + right, <c, x> = length."""
        z = self.factor.solve_reduced(right)
        unknown = np.linalg.solve(self.matrix, np.array([length, 0.0]) - self.rows @ z)
        return float(unknown[0]), np.asarray(unknown[0] * self.a + unknown[1] * self.p + z)

    def balance(self, total: FloatArray) -> tuple[float, FloatArray]:
        """Return lambda and h with M h = total - lambda c, <q, h> = 0."""
        z = self.factor.solve_reduced(total)
        multiplier = float(self.rows[1] @ z) / float(self.rows[1] @ self.a)
        return multiplier, np.asarray(z - multiplier * self.a)


def factor_pinned(
    factor: ReducedFactor,
    blocks: FloatArray,
    c: FloatArray,
    pin: tuple[tuple[int, int], FloatArray],
    stiffness: float,
) -> System | None:
    """Factor the matrix of the blocks with one pair pinned; None if it is not positive definite.

    Args:
        factor: overwritten.
        blocks: (m, d, d) S_e, with tau v v^T added to the pinned pair's.
        c: (B d + 1,) A^T D^T (w v).
        pin: the nodes of the pinned pair, and its v.
        stiffness: tau.
    """
    (i, j), v = pin
    at_nodes = np.zeros((factor.groups.num_nodes, len(v)))
    at_nodes[i], at_nodes[j] = v, -v
    q = factor.groups.reduce(at_nodes)
    try:
        factor.refactor(blocks)
    except UnsolvableError:
        return None
    a, p = factor.solve_reduced(c), factor.solve_reduced(q)
    rows = np.stack([c, q])
    matrix = rows @ np.stack([a, p], axis=1) - np.diag([0.0, 1.0 / stiffness])
    if not (np.isfinite(matrix).all() and abs(np.linalg.det(matrix)) > 0.0):
        return None
    return System(factor, a, p, rows, matrix)
