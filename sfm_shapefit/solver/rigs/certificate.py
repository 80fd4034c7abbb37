"""From locations of groups and any dual to a rigorous bound; see the package for the derivation.

Uniqueness is judged as in `solver.certificate`: whatever is optimal satisfies linear conditions, and if the
reduced matrix of these is regular with one pair pinned, nothing else does.
"""

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, frozen
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.solver.certificate import REGULAR, REPAIRS, RESIDUAL_FLOOR, STRICT, Certificate
from sfm_shapefit.solver.newton.reduction import Pin, factor_pinned
from sfm_shapefit.solver.program import across, adjoint, along, differences, objective, scale_functional
from sfm_shapefit.solver.rigs.reduced import RigidReduction

_OFF_GROUPS = 1e-9  # share of the extent; locations off their rigid groups by less are off by rounding
_EXACT = 1e-12  # equality residual; a smaller one needs no repair


def certify_groups(
    graph: ViewGraph,
    groups: RigidGroups,
    locations: FloatArray,
    dual: FloatArray,
    *,
    uniqueness: bool = False,
) -> Certificate:
    """Return the bound that `dual`, made feasible, proves for `locations`. It trusts no solver.

    `equality_residual` is the largest violation at a group, or in the equation for the scale with offsets of
    root mean square 1, relative to the largest weighted degree of a group.

    Args:
        graph: a view graph whose pairs connect the groups; those inside a group take no part.
        groups: groups of its nodes.
        locations: (n, d) in any scale, with L(T) > 0 and the groups' offsets in one common scale.
        dual: (m, d) approximate dual; any finite array gives a valid, perhaps useless, bound.
        uniqueness: also examine whether the optimum is unique.

    Raises:
        InputError: if an array has the wrong shape or is not finite, the locations have L(T) <= 0, or they
            are not those of rigid groups.
        UnsolvableError: if the dual must be repaired and the groups hang loose.
    """
    outer = groups.joins(graph.edges)
    _refuse(graph, groups, locations, dual)
    edges, v, w = graph.edges[outer], graph.directions[outer], graph.weights[outer]
    between = ViewGraph(graph.num_nodes, edges, v, w)
    value = objective(between, locations - locations.mean(axis=0))
    if not value < np.inf:
        raise InputError("the locations point against the directions (L(T) <= 0); negate them or solve again")
    unit = groups.normalize()
    c = unit.reduce(scale_functional(between))
    ends = unit.group_of[edges]
    degree = float(np.bincount(ends.ravel(), weights=np.repeat(w, 2)).max())

    y = across(np.ascontiguousarray(dual[outer]), v)
    y, total = _balance(between, unit, locations, y, _EXACT * degree)
    scale = 1.0 / max(1.0, float(np.max(np.linalg.norm(y, axis=1) / w)))
    y, total = scale * y, scale * total
    bound = float(total @ c / (c @ c))
    if bound <= 0.0:  # y = 0 is feasible and proves at least this
        y, total, bound = np.zeros_like(y), np.zeros_like(total), 0.0
    every = np.zeros_like(graph.directions)
    every[outer] = y
    return Certificate(
        objective=value,
        dual_bound=bound,
        dual=frozen(every),
        equality_residual=_largest(total - bound * c, unit) / degree,
        unique=_is_unique(between, unit, locations, y) if uniqueness else None,
    )


def _refuse(graph: ViewGraph, groups: RigidGroups, locations: FloatArray, dual: FloatArray) -> None:
    """Raise InputError for what cannot be certified."""
    shapes = (graph.num_nodes, graph.dimension), graph.directions.shape
    if locations.shape != shapes[0] or dual.shape != shapes[1] or groups.offsets.shape != shapes[0]:
        raise InputError(
            f"locations, dual and offsets have shapes {locations.shape}, {dual.shape} and "
            f"{groups.offsets.shape}; this graph needs {shapes[0]}, {shapes[1]} and {shapes[0]}"
        )
    if not (np.isfinite(locations).all() and np.isfinite(dual).all()):
        raise InputError("locations and dual must be finite to be certified")
    if not groups.joins(graph.edges).any():
        raise InputError("no pair joins two groups, so there is nothing to certify")
    apart = groups.fit(locations)[1]
    if apart > _OFF_GROUPS * float(np.abs(locations).max()):
        raise InputError(f"the locations are not those of rigid groups: a node is {apart:.1e} off its group")


def _largest(violation: FloatArray, groups: RigidGroups) -> float:
    """Return the largest norm of a reduced vector at a group, or its size for a scale."""
    at_groups, at_units = groups.split(violation)
    return float(max(np.linalg.norm(at_groups, axis=1).max(), np.abs(at_units).max()))


def _balance(
    graph: ViewGraph, groups: RigidGroups, locations: FloatArray, y: FloatArray, allowed: float
) -> tuple[FloatArray, FloatArray]:
    """Return the dual moved to A^T D^T y = lambda A^T c, up to `allowed`, and A^T D^T y."""
    n, c = graph.num_nodes, groups.reduce(scale_functional(graph))
    total = groups.reduce(adjoint(y, graph.edges, n))
    multiplier = float(total @ c / (c @ c))
    if _largest(total - multiplier * c, groups) <= allowed:
        return y, total
    stiffness, v = _stiffness(graph, locations), graph.directions
    blocks = stiffness[:, None, None] * (np.eye(graph.dimension) - v[:, :, None] * v[:, None, :])
    longest = _longest(graph, locations)
    pin = Pin(longest, graph.edges[longest], v[longest], float(np.mean(stiffness)))
    system = factor_pinned(RigidReduction(graph.edges, groups), blocks, c, pin)
    if system is None:
        raise UnsolvableError("the dual cannot be repaired: the pairs do not determine the groups")
    for _ in range(REPAIRS):
        multiplier, h = system.balance(total)
        moved = across(differences(groups.expand(h), graph.edges), v)
        y = across(y - stiffness[:, None] * moved, v)
        total = groups.reduce(adjoint(y, graph.edges, n))
        if _largest(total - multiplier * c, groups) <= allowed:
            break
    return y, total


def _stiffness(graph: ViewGraph, locations: FloatArray) -> FloatArray:
    """Return w_e / max(||r_e||, floor), in units of the mean residual: long residuals hardly move."""
    residuals = np.linalg.norm(across(differences(locations, graph.edges), graph.directions), axis=1)
    mean = float(np.average(residuals, weights=graph.weights))
    if not mean > 0.0:
        return graph.weights
    return np.asarray(graph.weights / np.maximum(residuals / mean, RESIDUAL_FLOOR))


def _longest(graph: ViewGraph, locations: FloatArray) -> int:
    """Return the pair whose baseline is the longest along its direction."""
    return int(np.argmax(along(differences(locations, graph.edges), graph.directions)))


def _is_unique(graph: ViewGraph, groups: RigidGroups, locations: FloatArray, y: FloatArray) -> bool:
    """Return whether the feasible dual excludes other optima, up to translation and scale."""
    v, w = graph.directions, graph.weights
    norms = np.linalg.norm(y, axis=1)
    held: BoolArray = norms < (1.0 - STRICT) * w
    u = np.where(held[:, None], 0.0, y / np.maximum(norms, 1e-300)[:, None])
    conditions = np.eye(graph.dimension) - v[:, :, None] * v[:, None, :] - u[:, :, None] * u[:, None, :]
    blocks = w[:, None, None] * conditions
    longest = _longest(graph, locations)
    blocks[longest] += w[longest] * np.outer(v[longest], v[longest])
    factor = RigidReduction(graph.edges, groups)
    try:
        factor.refactor(blocks)
    except UnsolvableError:
        return False
    return factor.smallest_pivot > REGULAR
