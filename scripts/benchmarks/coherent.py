"""Self-consistent corruption: wrong pairs that agree on one false configuration, as where facades repeat.

A share q of the directions belongs to a second configuration of all cameras, a permutation of the true one.
Below q = 0.5 the truth explains more pairs than the second one; at 0.5 the directions speak for both alike,
and no method can tell them apart. Errors are taken against the truth and against the second configuration. A
method breaks at the least q from which on its median error stays above a limit; what the report says of each
answer stands beside it.
"""

import argparse
from collections.abc import Iterator, Mapping
from functools import partial
from typing import NamedTuple

from harness import ours
from harness.driver import Benchmark, Case
from harness.graphs import GraphSpec, draw, relative_error, view_graph
from harness.metrics import Check, Quantity, Trials, number, verdict
from harness.record import table_of

PROBLEMS = {
    "er2-50": GraphSpec(family="er2", n=50, sigma=0.01),
    "er2-100": GraphSpec(family="er2", n=100, sigma=0.01),
    "geo-300": GraphSpec(family="geo", n=300, degree=20.0, sigma=0.01),
}
SHARES = (0.0, 0.1, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5)
QUICK = GraphSpec(family="er2", n=30, sigma=0.01)
BROKEN = 0.2
"""Relative error from which a method counts as broken; two independent configurations are 1.4 apart."""


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


def measure_seeds(name: str, spec: GraphSpec, q: float, seeds: int) -> Trials:
    """Measure a problem at one share of wrong pairs."""
    return Trials(name, q, [measure(spec, q, seed) for seed in range(seeds)])


def measure(spec: GraphSpec, q: float, seed: int) -> Trial:
    """Draw a graph with a share q of self-consistent wrong pairs and solve it by all methods."""
    problem = draw(spec, q=q, seed=seed, corruption="self-consistent")
    truth, false = problem.locations, problem.false_locations
    assert false is not None
    graph = view_graph(problem)
    placement = ours.place(graph)
    rows, found = placement.cameras, placement.locations
    # All methods are given the largest rigid piece, which the directions determine.
    determined = graph.restricted_to(placement.edges)[0]
    return Trial(
        shapefit=relative_error(ours.solve(determined, uniqueness=True).locations, truth[rows]),
        lud=relative_error(ours.solve_lud(determined), truth[rows]),
        placed=relative_error(found, truth[rows]),
        placed_false=relative_error(found, false[rows]),
        contradicting=len(placement.rejected_pairs) / len(placement.edges),
        warned=ours.warns(placement),
    )


def find_broken(found: Trials) -> list[Trial]:
    """Return those whose placed answer is wrong; the problem is the share of wrong pairs."""
    return [trial for trial in found.trials if trial.placed > BROKEN]


def checks(found: Trials) -> list[Check]:
    """Return the limits: a broken answer carries a warning, and one without wrong pairs does not."""
    limits = []
    if broken := find_broken(found):
        warned = sum(trial.warned for trial in broken)
        limits.append(Check(name="warned", value=warned, limit=len(broken), better="higher"))
    if found.problem == 0.0:
        alarms = sum(trial.warned for trial in found.trials)
        limits.append(Check(name="false alarms", value=alarms, limit=0))
    return limits


def breaking_share(errors: Mapping[float, float]) -> float | None:
    """Return the least share from which on the median error stays above `BROKEN`; None if it never does."""
    broken = None
    for q in sorted(errors, reverse=True):
        if errors[q] <= BROKEN:
            break
        broken = q
    return broken


def tables(measured: Mapping[str, Trials], _args: argparse.Namespace) -> Iterator[str]:
    yield (
        "All wrong pairs agree on one second configuration of the cameras. At q = 0.5 it is as good an answer"
        " as the truth, which is the limit of every method."
    )
    yield table_of(
        measured.values(),
        {
            "problem": lambda one: one.name,
            "q": lambda one: f"{one.problem:g}",
            "ShapeFit": lambda one: number(one.median("shapefit")),
            "LUD": lambda one: number(one.median("lud")),
            "placed": lambda one: number(one.median("placed")),
            "placed, false": lambda one: number(one.median("placed_false")),
            "contradicting": lambda one: f"{one.median('contradicting'):.0%}",
            "warned": lambda one: (
                f"{sum(trial.warned for trial in one.trials)} of {len(one.trials)},"
                f" {sum(trial.warned for trial in find_broken(one))} of {len(find_broken(one))} broken"
            ),
            "verdict": lambda one: verdict(checks(one)),
        },
    )
    yield f"## Where the methods break\n\nThe least q from which on the median error stays above {BROKEN:g}."

    def show_share(name: str, column: str) -> str:
        errors = {one.problem: one.median(column) for one in measured.values() if one.name == name}
        share = breaking_share(errors)
        return "never" if share is None else f"{share:g}"

    yield table_of(
        dict.fromkeys(one.name for one in measured.values()),
        {
            "problem": str,
            "ShapeFit": lambda name: show_share(name, "shapefit"),
            "LUD": lambda name: show_share(name, "lud"),
            "placed": lambda name: show_share(name, "placed"),
        },
    )


BENCHMARK = Benchmark(
    name="coherent",
    title="Self-consistent corruption",
    cases=cases,
    checks=checks,
    tables=tables,
    packages=("numpy", "scipy", "numba"),
    quick={"repeats": 1},
    repeats=5,
    quantities=(
        Quantity("q", "1", "neither", 0.0, "odds that a direction is a wrong one"),
        Quantity("ShapeFit, LUD, placed", "1", "lower", 0.05, "against the truth, median of the seeds"),
        Quantity("placed, false", "1", "neither", 0.05, "the same against the second configuration"),
        Quantity("contradicting", "1", "neither", 0.05, "share of pairs that contradict the answer, median"),
        Quantity("warned", "seeds", "neither", 0.0, f"and of those with an error above {BROKEN:g}"),
    ),
)
