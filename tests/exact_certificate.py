"""A checker of certificates in exact rational arithmetic: no code and no rounding of the package's.

Every double is a rational number, so that graph, locations and dual are taken as they are, and
P_e = I - v_e v_e^T / <v_e, v_e> is exact for directions that are unit vectors only up to rounding. A dual y
with ||y_e|| <= w_e and D^T P y = lambda c exactly proves that no T with <c, T> = 1 has R(T) < lambda:

    R(T) = sum_e w_e ||P_e d_e|| >= sum_e <P_e y_e, d_e> = <D^T P y, T> = lambda.

A dual of doubles has the equality up to rounding only. It is restored exactly by the rational solution of

    [D^T P D   c] [h     ]   [D^T P y - lambda c]        y' = P y - P D h,
    [t^T       0] [lambda']= [0                  ]       lambda + lambda',

with node 0 held, and divided by a rational number at least as large as every ||y'_e|| / w_e.
"""

from fractions import Fraction
from math import isqrt

import numpy as np

_DIGITS = 10**40


exact = np.vectorize(lambda x: Fraction(float(x)), otypes=[object])
"""Doubles as rational numbers."""


def proven_bound(edges, directions, weights, locations, dual, claimed):
    """Return a rational lower bound of the program that the dual proves, starting from the claimed one."""
    v, w, t, claimed = exact(directions), exact(weights), exact(locations), Fraction(float(claimed))
    incidence = np.array([[(k == i) - (k == j) for k in range(len(t))] for i, j in edges], dtype=object)
    c = incidence.T @ (w[:, None] * v)
    y = _across(v, exact(dual))
    h, change = _restored(incidence, v, c, t, incidence.T @ y - claimed * c)
    repaired = y - _across(v, incidence @ h)
    bound = claimed + change
    assert (incidence.T @ repaired == bound * c).all()  # exactly
    excess = max(root_above(square) / weight for square, weight in zip(_squares(repaired), w, strict=True))
    return bound / max(Fraction(1), excess)


def objective_bracket(edges, directions, weights, locations):
    """Return rational numbers below and above R(T) / L(T)."""
    v, w, t = exact(directions), exact(weights), exact(locations)
    i, j = np.transpose(edges)
    baselines = t[i] - t[j]
    norms = np.array([root_above(square) for square in _squares(_across(v, baselines))])
    length = w @ np.sum(baselines * v, axis=1)
    assert length > 0
    return w @ (norms - Fraction(1, _DIGITS)) / length, w @ norms / length


def root_above(square):
    """Return a rational number at least the root, and at most 1e-40 above it."""
    scaled = square * _DIGITS * _DIGITS
    return Fraction(isqrt(scaled.numerator // scaled.denominator) + 1, _DIGITS)


def _squares(rows):
    return np.sum(rows * rows, axis=1)


def _across(v, x):
    return x - (np.sum(v * x, axis=1) / _squares(v))[:, None] * v


def _restored(incidence, v, c, t, right):
    """Return h (n, d) and the change of lambda, by Gauss and Jordan; node 0 stands still."""
    n, d = t.shape
    projectors = np.eye(d, dtype=int) - v[:, :, None] * v[:, None, :] / _squares(v)[:, None, None]
    hessian = np.einsum("ei,ej,eab->iajb", incidence, incidence, projectors).reshape(n * d, n * d)[d:, d:]
    size = n * d - d + 1
    matrix = np.full((size, size + 1), Fraction(0), dtype=object)
    matrix[:-1, :-2], matrix[:-1, -2], matrix[-1, :-2] = hessian, c.ravel()[d:], (t - t[0]).ravel()[d:]
    matrix[:-1, -1] = right.ravel()[d:]
    for k in range(size):
        pivot = k + np.flatnonzero(matrix[k:, k])[0]
        matrix[[k, pivot]] = matrix[[pivot, k]]
        matrix[k] = matrix[k] / matrix[k, k]
        others = np.flatnonzero(matrix[:, k] * (np.arange(size) != k))
        matrix[others] -= matrix[others, k][:, None] * matrix[k]
    return np.concatenate([[Fraction(0)] * d, matrix[:-1, -1]]).reshape(n, d), matrix[-1, -1]
