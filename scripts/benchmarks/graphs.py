"""Families of graphs whose truth is known: ShapeFit, LUD and what is placed, against the best that can be.

The oracle knows which directions are right: unweighted (streets: weighted) least squares in angles on those
alone, started at the truth and run to convergence. It is pinned at two cameras and never pulled to the truth:
a little damping would hide most of the drift of a long chain, which is in the data.
"""

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from harness import ours
from harness.driver import DATA, ROOT, Benchmark, Case, if_there
from harness.graphs import GraphSpec, draw, relative_error, view_graph
from harness.metrics import Check, Quantity, Trials, number, verdict
from harness.record import table_of

if TYPE_CHECKING:
    from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
    from sfm_shapefit.graph.viewgraph import ViewGraph
    from sfm_shapefit.synthetic import GraphProblem

MADRID = "1dsfm-Madrid_Metropolis"
EXACT = 1e-9
"""Error that counts as exact, where right directions have no noise."""
MEAN_OVER_MEDIAN = 3.0
# `locate` keeps cameras of this trust by default.
_MIN_TRUST = 0.6
_ORACLE_STEPS = 8
# The oracle's factorization of larger graphs takes too long.
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
    "er2-100 0.05, q 0.4": Problem(spec=GraphSpec(family="er2", n=100, sigma=0.05, q=0.4), over_oracle=1.15),
    "seq-300 exact, q 0.1": Problem(spec=GraphSpec(family="seq", n=300, degree=36.0, q=0.1), error=EXACT),
    **{
        f"{family}-{n}": Problem(GraphSpec(family, n, degree, 0.01), over_oracle=1.3, below_lud=True)
        for family, n, degree in CHAINS
    },
    **{
        f"street-500 {words}": Problem(GraphSpec("street", 500, sigma=0.01, q=0.15), jitter, error=3e-3)
        for words, jitter in (("straight", 0.0), ("jitter 1%", 0.01), ("jitter 5%", 0.05))
    },
    "street-5000 straight": Problem(GraphSpec("street", 5000, sigma=0.01, q=0.15), error=9e-3, seconds=30.0),
    "Madrid, q 0.3 on few": Problem(spec=GraphSpec(family="madrid", n=394, sigma=0.01, q=0.3)),
}

QUICK = {
    "seqv-60": Problem(spec=GraphSpec(family="seqv", n=60, degree=16.0, sigma=0.01), over_oracle=1.3),
    "street-30": Problem(spec=GraphSpec(family="street", n=30), error=0.1),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drawn:
    """A graph with its truth."""

    graph: "ViewGraph"
    truth: "FloatArray"
    """(n, 3) of all nodes."""
    right: "FloatArray"
    """(m,) 1 / variance of right directions, 0 for wrong ones."""
    num_cameras: int
    covariance: "FloatArray | None" = None


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
    import numpy as np

    from sfm_shapefit import ViewGraph
    from sfm_shapefit.synthetic import street_problem

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
    return Drawn(
        graph=view_graph(bare),
        truth=bare.locations,
        right=np.where(bare.corrupted, 0.0, 1.0),
        num_cameras=len(bare.locations),
    )


def _madrid(spec: GraphSpec, seed: int, data: Path) -> "GraphProblem":
    """Return drawn positions, in a flat square, on the pairs of a real collection."""
    import numpy as np

    from sfm_shapefit.synthetic import measured_problem

    with np.load(data / MADRID / "viewgraph.npz") as file:
        edges, n = file["edges"].astype(np.int64), len(file["names"])
    rng = np.random.default_rng(seed)
    locations = rng.standard_normal((n, 3)) * [1.0, 1.0, 0.2]
    pairs = np.unique(np.sort(edges, axis=1), axis=0)
    return measured_problem(locations, pairs, sigma=spec.sigma, q=spec.q, seed=rng, corruption="concentrated")


def measure_seeds(name: str, problem: Problem, seeds: int, data: Path) -> Trials:
    """Measure a problem, after a small one that loads the compiled code."""
    measure(replace(problem, spec=replace(problem.spec, n=min(problem.spec.n, 100))), 0, data)
    return Trials(name, problem, [measure(problem, seed, data) for seed in range(seeds)])


def measure(problem: Problem, seed: int, data: Path = DATA) -> Trial:
    """Place one graph of a problem and compare with its truth."""
    import numpy as np

    from sfm_shapefit.base.geometry import fit_similarity

    one = draw_graph(problem, seed, data)
    run = ours.time_call(
        lambda: ours.place(one.graph, covariance=one.covariance, num_cameras=one.num_cameras)
    )
    placement = run.found
    rows, count = placement.cameras, len(placement.cameras)
    truth, lud = one.truth[rows], placement.refined.lud
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


def oracle(one: Drawn) -> "FloatArray":
    """Return weighted least squares of |u_e - v_e| on the right directions alone, (n, 3), from the truth.

    What fewer than two right directions hold stays where it is.
    """
    import numpy as np
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

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


def _holding(right: "BoolArray", edges: "IntArray") -> "BoolArray":
    """Return the right directions without those to nodes that have no second one, again and again."""
    import numpy as np

    while True:
        degree = np.bincount(edges[right].ravel(), minlength=int(edges.max()) + 1)
        left = right & (degree[edges] >= 2).all(axis=1)
        if (left == right).all():
            return right
        right = left


def worst_ratio(found: Trials) -> float:
    """Return the largest mean over median of the trials."""
    return max(trial.mean_over_median for trial in found.trials)


def checks(found: Trials) -> list[Check]:
    """Return the limits of one problem: of medians, and of the worst mean over median."""
    problem, worst = found.problem, worst_ratio(found)
    limits = (
        ("/ oracle", found.median("over_oracle"), problem.over_oracle),
        ("error", found.median("placed"), problem.error),
        ("placed against LUD", found.median("placed"), found.median("lud") if problem.below_lud else None),
        ("seconds", found.median("seconds"), problem.seconds),
        ("mean / median", worst, MEAN_OVER_MEDIAN),
    )
    return [Check(name=name, value=v, limit=limit) for name, v, limit in limits if limit is not None]


def tables(measured: Mapping[str, Trials], _args: argparse.Namespace) -> Iterator[str]:
    yield (
        "Problems have a fifth of wrong directions and noise of 0.01 unless they say otherwise; those of"
        " 5,000 nodes or more, one seed."
    )
    yield table_of(
        measured.values(),
        {
            "problem": lambda one: one.name,
            "ShapeFit": lambda one: number(one.median("shapefit")),
            "LUD": lambda one: number(one.median("lud")),
            "placed": lambda one: number(one.median("placed")),
            "oracle": lambda one: number(one.median("oracle")),
            "/ oracle": lambda one: number(one.median("over_oracle")),
            "mean / median": lambda one: number(worst_ratio(one)),
            "kept": lambda one: str(min(trial.kept for trial in one.trials)),
            "seconds": lambda one: number(one.median("seconds")),
            "verdict": lambda one: verdict(checks(one)),
        },
    )


BENCHMARK = Benchmark(
    name="graphs",
    title="Families of graphs",
    cases=cases,
    checks=checks,
    tables=tables,
    packages=("numpy", "scipy", "numba"),
    quick={"repeats": 1},
    repeats=5,
    quantities=(
        Quantity("ShapeFit, LUD, placed, oracle", "1", "lower", 0.05, "of the cameras, of unit norm, median"),
        Quantity("/ oracle", "1", "lower", 0.05, "placed over the oracle, median of the seeds' ratios"),
        Quantity("mean / median", "1", "lower", 0.1, "distances of the cameras kept; worst seed"),
        Quantity("kept", "cameras", "higher", 0.0, f"cameras of trust {_MIN_TRUST:g} or more, fewest"),
        Quantity("seconds", "s", "lower", 0.5, "`place`, wall-clock, median"),
    ),
)
