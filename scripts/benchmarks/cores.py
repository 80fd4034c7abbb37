"""`map` and `locate` on 1, 2, 4, ... cores, beside pycolmap's global mapper on as many.

Each run is a process of its own that may use so many cores and no other, with as many threads; imports,
reading and writing are included, kernels are compiled before. Every 20 ms its threads are looked at. CPU time
in which two or more are runnable, on a core or waiting for one, is parallel: other work on the machine makes
a run longer, and hardly changes this share. The bound is what 16 cores could reach if that share were divided
perfectly.
"""

import argparse
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from statistics import median
from typing import NamedTuple

from harness.driver import ROOT, Benchmark, Case, if_there, positive
from harness.process import call, children_cpu_s, thread_environment
from harness.record import Check, Row, at_least, at_most, ratio

OURS, PEER, PEER_MATCHES = "sfm-shapefit", "pycolmap's global mapper", 15
EVERY_S = 0.02  # between two looks at the threads
FAR = 16  # cores of the bound
SETS = ("fountain-P11", "Herz-Jesus-P8", "Herz-Jesus-P25", "castle-P19", "castle-P30", "lego100")
TOWER = "further: tower"  # a scene of the benchmark `map`
SIZES = (1000, 2500)
PEER_RATIO = 0.3
"""Of the wall time of `map` to that of the global mapper, with two cores."""
OF_ONE = {
    "Herz-Jesus-P8, map": 0.95,
    "castle-P30, map": 0.8,
    "lego100, map": 0.7,
    "facade 1000, map": 0.6,
    "facade 2500, map": 0.6,
    "facade 10000, locate": 0.6,
}
"""Wall time with two cores to reach, over that with one."""
PARALLEL = {"facade 1000, map": 0.85, "facade 2500, map": 0.85, "facade 10000, locate": 0.8}
"""Share of the CPU time to reach."""


class Spent(NamedTuple):
    """What one run took."""

    wall_s: float
    cpu_s: float
    parallel: float
    """Share of the CPU time; NaN where the system does not tell the states of threads."""


class Watch:
    """Looks at the threads of a process, and divides its CPU time by how many of them are runnable."""

    def __init__(self, pid: int) -> None:
        self.stage = "imports"
        self.ticks: dict[str, list[int]] = defaultdict(lambda: [0, 0])
        """CPU time by stage, in ticks of the system: with at most one thread runnable, and with more."""
        self._folder, self._before = Path(f"/proc/{pid}"), 0
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Look no more."""
        self._is_over.set()
        self._thread.join()

    def share(self, stages: Sequence[str] | None = None) -> float:
        """Return the parallel share of the CPU time of some stages, or of all."""
        chosen = [ticks for stage, ticks in self.ticks.items() if stages is None or stage in stages]
        return ratio(sum(ticks[1] for ticks in chosen), sum(map(sum, chosen)))

    def _look(self) -> None:
        own = threading.get_native_id()  # of the process that is watched, where that is this one
        while not self._is_over.wait(EVERY_S):
            try:
                now = sum(map(int, _fields(self._folder)[11:13]))
                tasks = [task for task in (self._folder / "task").iterdir() if task.name != str(own)]
                running = sum(_fields(task)[0] == "R" for task in tasks)
            except OSError:  # it, or one of its threads, has just ended
                continue
            self.ticks[self.stage][running > 1] += now - self._before
            self._before = now


def _fields(folder: Path) -> list[str]:
    """Return the fields of a process or thread after its name, which may have blanks in it."""
    return (folder / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()


@contextmanager
def on_cores(count: int) -> Iterator[None]:
    """Let processes that begin within use so many cores, where the system can hold them to that."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    every = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(every)[:count])
    try:
        yield
    finally:
        os.sched_setaffinity(0, every)


def flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--cores", type=positive, nargs="+", help="numbers of cores (1, 2, 4, ... all)")
    parser.add_argument("--images", type=positive, nargs="*", default=list(SIZES), help="of made facades")
    parser.add_argument("--located", type=positive, nargs="*", default=[10_000], help="of those to locate")
    parser.add_argument("--folder", type=Path, help="where made scenes are kept (a temporary folder)")
    parser.add_argument("--no-peers", action="store_true", help="leave out pycolmap's mapper: it takes long")
    parser.add_argument("--limit", type=positive, default=1800, help="seconds after which it is ended")


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the real sets and the made facades, to be mapped or to be located."""
    if args.quick:
        return {"ring8, map": partial(measure_set, "ring8, map", ROOT / "data_synthetic/ring8", args)}
    made = {f"facade {size}, map": size for size in args.images}
    made |= {f"facade {size}, locate": size for size in args.located}
    found: dict[str, Case] = {}
    for name in SETS:
        folder = args.data / name
        found[f"{name}, map"] = if_there(folder, partial(measure_set, f"{name}, map", folder, args))
    found["tower, map"] = partial(measure_tower, "tower, map", args)
    return found | {name: partial(measure_facade, name, size, args) for name, size in made.items()}


def counts(args: argparse.Namespace) -> list[int]:
    """Return the numbers of cores, ascending."""
    most = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    powers = [2**k for k in range(most.bit_length()) if 2**k <= most]
    return sorted({count for count in args.cores or [*powers, most] if count <= most})


def measure_facade(name: str, size: int, args: argparse.Namespace) -> list[Row]:
    """Make a facade, if the folder has none of its size, and measure it."""
    from benchmarks.endtoend import facade
    from harness.process import run_command

    with tempfile.TemporaryDirectory() as temporary:
        folder = (args.folder or Path(temporary)) / f"facade{size}"
        if not folder.exists():
            run_command("synth", folder, *facade(size).split())
        return measure_set(name, folder, args)


def measure_tower(name: str, args: argparse.Namespace) -> list[Row]:
    """Photograph the tower, if the folder has none, and measure it."""
    from benchmarks.map import make_scene

    with tempfile.TemporaryDirectory() as temporary:
        return measure_set(name, make_scene(TOWER, args.folder or Path(temporary)), args)


def measure_set(name: str, folder: Path, args: argparse.Namespace) -> list[Row]:
    """Run our command and the peer with all numbers of cores, and look at the stages of one run."""
    command = name.rpartition(" ")[2]
    given = folder / "database.db" if command == "map" else folder / "sparse" / "0"
    run_ours(command, given, 1)  # compiles
    ours, peers = dict[int, Spent](), dict[int, Spent]()
    for count in counts(args):
        ours[count] = typical([run_ours(command, given, count) for _ in range(args.repeats)])
    for count in [] if args.no_peers or args.quick or command != "map" else counts(args):
        ask = partial(call, run_peer, given, count, environment=thread_environment(count))
        try:
            with on_cores(count):
                peers[count] = typical([ask(timeout_s=args.limit) for _ in range(args.repeats)])
        except (RuntimeError, TimeoutError) as error:
            print(f"{name}, {count} cores, {PEER}: {error}", file=sys.stderr)
            break  # fewer cores take no longer than this
    most = max(ours)
    with on_cores(most):
        stages = call(look_at_stages, command, given, most, environment=thread_environment(1))
    return [*rows_of(name, OURS, ours, peers), *rows_of(name, PEER, peers), *rows_of_stages(name, stages)]


def typical(runs: Sequence[Spent]) -> Spent:
    """Return the medians of some runs."""
    return Spent(*(median(values) for values in zip(*runs, strict=True)))


def run_ours(command: str, given: Path, count: int) -> Spent:
    """Run a command line on so many cores, and watch it."""
    with tempfile.TemporaryDirectory() as out:
        words = [command, given, Path(out) / "out", "--threads", count, "--quiet"]
        before, start = children_cpu_s(), time.perf_counter()
        with on_cores(count):
            process = subprocess.Popen(
                [sys.executable, "-m", "sfm_shapefit", *map(str, words)],
                env=os.environ | thread_environment(1),  # as the command line has it; threads of BLAS idle
                cwd=ROOT,
            )
        watch = Watch(process.pid)
        code, wall_s = process.wait(), time.perf_counter() - start
        watch.close()
    if code:
        raise RuntimeError(f"{command} ended with code {code}")
    return Spent(wall_s, children_cpu_s() - before, watch.share())


def run_peer(database: Path, count: int) -> Spent:
    """Run pycolmap's global mapper with so many threads; in a process of its own."""
    start, watch = time.perf_counter(), Watch(os.getpid())
    from paper.colmap_peer import map_database
    from sfm_shapefit.files.colmap.quiet import quiet_stderr

    with quiet_stderr():
        map_database(database, PEER_MATCHES, num_threads=count)
    spent = time.perf_counter() - start, time.process_time()
    watch.close()
    return Spent(*spent, watch.share())


def look_at_stages(command: str, given: Path, count: int) -> dict[str, tuple[float, float]]:
    """Return the CPU seconds and the parallel share of each stage of a run; in a process of its own."""
    watch = Watch(os.getpid())
    import sfm_shapefit

    def tell(stage: str, _done: int, _total: int) -> None:
        watch.stage = stage

    run = {"map": sfm_shapefit.map_database, "locate": sfm_shapefit.locate}[command]
    found = run(given, threads=count, progress=tell)
    watch.stage = "write"
    with tempfile.TemporaryDirectory() as out:
        sfm_shapefit.write_result(found, Path(out) / "out")
    watch.close()
    second = os.sysconf("SC_CLK_TCK")
    return {stage: (sum(ticks) / second, watch.share([stage])) for stage, ticks in watch.ticks.items()}


def rows_of(
    name: str, contender: str, runs: dict[int, Spent], peers: dict[int, Spent] | None = None
) -> Iterator[Row]:
    """Yield a row for each number of cores; ours, which have `peers`, with what they have to reach."""
    for count, spent in runs.items():
        of_one = ratio(spent.wall_s, runs[1].wall_s) if 1 in runs else math.nan
        checks: list[Check] = []
        if peers is not None and count == 2:
            checks = at_most(of_one_core=(of_one, OF_ONE.get(name)))
            if count in peers:
                checks += at_most(of_the_peer=(ratio(spent.wall_s, peers[count].wall_s), PEER_RATIO))
            checks += at_least(parallel=(spent.parallel, PARALLEL.get(name)))
        cells = {
            "run": name,
            "contender": contender,
            "cores": count,
            "wall s": spent.wall_s,
            "of one core": of_one,
            "CPU s": spent.cpu_s,
            "parallel": spent.parallel if count > 1 else math.nan,
            "bound": 1.0 / (1.0 - spent.parallel * (1.0 - 1.0 / FAR)) if count > 1 else math.nan,
        }
        yield Row(cells, checks, "Runs")


def rows_of_stages(name: str, stages: dict[str, tuple[float, float]]) -> Iterator[Row]:
    """Yield a row for each stage."""
    for stage, (cpu_s, parallel) in stages.items():
        cells = {"run": name, "stage": stage, "CPU s": cpu_s, "parallel": parallel}
        yield Row(cells, (), "Stages, with all cores")


BENCHMARK = Benchmark(
    name="cores",
    title="cores: wall time on 1, 2, 4, ... cores",
    cases=cases,
    flags=flags,
    packages=("numpy", "numba", "pycolmap"),
    quick={"cores": [1, 2]},
    notes={
        "": "A process each, which may use so many cores and no other, with as many threads; kernels are"
        " compiled before. CPU time in which two or more threads are runnable is parallel: other work on the"
        " machine makes a wall time longer, and hardly changes this share."
    },
    columns={
        "wall": "s; time of the whole process, imports, reading and writing included",
        "of one core": "1; wall time over that with one core",
        "CPU": "s; time of all its threads",
        "parallel": "1; share of the CPU time in which two or more threads are runnable",
        "bound": f"1; how much faster than one core {FAR} could be if that share were divided perfectly",
    },
)
