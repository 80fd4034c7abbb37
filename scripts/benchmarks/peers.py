"""Peers side by side: bare graphs per family and real scenes per set, in one run and one table.

pytheia and gtsam are optional (the extra `peers`); without them their rows say so. What contenders get, and
with which options, is said in `paper.peers_on_graphs` and `paper.peers_on_scenes`. A failure is a row of the
table like any other.
"""

import argparse
import math
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

from benchmarks.real import SCENES, Scene, show_errors
from harness.driver import Benchmark, Case, if_there, positive
from harness.graphs import GraphSpec, draw
from harness.metrics import Check, Quantity, number, verdict
from harness.process import call, thread_environment
from harness.record import table
from paper import peers_on_graphs as on_graphs
from paper import peers_on_scenes as on_scenes

CPU_LIMIT_S = 150
QUICK = GraphSpec(family="er2", n=20, sigma=0.01)


class OnScene(NamedTuple):
    """All contenders on a real scene."""

    scene: Scene
    rows: tuple[on_graphs.Answer, ...]


def flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--cpu-limit", type=positive, default=CPU_LIMIT_S, help="seconds of CPU time per answer"
    )


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the graphs and the real scenes."""
    graphs = {"er2-20": QUICK} if args.quick else on_graphs.PROBLEMS
    found: dict[str, Case] = {
        name: partial(measure_graph, name, spec, args.cpu_limit) for name, spec in graphs.items()
    }
    for name, scene in {} if args.quick else SCENES.items():
        folder = args.data / name
        found[name] = if_there(folder, partial(measure_scene, scene, folder, args.cpu_limit))
    return found


def measure_graph(name: str, spec: GraphSpec, cpu_limit_s: int) -> on_graphs.Compared:
    """Run all contenders on a graph, ours once before, so that no process that is measured compiles."""
    for contender in on_graphs.CONTENDERS:
        if contender.package is None:
            call(on_graphs.measure, contender.name, QUICK, environment=thread_environment(1))
    answers = tuple(on_graphs.answer(one, spec, cpu_limit_s) for one in on_graphs.CONTENDERS)
    return on_graphs.Compared(name=name, num_edges=len(draw(spec).edges), answers=answers)


def measure_scene(scene: Scene, folder: Path, cpu_limit_s: int) -> OnScene:
    """Run all contenders on a real scene, after the directions that peers get; those compile our code."""
    directions: on_scenes.Directions | str
    try:
        directions = call(on_scenes.measure_directions, folder, environment=thread_environment(1))
    except RuntimeError as error:
        directions = str(error)
    names = on_scenes.contenders()
    rows = tuple(on_scenes.answer(name, folder, scene, directions, cpu_limit_s) for name in names)
    return OnScene(scene=scene, rows=rows)


def checks(one: on_graphs.Compared | OnScene) -> list[Check]:
    """Return the limits of one graph or scene."""
    return on_scenes.checks(one.rows) if isinstance(one, OnScene) else on_graphs.checks(one)


def tables(measured: Mapping[str, on_graphs.Compared | OnScene], args: argparse.Namespace) -> Iterator[str]:
    yield (
        f"A fresh process each on one thread, ended after {args.cpu_limit} s of CPU time, imports included;"
        " our code is warmed up first, so that nothing is compiled while the clock runs. Graphs: our best"
        " answer has the lowest error, and takes"
        f" {on_graphs.FASTER:g} times less CPU time than the fastest peer of equal or lower error, if any."
        " Scenes: by default `locate` has a median and a mean error at most 5 % above the lowest of the"
        " peers' positions; mapping, which ends with bundle adjustment, is shown only."
    )
    yield table(
        ["problem", "verdict"], [[name, verdict(checks(one)) or "-"] for name, one in measured.items()]
    )
    yield table(
        ["problem", "contender", "error", "seconds (CPU)", "peak MB", "note"],
        [row for one in measured.values() for row in _rows(one)],
    )


def _rows(one: on_graphs.Compared | OnScene) -> Iterator[list[str]]:
    for answer in one.rows if isinstance(one, OnScene) else one.answers:
        if isinstance(one, OnScene):
            problem, error = one.scene.label, show_errors(answer.error)
        else:
            problem, error = f"{one.name} ({one.num_edges} pairs)", number(answer.error)
        cpu = f" ({number(answer.cpu_s)})" if math.isfinite(answer.cpu_s) else ""
        peak = f"{answer.peak_mb:.0f}".replace("nan", "-")
        yield [problem, answer.name, error, number(answer.seconds) + cpu, peak, answer.note]


BENCHMARK = Benchmark(
    name="peers",
    title="Peers",
    cases=cases,
    checks=checks,
    tables=tables,
    flags=flags,
    packages=("numpy", "scipy", "numba", "pycolmap", "pytheia", "gtsam"),
    quick={"cpu_limit": 60},
    quantities=(
        Quantity(
            *("error", "1 on graphs, the set's on scenes", "lower", 0.05),
            "graphs: both centered and of unit norm; scenes: median / mean / max after L1 alignment",
        ),
        Quantity(
            *("seconds (CPU)", "s", "lower", 0.5),
            "of the call that turns directions, tracks or (mapping) a database into positions; for"
            " `locate`, wall-clock of placing and judging, for positioning without its tracks",
        ),
        Quantity("peak MB", "10^6 bytes", "lower", 0.1, "resident, of the whole process while the clock ran"),
    ),
)
