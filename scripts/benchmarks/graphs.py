"""Families of graphs whose truth is known: ShapeFit, LUD and what is placed, against the best that can be.

The oracle knows which directions are right: unweighted (streets: weighted) least squares in angles on those
alone, started at the truth and run to convergence. It is pinned at two cameras and never pulled to the truth:
a little damping would hide most of the drift of a long chain, which is in the data.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

import sfm_shapefit
from harness.driver import DATA, ROOT, Benchmark, Case, if_there
from harness.graphs import GraphSpec, draw, relative_error
from harness.process import time_call
from harness.record import Check, Row, median
from sfm_shapefit import ViewGraph
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.geometry import fit_similarity
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.synthetic import GraphProblem, measured_problem, street_problem

MADRID = "1dsfm-Madrid_Metropolis"
EXACT = 1e-9
"""Error that counts as exact, where right directions have no noise."""
MEAN_OVER_MEDIAN = 3.0
# Trust from which `locate` keeps cameras by default.
_MIN_TRUST = 0.6
_ORACLE_STEPS = 8
# Nodes up to which the oracle's factorization does not take too long.
_ORACLE_NODES = 20_000


@dataclass(frozen=True, slots=True)
class Problem:
    """What is drawn, once per seed, and what it has to reach."""

    spec: GraphSpec
    """The family "street" has cameras and points; "madrid" is the pairs of 1DSfM's Madrid_Metropolis."""
    jitter: float = 0.0
    """Of a street, in meters."""
    over_oracle: float | None = None
    error: float | None = None
    below_lud: bool = False
    seconds: float | None = None


USUAL = (("er2", 100, 0.0), ("geo", 500, 40.0), ("comm", 500, 67.0))
CHAINS = (
    *(("seq", 300, 36.0), ("seqv", 300, 36.0), ("ring", 500, 20.0), ("corr", 500, 20.0)),
    *(("lawn", 1000, 20.0), ("seq", 1000, 36.0), ("seqv", 1000, 36.0), ("seqv", 10_000, 36.0)),
)
PROBLEMS: dict[str, Problem] = {
    **{
        f"{family}-{n} {sigma:g}": Problem(GraphSpec(family, n, degree, sigma), over_oracle=1.08)
        for (family, n, degree), sigma in product(USUAL, (0.01, 0.05))
    },
    "er2-100 0.05, q 0.4": Problem(GraphSpec("er2", 100, sigma=0.05, q=0.4), over_oracle=1.15),
    "seq-300 exact, q 0.1": Problem(GraphSpec("seq", 300, degree=36.0, q=0.1), error=EXACT),
    **{
        f"{family}-{n}": Problem(GraphSpec(family, n, degree, 0.01), over_oracle=1.3, below_lud=True)
        for family, n, degree in CHAINS
    },
    **{
        f"street-500 {words}": Problem(GraphSpec("street", 500, sigma=0.01, q=0.15), jitter, error=3e-3)
        for words, jitter in (("straight", 0.0), ("jitter 1%", 0.01), ("jitter 5%", 0.05))
    },
    "street-5000 straight": Problem(GraphSpec("street", 5000, sigma=0.01, q=0.15), error=9e-3, seconds=30.0),
    "Madrid, q 0.3 on few": Problem(GraphSpec("madrid", 394, sigma=0.01, q=0.3)),
}
QUICK = {
    "seqv-60": Problem(GraphSpec("seqv", 60, degree=16.0, sigma=0.01), over_oracle=1.3),
    "street-30": Problem(GraphSpec("street", 30), error=0.1),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drawn:
    """A graph with its truth."""

    graph: ViewGraph
    truth: FloatArray
    """(n, 3) of all nodes."""
    right: FloatArray
    """(m,) 1 / variance of right directions, 0 for wrong ones."""
    num_cameras: int
    covariance: FloatArray | None = None


class Trial(NamedTuple):
    """One graph, solved."""

    shapefit: float
    lud: float
    placed: float
    oracle: float
    """NaN where the graph is too large for it, and for Madrid, where the right pairs leave cameras loose."""
    over_oracle: float
    mean_over_median: float
    kept: int
    seconds: float


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the problems; large ones are drawn once."""
    found: dict[str, Case] = {}
    for name, problem in (QUICK if args.quick else PROBLEMS).items():
        seeds = 1 if problem.spec.n >= 5000 else args.repeats
        needed = args.data / MADRID if problem.spec.family == "madrid" else ROOT
        found[name] = if_there(needed, partial(measure_seeds, name, problem, seeds, args.data))
    return found


def draw_graph(problem: Problem, seed: int, data: Path = DATA) -> Drawn:
    """Return the problem's graph for a seed."""
    spec = problem.spec
    if spec.family == "street":
        street = street_problem(spec.n, jitter=problem.jitter, seed=seed)
        return Drawn(
            graph=ViewGraph(len(street.locations), street.edges, street.directions),
            truth=street.locations,
            right=np.where(street.corrupted, 0.0, 1.0 / street.covariance[:, 0, 0]),
            num_cameras=spec.n,
            covariance=street.covariance,
        )
    bare = _madrid(spec, seed, data) if spec.family == "madrid" else draw(spec, seed=seed)
    right, n = np.where(bare.corrupted, 0.0, 1.0), len(bare.locations)
    return Drawn(graph=bare.view_graph, truth=bare.locations, right=right, num_cameras=n)


def _madrid(spec: GraphSpec, seed: int, data: Path) -> GraphProblem:
    """Return drawn positions, in a flat square, on the pairs of a real collection."""
    with np.load(data / MADRID / "viewgraph.npz") as file:
        edges, n = file["edges"].astype(np.int64), len(file["names"])
    rng = np.random.default_rng(seed)
    locations = rng.standard_normal((n, 3)) * [1.0, 1.0, 0.2]
    pairs = np.unique(np.sort(edges, axis=1), axis=0)
    return measured_problem(locations, pairs, sigma=spec.sigma, q=spec.q, seed=rng, corruption="concentrated")


def measure_seeds(name: str, problem: Problem, seeds: int, data: Path) -> Row:
    """Measure a problem, after a small one that loads the compiled code."""
    measure(replace(problem, spec=replace(problem.spec, n=min(problem.spec.n, 100))), 0, data)
    return judge(name, problem, [measure(problem, seed, data) for seed in range(seeds)])


def measure(problem: Problem, seed: int, data: Path = DATA) -> Trial:
    """Place one graph of a problem and compare with its truth."""
    one = draw_graph(problem, seed, data)
    num_points = one.graph.num_nodes - one.num_cameras
    measured = MeasuredGraph(one.graph, covariance=one.covariance, num_points=num_points)
    run = time_call(lambda: sfm_shapefit.place(measured))
    placement = run.found
    rows, count = placement.cameras, len(placement.cameras)
    truth, lud = one.truth[rows], placement.refined.finish.lud
    kept = placement.assessment.trust[:count] >= _MIN_TRUST
    aligned = fit_similarity(placement.locations[kept], truth[kept], rotate=False)
    distances = np.linalg.norm(aligned.apply(placement.locations[kept]) - truth[kept], axis=1)
    best = np.nan
    if one.graph.num_nodes <= _ORACLE_NODES and problem.spec.family != "madrid":
        best = relative_error(oracle(one)[rows], truth)
    placed = relative_error(placement.locations, truth)
    return Trial(
        shapefit=relative_error(placement.certified.locations[:count], truth),
        lud=np.nan if lud is None else relative_error(lud.locations[:count], truth),
        placed=placed,
        oracle=best,
        over_oracle=placed / max(best, EXACT) if np.isfinite(best) else np.nan,
        mean_over_median=float(distances.mean() / max(np.median(distances), EXACT * np.ptp(truth))),
        kept=int(kept.sum()),
        seconds=run.wall_s,
    )


def oracle(one: Drawn) -> FloatArray:
    """Return weighted least squares of |u_e - v_e| on the right directions alone, (n, 3), from the truth.

    What fewer than two right directions hold stays where it is.
    """
    right = _holding(one.right > 0.0, one.graph.edges)
    edges, v, root = one.graph.edges[right], one.graph.directions[right], np.sqrt(one.right[right])
    (m, d), t = v.shape, one.truth.copy()
    row = np.repeat(np.arange(m * d), d)
    column = edges[:, :, None] * d + np.arange(d)
    columns = np.concatenate([np.repeat(column[:, k, None, :], d, axis=1).ravel() for k in (0, 1)])
    free = np.ones(t.size, dtype=bool)
    # Held are the origin and, of the farthest camera, the coordinate that sets the scale.
    free[:d] = False
    far = int(np.argmax(np.abs(t - t[0]).max(axis=1)))
    free[far * d + int(np.argmax(np.abs(t[far] - t[0])))] = False
    for _ in range(_ORACLE_STEPS):
        baselines = t[edges[:, 0]] - t[edges[:, 1]]
        lengths = np.linalg.norm(baselines, axis=1)[:, None]
        u = baselines / lengths
        slope = (root[:, None] / lengths)[:, :, None] * (np.eye(d) - u[:, :, None] * u[:, None, :])
        values = np.concatenate([slope.ravel(), -slope.ravel()])
        jacobian = csc_array((values, (np.tile(row, 2), columns)), shape=(m * d, t.size))[:, free]
        normal = (jacobian.T @ jacobian).tocsc()
        held = np.where(normal.diagonal() > 0.0, 0.0, 1.0)
        normal += csc_array((held, (np.arange(len(held)),) * 2), shape=normal.shape)
        step = splu(normal, permc_spec="MMD_AT_PLUS_A").solve(jacobian.T @ (root[:, None] * (u - v)).ravel())
        t.ravel()[free] -= step
    return t


def _holding(right: BoolArray, edges: IntArray) -> BoolArray:
    """Return the right directions without those to nodes that have no second one, again and again."""
    while True:
        degree = np.bincount(edges[right].ravel(), minlength=int(edges.max()) + 1)
        left = right & (degree[edges] >= 2).all(axis=1)
        if (left == right).all():
            return right
        right = left


def judge(name: str, problem: Problem, trials: Sequence[Trial]) -> Row:
    """Return the row of a problem: limits of medians, and of the worst mean over median."""
    middle, worst = (
        Trial(*map(median, zip(*trials, strict=True))),
        max(one.mean_over_median for one in trials),
    )
    limits = (
        ("/ oracle", middle.over_oracle, problem.over_oracle),
        ("error", middle.placed, problem.error),
        ("placed against LUD", middle.placed, middle.lud if problem.below_lud else None),
        ("seconds", middle.seconds, problem.seconds),
        ("mean / median", worst, MEAN_OVER_MEDIAN),
    )
    cells = {
        "problem": name,
        "ShapeFit": middle.shapefit,
        "LUD": middle.lud,
        "placed": middle.placed,
        "oracle": middle.oracle,
        "/ oracle": middle.over_oracle,
        "mean / median": worst,
        "kept": min(trial.kept for trial in trials),
        "seconds": middle.seconds,
    }
    return Row(cells, [Check(name, value, limit) for name, value, limit in limits if limit is not None])


BENCHMARK = Benchmark(
    name="graphs",
    title="Families of graphs",
    cases=cases,
    packages=("numpy", "scipy", "numba"),
    quick={"repeats": 1},
    repeats=5,
    notes={
        "": "Problems have a fifth of wrong directions and noise of 0.01 unless they say otherwise; those of"
        " 5,000 nodes or more, one seed."
    },
    columns={
        "ShapeFit, LUD, placed, oracle": "1; errors of the cameras, of unit norm, median",
        "/ oracle": "1; placed over the oracle, median of the seeds' ratios",
        "mean / median": "1; distances of the cameras kept; worst seed",
        "kept": f"cameras of trust {_MIN_TRUST:g} or more, fewest",
        "seconds": "`place`, wall-clock, median",
    },
)
