"""Peers side by side: bare graphs per family and real scenes per set, in one run and one table.

pytheia and gtsam are optional (the extra `peers`); without them their rows say so. What contenders get, and
with which options, is said in `paper.peers_on_graphs` and `paper.peers_on_scenes`. A failure is a row of the
table like any other.
"""

import argparse
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from benchmarks.real import SCENES, Scene
from harness.driver import Benchmark, Case, if_there, positive
from harness.graphs import GraphSpec, draw
from harness.process import call, thread_environment
from harness.record import Check, Row, number
from paper import peers_on_graphs as on_graphs
from paper import peers_on_scenes as on_scenes

QUICK = GraphSpec("er2", n=20, sigma=0.01)


def flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--cpu-limit", type=positive, default=150, help="seconds of CPU time per answer")


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the graphs and the real scenes."""
    graphs = {"er2-20": QUICK} if args.quick else on_graphs.PROBLEMS
    found: dict[str, Case] = {n: partial(measure_graph, n, g, args.cpu_limit) for n, g in graphs.items()}
    for name, scene in {} if args.quick else SCENES.items():
        folder = args.data / name
        found[name] = if_there(folder, partial(measure_scene, scene, folder, args.cpu_limit))
    return found


def measure_graph(name: str, spec: GraphSpec, cpu_limit_s: int) -> list[Row]:
    """Run all contenders on a graph, ours once before, so that no process that is measured compiles."""
    for contender in on_graphs.CONTENDERS:
        if contender.package is None:
            call(on_graphs.measure, contender.name, QUICK, environment=thread_environment(1))
    answers = [on_graphs.answer(one, spec, cpu_limit_s) for one in on_graphs.CONTENDERS]
    return show(f"{name} ({len(draw(spec).edges)} pairs)", answers, on_graphs.checks(answers))


def measure_scene(scene: Scene, folder: Path, cpu_limit_s: int) -> list[Row]:
    """Run all contenders on a real scene, after the directions that peers get; those compile our code."""
    directions: on_scenes.Directions | str
    try:
        directions = call(on_scenes.measure_directions, folder, environment=thread_environment(1))
    except RuntimeError as error:
        directions = str(error)
    names = on_scenes.contenders()
    answers = [on_scenes.answer(name, folder, scene, directions, cpu_limit_s) for name in names]
    return show(f"{scene.case} ({scene.unit})", answers, on_scenes.checks(answers))


def show(problem: str, answers: Sequence[on_graphs.Answer], checks: Sequence[Check]) -> list[Row]:
    """Return a row per answer; the limits stand in the first, which is ours."""
    rows = []
    for k, answer in enumerate(answers):
        cpu = f" ({number(answer.cpu_s)})" if math.isfinite(answer.cpu_s) else ""
        cells = {
            "problem": problem,
            "contender": answer.name,
            "error": answer.error if isinstance(answer.error, float | None) else str(answer.error),
            "seconds (CPU)": number(answer.seconds) + cpu,
            "peak MB": f"{answer.peak_mb:.0f}".replace("nan", "-"),
            "note": answer.note,
        }
        rows.append(Row(cells, () if k else checks))
    return rows


BENCHMARK = Benchmark(
    name="peers",
    title="Peers",
    cases=cases,
    flags=flags,
    packages=("numpy", "scipy", "numba", "pycolmap", "pytheia", "gtsam"),
    quick={"cpu_limit": 60},
    notes={
        "": "A fresh process each on one thread, ended after so much CPU time, imports included; our code is"
        " warmed up first, so that nothing is compiled while the clock runs. Graphs: our best answer has the"
        f" lowest error, and takes {on_graphs.FASTER:g} times less CPU time than the fastest peer of equal or"
        " lower error, if any. Scenes: by default `locate` has a median and a mean error at most 5 % above"
        " the lowest of the peers' positions. What mapping reaches, `map` measures."
    },
    columns={
        "error": "1 on graphs, both centered and of unit norm; the set's on scenes, median / mean / max after"
        " L1 alignment",
        "seconds (CPU)": "of the call that turns directions or tracks into positions;"
        " for `locate`, wall-clock of placing and judging, for positioning without its tracks",
        "peak MB": "10^6 bytes; resident, of the whole process while the clock ran",
    },
)
