"""What moves: the unknowns x of the program, t = A x, and the factored matrix of their equations.

A is the identity where each node moves by itself, or it places the nodes of rigid groups: rigs, fixed
cameras, pieces with a scale of their own, single ones among them (`sfm_shapefit.graph.groups`). The programs
see it through `expand`, `reduce` and the linear solve alone, and so are one for all of these.

Over x = (f, s) the matrix A^T D^T S D A of edge blocks S_e is

    [ K    h   ]     K    the Laplacian of S_e on the graph of groups, repeated pairs added up
    [ h^T  eta ]     h    (., S) at each group the sums of its signed S_e p_e^c
                     eta  (S, S) sums of p_e^c . S_e p_e^k

with p_e^c = o_i - o_j of what is in unit c. K is factored in d x d blocks, sparse as the graph of groups is;
what remains for s is the Schur complement eta - h^T K^-1 h. Translations are taken away by grounding one
group.

Along the solution itself the matrix tends to singular whatever the data, for the objective is homogeneous. So
for a Newton step one pair is pinned: with M the matrix and q = A^T D^T of v_e at that pair,

    M' = M + tau q q^T,    M x = M' x - tau q <q, x>,

so that with a = M'^-1 c and p = M'^-1 q the step is lambda a + sigma p + M'^-1 (right-hand side), where
lambda and sigma = tau <q, x> solve the two equations <c, x> = what is wanted, <q, x> = sigma / tau.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import FloatArray, IntArray, sum_by
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.laplacian.factor import Factor, allocate_factor, analyze

_LEAST_SCHUR = 1e-13  # share of eta; less of s, when all groups may move, is rounding


class Reduction:
    """The map A from unknowns to locations, and memory for a factor of A^T D^T S D A.

    `refactor` overwrites it, `solve` and `solve_reduced` read it. An x has a row for each node or group, and
    one for each unit, see `RigidGroups`.
    """

    plan = None

    def __init__(
        self, factor: Factor, groups: RigidGroups | None = None, edges: IntArray | None = None
    ) -> None:
        """Keep the sparse factor over nodes or groups, which says what a factorization and a solve cost.

        With groups, whose offsets are best centered, `edges` (m, 2) are the pairs of nodes, each of two
        different groups.
        """
        self.factor = factor
        self.groups = groups
        self._s: FloatArray | None = None
        """(S, S) the Schur complement; None where no scale is unknown."""
        self.smallest_pivot = 0.0
        """Least pivot relative to its diagonal entry, that of s included."""
        if groups is not None and edges is not None:
            self._ends = np.ascontiguousarray(groups.group_of[edges])
            units = range(groups.num_units)
            columns = [np.where(groups.units[:, None] == c, groups.offsets, 0.0) for c in units]
            self._offsets = [own[edges[:, 0]] - own[edges[:, 1]] for own in columns]

    @classmethod
    def over(
        cls, edges: IntArray, groups: RigidGroups, *, threads: int = 1, max_bytes: int | None = None
    ) -> "Reduction":
        """Plan the factorization over groups; UnsolvableError if it would take more than `max_bytes`.

        Its answers do not depend on the threads.
        """
        dimension = groups.offsets.shape[1]
        plan = analyze(groups.num_groups, np.ascontiguousarray(groups.group_of[edges]))
        needed = plan.num_bytes(dimension, np.float64, threads)
        if max_bytes is not None and needed > max_bytes:
            raise UnsolvableError(
                f"the factor over {groups.num_groups} groups takes {needed / 1e6:.0f} MB, and only "
                f"{max_bytes / 1e6:.0f} MB are allowed; allow more memory for a factor"
            )
        return cls(allocate_factor(plan, dimension, threads=threads), groups, edges)

    def expand(self, x: FloatArray, /) -> FloatArray:
        """Return A x, (n, d)."""
        return x if self.groups is None else self.groups.expand(x)

    def reduce(self, g: FloatArray, /) -> FloatArray:
        """Return A^T g for g (n, d), in the shape of x."""
        return g if self.groups is None else self.groups.reduce(g)

    def refactor(self, weights: FloatArray, /) -> None:
        """Factor the matrix of the blocks S_e (m, d, d), or of weights (m,) times the identity.

        UnsolvableError if it is not positive definite to working precision.
        """
        blocks = weights if weights.ndim > 1 else weights[:, None, None] * np.eye(self.factor.block)
        self.factor.refactor(blocks)
        self.smallest_pivot = self.factor.smallest_pivot
        self._s = None
        if self.groups is None or not (self.groups.num_units > 1 or any(own.any() for own in self._offsets)):
            return
        scaled = [np.einsum("eab,eb->ea", blocks, own) for own in self._offsets]
        self._rows = [self._at_groups(values) for values in scaled]
        self._columns = self.factor.solve(np.stack(self._rows, axis=2))
        eta = _products(scaled, self._offsets)
        self._s = eta - _products(self._rows, np.moveaxis(self._columns, 2, 0))
        sizes = np.sqrt(np.diagonal(eta))
        least = float(np.linalg.eigvalsh(self._s / np.outer(sizes, sizes))[0]) if sizes.all() else 0.0
        if not least > _LEAST_SCHUR:
            raise UnsolvableError("the offsets inside the groups do not determine a scale")
        self.smallest_pivot = min(self.smallest_pivot, least)

    def solve_reduced(self, right: FloatArray, /) -> FloatArray:
        """Return the x with (A^T D^T S D A) x = right; s stays 0 without offsets."""
        if self.groups is None:
            return self.factor.solve(right)
        at_groups, at_units = self.groups.split(right)
        z, s = self.factor.solve(at_groups), np.zeros_like(at_units)
        if self._s is not None:
            rest = at_units - _products(self._rows, [z])[:, 0]
            s = np.asarray(rest / self._s[0] if len(rest) == 1 else np.linalg.solve(self._s, rest))
            z = z - self._columns @ s
        return self.groups.stack(z, s)

    def solve_two_reduced(self, first: FloatArray, second: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        """Return x for two right-hand sides, of nodes in one pass over the factor."""
        if self.groups is not None:
            return self.solve_reduced(first), self.solve_reduced(second)
        both = self.factor.solve(np.stack([first, second], axis=2))
        return np.ascontiguousarray(both[:, :, 0]), np.ascontiguousarray(both[:, :, 1])

    def solve(self, right: FloatArray, /) -> FloatArray:
        """Return A x for the x of the right-hand side A^T right, both (n, d): a `LaplacianFactor`."""
        return self.expand(self.solve_reduced(self.reduce(right)))

    def _at_groups(self, values: FloatArray) -> FloatArray:
        """Return the sum of the signed values (m, d) at each group, (B, d)."""
        leaving, entering = (sum_by(end, values, self.factor.plan.num_nodes) for end in self._ends.T)
        return np.asarray(leaving - entering)


def _products(first: Iterable[FloatArray], second: Iterable[FloatArray]) -> FloatArray:
    """Return the inner products of arrays with others, a row for each of the first."""
    others = list(second)
    return np.array([[np.vdot(one, other) for other in others] for one in first])


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
