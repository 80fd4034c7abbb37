"""Large view graphs: time, memory and iterations of `solve` as the number of cameras grows.

Each problem is drawn in one process and solved in another, fresh one, so that its peak of memory is its
own. There, a small problem is solved first (nothing is compiled while the clock runs); then the problem
itself, once, everything included: checks, rigidity, ordering, symbolic analysis, factorizations,
certificate. From `on_iteration` come the objective and the clock after each iteration, and in hindsight the
time at which the objective came, and stayed, within 1e-4 of the best one known. That is the lower of the
run's own and of a second, tighter run's.

`auto` carries the limits: it is what a user gets. ADMM is measured beside it on graphs that are not too
large, so that its iterations can be compared within a family.

Rigid pieces, a stage of it that has limits of its own, are found in further processes that are given the
pairs alone: their peak memory is that of the imports, the pairs and the search.
"""

import argparse
import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple

from harness import ours
from harness.driver import Benchmark, Case
from harness.graphs import GraphSpec, draw, relative_error, view_graph
from harness.metrics import Check, Quantity, check_all, number, ratio, verdict
from harness.process import call, peak_memory_mb, reset_peak, resident_memory_mb
from harness.record import table, table_of

if TYPE_CHECKING:
    from sfm_shapefit import SolverResult, ViewGraph
    from sfm_shapefit.base.arrays import FloatArray, IntArray

CLOSE = 1e-4
"""Relative excess of the objective that counts as close."""
FAMILIES = {"geo": "geometric", "comm": "community", "er": "random of degree 40", "seq": "trajectory"}


class Problem(NamedTuple):
    """A problem of `solve`, the gap asked for, and what is to be reached."""

    spec: GraphSpec
    tol: float
    reference_tol: float | None = None
    """Of the second run that knows the objective better; None for none."""
    limits: Mapping[str, float] | None = None
    """By the names in `checks`."""

    @property
    def name(self) -> str:
        return f"{self.spec.family} {_show_size(self.spec.n)}{', noiseless' * (self.spec.sigma == 0.0)}"


def _show_size(n: float) -> str:
    return f"{n:.0e}".replace("e+0", "e")


CLOSE_S, CERTIFIED_S, MEMORY_MB = "to 1e-4, s", "certified, s", "memory, MB"
PROBLEMS = (
    Problem(GraphSpec("geo", 1_000, 40.0, 0.01), 1e-6, 1e-8),
    Problem(GraphSpec("geo", 10_000, 40.0, 0.01), 1e-6, 1e-7, {CLOSE_S: 0.5, CERTIFIED_S: 3.0, "gap": 1e-6}),
    Problem(GraphSpec("geo", 10_000, 40.0), 3e-12, limits={"error": 1e-12, "gap": 1e-10}),
    Problem(
        *(GraphSpec("geo", 100_000, 60.0, 0.01), 1e-4, 1e-6),
        {CLOSE_S: 14.0, CERTIFIED_S: 30.0, MEMORY_MB: 1300.0, "gap": 1e-4},
    ),
    Problem(GraphSpec("comm", 1_000, 67.0, 0.01), 1e-4, 1e-7),
    Problem(GraphSpec("comm", 10_000, 67.0, 0.01), 1e-4, 1e-6),
    # Of 1e-4 the splitting would stop short, relatively; a run that knows the optimum would take an hour.
    Problem(GraphSpec("comm", 100_000, 67.0, 0.01), 3e-5, limits={CLOSE_S: 40.0, MEMORY_MB: 2000.0}),
    Problem(GraphSpec("er", 1_000, 40.0, 0.01), 1e-4, 1e-7),
    Problem(GraphSpec("er", 10_000, 40.0, 0.01), 1e-4, 1e-6),
    Problem(GraphSpec("er", 100_000, 40.0, 0.01), 1e-4, 1e-5, {CLOSE_S: 14.0, MEMORY_MB: 600.0}),
    Problem(GraphSpec("seq", 1_000, 20.0, 0.01), 1e-4, 1e-7),
    Problem(GraphSpec("seq", 10_000, 20.0, 0.01), 1e-4, 1e-6),
    Problem(GraphSpec("seq", 100_000, 20.0, 0.01), 1e-4, 1e-5),
)
MILLION = Problem(GraphSpec("geo", 1_000_000, 38.0, 0.01), 1e-4, limits={CLOSE_S: 300.0, MEMORY_MB: 6000.0})
QUICK = Problem(GraphSpec("seq", 200, 20.0, 0.01), 1e-4)
BESIDE_UP_TO = 10_000
"""Cameras, for ADMM beside another choice of `auto`."""

RIGID = {"geo-10000": 32.0, "seq-10000": 36.0, "comm-10000": 45.0, "er-10000": 20.0} | {
    "geo-100000": 53.0,
    "seq-100000": 60.0,
    "comm-100000": 62.0,
}
"""Graphs in 3D whose pieces are sought, and their mean degrees; er-10000 has few triangles."""
RIGID_LIMITS = {10_000: {"seconds": 0.5}, 100_000: {"seconds": 20.0, "peak": 1000.0}}
RIGID_REPEATS = 3


class Measured(NamedTuple):
    """What one solve gave."""

    problem: Problem
    asked: str
    num_edges: int
    solved: Mapping[str, Any]
    """What `SolverResult.summary` says."""
    trace: Sequence[tuple[float, float]]
    """The objective and the clock after each iteration."""
    best_objective: float
    """The lowest known, over both runs."""
    bound: float
    """The highest rigorous bound known, over both runs."""
    total_s: float
    cpu_s: float
    error: float
    before_mb: float
    """Resident before the solve: interpreter, libraries, the warm-up's leftovers and the problem."""
    peak_mb: float

    @property
    def limits(self) -> Mapping[str, float]:
        """Of `auto` only."""
        return (self.problem.limits or {}) if self.asked == "auto" else {}

    @property
    def certificate_s(self) -> float:
        """What came after the last iteration; NaN if there was none."""
        return self.total_s - self.trace[-1][1] if self.trace else math.nan

    @property
    def close_at(self) -> int | None:
        """The iteration from which the objective stays within CLOSE of the best, from 1."""
        return find_settled([value for value, _ in self.trace], self.best_objective * (1.0 + CLOSE))

    @property
    def close_s(self) -> float:
        """The seconds until then; NaN if never."""
        return math.nan if self.close_at is None else self.trace[self.close_at - 1][1]


class Search(NamedTuple):
    """What finding the rigid pieces of one graph gave and took."""

    spec: GraphSpec
    num_pairs: int
    num_pieces: int
    num_single_pairs: int
    wall_s: float
    cpu_s: float
    peak_mb: float


def find_settled(values: Sequence[float], limit: float) -> int | None:
    """Return the number, from 1, of the first value from which all are at or below the limit."""
    above = [k for k, value in enumerate(values, start=1) if not value <= limit]
    first = above[-1] + 1 if above else 1
    return first if first <= len(values) else None


def flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--million", action="store_true", help="also a geometric graph of 1e6 cameras")


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the graphs by `auto` and, if they are not too large, by ADMM, and the searches for pieces."""
    problems = (QUICK,) if args.quick else (*PROBLEMS, *([MILLION] if args.million else []))
    found: dict[str, Case] = {}
    for problem in problems:
        found[problem.name] = partial(measure, problem, "auto", args.threads)
        if problem.spec.n <= BESIDE_UP_TO:
            found[f"{problem.name} (admm)"] = partial(measure, problem, "admm", args.threads)
    for name, degree in ({"geo-200": 20.0} if args.quick else RIGID).items():
        family, n = name.split("-")
        found[f"rigid {name}"] = partial(search, GraphSpec(family=family, n=int(n), degree=degree))
    return found


def draw_graph(spec: GraphSpec) -> "tuple[ViewGraph, FloatArray]":
    """Return the measurements of a problem, and its truth."""
    problem = draw(spec)
    return view_graph(problem), problem.locations


def draw_edges(spec: GraphSpec) -> "IntArray":
    """Return the pairs of a problem alone."""
    return draw(spec).edges


def measure(problem: Problem, asked: str, threads: int) -> Measured:
    """Solve a problem that another process draws; to be called once per process.

    A small graph of the family, none larger than the problem's, is solved before by every method that the
    problem may call for.
    """
    spec = problem.spec
    small = GraphSpec(family=spec.family, n=min(spec.n, 1000), degree=min(spec.degree, 40.0), sigma=0.01)
    for method in ("auto", "newton", "admm"):
        _trace(view_graph(draw(small)), method, 1e-4, threads)
    graph, truth = call(draw_graph, problem.spec)
    before_mb = resident_memory_mb()
    reset_peak()
    run = ours.time_call(lambda: _trace(graph, asked, problem.tol, threads))
    (found, trace), peak_mb = run.found, peak_memory_mb()
    objectives, bound = [found.objective, *(value for value, _ in trace)], found.dual_bound
    if problem.reference_tol is not None:
        again, longer = _trace(graph, asked, problem.reference_tol, threads)
        objectives += [again.objective, *(value for value, _ in longer)]
        bound = max(bound, again.dual_bound)
    return Measured(
        problem=problem,
        asked=asked,
        num_edges=graph.num_edges,
        solved=found.summary(),
        trace=trace,
        best_objective=min(objectives),
        bound=bound,
        total_s=run.wall_s,
        cpu_s=run.cpu_s,
        error=relative_error(found.locations, truth),
        before_mb=before_mb,
        peak_mb=peak_mb,
    )


def _trace(
    graph: "ViewGraph", method: str, tol: float, threads: int
) -> "tuple[SolverResult, list[tuple[float, float]]]":
    """Solve; return the result, and the objective and the clock after each iteration."""
    trace: list[tuple[float, float]] = []

    def note(info: Any) -> None:
        trace.append((info.objective, time.perf_counter() - start))

    start = time.perf_counter()
    return ours.solve(graph, note=note, solver=method, tol=tol, threads=threads), trace


def search(spec: GraphSpec) -> Search:
    """Find the pieces in 3D a few times, after a small graph that loads the compiled code."""
    import numpy as np

    edges = call(draw_edges, spec)
    ours.rigid_pieces(5, np.array([[0, 1], [1, 2], [2, 3], [3, 4], [4, 0]]))
    runs = [ours.time_call(lambda: ours.rigid_pieces(spec.n, edges)) for _ in range(RIGID_REPEATS)]
    sizes = np.bincount(runs[0].found)
    return Search(
        spec=spec,
        num_pairs=len(edges),
        num_pieces=int(np.sum(sizes > 1)),
        num_single_pairs=int(np.sum(sizes == 1)),
        wall_s=statistics.median(run.wall_s for run in runs),
        cpu_s=statistics.median(run.cpu_s for run in runs),
        peak_mb=peak_memory_mb(),
    )


def checks(one: Measured | Search) -> list[Check]:
    """Return the limits of one case; of solves, only `auto` has any."""
    if isinstance(one, Search):
        has_limit = one.spec.family != "er"
        return check_all(
            {"seconds": one.wall_s, "peak": one.peak_mb},
            RIGID_LIMITS.get(one.spec.n, {}) if has_limit else {},
        )
    limits, gap = one.limits, one.solved["gap"]
    values = {
        CLOSE_S: one.close_s,
        CERTIFIED_S: one.total_s if gap <= limits.get("gap", -math.inf) else math.nan,
        MEMORY_MB: one.peak_mb,
        "error": one.error,
        "gap": gap,
    }
    return check_all(values, limits)


def exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """Return a in value ~ size^a by least squares of the logarithms; NaN for fewer than two sizes."""
    pairs = [(math.log(s), math.log(v)) for s, v in zip(sizes, values, strict=True) if v > 0.0]
    if len({x for x, _ in pairs}) < 2:
        return math.nan
    return statistics.linear_regression(*zip(*pairs, strict=True)).slope


def noisy(measured: Sequence[Measured], family: str, by_admm: bool = False) -> list[Measured]:
    """Return the solves of a family with noise, smallest first: what `auto` did, or what ADMM did."""
    chosen = [
        one
        for one in measured
        if one.problem.spec.family == family
        and one.problem.spec.sigma > 0.0
        and ("admm" in one.solved["method"] if by_admm else one.asked == "auto")
    ]
    return sorted(chosen, key=lambda one: one.problem.spec.n)


def tables(measured: Mapping[str, Measured | Search], _args: argparse.Namespace) -> Iterator[str]:
    solves = [one for one in measured.values() if isinstance(one, Measured)]
    searches = [one for one in measured.values() if isinstance(one, Search)]
    if solves:
        yield (
            "q = 0.2 of the directions are random; each solve once, after a warm-up on 1000 cameras of the"
            " family, so that nothing is compiled while the clock runs."
        )
        yield "## Time"
        yield table_of(
            solves,
            {
                "problem": _label,
                "cameras": lambda one: str(one.problem.spec.n),
                "pairs": lambda one: str(one.num_edges),
                "method": lambda one: one.solved["method"],
                "to 1e-4, s": lambda one: number(one.close_s),
                "iterations": lambda one: f"{one.close_at or '-'} / {len(one.trace)}",
                "total, s": lambda one: number(one.total_s),
                "CPU, s": lambda one: number(one.cpu_s),
                "certificate, s": lambda one: number(one.certificate_s),
                "to reach: to 1e-4 / certified": lambda one: show_limits(one, "s", CLOSE_S, CERTIFIED_S),
                "verdict": lambda one: verdict(checks(one)),
            },
        )
        yield "## Certificate, error and memory"
        yield table_of(
            solves,
            {
                "problem": _label,
                "status": lambda one: one.solved["status"],
                "gap asked": lambda one: f"{one.problem.tol:.0e}",
                "objective": lambda one: number(one.solved["objective"]),
                "gap": lambda one: number(one.solved["gap"]),
                "equality residual": lambda one: number(one.solved["equality_residual"]),
                "excess known": lambda one: number(ratio(one.best_objective, one.bound) - 1.0),
                "error": lambda one: number(one.error),
                "memory, MB": lambda one: f"{number(one.peak_mb)} / {number(one.before_mb)}",
                "to reach": lambda one: show_limits(one, "MB", MEMORY_MB),
            },
        )
        yield "## Exponents: value ~ size^exponent, least squares of logarithms over the sizes above"
        yield _show_exponents(solves)
        yield "## Why this solver"
        yield "\n".join(
            dict.fromkeys(
                f"- {one.problem.name}: {one.solved['method']}, because {one.solved['method_reason']}"
                for one in solves
            )
        )
        yield _CAVEATS
    if searches:
        yield "## Rigid pieces"
        yield table_of(
            searches,
            {
                "graph": lambda one: f"{one.spec.family}-{one.spec.n}",
                "cameras": lambda one: str(one.spec.n),
                "pairs": lambda one: str(one.num_pairs),
                "pieces; single pairs": lambda one: f"{one.num_pieces}; {one.num_single_pairs}",
                "seconds (CPU)": lambda one: f"{number(one.wall_s)} ({number(one.cpu_s)})",
                "peak, MB": lambda one: number(one.peak_mb),
                "verdict": lambda one: verdict(checks(one)),
            },
        )


_CAVEATS = (
    "Caveats: one run each. The best objective is that of two runs of the same solver, so `excess known`"
    " says how far from the optimum it may still be. That of comm 1e5 is the best of its own run: it goes on"
    " falling by 1e-7 per iteration while a few clusters that hang by few pairs shrink to points (860"
    " iterations reach 0.20403, with three times the error against the truth). A trajectory's optimum is far"
    " from its truth (ShapeFit collapses on long chains); its error is the program's, not the solver's. The"
    " exponent against pairs differs from that against cameras because the larger geometric graphs have more"
    " pairs per camera. `auto` may change its method between two sizes; then its exponent mixes two solvers,"
    " and that of ADMM is the one to extrapolate."
)


def _label(one: Measured) -> str:
    return one.problem.name + ("" if one.asked == "auto" else f" ({one.asked})")


def show_limits(one: Measured, unit: str, *names: str) -> str:
    """Return the limits of these names; "-" where there is none."""
    return " / ".join(f"{one.limits[name]:g} {unit}" if name in one.limits else "-" for name in names)


def _show_exponents(solves: Sequence[Measured]) -> str:
    values: dict[str, Callable[[Measured], float]] = {
        "to 1e-4": lambda one: one.close_s,
        "total": lambda one: one.total_s,
        "memory of the solve": lambda one: one.peak_mb - one.before_mb,
    }
    rows = []
    for (family, name), by_admm in product(FAMILIES.items(), (False, True)):
        found = noisy(solves, family, by_admm)
        cameras, pairs = [one.problem.spec.n for one in found], [one.num_edges for one in found]
        cells = [
            f"{exponent(cameras, grown):.2f} / {exponent(pairs, grown):.2f}".replace("nan", "-")
            for grown in ([show(one) for one in found] for show in values.values())
        ]
        if len(found) > 1:
            rows.append([name, "admm" if by_admm else "auto", " ".join(map(_show_size, cameras)), *cells])
    header = ["family", "solver", "cameras", *(f"{value}: per cameras / pairs" for value in values)]
    return table(header, rows)


BENCHMARK = Benchmark(
    name="scale",
    title="Large graphs",
    cases=cases,
    checks=checks,
    tables=tables,
    flags=flags,
    packages=("numpy", "scipy", "numba", "pymetis"),
    threads=2,
    timeout_s=3600.0,
    quantities=(
        Quantity("to 1e-4", "s", "lower", 0.5, "until the objective stays within 1e-4 of the best known"),
        Quantity("iterations", "1", "lower", 0.0, "until then / in all"),
        Quantity("total", "s", "lower", 0.5, "wall-clock of `solve`, everything included, once"),
        Quantity("certificate", "s", "lower", 0.5, "part of the total after the last iteration"),
        Quantity("gap", "1", "lower", 1.0, "certified: objective minus a rigorous bound"),
        Quantity("excess known", "1", "lower", 1.0, "best objective over the best bound known, minus 1"),
        Quantity("error", "1", "lower", 0.01, "the paper's, against the truth"),
        Quantity("memory", "MB", "lower", 0.15, "peak during `solve`, all included / resident before it"),
        Quantity("pieces", "1", "neither", 0.0, "of three cameras or more; single pairs"),
        Quantity("seconds (CPU)", "s", "lower", 0.3, f"of the search, median of {RIGID_REPEATS}"),
        Quantity("peak", "MB", "lower", 0.05, "of imports, the pairs, and the search for pieces"),
    ),
)
