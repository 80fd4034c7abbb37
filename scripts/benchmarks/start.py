"""The first run of each command in a fresh environment with empty caches, and the second.

One environment is a clone, used where it stands, another has the wheel of `scripts/wheel`, a third a clone on
which `warm-up` ran. The dependencies are those of the measuring Python, and are not downloaded. Commands run
one after the other, each in processes of its own, so that the first one compiles what the others need too.
Kernels are counted by the files that are left of them.
"""

import argparse
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from harness.driver import Benchmark, Case
from harness.installed import Installed, install
from harness.process import children_cpu_s
from harness.record import Row, at_most, ratio

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


class Spent(NamedTuple):
    """One run of a command."""

    wall_s: float
    cpu_s: float
    num_compiled: int


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the environments."""
    if args.quick:
        return {"clone": partial(measure, "clone", ("evaluate",))}
    return {
        "clone": partial(measure, "clone", tuple(COMMANDS)),
        "warm-up": partial(measure, "warm-up", (WARM_UP, *COMMANDS)),
        "wheel": partial(measure, "wheel", tuple(COMMANDS)),
    }


def measure(environment: str, commands: Sequence[str]) -> list[Row]:
    """Run commands twice in a fresh environment."""
    with tempfile.TemporaryDirectory() as name:
        folder, wheel = Path(name).resolve(), None
        if environment == "wheel":
            import kernel_wheel

            wheel = kernel_wheel.build(folder / "dist")
        made = install(folder / "environment", wheel)
        return [judge(environment, one, *(run(made, one, folder) for _ in range(2))) for one in commands]


def run(installed: Installed, command: str, out: Path) -> Spent:
    """Run a command once, in processes of its own."""
    before, wall, cpu = len(installed.kernels()), time.perf_counter(), children_cpu_s()
    done = installed.run("-m", "sfm_shapefit", *COMMANDS.get(command, WARM_UP).format(out=out).split())
    wall_s, cpu_s = time.perf_counter() - wall, children_cpu_s() - cpu
    if done.returncode != 0:
        raise RuntimeError(f"{command}: {done.stderr[-300:]}")
    return Spent(wall_s, cpu_s, len(installed.kernels()) - before)


def judge(environment: str, command: str, first: Spent, second: Spent) -> Row:
    """Return the row of a command: a wheel compiles nothing, a clone's first `locate` is soon done."""
    is_wheel, is_cold = environment == "wheel", (environment, command) == ("clone", "locate")
    checks = at_most(
        first_run=(first.wall_s, COLD_LOCATE_S if is_cold else None),
        kernels_compiled=(first.num_compiled, 0 if is_wheel else None),
        first_over_second=(ratio(first.wall_s, second.wall_s), FIRST_TO_SECOND if is_wheel else None),
    )
    cells = {
        "environment": environment,
        "command": command,
        "first: wall s": first.wall_s,
        "CPU s": first.cpu_s,
        "compiled": first.num_compiled,
        "second: wall s": second.wall_s,
        "CPU s again": second.cpu_s,
        "compiled again": second.num_compiled,
    }
    return Row(cells, checks)


BENCHMARK = Benchmark(
    name="start",
    title="start: the first run of each command",
    cases=cases,
    packages=("numpy", "numba", "pycolmap"),
    columns={
        "wall": "s; time of the whole command, imports included",
        "CPU": "s; time of all its processes",
        "compiled": "kernels that it left in a cache",
    },
)
