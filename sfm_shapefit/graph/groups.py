"""Rigid groups of cameras: rigs, whose frames are the unknowns, and cameras that must stay where they are.

Camera k belongs to group b(k) and stands at a known offset from its group's center, in world axes and in a
unit c(b) that its group shares with others, or has alone:

    t_k = f_b(k) + s_c(b(k)) o_k

Unknown are the centers f_b of the groups and s_c, the lengths of the units in the scale of t. So t = A x is
linear in x = (f, s), and dividing by s_c gives centers in the unit c. x has a row for each group, its f_b,
and after these one for each unit, (s_c, 0, ..., 0).

    rig            a frame is a group; o_k = R_frame^T (center of the sensor in the rig), metric, one unit
    fixed cameras  all of them are one group; o_k = their given centers, in the unit of rigs
    piece          a model with a unit of its own; o_k = its cameras and points, turned into the world
    other camera   a group of its own; o_k = 0

Rotations are known throughout, so a group only moves, it does not turn.
"""

from dataclasses import dataclass, replace

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, distinct, frozen, sum_by
from sfm_shapefit.base.errors import InputError

_COINCIDENT = 1e-12  # share of the largest offset; a smaller offset within a group is rounding


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RigidGroups:
    """Which group each node of a graph belongs to, and where it stands in it."""

    group_of: IntArray
    """(n,) the group of each node, 0..B-1, none of them empty."""
    offsets: FloatArray
    """(n, d) o_k, world axes."""
    unit_of: IntArray | None = None
    """(B,) c, the unit of each group, 0..S-1, of which some node has an offset; None: all share one."""

    def __post_init__(self) -> None:
        labels = np.array(self.group_of, dtype=np.int64)
        offsets = np.array(self.offsets, dtype=np.float64)
        if labels.ndim != 1 or offsets.ndim != 2 or len(labels) != len(offsets):
            raise InputError(
                f"groups have {labels.shape} labels and {offsets.shape} offsets; give one row per node"
            )
        if not np.isfinite(offsets).all():
            raise InputError(
                f"the offset of node {int(np.argmin(np.isfinite(offsets).all(axis=1)))} is not finite"
            )
        present = distinct(labels)
        if not np.array_equal(present, np.arange(len(present))):
            raise InputError("groups must be numbered 0, 1, ... without gaps")
        object.__setattr__(self, "group_of", frozen(labels))
        object.__setattr__(self, "offsets", frozen(offsets))
        units = np.zeros(len(present)) if self.unit_of is None else self.unit_of
        object.__setattr__(self, "unit_of", frozen(np.asarray(units, dtype=np.int64)))

    @property
    def num_nodes(self) -> int:
        """Number of nodes, n."""
        return len(self.group_of)

    @property
    def num_groups(self) -> int:
        """Number of groups, B."""
        return int(self.group_of.max(initial=-1) + 1)

    @property
    def units(self) -> IntArray:
        """Unit of each node, (n,)."""
        assert self.unit_of is not None
        return np.asarray(self.unit_of[self.group_of])

    @property
    def num_units(self) -> int:
        """Number of units, S."""
        return int(np.max(self.units, initial=0) + 1)

    @property
    def have_extent(self) -> bool:
        """Whether two nodes of a group stand apart; else their offsets say nothing of the scale."""
        return bool(self.center().offsets.any())

    def split(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return f (B, d) and s (S,) of an x."""
        return x[: self.num_groups], x[self.num_groups :, 0]

    def stack(self, centers: FloatArray, scales: FloatArray) -> FloatArray:
        """Return the x (B + S, d) of f (B, d) and s (S,)."""
        rows = np.zeros((len(scales), self.offsets.shape[1]))
        rows[:, 0] = scales
        return np.concatenate([centers, rows])

    def expand(self, x: FloatArray) -> FloatArray:
        """Return A x, the locations (n, d)."""
        centers, scales = self.split(x)
        return np.asarray(centers[self.group_of] + scales[self.units][:, None] * self.offsets)

    def reduce(self, g: FloatArray) -> FloatArray:
        """Return A^T g for g (n, d): its sums over groups, and its inner products with offsets by unit."""
        return self.stack(self._sum(g), self.along_units(g))

    def along_units(self, g: FloatArray) -> FloatArray:
        """Return the inner products (S,) of g (n, d) with the offsets in each unit."""
        own = (self.units == c for c in range(self.num_units))
        return np.array([np.vdot(g[rows], self.offsets[rows]) for rows in own])

    def _sum(self, values: FloatArray) -> FloatArray:
        """Return the sum of values (n, d) over each group, (B, d)."""
        return sum_by(self.group_of, values, self.num_groups)

    def fit(self, locations: FloatArray) -> tuple[FloatArray, float]:
        """Return x with A x nearest to locations (n, d), and its largest distance; s is 0 without offsets."""
        centered = self.center()
        spreads = centered.along_units(centered.offsets)
        sizes = np.bincount(self.group_of)[:, None]
        s = centered.along_units(locations) / np.where(spreads > 0.0, spreads, np.inf)
        left = self._sum(locations) - s[self.unit_of][:, None] * self._sum(self.offsets)
        x = self.stack(left / sizes, s)
        apart = np.linalg.norm(self.expand(x) - locations, axis=1)
        return x, float(apart.max(initial=0.0))

    def center(self) -> "RigidGroups":
        """Return the same groups with the mean offset of each at 0, and what is rounding exactly 0."""
        means = self._sum(self.offsets) / np.bincount(self.group_of)[:, None]
        moved = self.offsets - means[self.group_of]
        sizes = np.linalg.norm(moved, axis=1)
        largest = float(np.abs(self.offsets).max(initial=0.0))
        moved[sizes <= _COINCIDENT * largest] = 0.0
        return replace(self, offsets=moved)

    def normalize(self) -> "RigidGroups":
        """Return the same groups centered, in units in which their offsets have root mean square 1."""
        centered, units = self.center(), self.units
        moved = np.linalg.norm(centered.offsets, axis=1)
        sizes = np.ones(self.num_units)
        for unit in distinct(units[moved > 0.0]).tolist():
            sizes[unit] = np.sqrt(np.mean(moved[(moved > 0.0) & (units == unit)] ** 2))
        return replace(centered, offsets=centered.offsets / sizes[units][:, None])

    def restricted_to(self, nodes: IntArray) -> "RigidGroups":
        """Return the groups of some nodes, renumbered in the same order, and their units."""
        _, first, labels = np.unique(self.group_of[nodes], return_index=True, return_inverse=True)
        _, units = np.unique(self.units[nodes][first], return_inverse=True)
        return RigidGroups(group_of=labels.ravel(), offsets=self.offsets[nodes], unit_of=units.ravel())

    def joins(self, edges: IntArray) -> BoolArray:
        """Return which edges (m, 2) join two groups; those inside one say nothing of any unknown."""
        ends = self.group_of[edges]
        return np.asarray(ends[:, 0] != ends[:, 1])

    def with_separate(self, count: int) -> "RigidGroups":
        """Return the groups with further nodes, such as 3D points, each a group of its own."""
        labels = self.num_groups + np.arange(count)
        return RigidGroups(
            group_of=np.concatenate([self.group_of, labels]),
            offsets=np.concatenate([self.offsets, np.zeros((count, self.offsets.shape[1]))]),
        )

    def with_fixed(self, fixed: BoolArray, centers: FloatArray) -> "RigidGroups":
        """Return the groups with all of those that hold a fixed node joined to one, the first.

        Args:
            fixed: (n,) the nodes that keep their centers relative to each other.
            centers: (n, d) in the unit of the offsets; read for nodes that share a group with a fixed one.
        """
        whole = np.zeros(self.num_groups, dtype=np.bool_)
        whole[self.group_of[fixed]] = True
        members = whole[self.group_of]
        if not members.any():
            return self
        offsets, origin = self.offsets.copy(), centers[members].mean(axis=0)
        anchors = np.zeros((self.num_groups, offsets.shape[1]))
        first = np.flatnonzero(fixed)[::-1]  # the first fixed node of each group says where it stands
        anchors[self.group_of[first]] = centers[first] - self.offsets[first]
        offsets[members] += anchors[self.group_of[members]] - origin
        _, labels = np.unique(np.where(members, -1, self.group_of), return_inverse=True)
        return RigidGroups(group_of=labels.ravel(), offsets=offsets)


def separate(num_nodes: int, dimension: int) -> RigidGroups:
    """Return `count` nodes, each a group of its own."""
    return RigidGroups(group_of=np.arange(num_nodes), offsets=np.zeros((num_nodes, dimension)))
