"""Rigid groups of cameras: rigs, whose frames are the unknowns, and cameras that must stay where they are.

Camera k belongs to group b(k) and stands at a known offset from its group's center, in world axes and in one
unit that all groups share:

    t_k = f_b(k) + s o_k

Unknown are the centers f_b of the groups and s, the length of that unit in the scale of t. So t = A x is
linear in x = (f, s), and dividing by s gives the centers in the unit of the offsets.

    rig            a frame is a group; o_k = R_frame^T (center of the sensor in the rig), metric
    fixed cameras  all of them are one group; o_k = their given centers
    other camera   a group of its own; o_k = 0

Rotations are known throughout, so a group only moves, it does not turn.
"""

from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, frozen, sum_by
from sfm_shapefit.base.errors import InputError

_COINCIDENT = 1e-12  # share of the largest offset; a smaller offset within a group is rounding


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RigidGroups:
    """Which group each node of a graph belongs to, and where it stands in it."""

    group_of: IntArray
    """(n,) the group of each node, 0..B-1, none of them empty."""
    offsets: FloatArray
    """(n, d) o_k, world axes; all groups in one unit."""

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
        present = np.unique(labels)
        if not np.array_equal(present, np.arange(len(present))):
            raise InputError("groups must be numbered 0, 1, ... without gaps")
        object.__setattr__(self, "group_of", frozen(labels))
        object.__setattr__(self, "offsets", frozen(offsets))

    @property
    def num_nodes(self) -> int:
        """Number of nodes, n."""
        return len(self.group_of)

    @property
    def num_groups(self) -> int:
        """Number of groups, B."""
        return int(self.group_of.max(initial=-1) + 1)

    @property
    def num_unknowns(self) -> int:
        """Length of x, B d + 1."""
        return int(self.num_groups * self.offsets.shape[1] + 1)

    def expand(self, x: FloatArray) -> FloatArray:
        """Return A x, the locations (n, d) for x = (f, s)."""
        centers = x[:-1].reshape(-1, self.offsets.shape[1])
        return np.asarray(centers[self.group_of] + x[-1] * self.offsets)

    def reduce(self, g: FloatArray) -> FloatArray:
        """Return A^T g for g (n, d): its sum over each group, and its inner product with the offsets."""
        return np.append(self._sum(g).ravel(), np.vdot(g, self.offsets))

    def _sum(self, values: FloatArray) -> FloatArray:
        """Return the sum of values (n, d) over each group, (B, d)."""
        return sum_by(self.group_of, values, self.num_groups)

    def fit(self, locations: FloatArray) -> tuple[FloatArray, float]:
        """Return x with A x nearest to locations (n, d), and its largest distance; s is 0 without offsets."""
        centered = self.center()
        spread = float(np.sum(centered.offsets**2))
        sizes = np.bincount(self.group_of)[:, None]
        s = float(np.vdot(centered.offsets, locations)) / spread if spread > 0.0 else 0.0
        x = np.append(((self._sum(locations) - s * self._sum(self.offsets)) / sizes).ravel(), s)
        apart = np.linalg.norm(self.expand(x) - locations, axis=1)
        return x, float(apart.max(initial=0.0))

    def center(self) -> "RigidGroups":
        """Return the same groups with the mean offset of each at 0, and what is rounding exactly 0."""
        means = self._sum(self.offsets) / np.bincount(self.group_of)[:, None]
        moved = self.offsets - means[self.group_of]
        sizes = np.linalg.norm(moved, axis=1)
        largest = float(np.abs(self.offsets).max(initial=0.0))
        moved[sizes <= _COINCIDENT * largest] = 0.0
        return RigidGroups(group_of=self.group_of, offsets=moved)

    def normalize(self) -> "RigidGroups":
        """Return the same groups centered, in a unit in which their offsets have root mean square 1."""
        centered = self.center()
        moved = np.linalg.norm(centered.offsets, axis=1)
        size = float(np.sqrt(np.mean(moved[moved > 0.0] ** 2))) if moved.any() else 1.0
        return RigidGroups(group_of=self.group_of, offsets=centered.offsets / size)

    def restricted_to(self, nodes: IntArray) -> "RigidGroups":
        """Return the groups of some nodes, renumbered in the same order."""
        _, labels = np.unique(self.group_of[nodes], return_inverse=True)
        return RigidGroups(group_of=labels.ravel(), offsets=self.offsets[nodes])

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
        offsets = self.offsets.copy()
        origin = centers[members].mean(axis=0)
        anchors = np.zeros((self.num_groups, offsets.shape[1]))
        first = np.flatnonzero(fixed)[::-1]  # the first fixed node of each group says where it stands
        anchors[self.group_of[first]] = centers[first] - self.offsets[first]
        offsets[members] += anchors[self.group_of[members]] - origin
        _, labels = np.unique(np.where(members, -1, self.group_of), return_inverse=True)
        return RigidGroups(group_of=labels.ravel(), offsets=offsets)


def separate(num_nodes: int, dimension: int) -> RigidGroups:
    """Return `count` nodes, each a group of its own."""
    return RigidGroups(group_of=np.arange(num_nodes), offsets=np.zeros((num_nodes, dimension)))
