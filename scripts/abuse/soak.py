"""Many calls in one process: memory and open files stay flat, and each call gives the same answer."""

import argparse
import gc
import os
import resource
import tempfile
from pathlib import Path

import numpy as np

from abuse.fuzz import make_base

HELP = "many locate calls in one process: memory, open files and answers must not change"
_WARM_UP = 20  # calls in which caches and allocators fill
_GROWTH_BYTES = 8_000_000  # allowed between the first and the last quarter, whatever the number of calls


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--calls", type=int, default=1000)


def run(args: argparse.Namespace) -> int:
    """Call, print a line, and return 1 if anything grew or changed."""
    with tempfile.TemporaryDirectory() as temporary:
        problems = soak(make_base(Path(temporary) / "base"), args.calls, show=True)
    for problem in problems:
        print(problem)
    return int(bool(problems))


def soak(base: Path, calls: int, *, show: bool = False) -> list[str]:
    """Locate the scene in `base` so many times, from matches and from tracks in turn; return what changed."""
    from sfm_shapefit.commands.locate import locate
    from sfm_shapefit.commands.write import write_result
    from sfm_shapefit.options import LocateOptions

    sources = ((base / "sparse" / "0", base / "database.db"), (base / "old", None))
    answers: dict[int, bytes] = {}
    sizes, descriptors, problems = [], [], []
    for call in range(calls + _WARM_UP):
        model, database = sources[call % 2]
        found = locate(
            model, database, options=LocateOptions(directions="auto" if database else "tracks", threads=1)
        )
        write_result(found, base.parent / "out", overwrite=True)
        centers = np.array([row.center for row in found.cameras if row.placed]).tobytes()
        if answers.setdefault(call % 2, centers) != centers:
            problems.append(f"call {call}: another answer")
        del found
        if call >= _WARM_UP:
            sizes.append(_resident_bytes())
            descriptors.append(len(os.listdir("/proc/self/fd")))
    gc.collect()
    quarter = max(calls // 4, 1)
    growth = float(np.median(sizes[-quarter:]) - np.median(sizes[:quarter]))
    if growth > _GROWTH_BYTES:
        problems.append(f"memory grew by {growth / 1e6:.1f} MB in {calls} calls")
    if max(descriptors) != min(descriptors):
        problems.append(f"open files went from {descriptors[0]} to {descriptors[-1]}")
    if show:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
        print(
            f"{calls} calls: resident {sizes[0] / 1e6:.1f} MB at first, {sizes[-1] / 1e6:.1f} MB at last "
            f"(median of quarters grew by {growth / 1e6:.2f} MB), peak "
            f"{peak:.0f} MB, {descriptors[-1]} open files, "
            f"{len(answers)} different inputs, each with one answer"
        )
    return problems


def _resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
