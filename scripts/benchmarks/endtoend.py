"""End to end at scale: a synthetic workspace as COLMAP would leave it, and `locate` on it.

Each scene is made by `synth` in a folder that is kept if it is given, so that a run can be repeated: a facade
with 100 matches a pair, a fifth of them wrong, and a tenth of the pairs wrong as a whole. `locate` runs in a
process of its own. Stages are compared between sizes by exponents: log(ratio of processor times) / log(ratio
of matches), 1 where a stage is linear; other users of the machine change the clock, and hardly that.
"""

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.metrics import Check, number, verdict
from benchmarks.process import call, peak_memory_mb, reset_peak, thread_environment
from benchmarks.record import environment, table, write_section

HELP = "synth and locate at thousands of images: time by stage, memory, exponents."
ROOT = Path(__file__).parents[2]
PACKAGES = ("numpy", "scipy", "numba", "pycolmap")
LARGEST = 10_000
MOST_S, MOST_MB = 600.0, 4000.0  # of the largest
MATCHES_PER_PAIR, PAIRS_PER_IMAGE, POINTS_PER_IMAGE = 100, 60, 33
_SHORT_S = 1.0  # a stage that says nothing of an exponent


@dataclass(frozen=True, slots=True, kw_only=True)
class Usage:
    """What a process took."""

    wall_s: float
    cpu_s: float
    peak_mb: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Located:
    """One size."""

    num_images: int
    num_pairs: int
    num_matches: int
    num_placed: int
    median_error: float
    """Of the cameras, as a share of the scene's extent."""
    usage: Usage
    stages: dict[str, Usage]


class Stages:
    """Takes the place of a progress bar: what each stage takes, its own peak of memory included."""

    def __init__(self) -> None:
        self.found: dict[str, Usage] = {}
        self._stage, self._wall_s, self._cpu_s = "imports", time.perf_counter(), 0.0

    def __call__(self, stage: str, _done: int = 0, _total: int = 1) -> None:
        if stage == self._stage:
            return
        earlier = self.found.get(self._stage, Usage(wall_s=0.0, cpu_s=0.0, peak_mb=0.0))
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        self.found[self._stage] = Usage(
            wall_s=earlier.wall_s + wall_s - self._wall_s,
            cpu_s=earlier.cpu_s + cpu_s - self._cpu_s,
            peak_mb=max(earlier.peak_mb, peak_memory_mb()),
        )
        print(f"{self._stage}: {self.found[self._stage]}", file=sys.stderr, flush=True)
        self._stage, self._wall_s, self._cpu_s = stage, wall_s, cpu_s
        reset_peak()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `endtoend`."""
    parser.add_argument("--images", type=int, nargs="+", default=[2500, LARGEST], help="sizes")
    parser.add_argument("--threads", type=int, default=2, help="threads (default 2)")
    parser.add_argument("--folder", type=Path, help="where scenes are kept (default: a temporary folder)")
    parser.add_argument("--out", type=Path, default=ROOT / "scripts" / "results.md", help="file of results")


def run(args: argparse.Namespace) -> int:
    """Measure, print the section and write it; a missed limit is no failure."""
    sizes = " ".join(map(str, args.images))
    about = environment(
        PACKAGES, f"python scripts/benchmark.py endtoend --images {sizes} --threads {args.threads}"
    )
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.folder or Path(temporary)
        measured = [measure(folder, size, args.threads) for size in sorted(args.images)]
    body = section(measured, about)
    print(body)
    write_section(args.out, "endtoend", body)
    return 0


def measure(folder: Path, num_images: int, threads: int) -> Located:
    """Make a scene of so many images if the folder has none, and locate its cameras."""
    scene, out = folder / f"facade{num_images}", folder / "out"
    if not scene.exists():
        print(f"making {num_images} images", file=sys.stderr, flush=True)
        command("synth", scene, *scene_flags(num_images))
    shutil.rmtree(out, ignore_errors=True)
    print(f"locating {num_images} images", file=sys.stderr, flush=True)
    stages = call(_located, scene, out, threads, environment=thread_environment(threads))
    facts = json.loads((out / "locate.json").read_text(encoding="utf-8"))
    truth = scene / "sparse" / "0"  # its centres are the true ones, which `locate` does not look at
    found = json.loads(command("evaluate", out, truth, "--json")[1])
    located = Located(
        num_images=num_images,
        num_pairs=facts["num_pairs"],
        num_matches=_num_matches(scene / "database.db"),
        num_placed=facts["num_placed"],
        median_error=found["position_error"]["median"] / found["extent"],
        usage=Usage(
            wall_s=sum(one.wall_s for one in stages.values()),
            cpu_s=sum(one.cpu_s for one in stages.values()),
            peak_mb=max(one.peak_mb for one in stages.values()),
        ),
        stages=stages,
    )
    shutil.rmtree(out)
    return located


def _located(scene: Path, out: Path, threads: int) -> dict[str, Usage]:
    """Locate a scene, write the result, and return what each stage took."""
    stages = Stages()
    from sfm_shapefit import LocateOptions, locate, write_result

    write_result(locate(scene / "sparse" / "0", options=LocateOptions(threads=threads), progress=stages), out)
    stages("end")
    return stages.found


def scene_flags(num_images: int) -> Iterator[object]:
    """Yield what `synth` makes a scene of."""
    yield from ("--shape", "facade", "--num-images", num_images)
    yield from ("--num-points", POINTS_PER_IMAGE * num_images)
    yield from ("--max-pairs-per-image", PAIRS_PER_IMAGE)
    yield from ("--min-matches", MATCHES_PER_PAIR, "--max-matches-per-pair", MATCHES_PER_PAIR)
    yield from ("--wrong-match-fraction", 0.2, "--corrupted-pair-fraction", 0.1, "--seed", 1)


def command(*words: object) -> tuple[Usage, str]:
    """Run a command of sfm-shapefit; return what it took and what it printed.

    Raises:
        RuntimeError: if it fails, with its last line.
    """
    start = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "sfm_shapefit.cli", *map(str, words)],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert process.stdout is not None
    printed = process.stdout.read()
    _, code, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(code)
    if process.returncode:
        raise RuntimeError(f"{words[0]} ended with code {process.returncode}: {printed.strip()[-300:]}")
    unit = 1 if sys.platform == "darwin" else 1024
    usage = Usage(
        wall_s=time.perf_counter() - start,
        cpu_s=used.ru_utime + used.ru_stime,
        peak_mb=used.ru_maxrss * unit / 1e6,
    )
    return usage, printed


def _num_matches(database: Path) -> int:
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        return int(opened.num_inlier_matches())


def section(measured: Sequence[Located], about: str) -> str:
    """Return the Markdown of all sizes."""
    rows = []
    for one in measured:
        used = one.usage
        checks = [
            Check(name="s", value=used.wall_s, limit=MOST_S),
            Check(name="MB", value=used.peak_mb, limit=MOST_MB),
        ]
        rows.append(
            [
                str(one.num_images),
                str(one.num_pairs),
                str(one.num_matches),
                str(one.num_placed),
                f"{one.median_error:.2e}",
                number(used.wall_s),
                number(used.cpu_s),
                number(used.peak_mb),
                verdict(checks) if one.num_images >= LARGEST else "no target",
            ]
        )
    header = ["images", "pairs", "matches", "placed", "error / extent", "s", "CPU s", "peak MB", "verdict"]
    parts = ["## Reliability: end to end at scale\n", about, "", table(header, rows)]
    parts += ["\nSeconds / CPU seconds / peak MB by stage; exponents between smallest and largest:\n"]
    return "\n".join([*parts, _stages(measured)])


def _stages(measured: Sequence[Located]) -> str:
    none = Usage(wall_s=0.0, cpu_s=0.0, peak_mb=0.0)
    header = ["stage", *[f"{one.num_images} images" for one in measured], "exponent"]
    rows = []
    for name in measured[-1].stages:
        used = [one.stages.get(name, none) for one in measured]
        cells = [f"{one.wall_s:.1f} / {one.cpu_s:.1f} / {one.peak_mb:.0f}" for one in used]
        rows.append([name, *cells, _exponent(measured, [one.cpu_s for one in used])])
    return table(header, rows)


def _exponent(measured: Sequence[Located], seconds: Sequence[float]) -> str:
    if len(measured) < 2 or min(seconds[0], seconds[-1]) < _SHORT_S:
        return "-"
    growth = math.log(measured[-1].num_matches / measured[0].num_matches)
    return f"{math.log(seconds[-1] / seconds[0]) / growth:.2f}"
