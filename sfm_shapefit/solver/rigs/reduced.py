"""The normal matrix of groups, A^T D^T S D A, factored: a block Laplacian with a dense row for each unit.

Over x = (f, s) the matrix of edge blocks S_e is

    [ K    h   ]     K    the Laplacian of S_e on the graph of groups, repeated pairs added up
    [ h^T  eta ]     h    (., S) at each group the sums of its signed S_e p_e^c
                     eta  (S, S) sums of p_e^c . S_e p_e^k

with p_e^c = o_i - o_j of what is in unit c. K is factored in d x d blocks, sparse as the graph of groups is;
what remains for s is the Schur complement eta - h^T K^-1 h. Translations are taken away by grounding one
group.
"""

from collections.abc import Iterable

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray, sum_by
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.laplacian.cholesky import allocate_factor, analyze
from sfm_shapefit.solver.newton.reduction import Reduction

_LEAST_SCHUR = 1e-13  # share of eta; less of s, when all groups may move, is rounding


class RigidReduction(Reduction):
    """Memory for the factor of A^T D^T S D A; `refactor` overwrites it, `solve` reads it.

    It answers in locations, A (A^T D^T S D A)^-1 A^T g, so that whatever works with a Laplacian of cameras
    works with groups.
    """

    def __init__(
        self, edges: IntArray, groups: RigidGroups, *, threads: int = 1, max_bytes: int | None = None
    ) -> None:
        """Plan the factorization; UnsolvableError if the factor would take more than `max_bytes`.

        Args:
            edges: (m, 2) pairs of nodes, each of two different groups, which they connect.
            groups: groups of the nodes; offsets best centered.
            threads: threads of the factor; its answers do not depend on them.
            max_bytes: limit of the factor; predicted before it is allocated.
        """
        self.groups = groups
        self._ends = np.ascontiguousarray(groups.group_of[edges])
        units = range(groups.num_units)
        columns = [np.where(groups.units[:, None] == c, groups.offsets, 0.0) for c in units]
        self._offsets = [own[edges[:, 0]] - own[edges[:, 1]] for own in columns]
        self._metric = any(own.any() for own in self._offsets)
        dimension = groups.offsets.shape[1]
        plan = analyze(groups.num_groups, self._ends)
        needed = plan.num_bytes(dimension, np.float64, threads)
        if max_bytes is not None and needed > max_bytes:
            raise UnsolvableError(
                f"the factor over {groups.num_groups} groups takes {needed / 1e6:.0f} MB, and only "
                f"{max_bytes / 1e6:.0f} MB are allowed; allow more memory for a factor"
            )
        super().__init__(allocate_factor(plan, dimension, threads=threads))
        self.smallest_pivot = 0.0
        """Least pivot relative to its diagonal entry, that of s included; see `refactor`."""

    def expand(self, x: FloatArray, /) -> FloatArray:
        """Return A x, (n, d)."""
        return self.groups.expand(x)

    def reduce(self, g: FloatArray, /) -> FloatArray:
        """Return A^T g, (B d + S,), for g (n, d)."""
        return self.groups.reduce(g)

    def refactor(self, weights: FloatArray, /) -> None:
        """Factor the matrix of the blocks (m, d, d), or of weights (m,) times the identity.

        UnsolvableError if it is not positive definite to working precision.
        """
        d = self._offsets[0].shape[1]
        blocks = weights if weights.ndim > 1 else weights[:, None, None] * np.eye(d)
        self.factor.refactor(blocks)
        self.smallest_pivot = self.factor.smallest_pivot
        bent = [np.einsum("eab,eb->ea", blocks, own) for own in self._offsets]
        self._rows = [self._at_groups(values) for values in bent]
        eta = _products(bent, self._offsets)
        if not self._metric and self.groups.num_units == 1:
            self._columns, self._schur = np.zeros((*self._rows[0].shape, 1)), np.full((1, 1), np.inf)
            return
        self._columns = self.factor.solve(np.stack(self._rows, axis=2))
        self._schur = eta - _products(self._rows, np.moveaxis(self._columns, 2, 0))
        sizes = np.sqrt(np.diagonal(eta))
        least = float(np.linalg.eigvalsh(self._schur / np.outer(sizes, sizes))[0]) if sizes.all() else 0.0
        if not least > _LEAST_SCHUR:
            raise UnsolvableError("the offsets inside the groups do not determine a scale")
        self.smallest_pivot = min(self.smallest_pivot, least)

    def solve_reduced(self, right: FloatArray, /) -> FloatArray:
        """Return the x (B d + S,) with (A^T D^T S D A) x = right; s stays 0 without offsets."""
        at_groups, at_units = self.groups.split(right)
        z = self.factor.solve(at_groups)
        rest = at_units - _products(self._rows, [z])[:, 0]
        s = rest / self._schur[0] if len(rest) == 1 else np.linalg.solve(self._schur, rest)
        return np.append((z - self._columns @ s).ravel(), s)

    def solve_two_reduced(self, first: FloatArray, second: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        """Return x for two right-hand sides."""
        return self.solve_reduced(first), self.solve_reduced(second)

    def solve(self, right: FloatArray, /) -> FloatArray:
        """Return A x for the x of the right-hand side A^T right, both (n, d)."""
        return self.groups.expand(self.solve_reduced(self.groups.reduce(right)))

    def _at_groups(self, values: FloatArray) -> FloatArray:
        """Return the sum of the signed values (m, d) at each group, (B, d)."""
        leaving, entering = (sum_by(end, values, self.groups.num_groups) for end in self._ends.T)
        return np.asarray(leaving - entering)


def _products(first: Iterable[FloatArray], second: Iterable[FloatArray]) -> FloatArray:
    """Return the inner products of arrays with others, a row for each of the first."""
    others = list(second)
    return np.array([[np.vdot(one, other) for other in others] for one in first])
