"""The Newton solver against a generic cone solver: on the paper's random graphs, and on real graphs alone.

Random graphs: G(n, 1/2), a quarter of the directions random, with and without noise. Three contenders are
given the same `ViewGraph` and run in turns of 50 ms or two runs, in one process on one thread, so that a
change of the machine's load meets all of them. The median of all runs counts; that of each turn's first run,
when the caches hold another contender's data, is told beside it.

    ours      solve(graph, method="newton"), checks, rigidity and certificate included, to a certified 1e-8
    cvxpy     the program as a user would write it (`solve_cvxpy`), cvxpy's own compilation included
    Clarabel  called directly on cones of 2 rows (`clarabel_direct`), building its matrices included

Both rivals start from Clarabel's default tolerances, 1e-8, which are tightened tenfold, before the clock
runs, until their objective is within 1e-8 of a rigorous lower bound: of what ours promises, the primal
half.

Real graphs: the largest rigid piece that `locate` finds, directions from matches and known rotations. Once of
the cameras alone, as when the limits were measured; once with the 3D points that `locate` joins by default,
several times as many nodes: no limit of time was measured on those.
"""

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.graphs import GraphSpec, draw, relative_error, view_graph
from benchmarks.metrics import Check, Quantity, median, number, numbers, ratio, times, verdict
from benchmarks.process import call, thread_environment
from benchmarks.real import SCENES
from benchmarks.record import environment, legend, table, write_section

if TYPE_CHECKING:
    from sfm_shapefit import SolverResult, ViewGraph
    from sfm_shapefit.arrays import FloatArray
    from sfm_shapefit.options import Points

HELP = "The Newton solver against cvxpy and Clarabel on G(n, 1/2), and on real graphs."
ROOT = Path(__file__).parents[2]
PACKAGES = ("numpy", "scipy", "numba", "cvxpy", "clarabel")

TOL = 1e-8
SIGMAS = (0.0, 0.05)
CORRUPTED = 0.25
REPEATS = {50: 15, 100: 9, 200: 5, 300: 3, 500: 2}
TURN_S, BURST = 0.05, 2  # a turn lasts so long, and for so many runs at least
TARGETS = {
    50: ((30.0, 18.0), (15.0, 9.0)),
    100: ((55.0, 35.0), (25.0, 12.0)),
    200: ((45.0, 28.0), (17.0, 13.0)),
    300: ((40.0, 23.0), (24.0, 13.0)),
    500: ((30.0, 18.0), (22.0, 13.0)),
}
"""Ratios to reach: to cvxpy and to Clarabel called directly, each at the two noise levels."""
REAL_LIMITS = {"gap": 1e-8, "factorisations": 21.0, "ms": 32.0}
"""Of graphs of cameras alone; those with points have no limit of time."""
REAL_REPEATS = 9
POINTS: "tuple[Points, ...]" = ("never", "always")
_TIGHTEST = 1e-13


@dataclass(frozen=True, slots=True, kw_only=True)
class Contender:
    """What one solver did on one problem."""

    name: str
    tolerance: float
    wall_s: tuple[float, ...] = ()
    cpu_s: tuple[float, ...] = ()
    first_s: tuple[float, ...] = ()
    """Wall-clock of the first run of each turn."""
    error: float = math.nan
    """Against the truth."""
    excess: float = math.nan
    """Objective above the best rigorous bound known."""
    gap: float = math.nan
    """Proved by `certify` from the contender's own dual; NaN if it gives none."""
    iterations: int = 0
    failure: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """One random problem and its contenders, ours first."""

    spec: GraphSpec
    num_edges: int
    contenders: tuple[Contender, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class RealGraph:
    """One real graph, solved by `auto`."""

    name: str
    num_cameras: int
    num_points: int
    """3D points among its nodes."""
    num_edges: int
    method: str
    converged: bool
    objective: float
    gap: float
    factorisations: int
    wall_s: tuple[float, ...]
    newton_s: tuple[float, ...]
    distance: float
    """From the locations of a solve to a gap of 1e-11, by the paper's error."""


QUANTITIES = (
    Quantity(
        name="ours, cvxpy, Clarabel",
        unit="ms",
        better="lower",
        rel_tol=0.5,
        meaning="wall-clock, median of the repeats",
    ),
    Quantity(
        name="first",
        unit="ms",
        better="lower",
        rel_tol=0.5,
        meaning="the same of the first runs of the turns: another contender's data fill the caches",
    ),
    Quantity(name="CPU", unit="ms", better="lower", rel_tol=0.25, meaning="the same in processor time"),
    Quantity(
        name="ratio",
        unit="1",
        better="higher",
        rel_tol=0.3,
        meaning="the rival's median over ours; the limit applies to wall-clock",
    ),
    Quantity(
        name="excess",
        unit="1",
        better="lower",
        rel_tol=1.0,
        meaning="objective above the best rigorous lower bound, in the scale of `SolverResult.objective`",
    ),
    Quantity(
        name="certified gap",
        unit="1",
        better="lower",
        rel_tol=1.0,
        meaning="what `certify` proves from the solver's own dual; cvxpy's form gives no dual of the edges",
    ),
    Quantity(
        name="error",
        unit="1",
        better="lower",
        rel_tol=0.01,
        meaning="against the truth, both centred and of unit norm",
    ),
)


# --- the subcommand --------------------------------------------------------------------------------


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `solver`."""
    known = ",".join(map(str, TARGETS))
    parser.add_argument(
        "--sizes", type=sizes, default=list(TARGETS), help=f"of the random graphs (default {known})"
    )
    parser.add_argument(
        "--repeats", type=int, default=None, help="turns of each contender (default 15 to 2 by size)"
    )
    parser.add_argument("--no-real", action="store_true", help="leave the real graphs out")
    parser.add_argument(
        "--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the sets"
    )
    parser.add_argument("--out", type=Path, default=ROOT / "scripts" / "results.md", help="file of results")


def sizes(text: str) -> list[int]:
    """Parse `--sizes`."""
    found = [int(word) for word in text.split(",") if word.strip().isdecimal()]
    if not found or len(found) != len(text.split(",")) or min(found) < 4:
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of sizes of 4 or more, such as 50,100")
    return list(dict.fromkeys(found))


def run(args: argparse.Namespace) -> int:
    """Measure, print the section and write it; a missed limit is no failure."""
    about = environment(PACKAGES, command_line(args))
    one_thread = thread_environment(1)
    cold = _cold_s(one_thread)
    compared = []
    for n in args.sizes:
        for sigma in SIGMAS:
            spec = GraphSpec(family="er2", n=n, sigma=sigma, q=CORRUPTED)
            print(f"measuring {spec}", file=sys.stderr, flush=True)
            repeats = args.repeats or REPEATS.get(n, 3)
            compared.append(call(compare, spec, repeats, environment=one_thread))
    real, skipped = ([], ["real graphs: left out"]) if args.no_real else _real_graphs(args.data, one_thread)
    body = section(compared, real, about, cold, skipped)
    print(body)
    write_section(args.out, "solver", body)
    return 0


def command_line(args: argparse.Namespace) -> str:
    """Return the command that repeats the measurement, without paths."""
    chosen = "" if args.sizes == list(TARGETS) else f" --sizes {','.join(map(str, args.sizes))}"
    repeats = f" --repeats {args.repeats}" if args.repeats else ""
    return f"python scripts/benchmark.py solver{chosen}{repeats}{' --no-real' if args.no_real else ''}"


def _cold_s(one_thread: dict[str, str]) -> tuple[float, float]:
    """Return the seconds of a first solve in a fresh process: compiled code on disk, and nothing compiled."""
    call(first_solve, environment=one_thread)  # fills the cache
    loaded = call(first_solve, environment=one_thread)
    with tempfile.TemporaryDirectory() as folder:
        compiled = call(first_solve, environment=one_thread | {"NUMBA_CACHE_DIR": folder})
    return loaded, compiled


def first_solve() -> float:
    """Return the seconds of imports and a small problem's solve; to be called once per process."""
    start = time.perf_counter()
    solve_ours(view_graph(draw(GraphSpec(family="er2", n=50, q=CORRUPTED))), TOL)
    return time.perf_counter() - start


def _real_graphs(data: Path, one_thread: dict[str, str]) -> tuple[list[RealGraph], list[str]]:
    """Measure every real graph; return what was found, and why sets are missing."""
    measured, skipped = [], []
    for name in SCENES:
        if not (data / name / "sparse" / "0").is_dir():
            skipped.append(f"{name}: not found, give its folder's parent with --data")
            continue
        print(f"measuring {name}", file=sys.stderr, flush=True)
        for points in POINTS:
            try:
                measured.append(call(measure_real, name, data / name, points, environment=one_thread))
            except RuntimeError as error:
                skipped.append(f"{name}, points {points}: {error}")
    return measured, skipped


# --- measuring -------------------------------------------------------------------------------------


def solve_ours(graph: "ViewGraph", tol: float, method: str = "newton") -> "SolverResult":
    """Solve and certify with our solver."""
    from sfm_shapefit import SolverOptions, solve

    return solve(graph, SolverOptions(solver=method, tol=tol, uniqueness=False))  # type: ignore[arg-type]


def solve_cvxpy(graph: "ViewGraph", tol: float) -> tuple["FloatArray", int]:
    """Write the program down as in the paper, with a scale near 1, and let cvxpy and Clarabel solve it."""
    import cvxpy as cp

    v, m = graph.directions, graph.num_edges
    t = cp.Variable((graph.num_nodes, graph.dimension))
    baselines = t[graph.edges[:, 0]] - t[graph.edges[:, 1]]
    lengths = cp.sum(cp.multiply(v, baselines), axis=1)
    residuals = baselines - cp.multiply(v, cp.reshape(lengths, (m, 1), order="C"))
    problem = cp.Problem(
        cp.Minimize(cp.sum(cp.norm(residuals, 2, axis=1))),
        [cp.sum(lengths) == m, cp.sum(t, axis=0) == 0],
    )
    problem.solve(solver=cp.CLARABEL, tol_gap_abs=tol, tol_gap_rel=tol, tol_feas=tol, max_threads=1)
    return t.value, int(problem.solver_stats.num_iters)


def compare(spec: GraphSpec, repeats: int) -> Compared:
    """Measure the three contenders on one problem; to be called in a process of one thread."""
    from benchmarks.clarabel_direct import solve_direct

    problem = draw(spec)
    graph = view_graph(problem)
    bound = solve_ours(graph, 1e-3 * TOL).dual_bound

    def ours(tol: float) -> tuple["FloatArray", "FloatArray | None", int]:
        found = solve_ours(graph, tol)
        return found.locations, found.dual, found.iterations

    def cvxpy(tol: float) -> tuple["FloatArray", "FloatArray | None", int]:
        locations, iterations = solve_cvxpy(graph, tol)
        return locations, None, iterations

    def direct(tol: float) -> tuple["FloatArray", "FloatArray | None", int]:
        found = solve_direct(graph, tol)
        return found.locations, found.dual, found.iterations

    solvers = {"ours": ours, "cvxpy + Clarabel": cvxpy, "Clarabel directly": direct}
    tuned = {name: _tuned(name, solver, graph, problem.locations, bound) for name, solver in solvers.items()}
    turns: dict[str, list[list[tuple[float, float]]]] = {name: [] for name in solvers}
    for name in [name for _ in range(repeats) for name in solvers if not tuned[name].failure]:
        turns[name].append(_turn(solvers[name], tuned[name].tolerance))
    contenders = tuple(_with_times(tuned[name], turns[name]) for name in solvers)
    return Compared(spec=spec, num_edges=graph.num_edges, contenders=contenders)


def _tuned(
    name: str,
    solver: Callable[[float], tuple["FloatArray", "FloatArray | None", int]],
    graph: "ViewGraph",
    truth: "FloatArray",
    bound: float,
) -> Contender:
    """Return the contender at the loosest tolerance that brings it within TOL of the bound. A warm-up too."""
    from sfm_shapefit import certify
    from sfm_shapefit.solver.program import objective

    tol, best = TOL, Contender(name=name, tolerance=TOL, failure="no answer")
    while tol > _TIGHTEST:
        try:
            locations, dual, iterations = solver(tol)
        except Exception as error:  # whatever a library raises is an answer, to be shown as such
            reason = " ".join(str(error).split())[:200]
            return best if not best.failure else Contender(name=name, tolerance=tol, failure=reason)
        if locations is None:
            return best
        centred = locations - locations.mean(axis=0)
        proved = math.nan if dual is None else certify(graph, centred, dual, uniqueness=False).gap
        found = Contender(
            name=name,
            tolerance=tol,
            error=relative_error(locations, truth),
            excess=objective(graph, locations) - bound,
            gap=proved,
            iterations=iterations,
        )
        if best.failure or found.excess < best.excess:
            best = found
        if found.excess <= TOL:
            break
        tol /= 10.0
    return best


def _turn(solver: Callable[[float], object], tol: float) -> list[tuple[float, float]]:
    """Run a solver for TURN_S, BURST times at least; return the wall-clock and CPU seconds of each run."""
    runs: list[tuple[float, float]] = []
    while len(runs) < BURST or sum(wall for wall, _ in runs) < TURN_S:
        start, cpu_start = time.perf_counter(), time.process_time()
        solver(tol)
        runs.append((time.perf_counter() - start, time.process_time() - cpu_start))
    return runs


def _with_times(contender: Contender, turns: Sequence[Sequence[tuple[float, float]]]) -> Contender:
    runs = [run for turn in turns for run in turn]
    return replace(
        contender,
        wall_s=tuple(wall for wall, _ in runs),
        cpu_s=tuple(cpu for _, cpu in runs),
        first_s=tuple(turn[0][0] for turn in turns),
    )


def measure_real(name: str, folder: Path, points: "Points") -> RealGraph:
    """Solve the graph of a real set, with points or without; to be called in a process of one thread."""
    from sfm_shapefit import LocateOptions, Status, locate

    placement = locate(folder / "sparse" / "0", options=LocateOptions(points=points)).placement
    graph, nodes = placement.graph.restricted_to(placement.edges)
    num_points = int((nodes >= placement.num_cameras).sum())
    tight = solve_ours(graph, 1e-11)
    found = solve_ours(graph, TOL, "auto")  # a warm-up too
    wall: dict[str, list[float]] = {"auto": [], "newton": []}
    for _ in range(REAL_REPEATS):
        for method, seconds in wall.items():
            start = time.perf_counter()
            solve_ours(graph, TOL, method)
            seconds.append(time.perf_counter() - start)
    return RealGraph(
        name=name,
        num_cameras=graph.num_nodes - num_points,
        num_points=num_points,
        num_edges=graph.num_edges,
        method=found.method,
        converged=found.status is Status.CONVERGED,
        objective=found.objective,
        gap=found.gap,
        factorisations=found.iterations + 1,  # Newton's start factors the projected Laplacian
        wall_s=tuple(wall["auto"]),
        newton_s=tuple(wall["newton"]),
        distance=relative_error(found.locations, tight.locations),
    )


# --- what is to be reached -------------------------------------------------------------------------


def wall_ratio(one: Compared, rival: int) -> float:
    """Return how many times longer a rival takes; NaN if it failed."""
    return ratio(median(one.contenders[rival].wall_s), median(one.contenders[0].wall_s))


def cpu_ratio(one: Compared, rival: int) -> float:
    """Return how many times more processor time a rival takes; NaN if it failed."""
    return ratio(median(one.contenders[rival].cpu_s), median(one.contenders[0].cpu_s))


def ratio_checks(one: Compared) -> list[Check]:
    """Return the checks of one problem: our certified gap, and the ratio to each rival."""
    if one.spec.n not in TARGETS:
        return []
    ours = one.contenders[0]
    level = SIGMAS.index(one.spec.sigma)
    limits = [targets[level] for targets in TARGETS[one.spec.n]]
    return [
        Check(name="gap", value=ours.gap, limit=TOL),
        *(
            Check(name=one.contenders[k].name, value=wall_ratio(one, k), limit=limit, better="higher")
            for k, limit in enumerate(limits, start=1)
        ),
    ]


def real_checks(one: RealGraph) -> list[Check]:
    """Return the checks of one real graph: of time only without points."""
    values = {"gap": one.gap, "factorisations": one.factorisations}
    if one.num_points == 0:
        values["ms"] = 1e3 * median(one.wall_s)
    return [Check(name=name, value=value, limit=REAL_LIMITS[name]) for name, value in values.items()]


# --- the section -----------------------------------------------------------------------------------


def section(
    compared: Sequence[Compared],
    real: Sequence[RealGraph],
    about: str,
    cold: tuple[float, float],
    skipped: Sequence[str],
) -> str:
    """Return the section of the file of results."""
    checks = [c for one in compared for c in ratio_checks(one)] + [c for r in real for c in real_checks(r)]
    loaded, compiled = cold
    parts = [
        "## The solver against a generic cone solver",
        about
        + "- Threads: 1 (OPENBLAS_NUM_THREADS and its like = 1 before numpy is loaded), all contenders\n"
        "- Every contender is warmed up before the clock runs. A cold process, imports included, takes"
        f" {number(loaded)} s to its first answer, and {number(compiled)} s where nothing is compiled yet.",
        f"**{sum(check.met for check in checks)} of {len(checks)} limits met.**",
        f"### G(n, 1/2), q = {CORRUPTED:g}, to a certified gap of {TOL:.0e}",
        _ratio_table(compared),
        "### The same in detail",
        _detail_table(compared),
    ]
    if real:
        parts += [
            f"### Real graphs, directions from known rotations, `auto`\n\n{_REAL_NOTE}",
            _real_table(real),
        ]
    if skipped:
        parts.append("Skipped: " + "; ".join(skipped) + ".")
    parts += ["### What the columns mean", legend(QUANTITIES), _CAVEATS]
    return "\n\n".join(part.strip() for part in parts)


_REAL_NOTE = (
    "Factorisations are the Newton steps and the one of the start. The distance is that of `auto`'s locations"
    " from those of a gap of 1e-11: what is lost by stopping where it stops. The limits were measured on"
    " graphs of cameras alone: those have a limit of 32 ms. The same graphs with the points that"
    " `locate` joins are several times larger and have none."
)
_CAVEATS = (
    "Caveats: the optimum need not be the truth: at n = 50 and this share of random directions, a camera may"
    " well have nearly as many wrong as right ones, and then every contender has the same error. A rival is"
    " tuned by its objective alone, so its own dual may prove less than ours; see its certified gap. Where"
    " the load average is above the number of cores, times are upper bounds; the ratios hold better, since"
    " the contenders take turns."
)


def _limit_cell(one: Compared, rival: int) -> str:
    checks = ratio_checks(one)
    return "-" if not checks else f"{checks[rival].limit:g}x"


def _ratio_table(compared: Sequence[Compared]) -> str:
    rows = []
    for one in compared:
        ours, cvxpy, direct = (number(1e3 * median(c.wall_s)) for c in one.contenders)
        rows.append(
            [
                f"{one.spec.n}",
                f"{one.num_edges}",
                f"{one.spec.sigma:g}",
                ours,
                cvxpy,
                direct,
                times(wall_ratio(one, 1)),
                _limit_cell(one, 1),
                times(wall_ratio(one, 2)),
                _limit_cell(one, 2),
                f"{times(cpu_ratio(one, 1))} / {times(cpu_ratio(one, 2))}",
                verdict(ratio_checks(one)),
            ]
        )
    header = [
        "n",
        "pairs",
        "sigma",
        "ours, ms",
        "cvxpy, ms",
        "Clarabel, ms",
        "ratio to cvxpy",
        "to reach",
        "ratio to Clarabel",
        "to reach",
        "CPU ratios",
        "verdict",
    ]
    return table(header, rows)


def _detail_table(compared: Sequence[Compared]) -> str:
    rows = []
    for one in compared:
        for contender in one.contenders:
            milliseconds = [1e3 * seconds for seconds in contender.wall_s]
            rows.append(
                [
                    f"{one.spec.n}, sigma {one.spec.sigma:g}",
                    contender.name + (f": {contender.failure}" if contender.failure else ""),
                    f"{contender.tolerance:.0e}",
                    f"{contender.iterations}",
                    f"{len(milliseconds)}",
                    numbers([min(milliseconds), max(milliseconds)]) if milliseconds else "-",
                    number(1e3 * median(contender.first_s)),
                    number(1e3 * median(contender.cpu_s)),
                    number(contender.excess),
                    number(contender.gap),
                    number(contender.error),
                ]
            )
    header = [
        "problem",
        "contender",
        "tolerance",
        "iterations",
        "repeats",
        "min / max, ms",
        "first, ms",
        "CPU, ms",
        "excess",
        "certified gap",
        "error",
    ]
    return table(header, rows)


def _real_table(real: Sequence[RealGraph]) -> str:
    rows = [
        [
            one.name,
            f"{one.num_cameras}",
            f"{one.num_points}",
            f"{one.num_edges}",
            one.method,
            number(one.objective),
            f"{one.gap:.0e}" + ("" if one.converged else " (not converged)"),
            f"{one.factorisations}",
            number(1e3 * median(one.wall_s)),
            number(1e3 * median(one.newton_s)),
            number(one.distance),
            verdict(real_checks(one)),
        ]
        for one in real
    ]
    header = [
        "set",
        "cameras",
        "points",
        "pairs",
        "method",
        "objective",
        "certified gap",
        "factorisations",
        "ms",
        "ms, newton",
        "distance",
        "verdict",
    ]
    return table(header, rows)
