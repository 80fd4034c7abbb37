"""Self-consistent corruption: wrong pairs that agree on one false configuration, as where facades repeat.

A share q of the directions belongs to a second configuration of all cameras, a permutation of the true one.
Below q = 0.5 the truth explains more pairs than the second one; at 0.5 the directions speak for both alike,
and no method can tell them apart. Errors are taken against the truth and against the second configuration. A
method breaks at the least q from which on its median error stays above a limit; what the report says of each
answer stands beside it.
"""

import argparse
import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.graphs import GraphSpec, draw, relative_error, view_graph
from benchmarks.metrics import Check, Quantity, number, verdict
from benchmarks.record import environment, legend, table, write_section

if TYPE_CHECKING:
    from sfm_shapefit.arrays import FloatArray
    from sfm_shapefit.placement.place import Placement
    from sfm_shapefit.viewgraph import ViewGraph

HELP = "Graphs whose wrong pairs agree on one false configuration, up to the theoretical limit."
ROOT = Path(__file__).parents[2]
PACKAGES = ("numpy", "scipy", "numba")
PROBLEMS = {
    "er2-50": GraphSpec(family="er2", n=50, sigma=0.01),
    "er2-100": GraphSpec(family="er2", n=100, sigma=0.01),
    "geo-300": GraphSpec(family="geo", n=300, degree=20.0, sigma=0.01),
}
SHARES = (0.0, 0.1, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5)
BROKEN = 0.2
"""Relative error from which a method counts as broken; two independent configurations are 1.4 apart."""

QUANTITIES = (
    Quantity(
        name="q", unit="1", better="neither", rel_tol=0.0, meaning="odds that a direction is a wrong one"
    ),
    Quantity(
        name="ShapeFit, LUD, placed",
        unit="1",
        better="lower",
        rel_tol=0.05,
        meaning="error against the truth, both centred and of unit norm, median of the seeds; "
        "placed is what `solve` and `locate` give",
    ),
    Quantity(
        name="placed, false",
        unit="1",
        better="neither",
        rel_tol=0.05,
        meaning="the same against the second configuration",
    ),
    Quantity(
        name="contradicting",
        unit="1",
        better="neither",
        rel_tol=0.05,
        meaning="share of pairs that `place` finds to contradict its answer, median",
    ),
    Quantity(
        name="warned",
        unit="seeds",
        better="neither",
        rel_tol=0.0,
        meaning=f"seeds with a warning in the report, and of those, seeds with an error above {BROKEN:g}",
    ),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One graph, solved by all methods."""

    shapefit: float
    lud: float
    placed: float
    placed_false: float
    """Error against the second configuration."""
    contradicting: float
    warned: bool


# --- the subcommand --------------------------------------------------------------------------------


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `coherent`."""
    parser.add_argument("--seeds", type=int, default=5, help="graphs per problem and share (default 5)")
    parser.add_argument("--out", type=Path, default=ROOT / "scripts" / "results.md", help="file of results")


def run(args: argparse.Namespace) -> int:
    """Measure, print the section and write it."""
    about = environment(PACKAGES, f"python scripts/benchmark.py coherent --seeds {args.seeds}")
    measured = {}
    for name, spec in PROBLEMS.items():
        for q in SHARES:
            measured[name, q] = [measure(spec, q, seed) for seed in range(args.seeds)]
            print(f"{name}, q = {q:g}: {_row(name, q, measured[name, q])[2:]}", file=sys.stderr, flush=True)
    body = section(measured, about)
    print(body)
    write_section(args.out, "coherent", body)
    return 0


# --- measuring -------------------------------------------------------------------------------------


def measure(spec: GraphSpec, q: float, seed: int) -> Trial:
    """Draw a graph with a share q of self-consistent wrong pairs and solve it by all methods."""
    import numpy as np

    from sfm_shapefit.placement.place import place
    from sfm_shapefit.results import quality_warnings
    from sfm_shapefit.solver.solve import solve
    from sfm_shapefit.solver.splitting import solve_lud

    problem = draw(spec, q=q, seed=seed, corruption="self-consistent")
    truth, false = problem.locations, problem.false_locations
    assert false is not None
    graph = view_graph(problem)
    placement = place(graph)
    rows, found = placement.cameras, _locations(placement)
    return Trial(
        shapefit=relative_error(solve(_determined(graph, placement)).locations, truth[rows]),
        lud=relative_error(solve_lud(_determined(graph, placement)).locations, truth[rows]),
        placed=relative_error(found, truth[rows]),
        placed_false=relative_error(found, false[rows]),
        contradicting=len(placement.rejected_pairs) / len(placement.edges),
        warned=bool(np.any([True for _ in quality_warnings(placement)])),
    )


def _determined(graph: "ViewGraph", placement: "Placement") -> "ViewGraph":
    """Return the largest rigid piece, which all methods are given."""
    return graph.restricted_to(placement.edges)[0]


def _locations(placement: "Placement") -> "FloatArray":
    """Return the locations of the placed cameras."""
    return placement.locations


# --- the section -----------------------------------------------------------------------------------


def breaking_share(errors: dict[float, float]) -> float | None:
    """Return the least share from which on the median error stays above `BROKEN`; None if it never does."""
    broken = None
    for q in sorted(errors, reverse=True):
        if errors[q] <= BROKEN:
            break
        broken = q
    return broken


def section(measured: dict[tuple[str, float], list[Trial]], about: str) -> str:
    """Return the section of the results file."""
    header = ["problem", "q", "ShapeFit", "LUD", "placed", "placed, false", "contradicting", "warned"]
    rows = [_row(name, q, trials) for (name, q), trials in measured.items()]
    parts = [
        "## Self-consistent corruption",
        about,
        "All wrong pairs agree on one second configuration of the cameras. At q = 0.5 it is as good an answer"
        " as the truth, which is the limit of every method.",
        table(header, rows),
        _warnings_sentence(measured),
        "### Where the methods break",
        f"The least q from which on the median error stays above {BROKEN:g}.",
        _breaking_table(measured),
        "### What the columns mean",
        legend(QUANTITIES),
    ]
    return "\n\n".join(part.strip() for part in parts)


def _row(name: str, q: float, trials: Sequence[Trial]) -> list[str]:
    """Return the row of one problem at one share."""
    warned = sum(trial.warned for trial in trials)
    broken = [trial for trial in trials if trial.placed > BROKEN]
    return [
        name,
        f"{q:g}",
        *(number(_median(trials, column)) for column in ("shapefit", "lud", "placed", "placed_false")),
        f"{_median(trials, 'contradicting'):.0%}",
        f"{warned} of {len(trials)}, {sum(trial.warned for trial in broken)} of {len(broken)} broken",
    ]


def _warnings_sentence(measured: dict[tuple[str, float], list[Trial]]) -> str:
    """Say whether every broken answer carries a warning, and none does where no pair is wrong."""
    broken = [trial for trials in measured.values() for trial in trials if trial.placed > BROKEN]
    clean = [trial for (_, q), trials in measured.items() for trial in trials if q == 0.0]
    warned, alarms = (sum(trial.warned for trial in trials) for trials in (broken, clean))
    checks = [
        Check(name="warned", value=warned, limit=len(broken), better="higher"),
        Check(name="false alarms", value=alarms, limit=0),
    ]
    return (
        f"Of {len(broken)} answers with an error above {BROKEN:g}, {warned} carry a warning; of {len(clean)} "
        f"without wrong pairs, {alarms}: {verdict(checks)}."
    )


def _breaking_table(measured: dict[tuple[str, float], list[Trial]]) -> str:
    rows = []
    for name in dict.fromkeys(name for name, _ in measured):
        cells = []
        for column in ("shapefit", "lud", "placed"):
            errors = {q: _median(trials, column) for (of, q), trials in measured.items() if of == name}
            share = breaking_share(errors)
            cells.append("never" if share is None else f"{share:g}")
        rows.append([name, *cells])
    return table(["problem", "ShapeFit", "LUD", "placed"], rows)


def _median(trials: Sequence[Trial], column: str) -> float:
    return float(statistics.median(getattr(trial, column) for trial in trials))
