"""Which groups the pairs tie to one another once the scale s is known, and which hang free.

With s held, x moves along f alone, and a motion that no pair notices is a null vector of K, the Laplacian of
the groups with blocks P_e = I - u_e u_e^T, u_e the directions of the baselines. Two groups are tied if every
null vector moves both alike: an equivalence relation, whose classes are the sets of groups that keep their
places relative to one another. If all groups are in one class, s and f are determined up to translation and
one common factor: a null vector that changes s is the solution itself, plus one that does not.

Random null vectors tell the classes with probability 1: z <- (K + eps N)^-1 eps N z with N the plain
Laplacian tends to the projection of z on the null space. Whether pairs tie groups in general is asked at
random positions with the given offsets, which are part of the problem; whether they do at a solution, at its
baselines.
"""

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray, distinct
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.forests import connected_components
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.base.lists import RowLists
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.solver.program import differences
from sfm_shapefit.solver.reduction import Reduction

_EPSILON = 1e-10  # shift of the matrix, relative; null vectors grow by its inverse per step
_STEPS = 4  # steps of inverse iteration; after these nothing but null vectors is left
_PROBES = 3  # null vectors drawn; groups that move alike in all by chance are improbable
_ALIKE = 1e-3  # difference of motions; groups are tied if all null vectors, of unit variance, differ by less
_SEED = 0  # seed of the probes; same input, same answer


def largest_tied(
    edges: IntArray,
    groups: RigidGroups,
    sizes: IntArray,
    locations: FloatArray | None = None,
    around: int | None = None,
) -> IntArray:
    """Return the largest set of groups (k,), ascending, that the pairs tie to one another if s is known.

    Args:
        edges: (m, 2) pairs of nodes; those inside a group are ignored.
        groups: groups of the nodes.
        sizes: (B,) what each group counts, such as its number of cameras; sets are compared by their sum.
        locations: (n, d) positions; random ones with the groups' offsets if None.
        around: a group; then the set that holds it, whatever its size.
    """
    used = edges[groups.joins(edges)]
    if locations is None:
        locations = general_positions(groups)
    if around is not None:  # outweighs all others together
        sizes = np.where(np.arange(groups.num_groups) == around, sizes.sum() + 1, sizes)
    best = np.array([int(np.argmax(sizes))])
    ends = groups.group_of[used]
    for members in _components(ends, groups.num_groups):
        if len(members) < 2 or sizes[members].sum() <= sizes[best].sum():
            continue
        inside = np.isin(ends[:, 0], members)
        nodes, renumbered = np.unique(used[inside], return_inverse=True)
        part = groups.restricted_to(nodes)
        names = distinct(groups.group_of[nodes])
        motions = _null_motions(renumbered.reshape(-1, 2), part, locations[nodes])
        tied = names[_largest_alike(motions, sizes[names])]
        if sizes[tied].sum() > sizes[best].sum():
            best = tied
    return best


def general_positions(groups: RigidGroups) -> FloatArray:
    """Return random locations of the groups, at distances comparable to the size of their offsets."""
    unit = groups.normalize()
    rng = np.random.default_rng(_SEED)
    centers = rng.standard_normal((unit.num_groups, unit.offsets.shape[1]))
    return unit.expand(unit.stack(centers, np.ones(unit.num_units)))


def _components(ends: IntArray, count: int) -> list[IntArray]:
    return list(RowLists.by_label(connected_components(count, ends)))


def _null_motions(edges: IntArray, groups: RigidGroups, locations: FloatArray) -> FloatArray:
    """Return random null vectors of K for connected groups, (B, d * probes), up to a translation each."""
    d = locations.shape[1]
    still = RigidGroups(group_of=groups.group_of, offsets=np.zeros_like(locations))
    u = normalized(differences(locations, edges))  # NaN where two nodes coincide, which says nothing
    blocks = np.nan_to_num(np.eye(d) - u[:, :, None] * u[:, None, :])
    factor = Reduction.over(edges, still)
    try:
        factor.refactor(blocks + _EPSILON * np.eye(d))
    except UnsolvableError:  # regular but for rounding: nothing can be told apart
        return np.arange(groups.num_groups, dtype=np.float64)[:, None]
    rng = np.random.default_rng(_SEED)
    ends = groups.group_of[edges]
    motions = []
    for _ in range(_PROBES):
        z = rng.standard_normal((groups.num_groups, d))
        for _ in range(_STEPS):
            pull = np.zeros_like(z)
            np.add.at(pull, ends[:, 0], z[ends[:, 0]] - z[ends[:, 1]])
            np.subtract.at(pull, ends[:, 1], z[ends[:, 0]] - z[ends[:, 1]])
            z = factor.factor.solve(_EPSILON * pull)
        motions.append(z)
    return np.concatenate(motions, axis=1)


def _largest_alike(motions: FloatArray, sizes: IntArray) -> IntArray:
    """Return the largest group of rows that agree, weighed by their sizes."""
    left = np.ones(len(motions), dtype=np.bool_)
    best = np.zeros(0, dtype=np.int64)
    while left.any() and sizes[left].sum() > sizes[best].sum():
        reference = int(np.flatnonzero(left)[0])
        group = left & (np.abs(motions - motions[reference]).max(axis=1) <= _ALIKE)
        left &= ~group
        if sizes[group].sum() > sizes[best].sum():
            best = np.flatnonzero(group)
    return best
