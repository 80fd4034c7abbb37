"""A start near the optimum: reweighted least squares, each solved by a few conjugate gradients.

One least-squares problem after the other is solved roughly, with weights s_e = w_e / rho_e from the
residuals of the one before,

    min  sum_e s_e ||r_e||^2    subject to    <c, T> = kappa,        rho_e = sqrt(||r_e||^2 + (eps R)^2)

where R is the mean residual and eps shrinks. The constraint is kept by projecting the gradient along the
preconditioner, the weighted degrees of the cameras. On a graph without bottlenecks twenty passes over the
edges lead nearer to the optimum than the factorization of M for the least-squares locations and a Newton
cycle from there. On the graphs of most real scenes the gradients do not converge, or nearly exact data make
the least-squares locations the better start; both show in what the first steps leave of the energy.

Source: Daubechies, DeVore, Fornasier, Gunturk, "Iteratively reweighted least squares minimization for sparse
recovery", Comm. Pure Appl. Math. 63 (2010), also for the shrinking eps.
"""

from typing import Any

import numpy as np

from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.solver.newton.steps import (
    LEAST_MU,
    MU_PER_GAP,
    NewtonProgress,
    combine,
    dot,
    largest,
    measure_gap,
    scale_to,
    set_residuals,
)

_FIRST_STEPS, _STEPS = 4, 2  # conjugate gradient steps: for plain least squares, and each reweighted problem
# Rounds of reweighting: with half of them Newton needs a factorization more, and twice as many gain nothing.
_ROUNDS = 7
_EPS, _SHRINK = 0.5, 0.7  # smoothing of the first weights, per mean residual; its factor per round
# The first steps may leave this share of the energy; dense random graphs leave 1e-3, real ones 5e-2.
_LEFT = 3e-3
_ROUNDING = 1e-14  # energy per that of T; below, t fits, and steps would follow what rounding leaves


@kernel
def approach(problem: Any, iterate: Any, step: Any) -> bool:
    """Start near the optimum, with the bound 0; return whether it is: if not, the iterate is of no use."""
    t, gradient, degrees = iterate.t, step.addend, np.empty(len(iterate.t))
    downhill = np.empty_like(iterate.t)
    scale_to(problem, problem.c, t)
    weigh(problem, t, np.inf, step.ratios, gradient, degrees)
    left = descend(problem, step, t, gradient, degrees, downhill, _FIRST_STEPS)
    energy = dot(t, gradient)
    if left > _LEFT * energy or energy <= _ROUNDING * largest(degrees) * dot(t, t):
        return False
    mean = weigh(problem, t, np.inf, step.ratios, gradient, degrees)
    eps = _EPS
    for _ in range(_ROUNDS):
        mean = weigh(problem, t, eps * mean, step.ratios, gradient, degrees)
        descend(problem, step, t, gradient, degrees, downhill, _STEPS)
        eps *= _SHRINK
    set_residuals(problem, t, iterate.r)
    iterate.feasible[:] = 0.0
    floor = max(MU_PER_GAP * NewtonProgress(*measure_gap(problem, iterate)).gap, LEAST_MU)
    for e in range(len(problem.w)):
        rr = floor * floor
        for k in range(len(problem.transverse)):
            rr += iterate.r[e, k] * iterate.r[e, k]
        scale = problem.w[e] / np.sqrt(rr)
        for k in range(len(problem.transverse)):
            iterate.y[e, k] = scale * iterate.r[e, k]
    return True


@inner_kernel
def weigh(problem: Any, t: Any, floor: float, weights: Any, gradient: Any, degrees: Any) -> float:
    """Write s_e (w_e at an infinite floor), their sums at cameras, D^T S r; return the mean residual."""
    edges, v = problem.edges, problem.v
    gradient[:] = 0.0
    degrees[:] = 0.0
    total = 0.0
    plain, least = np.isinf(floor), max(floor, LEAST_MU) ** 2
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        along = square = 0.0
        for k in range(len(problem.axes)):
            x = t[i, k] - t[j, k]
            along += v[e, k] * x
            square += x * x
        rr = max(square - along * along, 0.0)
        s = problem.w[e] if plain else problem.w[e] / np.sqrt(rr + least)
        total += np.sqrt(rr)
        weights[e] = s
        degrees[i] += s
        degrees[j] += s
        for k in range(len(problem.axes)):
            x = s * ((t[i, k] - t[j, k]) - along * v[e, k])
            gradient[i, k] += x
            gradient[j, k] -= x
    return total / len(edges)


@inner_kernel
def descend(problem: Any, step: Any, t: Any, gradient: Any, degrees: Any, downhill: Any, steps: int) -> float:
    """Move t by conjugate gradients of the weighted least squares, <c, T> unchanged.

    Returns about what is left of its energy <T, gradient>, where the preconditioned matrix is about the
    identity.
    """
    direction, product = step.t, step.nodes
    direction[:] = 0.0
    size, keep = set_downhill(problem, degrees, gradient, downhill), 0.0
    for _ in range(steps):
        combine(1.0, downhill, keep, direction, direction)
        multiply(problem, step.ratios, direction, product)
        curvature = dot(direction, product)
        if not curvature > 0.0:
            break
        alpha, previous = size / curvature, size
        combine(1.0, t, alpha, direction, t)
        combine(1.0, gradient, alpha, product, gradient)
        size = set_downhill(problem, degrees, gradient, downhill)
        keep = size / previous
    return size


@inner_kernel
def set_downhill(problem: Any, degrees: Any, gradient: Any, downhill: Any) -> float:
    """Write the preconditioned direction of descent that keeps <c, T>; return its slope, positive."""
    along = length = slope = 0.0
    c = problem.c
    for i in range(len(c)):
        inverse = 1.0 / degrees[i]
        for k in range(len(problem.axes)):
            along += inverse * c[i, k] * gradient[i, k]
            length += inverse * c[i, k] * c[i, k]
    for i in range(len(c)):
        inverse = 1.0 / degrees[i]
        for k in range(len(problem.axes)):
            downhill[i, k] = inverse * (along / length * c[i, k] - gradient[i, k])
            slope -= gradient[i, k] * downhill[i, k]
    return slope


@inner_kernel
def multiply(problem: Any, weights: Any, x: Any, product: Any) -> None:
    """Write D^T S P D x at the nodes."""
    edges, v = problem.edges, problem.v
    product[:] = 0.0
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        along = 0.0
        for k in range(len(problem.axes)):
            along += v[e, k] * (x[i, k] - x[j, k])
        for k in range(len(problem.axes)):
            pull = weights[e] * ((x[i, k] - x[j, k]) - along * v[e, k])
            product[i, k] += pull
            product[j, k] -= pull
