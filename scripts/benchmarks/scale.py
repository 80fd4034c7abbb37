"""Large view graphs: time, memory and iterations of `solve` as the number of cameras grows.

Each problem is drawn in one process and solved in another, fresh one, so that its peak of memory is its
own. There, a small problem is solved first (nothing is compiled while the clock runs); then the problem
itself, once, everything included: checks, rigidity, ordering, symbolic analysis, factorisations,
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
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from harness import ours
from harness.driver import ROOT, Benchmark, Case
from harness.graphs import GraphSpec, draw, relative_error, view_graph
from harness.metrics import Check, Quantity, number, verdict
from harness.process import call, peak_memory_mb, reset_peak, resident_memory_mb
from harness.record import table, table_of

if TYPE_CHECKING:
    from sfm_shapefit import SolverResult, ViewGraph

CLOSE = 1e-4
"""Relative excess of the objective that counts as close."""
FAMILIES = {"geo": "geometric", "comm": "community", "er": "random of degree 40", "seq": "trajectory"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """A problem, the gap asked for, and what is to be reached."""

    spec: GraphSpec
    tol: float
    reference_tol: float | None = None
    """Of the second run that knows the objective better; None for none."""
    close_s: float | None = None
    certified_s: float | None = None
    memory_mb: float | None = None
    error: float | None = None
    gap: float | None = None

    @property
    def name(self) -> str:
        return f"{self.spec.family} {self.spec.n:.0e}".replace("e+0", "e") + (
            ", noiseless" if self.spec.sigma == 0.0 else ""
        )


def _spec(family: str, n: int, degree: float, sigma: float = 0.01) -> GraphSpec:
    return GraphSpec(family=family, n=n, degree=degree, sigma=sigma)


PROBLEMS = (
    Problem(spec=_spec("geo", 1_000, 40.0), tol=1e-6, reference_tol=1e-8),
    Problem(
        spec=_spec("geo", 10_000, 40.0), tol=1e-6, reference_tol=1e-7, close_s=0.5, certified_s=3.0, gap=1e-6
    ),
    Problem(spec=_spec("geo", 10_000, 40.0, sigma=0.0), tol=3e-12, error=1e-12, gap=1e-10),
    Problem(
        spec=_spec("geo", 100_000, 60.0),
        tol=1e-4,
        reference_tol=1e-6,
        close_s=14.0,
        certified_s=30.0,
        memory_mb=1300.0,
        gap=1e-4,
    ),
    Problem(spec=_spec("comm", 1_000, 67.0), tol=1e-4, reference_tol=1e-7),
    Problem(spec=_spec("comm", 10_000, 67.0), tol=1e-4, reference_tol=1e-6),
    # Of 1e-4 the splitting would stop short, relatively; a run that knows the optimum would take an hour.
    Problem(spec=_spec("comm", 100_000, 67.0), tol=3e-5, close_s=40.0, memory_mb=2000.0),
    Problem(spec=_spec("er", 1_000, 40.0), tol=1e-4, reference_tol=1e-7),
    Problem(spec=_spec("er", 10_000, 40.0), tol=1e-4, reference_tol=1e-6),
    Problem(spec=_spec("er", 100_000, 40.0), tol=1e-4, reference_tol=1e-5, close_s=14.0, memory_mb=600.0),
    Problem(spec=_spec("seq", 1_000, 20.0), tol=1e-4, reference_tol=1e-7),
    Problem(spec=_spec("seq", 10_000, 20.0), tol=1e-4, reference_tol=1e-6),
    Problem(spec=_spec("seq", 100_000, 20.0), tol=1e-4, reference_tol=1e-5),
)
MILLION = Problem(spec=_spec("geo", 1_000_000, 38.0), tol=1e-4, close_s=300.0, memory_mb=6000.0)
QUICK = Problem(spec=_spec("seq", 200, 20.0), tol=1e-4)
BESIDE_UP_TO = 10_000
"""Cameras, for ADMM beside another choice of `auto`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trace:
    """The objective and the clock after each iteration."""

    objectives: tuple[float, ...]
    seconds: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """What one solve gave."""

    problem: Problem
    asked: str
    num_edges: int
    method: str
    reason: str
    status: str
    trace: Trace
    best_objective: float
    """The lowest known, over both runs."""
    bound: float
    """The highest rigorous bound known, over both runs."""
    total_s: float
    cpu_s: float
    objective: float
    gap: float
    equality_residual: float
    error: float
    before_mb: float
    """Resident before the solve: interpreter, libraries, the warm-up's leftovers and the problem."""
    peak_mb: float

    @property
    def certificate_s(self) -> float:
        """What came after the last iteration; NaN if there was none."""
        return self.total_s - self.trace.seconds[-1] if self.trace.seconds else math.nan

    @property
    def close_at(self) -> int | None:
        """The iteration from which the objective stays within CLOSE of the best, from 1."""
        return find_settled(self.trace.objectives, self.best_objective * (1.0 + CLOSE))

    @property
    def close_s(self) -> float:
        """The seconds until then; NaN if never."""
        return math.nan if self.close_at is None else self.trace.seconds[self.close_at - 1]


def find_settled(values: Sequence[float], limit: float) -> int | None:
    """Return the number, from 1, of the first value from which all are at or below the limit."""
    above = [k for k, value in enumerate(values, start=1) if not value <= limit]
    first = above[-1] + 1 if above else 1
    return first if first <= len(values) else None


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidProblem:
    """A graph in 3D, and what finding its pieces may take."""

    spec: GraphSpec
    seconds: float | None = None
    peak_mb: float | None = None


RIGID_PROBLEMS = {
    **{
        f"{family}-10000": RigidProblem(spec=GraphSpec(family=family, n=10_000, degree=degree), seconds=0.5)
        for family, degree in (("geo", 32.0), ("seq", 36.0), ("comm", 45.0))
    },
    "er-10000, few triangles": RigidProblem(spec=GraphSpec(family="er", n=10_000, degree=20.0)),
    **{
        f"{family}-100000": RigidProblem(
            spec=GraphSpec(family=family, n=100_000, degree=degree), seconds=20.0, peak_mb=1000.0
        )
        for family, degree in (("geo", 53.0), ("seq", 60.0), ("comm", 62.0))
    },
}
QUICK_RIGID = RigidProblem(spec=GraphSpec(family="geo", n=200, degree=20.0))
RIGID_REPEATS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Search:
    """What finding the rigid pieces of one graph gave and took."""

    name: str
    problem: RigidProblem
    num_pairs: int
    num_pieces: int
    num_single_pairs: int
    wall_s: float
    cpu_s: float
    peak_mb: float


# --- the cases -------------------------------------------------------------------------------------


def flags(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `scale`."""
    parser.add_argument("--million", action="store_true", help="also a geometric graph of 1e6 cameras")
    parser.add_argument("--plot", type=Path, help="the plot's file (docs/scale.png)")


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the graphs by `auto` and, if they are not too large, by ADMM, and the searches for pieces."""
    problems = (QUICK,) if args.quick else (*PROBLEMS, *([MILLION] if args.million else []))
    found: dict[str, Case] = {}
    for problem in problems:
        found[problem.name] = partial(measure, problem, "auto", args.threads)
        if problem.spec.n <= BESIDE_UP_TO:
            found[f"{problem.name} (admm)"] = partial(measure, problem, "admm", args.threads)
    rigid = {"geo-200": QUICK_RIGID} if args.quick else RIGID_PROBLEMS
    return found | {f"rigid {name}": partial(search, name, problem) for name, problem in rigid.items()}


# --- measuring -------------------------------------------------------------------------------------


def save_problem(spec: GraphSpec, file: Path) -> None:
    """Draw a problem and store it."""
    import numpy as np

    problem = draw(spec)
    np.savez(file, edges=problem.edges, directions=problem.directions, locations=problem.locations)


def measure(problem: Problem, asked: str, threads: int) -> Measured:
    """Solve a problem that another process draws; to be called once per process."""
    import numpy as np

    from sfm_shapefit import ViewGraph

    _warm_up(problem.spec, threads)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "problem.npz"
        call(save_problem, problem.spec, file)
        with np.load(file) as stored:
            truth = stored["locations"]
            graph = ViewGraph(len(truth), stored["edges"], stored["directions"])
    before_mb = resident_memory_mb()
    reset_peak()
    run = ours.time_call(lambda: _trace(graph, asked, problem.tol, threads))
    (found, trace), peak_mb = run.found, peak_memory_mb()
    best, bound = min([found.objective, *trace.objectives]), found.dual_bound
    if problem.reference_tol is not None:
        again, longer = _trace(graph, asked, problem.reference_tol, threads)
        best = min([best, again.objective, *longer.objectives])
        bound = max(bound, again.dual_bound)
    return Measured(
        problem=problem,
        asked=asked,
        num_edges=graph.num_edges,
        method=found.method,
        reason=found.method_reason,
        status=found.status.name.lower(),
        trace=trace,
        best_objective=best,
        bound=bound,
        total_s=run.wall_s,
        cpu_s=run.cpu_s,
        objective=found.objective,
        gap=found.gap,
        equality_residual=found.equality_residual,
        error=relative_error(found.locations, truth),
        before_mb=before_mb,
        peak_mb=peak_mb,
    )


def _warm_up(spec: GraphSpec, threads: int) -> None:
    """Solve a small graph of the family by every method that the problem may call for."""
    small = GraphSpec(family=spec.family, n=1000, degree=min(spec.degree, 40.0), sigma=0.01)
    graph = view_graph(draw(small))
    for method in ("auto", "newton", "admm"):
        _trace(graph, method, 1e-4, threads)


def _trace(graph: "ViewGraph", method: str, tol: float, threads: int) -> "tuple[SolverResult, Trace]":
    """Solve; return the result, and the objective and the clock after each iteration."""
    objectives: list[float] = []
    seconds: list[float] = []

    def note(info: object) -> None:
        seconds.append(time.perf_counter() - start)
        objectives.append(info.objective)  # type: ignore[attr-defined]

    start = time.perf_counter()
    found = ours.solve(graph, note=note, solver=method, tol=tol, threads=threads)
    return found, Trace(objectives=tuple(objectives), seconds=tuple(seconds))


def search(name: str, problem: RigidProblem) -> Search:
    """Find the pieces in 3D a few times, after a small graph that loads the compiled code."""
    import numpy as np

    edges = call(draw_edges, problem.spec)
    ours.rigid_pieces(5, np.array([[0, 1], [1, 2], [2, 3], [3, 4], [4, 0]]))
    runs = [ours.time_call(lambda: ours.rigid_pieces(problem.spec.n, edges)) for _ in range(RIGID_REPEATS)]
    sizes = np.bincount(runs[0].found)
    return Search(
        name=name,
        problem=problem,
        num_pairs=len(edges),
        num_pieces=int(np.sum(sizes > 1)),
        num_single_pairs=int(np.sum(sizes == 1)),
        wall_s=statistics.median(run.wall_s for run in runs),
        cpu_s=statistics.median(run.cpu_s for run in runs),
        peak_mb=peak_memory_mb(),
    )


def draw_edges(spec: GraphSpec) -> object:
    """Return the pairs of a problem."""
    return draw(spec).edges


# --- what is to be reached -------------------------------------------------------------------------


def checks(one: Measured | Search) -> list[Check]:
    """Return the limits of one case; of solves, only `auto` has any."""
    if isinstance(one, Search):
        values = [("seconds", one.wall_s, one.problem.seconds), ("peak", one.peak_mb, one.problem.peak_mb)]
    elif one.asked != "auto":
        return []
    else:
        problem = one.problem
        certified_s = one.total_s if problem.gap is not None and one.gap <= problem.gap else math.nan
        values = [
            ("to 1e-4, s", one.close_s, problem.close_s),
            ("certified, s", certified_s, problem.certified_s),
            ("memory, MB", one.peak_mb, problem.memory_mb),
            ("error", one.error, problem.error),
            ("gap", one.gap, problem.gap),
        ]
    return [Check(name=name, value=value, limit=limit) for name, value, limit in values if limit is not None]


def exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """Return a in value ~ size^a by least squares of the logarithms; NaN for fewer than two sizes."""
    pairs = [(math.log(s), math.log(v)) for s, v in zip(sizes, values, strict=True) if v > 0.0]
    if len({x for x, _ in pairs}) < 2:
        return math.nan
    mean_x = sum(x for x, _ in pairs) / len(pairs)
    mean_y = sum(y for _, y in pairs) / len(pairs)
    return sum((x - mean_x) * (y - mean_y) for x, y in pairs) / sum((x - mean_x) ** 2 for x, _ in pairs)


def noisy(measured: Sequence[Measured], family: str, by_admm: bool = False) -> list[Measured]:
    """Return the solves of a family with noise, smallest first: what `auto` did, or what ADMM did."""
    chosen = [
        one
        for one in measured
        if one.problem.spec.family == family
        and one.problem.spec.sigma > 0.0
        and ("admm" in one.method if by_admm else one.asked == "auto")
    ]
    return sorted(chosen, key=lambda one: one.problem.spec.n)


# --- the section -----------------------------------------------------------------------------------


def tables(measured: Mapping[str, Measured | Search], args: argparse.Namespace) -> Iterator[str]:
    """Yield the parts of the section, and draw the plot."""
    solves = [one for one in measured.values() if isinstance(one, Measured)]
    searches = [one for one in measured.values() if isinstance(one, Search)]
    if solves:
        if args.plot is not None or not args.quick:
            plot(solves, args.plot or ROOT / "docs" / "scale.png")
        yield (
            "q = 0.2 of the directions are random; each solve once, after a warm-up on 1000 cameras of the"
            " family, so that nothing is compiled while the clock runs."
        )
        yield "## Time"
        yield _show_times(solves)
        yield "## Certificate, error and memory"
        yield _show_proofs(solves)
        yield f"## Iterations of ADMM until the objective is within {CLOSE:.0e}, as n grows"
        yield _show_iterations(solves)
        yield (
            "## Exponents: value ~ size^exponent, least squares of logarithms over the sizes above\n\n"
            "![time and memory against cameras](../../docs/scale.png)"
        )
        yield _show_exponents(solves)
        yield "## Why this solver"
        yield "\n".join(
            dict.fromkeys(f"- {one.problem.name}: {one.method}, because {one.reason}" for one in solves)
        )
        yield _CAVEATS
    if searches:
        yield "## Rigid pieces"
        yield _show_searches(searches)


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


def _show_times(solves: Sequence[Measured]) -> str:
    def show_limits(one: Measured) -> str:
        limits = (one.problem.close_s, one.problem.certified_s)
        shown = ["-" if limit is None else f"{limit:g} s" for limit in limits]
        return " / ".join(shown) if one.asked == "auto" else "-"

    return table_of(
        solves,
        {
            "problem": _label,
            "cameras": lambda one: str(one.problem.spec.n),
            "pairs": lambda one: str(one.num_edges),
            "method": lambda one: one.method,
            "to 1e-4, s": lambda one: number(one.close_s),
            "iterations": lambda one: f"{one.close_at or '-'} / {len(one.trace.objectives)}",
            "total, s": lambda one: number(one.total_s),
            "CPU, s": lambda one: number(one.cpu_s),
            "certificate, s": lambda one: number(one.certificate_s),
            "to reach: to 1e-4 / certified": show_limits,
            "verdict": lambda one: verdict(checks(one)),
        },
    )


def _show_proofs(solves: Sequence[Measured]) -> str:
    def show_excess(one: Measured) -> str:
        return number(one.best_objective / one.bound - 1.0) if one.bound > 0.0 else "-"

    def show_limit(one: Measured) -> str:
        has_limit = one.problem.memory_mb is not None and one.asked == "auto"
        return f"{one.problem.memory_mb:g} MB" if has_limit else "-"

    return table_of(
        solves,
        {
            "problem": _label,
            "status": lambda one: one.status,
            "gap asked": lambda one: f"{one.problem.tol:.0e}",
            "objective": lambda one: number(one.objective),
            "gap": lambda one: number(one.gap),
            "equality residual": lambda one: number(one.equality_residual),
            "excess known": show_excess,
            "error": lambda one: number(one.error),
            "memory, MB": lambda one: f"{number(one.peak_mb)} / {number(one.before_mb)}",
            "to reach": show_limit,
        },
    )


def _show_searches(searches: Sequence[Search]) -> str:
    return table_of(
        searches,
        {
            "graph": lambda one: one.name,
            "cameras": lambda one: str(one.problem.spec.n),
            "pairs": lambda one: str(one.num_pairs),
            "pieces; single pairs": lambda one: f"{one.num_pieces}; {one.num_single_pairs}",
            "seconds (CPU)": lambda one: f"{number(one.wall_s)} ({number(one.cpu_s)})",
            "peak, MB": lambda one: number(one.peak_mb),
            "verdict": lambda one: verdict(checks(one)),
        },
    )


def _show_iterations(measured: Sequence[Measured]) -> str:
    by_admm = {family: noisy(measured, family, by_admm=True) for family in FAMILIES}
    sizes = sorted({one.problem.spec.n for found in by_admm.values() for one in found})
    rows = []
    for family, name in FAMILIES.items():
        close_at = {one.problem.spec.n: one.close_at for one in by_admm[family]}
        if close_at:
            cells = [close_at.get(n) for n in sizes]
            rows.append([name, *("-" if cell is None else f"{cell}" for cell in cells)])
    return table(["family", *(f"{n} cameras" for n in sizes)], rows)


def _show_exponents(measured: Sequence[Measured]) -> str:
    rows = []
    for family, name in FAMILIES.items():
        for by_admm in (False, True):
            found = noisy(measured, family, by_admm)
            if len(found) > 1:
                rows.append([name, "admm" if by_admm else "auto", *_exponent_cells(found)])
    values = ("to 1e-4", "total", "memory of the solve")
    return table(
        ["family", "solver", "cameras", *(f"{value}: per cameras / pairs" for value in values)], rows
    )


def _exponent_cells(found: Sequence[Measured]) -> list[str]:
    """Return the sizes, and the exponents of times and memory."""
    cameras = [float(one.problem.spec.n) for one in found]
    pairs = [float(one.num_edges) for one in found]
    values = (
        [one.close_s for one in found],
        [one.total_s for one in found],
        [one.peak_mb - one.before_mb for one in found],
    )
    sizes = " ".join(f"{n:.0e}".replace("e+0", "e") for n in cameras)
    exponents = [f"{exponent(cameras, v):.2f} / {exponent(pairs, v):.2f}".replace("nan", "-") for v in values]
    return [sizes, *exponents]


def plot(measured: Sequence[Measured], file: Path) -> None:
    """Draw time and memory against the number of cameras, log-log, into a PNG file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 2)
    for color, (family, name) in enumerate(FAMILIES.items()):
        found = noisy(measured, family)
        if not found:
            continue
        cameras = [one.problem.spec.n for one in found]
        style = {"color": f"C{color}", "marker": "o", "markersize": 4.0}
        slope = exponent(cameras, [one.total_s for one in found])
        fitted = "" if math.isnan(slope) else f", n^{slope:.2f}"
        panels[0].loglog(cameras, [one.total_s for one in found], label=f"{name}{fitted}", **style)
        panels[0].loglog(cameras, [one.close_s for one in found], linestyle="--", **style)
        panels[1].loglog(cameras, [one.peak_mb for one in found], label=name, **style)
    panels[0].set_ylabel("seconds: certified (solid), objective to 1e-4 (dashed)")
    panels[1].set_ylabel("peak resident memory, MB, libraries included")
    for panel in panels:
        panel.set_xlabel("cameras")
        panel.grid(True, which="both", alpha=0.25)
        panel.legend(frameon=False)
    figure.savefig(file, dpi=110)


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
        Quantity(
            *("to 1e-4", "s", "lower", 0.5),
            "until the objective stays within 1e-4, relatively, of the best one known",
        ),
        Quantity("iterations", "1", "lower", 0.0, "until then / in all"),
        Quantity("total", "s", "lower", 0.5, "wall-clock of `solve`, everything included, once"),
        Quantity("certificate", "s", "lower", 0.5, "part of the total after the last iteration"),
        Quantity("gap", "1", "lower", 1.0, "certified: objective minus a rigorous bound"),
        Quantity(
            *("excess known", "1", "lower", 1.0),
            "best objective known over the best bound known, minus 1: how soft `to 1e-4` is",
        ),
        Quantity("error", "1", "lower", 0.01, "the paper's, against the truth"),
        Quantity(
            *("memory", "MB", "lower", 0.15),
            "peak resident memory during `solve`, all included / before it: libraries, problem",
        ),
        Quantity("pieces", "1", "neither", 0.0, "of three cameras or more; single pairs"),
        Quantity(
            *("seconds (CPU)", "s", "lower", 0.3),
            f"of `parallel_rigid_pieces`, median of {RIGID_REPEATS} (processor time), one thread",
        ),
        Quantity(
            *("peak", "MB", "lower", 0.05),
            "resident memory of the process: imports, the pairs, and the search for pieces",
        ),
    ),
)
