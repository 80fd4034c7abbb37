"""placeholder"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.jit import array_address, call_address, function_address, kernel
from sfm_shapefit.solver.program import scale_functional
from sfm_shapefit.viewgraph import ViewGraph


class Problem(NamedTuple):
    edges: IntArray
    v: FloatArray
    w: FloatArray
    c: FloatArray
    kappa: float
    axes: tuple[int, ...]
    routines: IntArray


class State(NamedTuple):
    t: FloatArray
    y: FloatArray
    r: FloatArray
    dt: FloatArray
    dy: FloatArray
    dr: FloatArray
    rhs: FloatArray  # (2, n, d)
    total: FloatArray  # (n, d)
    matrix: FloatArray  # (N * N,)
    diagonal: FloatArray
    flags: Any
    integers: Any


@kernel()
def _transverse(problem, x, out):
    edges, v = problem.edges, problem.v
    d = len(problem.axes)
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        s = 0.0
        for k in range(d):
            s += (x[i, k] - x[j, k]) * v[e, k]
        for k in range(d):
            out[e, k] = (x[i, k] - x[j, k]) - s * v[e, k]


@kernel(exact=True)
def _adjoint(problem, y, out):
    edges = problem.edges
    d = len(problem.axes)
    out[:] = 0.0
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        for k in range(d):
            out[i, k] += y[e, k]
            out[j, k] -= y[e, k]


@kernel()
def _assemble(problem, state, mu, start):
    edges, v, w = problem.edges, problem.v, problem.w
    r, y = state.r, state.y
    a, diag = state.matrix, state.diagonal
    d = len(problem.axes)
    n = len(problem.c)
    N = n * d
    diag[:] = 0.0
    # trace
    lift = 0.0
    c = problem.c.reshape(N)
    cc = 0.0
    for p in range(N):
        cc += c[p] * c[p]
    trace = 0.0
    for e in range(len(edges)):
        if start:
            trace += 2 * (d - 1) * w[e]
        else:
            q = 0.0
            for k in range(d):
                q += r[e, k] * r[e, k]
            trace += 2 * (d - 1) * w[e] / np.sqrt(q + mu * mu)
    delta = trace / N / cc
    shift = trace / N / n
    for q in range(N):
        col = a[q * N : (q + 1) * N]
        f = delta * c[q]
        for p in range(q, N):
            col[p] = f * c[p]
        for p in range(q, N, d):
            col[p] += shift
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        q = 0.0
        for k in range(d):
            q += r[e, k] * r[e, k]
        rho = np.sqrt(q + mu * mu)
        if start:
            rho = 1.0
        wr = w[e] / rho
        h = 0.0 if start else 0.5 / (rho * rho)
        low, high = max(i, j), min(i, j)
        base = high * d * N + low * d
        for k in range(d):
            for l in range(d):
                s = -wr * v[e, k] * v[e, l] - h * (y[e, k] * r[e, l] + r[e, k] * y[e, l])
                if k == l:
                    s += wr
                a[base + k * N + l] -= s
                diag[i, k, l] += s
                diag[j, k, l] += s
    for i in range(n):
        for k in range(d):
            for l in range(k, d):
                a[(i * d + k) * N + i * d + l] += diag[i, k, l]


@kernel()
def _factor(problem, state, order):
    ints = state.integers
    ints[0] = order
    ints[1] = 0
    text, pi = array_address(state.flags), array_address(ints)
    call_address(problem.routines[0], (text, pi, array_address(state.matrix), pi, pi + 4))
    return ints[1]


@kernel()
def _solve(problem, state, b, order, count):
    ints = state.integers
    ints[0] = order
    ints[1] = 0
    ints[2] = count
    text, pi = array_address(state.flags), array_address(ints)
    call_address(
        problem.routines[1],
        (text, pi, pi + 8, array_address(state.matrix), pi, array_address(b), pi, pi + 4),
    )
    return ints[1]


@kernel()
def _dot(x, y):
    s = 0.0
    a, b = x.reshape(x.size), y.reshape(y.size)
    for k in range(a.size):
        s += a[k] * b[k]
    return s


@kernel()
def _start(problem, state):
    n, d = problem.c.shape
    _assemble(problem, state, 1.0, True)
    if _factor(problem, state, n * d) != 0:
        return -1.0
    state.t[:] = problem.c
    _solve(problem, state, state.t, n * d, 1)
    scale = problem.kappa / _dot(problem.c, state.t)
    state.t[:] *= scale
    _transverse(problem, state.t, state.r)
    worst = 0.0
    for e in range(len(problem.w)):
        q = 0.0
        for k in range(d):
            q += state.r[e, k] ** 2
        worst = max(worst, q)
    worst = np.sqrt(worst)
    for e in range(len(problem.w)):
        for k in range(d):
            state.y[e, k] = problem.w[e] * state.r[e, k] / worst
    return 1.0


@kernel()
def _sums(problem, state, mu):
    """objective, <y, r>, smoothed"""
    f = g = phi = 0.0
    for e in range(len(problem.w)):
        q = p = 0.0
        for k in range(len(problem.axes)):
            q += state.r[e, k] ** 2
            p += state.r[e, k] * state.y[e, k]
        f += problem.w[e] * np.sqrt(q)
        g += p
        phi += problem.w[e] * np.sqrt(q + mu * mu)
    return f, g, phi


@kernel()
def _smooth(problem, state, mu, alpha):
    phi = 0.0
    for e in range(len(problem.w)):
        q = 0.0
        for k in range(len(problem.axes)):
            q += (state.r[e, k] + alpha * state.dr[e, k]) ** 2
        phi += problem.w[e] * np.sqrt(q + mu * mu)
    return phi


@kernel()
def _gradients(problem, state, mu):
    """dy <- w r / rho"""
    for e in range(len(problem.w)):
        q = 0.0
        for k in range(len(problem.axes)):
            q += state.r[e, k] ** 2
        s = problem.w[e] / np.sqrt(q + mu * mu)
        for k in range(len(problem.axes)):
            state.dy[e, k] = s * state.r[e, k]


@kernel()
def _next_dual(problem, state, mu):
    """dy <- y+ = g + S dr"""
    y, r, dr = state.y, state.r, state.dr
    for e in range(len(problem.w)):
        q = a = b = 0.0
        for k in range(len(problem.axes)):
            q += r[e, k] ** 2
            a += r[e, k] * dr[e, k]
            b += y[e, k] * dr[e, k]
        rho = np.sqrt(q + mu * mu)
        s = problem.w[e] / rho
        h = 0.5 / (rho * rho)
        for k in range(len(problem.axes)):
            state.dy[e, k] = s * (r[e, k] + dr[e, k]) - h * (a * y[e, k] + b * r[e, k])


@kernel()
def _ratio(problem, state):
    """Largest alpha with ||y + alpha (y+ - y)|| <= w."""
    best = 1e300
    for e in range(len(problem.w)):
        a = b = 0.0
        yy = 0.0
        for k in range(len(problem.axes)):
            dy = state.dy[e, k] - state.y[e, k]
            a += dy * dy
            b += dy * state.y[e, k]
            yy += state.y[e, k] ** 2
        room = problem.w[e] ** 2 - yy
        # a s^2 + 2 b s - room = 0
        root = np.sqrt(b * b + a * max(room, 0.0))
        s = room / (b + root) if b > 0 else (root - b) / max(a, 1e-300)
        best = min(best, s)
    return best


@kernel()
def _newton(problem, state, lam, mu, tol, rule, steps, trace):
    n, d = problem.c.shape
    N = n * d
    its = 0
    pstep, dstep = 1.0, 1.0
    f, g, phi = _sums(problem, state, mu)
    gap = (f - g) / problem.kappa
    old = gap
    while its < steps and gap > tol:
        if rule[0] == 0:
            mu = min(mu, rule[1] * gap)
        else:
            q = rule[1] if min(pstep, dstep) < 0.9 else rule[2]
            mu = min(mu, q * gap)
        phi = _smooth(problem, state, mu, 0.0)
        _assemble(problem, state, mu, False)
        if _factor(problem, state, N) != 0:
            return its, lam, mu, -gap
        _gradients(problem, state, mu)
        _adjoint(problem, state.dy, state.rhs[1])
        state.rhs[0][:] = problem.c
        _solve(problem, state, state.rhs, N, 2)
        ca = _dot(problem.c, state.rhs[0])
        up = _dot(problem.c, state.rhs[1]) / ca
        state.dt[:] = up * state.rhs[0] - state.rhs[1]
        for rep in range(4):
            _transverse(problem, state.dt, state.dr)
            _next_dual(problem, state, mu)
            _adjoint(problem, state.dy, state.total)
            worst = 0.0
            for i in range(n):
                for k in range(d):
                    state.total[i, k] = up * problem.c[i, k] - state.total[i, k]
                    worst = max(worst, abs(state.total[i, k]))
            trace[its, 5] = worst
            trace[its, 6] = rep
            if worst < max(1e-13, 1e-3 * gap) * problem.kappa / n or rep == 3:
                break
            _solve(problem, state, state.total, N, 1)
            s = _dot(problem.c, state.total) / ca
            up -= s
            state.dt[:] += state.total - s * state.rhs[0]
        slope = -_dot(state.dt, problem.c)  # ~0
        pstep = 1.0
        new = _smooth(problem, state, mu, pstep)
        cuts = 0
        while new > phi and cuts < 30:
            pstep *= 0.5
            cuts += 1
            new = _smooth(problem, state, mu, pstep)
        dstep = min(1.0, 0.99 * _ratio(problem, state))
        state.t[:] += pstep * state.dt
        state.y[:] += dstep * (state.dy - state.y)
        _transverse(problem, state.t, state.r)
        f, g, phi = _sums(problem, state, mu)
        gap = (f - g) / problem.kappa
        trace[its, 0] = f / problem.kappa
        trace[its, 1] = gap
        trace[its, 2] = mu
        trace[its, 3] = pstep
        trace[its, 4] = dstep
        its += 1
    return its, g / problem.kappa, mu, gap


def prepare(graph):
    n, m, d = graph.num_cameras, graph.num_edges, graph.dimension
    lapack = "scipy.linalg.cython_lapack"
    routines = np.array([function_address(lapack, "dpotrf"), function_address(lapack, "dpotrs")])
    problem = Problem(
        graph.edges, graph.directions, graph.weights, scale_functional(graph), float(graph.weights.sum()),
        tuple(range(d)), routines,
    )
    state = State(
        t=np.zeros((n, d)), y=np.zeros((m, d)), r=np.zeros((m, d)), dt=np.zeros((n, d)), dy=np.zeros((m, d)),
        dr=np.zeros((m, d)), rhs=np.zeros((2, n, d)), total=np.zeros((n, d)), matrix=np.zeros((n * d) ** 2),
        diagonal=np.zeros((n, d, d)), flags=np.frombuffer(b"LRTN", dtype=np.uint8), integers=np.zeros(8, np.int32),
    )
    return problem, state


def run(graph, tol=1e-8, rule=(0, 0.15, 0.15), mu0=1.0, steps=60):
    problem, state = prepare(graph)
    trace = np.zeros((steps, 8))
    _start(problem, state)
    its, lam, mu, gap = _newton(problem, state, 0.0, mu0, tol, np.array(rule, float), steps, trace)
    return state.t, state.y, its, gap, trace[:its]
