"""Self-consistent corruption: wrong pairs that agree on one false configuration, as where facades repeat.

A share q of the directions belongs to a second configuration of all cameras, a permutation of the true one.
Below q = 0.5 the truth explains more pairs than the second one; at 0.5 the directions speak for both alike,
and no method can tell them apart. Errors are taken against the truth and against the second configuration. A
method breaks at the least q from which on its median error stays above a limit; what the report says of each
answer stands beside it.
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import sfm_shapefit
from harness.driver import Benchmark, Case
from harness.graphs import GraphSpec, draw, relative_error
from harness.record import Row, at_least, at_most, median, table
from sfm_shapefit.facts.warnings import quality_warnings
from sfm_shapefit.solver.splitting.lud import solve_lud

PROBLEMS = {
    "er2-50": GraphSpec("er2", n=50, sigma=0.01),
    "er2-100": GraphSpec("er2", n=100, sigma=0.01),
    "geo-300": GraphSpec("geo", n=300, degree=20.0, sigma=0.01),
}
SHARES = (0.0, 0.1, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5)
QUICK = GraphSpec("er2", n=30, sigma=0.01)
BROKEN = 0.2
"""Relative error from which a method counts as broken; two independent configurations are 1.4 apart."""
METHODS = ("ShapeFit", "LUD", "placed")


class Trial(NamedTuple):
    """One graph, solved by all methods."""

    shapefit: float
    lud: float
    placed: float
    placed_false: float
    """Error against the second configuration."""
    contradicting: float
    warned: bool


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return each problem at each share."""
    problems, shares = ({"er2-30": QUICK}, (0.0, 0.5)) if args.quick else (PROBLEMS, SHARES)
    return {
        f"{name}, q = {q:g}": partial(measure_seeds, name, spec, q, args.repeats)
        for name, spec in problems.items()
        for q in shares
    }


def measure_seeds(name: str, spec: GraphSpec, q: float, seeds: int) -> Row:
    """Measure a problem at one share of wrong pairs."""
    return judge(name, q, [measure(spec, q, seed) for seed in range(seeds)])


def measure(spec: GraphSpec, q: float, seed: int) -> Trial:
    """Draw a graph with a share q of self-consistent wrong pairs and solve it by all methods."""
    problem = draw(spec, q=q, seed=seed, corruption="self-consistent")
    truth, false, graph = problem.locations, problem.false_locations, problem.view_graph
    placement = sfm_shapefit.place(graph)
    rows, found = placement.cameras, placement.locations
    # All methods are given the largest rigid piece, which the directions determine.
    determined = graph.restricted_to(placement.edges)[0]
    return Trial(
        shapefit=relative_error(sfm_shapefit.solve(determined).locations, truth[rows]),
        lud=relative_error(solve_lud(determined).locations, truth[rows]),
        placed=relative_error(found, truth[rows]),
        placed_false=relative_error(found, false[rows]),
        contradicting=len(placement.rejected_pairs) / len(placement.edges),
        warned=any(quality_warnings(placement)),
    )


def judge(name: str, q: float, trials: Sequence[Trial]) -> Row:
    """Return the row of a problem: a broken answer has to carry a warning, one without wrong pairs none."""
    middle = Trial(*map(median, zip(*trials, strict=True)))
    warned = sum(trial.warned for trial in trials)
    broken = [trial for trial in trials if trial.placed > BROKEN]
    heard = sum(trial.warned for trial in broken)
    checks = at_least(warned=(heard, len(broken) or None)) + at_most(false_alarms=(warned, None if q else 0))
    cells = {
        "problem": name,
        "q": q,
        **dict(zip(METHODS, middle, strict=False)),
        "placed, false": middle.placed_false,
        "contradicting": f"{middle.contradicting:.0%}",
        "warned": f"{warned} of {len(trials)}, {heard} of {len(broken)} broken",
    }
    return Row(cells, checks)


def breaking_share(errors: Mapping[float, float]) -> float | None:
    """Return the least share from which on the median error stays above `BROKEN`; None if it never does."""
    broken = None
    for q in sorted(errors, reverse=True):
        if errors[q] <= BROKEN:
            break
        broken = q
    return broken


def show_breaking(rows: Sequence[Row]) -> Iterator[str]:
    """Yield where the methods break."""
    yield f"## Where the methods break\n\nThe least q from which on the median error stays above {BROKEN:g}."
    lines = []
    for name in dict.fromkeys(row["problem"] for row in rows):
        own = [row for row in rows if row["problem"] == name]
        shares = [breaking_share({row["q"]: row[method] for row in own}) for method in METHODS]
        lines.append([name, *("never" if share is None else f"{share:g}" for share in shares)])
    yield table(["problem", *METHODS], lines)


BENCHMARK = Benchmark(
    name="coherent",
    title="Self-consistent corruption",
    cases=cases,
    closing=show_breaking,
    packages=("numpy", "scipy", "numba"),
    quick={"repeats": 1},
    repeats=5,
    notes={
        "": "All wrong pairs agree on one second configuration of the cameras. At q = 0.5 it is as good an"
        " answer as the truth, which is the limit of every method."
    },
    columns={
        "q": "1; odds that a direction is a wrong one",
        "ShapeFit, LUD, placed": "1; error against the truth, median of the seeds",
        "placed, false": "1; the same against the second configuration",
        "contradicting": "1; share of pairs that contradict the answer, median",
        "warned": f"seeds; and of those with an error above {BROKEN:g}",
    },
)
