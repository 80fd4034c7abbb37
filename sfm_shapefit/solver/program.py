"""The ShapeFit program and its dual, as arrays.

    minimize    R(T) = sum_e w_e || P_e (t_i - t_j) ||        e = (i, j), P_e = I - v_e v_e^T
    subject to  L(T) = sum_e w_e <t_i - t_j, v_e> = kappa,    sum_i t_i = 0

With D the incidence operator, (D T)_e = t_i - t_j, and c = D^T (w v), L(T) = <c, T>. The dual is

    maximize    lambda
    subject to  D^T y = lambda c,    <y_e, v_e> = 0,    ||y_e|| <= w_e

and for every feasible pair R(T) - lambda L(T) = sum_e (w_e ||r_e|| - <y_e, r_e>) >= 0 with
r_e = P_e (t_i - t_j). The program is homogeneous: R(T) / L(T) is the paper's objective whatever kappa.
Inside the solvers kappa = sum_e w_e, so that the mean edge has length about 1 and tolerances mean
something; with the paper's kappa = 1 locations and objective would shrink like 1 / m.

Source: Hand, Lee, Voroninski, "ShapeFit: Exact location recovery from corrupted pairwise
directions", 2015 (arXiv 1506.01437), the program called ShapeFit. Weights w_e = 1 there.
"""

from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray, frozen
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.executors import in_slices
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.graph.viewgraph import ViewGraph

SLICE = 8192
"""Edges that one thread takes at a time; sums are those of slices, whatever the number of threads."""


def differences(t: FloatArray, edges: IntArray) -> FloatArray:
    """Return D T, the baselines t_i - t_j, shape (m, d)."""
    return measure_baselines(t, edges)[0]


def measure_baselines(t: FloatArray, edges: IntArray, threads: int = 1) -> tuple[FloatArray, FloatArray]:
    """Return the baselines t_i - t_j, shape (m, d), and their lengths, (m,); threads share the edges."""
    out = np.empty((len(edges), t.shape[1])), np.empty(len(edges))
    # Arrays that can be written cost another compilation.
    in_slices(threads, len(edges), SLICE, _measure_baselines, frozen(t), frozen(edges), *out)
    return out


def adjoint(y: FloatArray, edges: IntArray, num_nodes: int) -> FloatArray:
    """Return D^T y, at every node the sum of its incident signed y_e, shape (n, d)."""
    total = np.zeros((num_nodes, y.shape[1]))
    _add_adjoint(y, frozen(edges), total)
    return total


def along(x: FloatArray, v: FloatArray) -> FloatArray:
    """Return <x_e, v_e> for every edge, shape (m,)."""
    return np.asarray(np.einsum("ed,ed->e", x, v))


def across(x: FloatArray, v: FloatArray) -> FloatArray:
    """Return P_e x_e = x_e - <x_e, v_e> v_e for every edge, shape (m, d).

    Formed explicitly: sqrt(||x||^2 - <x, v>^2) would lose half of the digits.
    """
    return x - along(x, v)[:, None] * v


def scale_functional(graph: ViewGraph) -> FloatArray:
    """Return c = D^T (w v), so that L(T) = <c, T>, shape (n, d)."""
    return adjoint(graph.weights[:, None] * graph.directions, graph.edges, graph.num_nodes)


def projected_length(graph: ViewGraph, t: FloatArray) -> float:
    """Return L(T), the weighted sum of the baselines' lengths along their directions."""
    return _sums_of(graph, t)[1]


def objective(graph: ViewGraph, t: FloatArray) -> float:
    """Return R(T) / L(T), the paper's objective; infinite where L(T) <= 0."""
    residual, length = _sums_of(graph, t)
    return residual / length if length > 0.0 else float("inf")


def normalize_locations(graph: ViewGraph, t: FloatArray) -> FloatArray:
    """Return `t` centered and scaled so that L(T) = kappa = sum of the weights.

    UnsolvableError if they are not finite or point against the directions.
    """
    centered: FloatArray = t - t.mean(axis=0)
    length = projected_length(graph, centered)
    if not (np.isfinite(centered).all() and length > 0.0):
        raise UnsolvableError("the solver found no finite locations; check the directions of the graph")
    return centered * (float(graph.weights.sum()) / length)


@kernel
def _measure_baselines(begin: int, end: int, t: Any, edges: Any, baselines: Any, lengths: Any) -> None:
    for e in range(begin, end):
        square = 0.0
        for k in range(t.shape[1]):
            baselines[e, k] = t[edges[e, 0], k] - t[edges[e, 1], k]
            square += baselines[e, k] ** 2
        lengths[e] = np.sqrt(square)


@kernel
def _add_adjoint(y: Any, edges: Any, out: Any) -> None:
    for e in range(len(edges)):
        for k in range(y.shape[1]):
            out[edges[e, 0], k] += y[e, k]
            out[edges[e, 1], k] -= y[e, k]


def _sums_of(graph: ViewGraph, t: FloatArray) -> tuple[float, float]:
    # In one layout: kernels are compiled by layouts.
    return _sums(np.ascontiguousarray(t), graph.edges, graph.directions, graph.weights)


@kernel
def _sums(t: Any, edges: Any, v: Any, w: Any) -> tuple[float, float]:
    """Return R(T) and L(T)."""
    residual, length = 0.0, 0.0
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        projected = 0.0
        for k in range(t.shape[1]):
            projected += (t[i, k] - t[j, k]) * v[e, k]
        square = 0.0
        for k in range(t.shape[1]):
            square += (t[i, k] - t[j, k] - projected * v[e, k]) ** 2
        residual += w[e] * np.sqrt(square)
        length += w[e] * projected
    return residual, length
