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

_DIGITS = 10**40


def proven_bound(edges, directions, weights, locations, dual, claimed):
    """Return a rational lower bound of the program that the dual proves, starting from the claimed one."""
    n, d = len(locations), len(locations[0])
    v, w = exact(directions), [Fraction(float(x)) for x in weights]
    t = exact(locations)
    c = _scale_functional(edges, v, w, n, d)
    y = [_across(v[e], row) for e, row in enumerate(exact(dual))]
    claimed = Fraction(float(claimed))
    right = [value - claimed * c[k] for k, value in enumerate(_transposed(edges, y, n, d))]
    h, change = _restored(edges, v, c, t, right)
    repaired = [
        [a - b for a, b in zip(y[e], _across(v[e], _difference(h, i, j, d)), strict=True)]
        for e, (i, j) in enumerate(edges)
    ]
    bound = claimed + change
    assert _transposed(edges, repaired, n, d) == [bound * x for x in c]  # exactly
    excess = max(root_above(_dot(row, row)) / w[e] for e, row in enumerate(repaired))
    return bound / max(Fraction(1), excess)


def objective_bracket(edges, directions, weights, locations):
    """Return rational numbers below and above R(T) / L(T)."""
    v, w, t = exact(directions), [Fraction(float(x)) for x in weights], exact(locations)
    below = above = length = Fraction(0)
    for e, (i, j) in enumerate(edges):
        baseline = [a - b for a, b in zip(t[i], t[j], strict=True)]
        across = _across(v[e], baseline)
        above += w[e] * root_above(_dot(across, across))
        below += w[e] * (root_above(_dot(across, across)) - Fraction(1, _DIGITS))
        length += w[e] * _dot(baseline, v[e])
    assert length > 0
    return below / length, above / length


def exact(rows):
    """Return rows of doubles as rational numbers."""
    return [[Fraction(float(x)) for x in row] for row in rows]


def root_above(square):
    """Return a rational number at least the root, and at most 1e-40 above it."""
    scaled = square * _DIGITS * _DIGITS
    return Fraction(isqrt(scaled.numerator // scaled.denominator) + 1, _DIGITS)


def _dot(a, b):
    return sum((x * y for x, y in zip(a, b, strict=True)), Fraction(0))


def _across(v, x):
    share = _dot(v, x) / _dot(v, v)
    return [a - share * b for a, b in zip(x, v, strict=True)]


def _difference(flat, i, j, d):
    return [flat[i * d + k] - flat[j * d + k] for k in range(d)]


def _transposed(edges, y, n, d):
    total = [Fraction(0)] * (n * d)
    for row, (i, j) in zip(y, edges, strict=True):
        for k in range(d):
            total[i * d + k] += row[k]
            total[j * d + k] -= row[k]
    return total


def _scale_functional(edges, v, w, n, d):
    return _transposed(edges, [[w[e] * x for x in row] for e, row in enumerate(v)], n, d)


def _restored(edges, v, c, t, right):
    """Return h (n d,) and the change of lambda; node 0 stands still."""
    d = len(v[0])
    size = len(c) - d + 1
    matrix = [[Fraction(0)] * (size + 1) for _ in range(size)]
    for e, (i, j) in enumerate(edges):
        norm = _dot(v[e], v[e])
        for a in range(d):
            for b in range(d):
                p = Fraction(a == b) - v[e][a] * v[e][b] / norm
                for x, y, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
                    if x and y:
                        matrix[(x - 1) * d + a][(y - 1) * d + b] += sign * p
    flat = [x - y for row in t for x, y in zip(row, t[0], strict=True)]
    for k in range(size - 1):
        matrix[k][size - 1] = c[d + k]
        matrix[size - 1][k] = flat[d + k]
        matrix[k][size] = right[d + k]
    solved = _solve(matrix)
    return [Fraction(0)] * d + solved[:-1], solved[-1]


def _solve(matrix):
    """Gauss and Jordan on an augmented matrix."""
    size = len(matrix)
    for k in range(size):
        pivot = next(row for row in range(k, size) if matrix[row][k] != 0)
        matrix[k], matrix[pivot] = matrix[pivot], matrix[k]
        lead = matrix[k][k]
        matrix[k] = [x / lead for x in matrix[k]]
        for row in range(size):
            if row != k and matrix[row][k] != 0:
                factor = matrix[row][k]
                matrix[row] = [x - factor * y for x, y in zip(matrix[row], matrix[k], strict=True)]
    return [row[-1] for row in matrix]
