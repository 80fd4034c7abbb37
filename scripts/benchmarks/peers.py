"""Peers side by side: bare graphs per family and real scenes per set, in one run and one table.

pytheia and gtsam are optional (the extra `peers`); without them their rows say so. What contenders get, and
with which options, is said in `graph_peers` and `real_peers`. A failure is a row of the table like any other.
"""

import argparse
import math
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import graph_peers, real_peers
from benchmarks.graph_peers import FASTER, PROBLEMS, Answer, Compared
from benchmarks.graphs import GraphSpec, draw
from benchmarks.kept import KeptAnswers
from benchmarks.metrics import Check, Quantity, number, numbers, verdict
from benchmarks.process import call, thread_environment
from benchmarks.real import SCENES, Errors, scene_names
from benchmarks.record import environment, legend, table, versions, write_section

HELP = "pytheia, gtsam and pycolmap beside ours, on bare graphs and real scenes: error, time, peak memory."
ROOT = Path(__file__).parents[2]
PACKAGES = ("numpy", "scipy", "numba", "pycolmap", "pytheia", "gtsam")
CPU_LIMIT_S, QUICK_CPU_LIMIT_S = 150, 60
QUICK = GraphSpec(family="er2", n=20, sigma=0.01)
NO_SETS = "none"

QUANTITIES = (
    Quantity(
        name="error",
        unit="1 on graphs, the set's on scenes",
        better="lower",
        rel_tol=0.05,
        meaning="graphs: against the truth, both centred and of unit norm; scenes: median / mean / max of"
        " position after robust (L1) alignment, over the cameras that are placed",
    ),
    Quantity(
        name="seconds (CPU)",
        unit="s",
        better="lower",
        rel_tol=0.5,
        meaning="wall-clock, and CPU time of all threads, of the call that turns directions, tracks or"
        " (mapping) a database into positions,"
        " one run; for `locate`, wall-clock of placing and judging, for positioning without its tracks",
    ),
    Quantity(
        name="peak MB",
        unit="10^6 bytes",
        better="lower",
        rel_tol=0.1,
        meaning="peak resident memory of the whole process while the clock ran; for `locate` and pycolmap"
        " with reading the database",
    ),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `peers`."""
    parser.add_argument(
        "--problems", type=problems, default=list(PROBLEMS), help="graphs, with commas; or none"
    )
    parser.add_argument("--sets", type=sets, default=list(SCENES), help="real scenes, with commas; or none")
    parser.add_argument(
        "--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the sets"
    )
    parser.add_argument(
        "--cpu-limit", type=int, default=CPU_LIMIT_S, help="seconds of CPU time per answer (default 150)"
    )
    parser.add_argument("--cache", type=Path, help="JSON that keeps answers between runs")
    parser.add_argument("--quick", action="store_true", help="one small graph instead of all of that")
    parser.add_argument("--out", type=Path, default=ROOT / "scripts" / "results.md", help="file of results")


def problems(text: str) -> list[str]:
    """Parse `--problems`."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    if names == [NO_SETS]:
        return []
    unknown = [name for name in names if name not in PROBLEMS]
    if unknown or not names:
        raise argparse.ArgumentTypeError(
            f"unknown problem {', '.join(unknown) or '(none)'}; known: {', '.join(PROBLEMS)}"
        )
    return list(dict.fromkeys(names))


def sets(text: str) -> list[str]:
    """Parse `--sets`."""
    return [] if text.strip() == NO_SETS else scene_names(text)


def run(args: argparse.Namespace) -> int:
    """Measure, print the section and write it; a missed limit is no failure."""
    about = environment(PACKAGES, command_line(args))
    if args.quick:
        graphs, chosen, limit_s = {"er2-20": QUICK}, [], QUICK_CPU_LIMIT_S
    else:
        graphs, chosen, limit_s = {name: PROBLEMS[name] for name in args.problems}, args.sets, args.cpu_limit
    kept = KeptAnswers(args.cache, {"cpu_limit_s": limit_s, "versions": versions(PACKAGES)})
    _compile()
    compared = [_on_graph(name, spec, limit_s, kept) for name, spec in graphs.items()]
    scenes = {}
    for name in chosen:
        if (args.data / name).is_dir():
            scenes[name] = _on_scene(name, args.data / name, limit_s, kept)
        else:
            print(f"skipped: {name} not found in {args.data}", file=sys.stderr)
    body = section(compared, scenes, about + _loads(kept), limit_s)
    print(body)
    write_section(args.out, "peers", body)
    return 0


def command_line(args: argparse.Namespace) -> str:
    """Return the command that repeats the measurement, without paths."""
    command = "python scripts/benchmark.py peers"
    if args.quick:
        return f"{command} --quick"
    for flag, given, default in (("problems", args.problems, PROBLEMS), ("sets", args.sets, SCENES)):
        if given != list(default):
            command += f" --{flag} {','.join(given) or NO_SETS}"
    return command + ("" if args.cpu_limit == CPU_LIMIT_S else f" --cpu-limit {args.cpu_limit}")


def _compile() -> None:
    """Run ours once, so that no process that is measured compiles: that takes memory and time."""
    for contender in graph_peers.CONTENDERS:
        if contender.package is None:
            call(graph_peers.measure, contender.name, QUICK, environment=thread_environment(1))


def _on_graph(name: str, spec: GraphSpec, limit_s: int, kept: KeptAnswers) -> Compared:
    """Run all contenders on a graph."""
    answers = []
    for contender in graph_peers.CONTENDERS:
        ask = partial(graph_peers.answer, contender, spec, limit_s)
        found = Answer(**kept.get(f"{name}, {contender.name}", ask))
        answers.append(found)
        print(name, found.name, number(found.error), found.note, file=sys.stderr, flush=True)
    return Compared(name=name, num_cameras=spec.n, num_edges=len(draw(spec).edges), answers=tuple(answers))


def _on_scene(name: str, folder: Path, limit_s: int, kept: KeptAnswers) -> list[real_peers.Row]:
    """Run all contenders on a real scene."""
    directions: real_peers.Directions | str = "not needed"
    if not all(f"{name}, {contender}" in kept for contender in real_peers.contenders()):
        directions = _directions(folder)
    rows = []
    for contender in real_peers.contenders():
        ask = partial(real_peers.answer, contender, folder, SCENES[name], directions, limit_s)
        row = _row(kept.get(f"{name}, {contender}", ask))
        rows.append(row)
        print(name, row.name, _cell(row.errors), row.note, file=sys.stderr, flush=True)
    return rows


def _directions(folder: Path) -> real_peers.Directions | str:
    """Return the directions that peers get, or why there are none; compiles what `locate` needs."""
    try:
        found: real_peers.Directions = call(
            real_peers.measured_directions, folder, environment=thread_environment(1)
        )
    except RuntimeError as error:
        return str(error)
    return found


def _row(kept: dict[str, Any]) -> real_peers.Row:
    errors = kept["errors"]
    return real_peers.Row(**kept | {"errors": errors and Errors(**errors)})


def _loads(kept: KeptAnswers) -> str:
    return f"- Load average while measuring: {min(kept.loads):.1f} to {max(kept.loads):.1f}\n"


def section(
    compared: Sequence[Compared], scenes: dict[str, list[real_peers.Row]], about: str, limit_s: int
) -> str:
    """Return the section of the file of results."""
    verdicts: list[tuple[str, list[Check]]] = [(one.name, graph_peers.checks(one)) for one in compared]
    verdicts += [(name, real_peers.checks(rows)) for name, rows in scenes.items()]
    every = [check for _, found in verdicts for check in found]
    parts = [
        "## Peers",
        about
        + f"- Threads: 1; a fresh process each, ended after {limit_s} s of CPU time, imports included; our"
        " code is warmed up first, so that nothing is compiled while the clock runs",
        f"**{sum(check.met for check in every)} of {len(every)} limits met**. Graphs: our best answer has"
        f" the lowest error, and takes {FASTER:g} times less CPU time than the fastest peer of equal or lower"
        " error, if any. Scenes: by default `locate` has a median and a mean error at most 5 % above the"
        " lowest of the peers' (mapping aside, which ends with bundle adjustment). A peer without answer is"
        " in no limit.",
        table(["problem", "method", "error", "seconds (CPU)", "peak MB", "note"], _rows(compared, scenes)),
        table(["problem", "verdict"], [[name, verdict(found)] for name, found in verdicts]),
        "### What the columns mean",
        legend(QUANTITIES),
    ]
    return "\n\n".join(part.strip() for part in parts)


def _rows(compared: Sequence[Compared], scenes: dict[str, list[real_peers.Row]]) -> list[list[str]]:
    """Return the rows of the one table."""
    rows = [
        [
            f"{one.name} ({one.num_edges} pairs)",
            a.name,
            number(a.error),
            _times(a.seconds, a.cpu_s),
            _mb(a.peak_mb),
            a.note,
        ]
        for one in compared
        for a in one.answers
    ]
    return rows + [
        [
            f"{name} ({SCENES[name].unit})",
            r.name,
            _cell(r.errors),
            _times(r.seconds, r.cpu_s),
            _mb(r.peak_mb),
            r.note,
        ]
        for name, answers in scenes.items()
        for r in answers
    ]


def _times(seconds: float, cpu_s: float) -> str:
    return f"{number(seconds)} ({number(cpu_s)})" if math.isfinite(cpu_s) else number(seconds)


def _mb(value: float) -> str:
    return f"{value:.0f}" if value > 0.0 else "-"  # NaN is not


def _cell(errors: Errors | None) -> str:
    if errors is None:
        return "-"
    text = numbers([errors.median, errors.mean, errors.max])
    return f"{text} ({errors.num_missing} missing)" if errors.num_missing else text
