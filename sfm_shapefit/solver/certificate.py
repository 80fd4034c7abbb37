"""Any iterate to a rigorous bound: how far locations can be from the optimum of the ShapeFit program.

An approximate dual y is made feasible in two steps. It is moved by the smallest transverse change
that restores D^T y = lambda c,

    y' = y - P D h,    (D^T P D) h = D^T y - lambda c,    lambda = <y, D T> / <c, T>,

and divided by max(1, max_e ||y'_e|| / w_e), which keeps the equality since both constraints are
homogeneous. Then no locations have an objective below lambda / max(...). The choice of lambda makes
the right-hand side orthogonal to T, the one direction in which D^T P D is nearly singular when the
data are nearly exact.

The system is solved by conjugate gradients, preconditioned by the scalar graph Laplacian of the same
graph, in a number of steps that does not grow with n. A dual that satisfies the equality already, as
that of a Newton method does, is taken as it is.

Uniqueness. An optimal T' has w_e ||r'_e|| = <y_e, r'_e> for every pair and every optimal dual: r'_e = 0
where ||y_e|| < w_e, and r'_e points along y_e where ||y_e|| = w_e. If translations and T are all that
satisfies these linear conditions, there is no other optimum. (It suffices, but is not needed, that the
pairs with ||y_e|| < w_e are parallel rigid.) The conditions are the null space of a Laplacian with blocks

    w_e P_e  where ||y_e|| < (1 - margin) w_e,      w_e (P_e - y_e y_e^T / ||y_e||^2)  elsewhere,

and w_e v_e v_e^T is added for one pair, which excludes T: then Cholesky tells whether it is regular.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from sfm_shapefit.arrays import FloatArray, frozen
from sfm_shapefit.errors import InputError, UnsolvableError
from sfm_shapefit.laplacian.cholesky import factorise
from sfm_shapefit.laplacian.operators import adjacency
from sfm_shapefit.laplacian.ordering import best_order
from sfm_shapefit.laplacian.symbolic import plan_factorisation
from sfm_shapefit.solver.program import (
    across,
    adjoint,
    along,
    differences,
    objective,
    scale_functional,
)
from sfm_shapefit.viewgraph import ViewGraph

LinearMap = Callable[[FloatArray], FloatArray]

_REPAIRS = 3  # each repair shrinks the equality residual to the rounding of the previous one
_CG_STEPS = 500
_CG_REDUCTION = 1e-13
_EXACT = 1e-12  # an equality residual that needs no repair: it moves the bound by no more than this
_STRICT = 1e-3  # a pair counts as held by its fit if ||y_e|| < (1 - this) w_e
_REGULAR = 1e-9  # least pivot, relative to its diagonal entry, of a matrix that counts as regular
_UNIQUENESS_FLOPS = 1e11  # a few seconds; beyond it uniqueness is not examined


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Certificate:
    """A feasible dual point and what it proves about locations."""

    objective: float
    """R(T) / L(T) at the locations."""
    dual_bound: float
    """No locations have an objective below this."""
    dual: FloatArray
    """(m, d) the feasible dual point that proves it."""
    equality_residual: float
    """Largest violation of D^T y = dual_bound * c at a camera, relative to the largest weighted degree."""
    unique: bool | None = None
    """True: the dual proves that no other locations are optimal (up to translation and scale, and up to
    the gap). False: it does not prove that. None: not examined."""

    @property
    def gap(self) -> float:
        """How far the objective may be above the optimum."""
        return self.objective - self.dual_bound


def certify(
    graph: ViewGraph, locations: FloatArray, dual: FloatArray, *, uniqueness: bool = False
) -> Certificate:
    """Return the bound that `dual`, made feasible, proves for `locations`. It trusts no solver.

    Args:
        graph: a connected view graph.
        locations: (n, d) camera centres, in any scale, with L(T) > 0.
        dual: (m, d) approximate dual; any finite array gives a valid, perhaps useless, bound.
        uniqueness: also examine whether the optimum is unique; costs one sparse factorisation.

    Raises:
        InputError: if an array has the wrong shape, is not finite, or the locations have L(T) <= 0.
    """
    _check(graph, locations, dual)
    edges, w = graph.edges, graph.weights
    c = scale_functional(graph)
    degree = np.bincount(edges.ravel(), weights=np.repeat(w, 2), minlength=graph.num_cameras).max()
    t = locations - locations.mean(axis=0)

    y = _with_equality(graph, t, dual, c, _EXACT * float(degree))
    y /= max(1.0, float(np.max(np.linalg.norm(y, axis=1) / w)))
    total = adjoint(y, edges, graph.num_cameras)
    bound = float(np.sum(total * c) / np.sum(c * c))
    if bound <= 0.0:  # y = 0 is feasible and proves at least this
        y, total, bound = np.zeros_like(y), np.zeros_like(total), 0.0
    return Certificate(
        objective=objective(graph, t),
        dual_bound=bound,
        dual=frozen(y),
        equality_residual=float(np.linalg.norm(total - bound * c, axis=1).max() / degree),
        unique=_is_unique(graph, t, y) if uniqueness else None,
    )


def _with_equality(
    graph: ViewGraph, t: FloatArray, dual: FloatArray, c: FloatArray, allowed: float
) -> FloatArray:
    """Return the dual moved across the directions until D^T y = lambda c at every camera up to `allowed`."""
    edges, v = graph.edges, graph.directions
    y = across(dual, v)
    precondition: LinearMap | None = None
    for _ in range(_REPAIRS):
        multiplier = float(np.sum(y * differences(t, edges)) / np.sum(c * t))
        violation = adjoint(y, edges, graph.num_cameras) - multiplier * c
        if np.linalg.norm(violation, axis=1).max() <= allowed:
            break
        precondition = precondition or _laplacian_inverse(graph)
        h = _conjugate_gradients(lambda x: _projected_laplacian(graph, x), violation, precondition)
        y = across(y - across(differences(h, edges), v), v)
    return y


def _is_unique(graph: ViewGraph, t: FloatArray, y: FloatArray) -> bool | None:
    """Return whether the feasible dual excludes other optima; None if the factor would be too large."""
    neighbours = adjacency(graph.num_cameras, graph.edges)
    symbolic = plan_factorisation(neighbours, graph.edges, best_order(neighbours))
    d = graph.dimension
    if symbolic.flops * d**3 > _UNIQUENESS_FLOPS:
        return None
    v = graph.directions
    norms = np.linalg.norm(y, axis=1)
    held = norms < (1.0 - _STRICT) * graph.weights
    u = np.where(held, 0.0, 1.0 / np.maximum(norms, np.finfo(float).tiny))[:, None] * y
    blocks = np.eye(d) - v[:, :, None] * v[:, None, :] - u[:, :, None] * u[:, None, :]
    longest = int(np.argmax(along(differences(t, graph.edges), v)))
    blocks[longest] += np.outer(v[longest], v[longest])
    try:
        return factorise(symbolic, graph.weights[:, None, None] * blocks).smallest_pivot > _REGULAR
    except UnsolvableError:
        return False


def _check(graph: ViewGraph, locations: FloatArray, dual: FloatArray) -> None:
    shapes = (graph.num_cameras, graph.dimension), graph.directions.shape
    if locations.shape != shapes[0] or dual.shape != shapes[1]:
        raise InputError(
            f"locations and dual have shapes {locations.shape} and {dual.shape}; this graph needs "
            f"{shapes[0]} and {shapes[1]}"
        )
    if not (np.isfinite(locations).all() and np.isfinite(dual).all()):
        raise InputError("locations and dual must be finite to be certified")
    if not objective(graph, locations) < np.inf:
        raise InputError("the locations point against the directions (L(T) <= 0); negate them or solve again")


def _projected_laplacian(graph: ViewGraph, x: FloatArray) -> FloatArray:
    """Return D^T P D x, shape (n, d)."""
    transverse = across(differences(x, graph.edges), graph.directions)
    return adjoint(transverse, graph.edges, graph.num_cameras)


def _laplacian_inverse(graph: ViewGraph) -> LinearMap:
    """Return the pseudo-inverse of the unweighted graph Laplacian, applied to each column."""
    n = graph.num_cameras
    i, j = graph.edges.T
    adjacency = coo_array((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), shape=(n, n)).tocsc()
    degrees = coo_array((graph.degrees().astype(float), (np.arange(n), np.arange(n))), shape=(n, n)).tocsc()
    grounded = (degrees - adjacency)[1:, 1:]
    factor = splu(grounded.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0)

    def apply(b: FloatArray) -> FloatArray:
        x = np.zeros_like(b)
        x[1:] = factor.solve(b[1:] - b.mean(axis=0))
        centred: FloatArray = x - x.mean(axis=0)
        return centred

    return apply


def _conjugate_gradients(matrix: LinearMap, b: FloatArray, precondition: LinearMap) -> FloatArray:
    """Return an approximate solution of matrix(x) = b for a positive semidefinite matrix, from x = 0.

    Stops early where the curvature vanishes to rounding, as it does in the null space.
    """
    x, r = np.zeros_like(b), b.copy()
    z = precondition(r)
    p, rz = z, float(np.sum(r * z))
    target = _CG_REDUCTION**2 * rz
    for _ in range(_CG_STEPS):
        if rz <= target or rz <= 0.0:
            break
        q = matrix(p)
        curvature = float(np.sum(p * q))
        if curvature <= 1e-15 * float(np.sum(p * p)):
            break
        step = rz / curvature
        x = x + step * p
        r = r - step * q
        z = precondition(r)
        rz, previous = float(np.sum(r * z)), rz
        p = z + (rz / previous) * p
    return x
