"""The first run of each command in a fresh environment with empty caches, and the second.

One environment is a clone, used where it stands, another has the wheel of `scripts/wheel`, a third a clone on
which `warm-up` ran. The dependencies are those of the measuring Python, and are not downloaded. Commands run
one after the other, each in processes of its own, so that the first one compiles what the others need too.
Kernels are counted by the files that are left of them.
"""

import argparse
import resource
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from harness.driver import Benchmark, Case
from harness.installed import Installed, install
from harness.metrics import Check, Quantity, number, ratio, verdict
from harness.record import table_of

COMMANDS = {
    "locate": "locate data_synthetic/courtyard/sparse/0 {out}/located --overwrite --quiet",
    "map": "map data_synthetic/ring8/database.db {out}/mapped --overwrite --quiet",
    "place": "place data_synthetic/graph40.txt {out}/placed --overwrite --quiet",
    "inspect": "inspect data_synthetic/courtyard/sparse/0 --json",
    "evaluate": "evaluate data_synthetic/courtyard/truth data_synthetic/courtyard/truth --json",
}
WARM_UP = "warm-up"
COLD_LOCATE_S = 20.0
FIRST_TO_SECOND = 1.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Spent:
    """One run of a command."""

    wall_s: float
    cpu_s: float
    num_compiled: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """A command in an environment."""

    environment: str
    command: str
    first: Spent
    second: Spent


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the environments."""
    if args.quick:
        return {"clone": partial(measure, "clone", ("evaluate",))}
    names = tuple(COMMANDS)
    return {
        "clone": partial(measure, "clone", names),
        "warm-up": partial(measure, "warm-up", (WARM_UP, *names)),
        "wheel": partial(measure, "wheel", names),
    }


def measure(environment: str, commands: Sequence[str]) -> list[Start]:
    """Run commands twice in a fresh environment."""
    with tempfile.TemporaryDirectory() as name:
        folder, wheel = Path(name).resolve(), None
        if environment == "wheel":
            import kernel_wheel

            wheel = kernel_wheel.build(folder / "dist")
        installed = install(folder / "environment", wheel)
        return [
            Start(
                environment=environment,
                command=command,
                first=run(installed, command, folder),
                second=run(installed, command, folder),
            )
            for command in commands
        ]


def run(installed: Installed, command: str, out: Path) -> Spent:
    """Run a command once, in processes of its own."""
    before, wall, cpu = len(installed.kernels()), time.perf_counter(), cpu_of_children_s()
    done = installed.run("-m", "sfm_shapefit", *COMMANDS.get(command, WARM_UP).format(out=out).split())
    wall_s, cpu_s = time.perf_counter() - wall, cpu_of_children_s() - cpu
    if done.returncode != 0:
        raise RuntimeError(f"{command}: {done.stderr[-300:]}")
    return Spent(wall_s=wall_s, cpu_s=cpu_s, num_compiled=len(installed.kernels()) - before)


def cpu_of_children_s() -> float:
    """Return the CPU time of all processes that were started here and ended, and of theirs."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def checks_of(start: Start) -> list[Check]:
    """Return the limits of one command: a wheel compiles nothing, a clone's first `locate` is soon done."""
    if (start.environment, start.command) == ("clone", "locate"):
        return [Check(name="first run", value=start.first.wall_s, limit=COLD_LOCATE_S)]
    if start.environment != "wheel":
        return []
    pace = ratio(start.first.wall_s, start.second.wall_s)
    return [
        Check(name="kernels compiled", value=start.first.num_compiled, limit=0),
        Check(name="first / second", value=pace, limit=FIRST_TO_SECOND),
    ]


def checks(starts: Sequence[Start]) -> list[Check]:
    """Return the limits of an environment."""
    return [check for start in starts for check in checks_of(start)]


def tables(measured: Mapping[str, Sequence[Start]], _args: argparse.Namespace) -> Iterator[str]:
    yield (
        f"The limits: the first `locate` of a clone takes {COLD_LOCATE_S:g} s; with the wheel nothing is "
        f"compiled, and a first run takes {FIRST_TO_SECOND} times as long as the second."
    )
    yield table_of(
        [start for starts in measured.values() for start in starts],
        {
            "environment": lambda start: start.environment,
            "command": lambda start: start.command,
            "first: wall s": lambda start: number(start.first.wall_s),
            "CPU s": lambda start: number(start.first.cpu_s),
            "compiled": lambda start: str(start.first.num_compiled),
            "second: wall s": lambda start: number(start.second.wall_s),
            "CPU s again": lambda start: number(start.second.cpu_s),
            "compiled again": lambda start: str(start.second.num_compiled),
            "result": lambda start: verdict(checks_of(start)),
        },
    )


BENCHMARK = Benchmark(
    name="start",
    title="start: the first run of each command",
    cases=cases,
    checks=checks,
    tables=tables,
    packages=("numpy", "numba", "pycolmap"),
    quantities=(
        Quantity("wall", "s", "lower", 0.1, "time of the whole command, imports included"),
        Quantity("CPU", "s", "lower", 0.1, "time of all its processes"),
        Quantity("compiled", "1", "lower", 0.0, "kernels that it left in a cache"),
    ),
)
