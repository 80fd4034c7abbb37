"""End to end at scale: a synthetic workspace as COLMAP would leave it, and `locate` on it.

Each scene is made by `synth` in a folder that is kept if it is given, so that a run can be repeated: a facade
with 100 matches a pair, a fifth of them wrong, and a tenth of the pairs wrong as a whole. `locate` runs in a
process of its own, on real sets too, and the memory that `inspect` forecasts is compared with what it takes.
Stages are compared between sizes by exponents: log(ratio of processor times) / log(ratio of matches), 1 where
a stage is linear; other users of the machine change the clock, and hardly that.
"""

import argparse
import json
import math
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import NamedTuple

from harness import ours
from harness.driver import ROOT, Benchmark, Case, if_there, positive
from harness.metrics import Check, Quantity, number, ratio, verdict
from harness.process import peak_memory_mb, reset_peak
from harness.record import table, table_of

LARGEST = 10_000
# Limits of the largest scene.
MOST_S, MOST_MB = 600.0, 4000.0
FORECAST_FACTOR = 1.5
"""By which the forecast of memory may be off, either way."""
POINTS_PER_IMAGE = 33
SCENE_FLAGS = (
    "--shape facade --max-pairs-per-image 60 --min-matches 100 --max-matches-per-pair 100"
    " --wrong-match-fraction 0.2 --corrupted-pair-fraction 0.1 --seed 1"
)
SETS = ("fountain-P11", "Herz-Jesus-P8", "Herz-Jesus-P25", "castle-P19", "castle-P30", "lego100", "liberty")
# A shorter stage says nothing of an exponent.
_SHORT_S = 1.0


class Usage(NamedTuple):
    """What a process took."""

    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_mb: float = 0.0


class Located(NamedTuple):
    """One scene."""

    name: str
    num_images: int
    num_pairs: int
    num_matches: int
    num_placed: int
    median_error: float
    """Of the cameras, as a share of the scene's extent; NaN of a real set."""
    forecast_mb: float
    stages: dict[str, Usage]

    @property
    def usage(self) -> Usage:
        """What all stages took."""
        wall_s, cpu_s, peaks_mb = zip(*self.stages.values(), strict=True)
        return Usage(sum(wall_s), sum(cpu_s), max(peaks_mb))


class Stages:
    """Takes the place of a progress bar: what each stage takes, its own peak of memory included."""

    def __init__(self) -> None:
        self.found: dict[str, Usage] = {}
        self._stage, self._start = "imports", (time.perf_counter(), 0.0)

    def __call__(self, stage: str, _done: int = 0, _total: int = 1) -> None:
        if stage == self._stage:
            return
        wall_s, cpu_s, peak_mb = self.found.get(self._stage, Usage())
        now = time.perf_counter(), time.process_time()
        wall_s, cpu_s = wall_s + now[0] - self._start[0], cpu_s + now[1] - self._start[1]
        self.found[self._stage] = Usage(wall_s, cpu_s, max(peak_mb, peak_memory_mb()))
        self._stage, self._start = stage, now
        reset_peak()


def flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--images", type=positive, nargs="*", default=[2500, LARGEST], help="of made scenes")
    parser.add_argument("--folder", type=Path, help="where scenes are kept (default: a temporary folder)")


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the made scenes, smallest first, and the real sets."""
    found: dict[str, Case] = {
        f"{size} images": partial(measure_made, size, args.folder, args.threads)
        for size in sorted(args.images)
    }
    for name in () if args.quick else SETS:
        folder = args.data / name
        found[name] = if_there(folder, partial(measure, name, folder, args.threads))
    return found


def measure_made(num_images: int, folder: Path | None, threads: int) -> Located:
    """Make a scene of so many images if the folder has none, and locate its cameras."""
    with tempfile.TemporaryDirectory() as temporary:
        scene = (folder or Path(temporary)) / f"facade{num_images}"
        if not scene.exists():
            size = f"--num-images {num_images} --num-points {POINTS_PER_IMAGE * num_images}"
            run_command("synth", scene, *size.split(), *SCENE_FLAGS.split())
        return measure(f"{num_images} images", scene, threads, is_made=True)


def measure(name: str, scene: Path, threads: int, is_made: bool = False) -> Located:
    """Locate the cameras of a scene, and write the result."""
    model = scene / "sparse" / "0"
    forecast = json.loads(run_command("inspect", model, "--json"))["expected"]
    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary) / "out"
        stages = Stages()
        ours.locate_and_write(model, out, threads=threads, progress=stages)
        stages("end")
        facts = json.loads((out / "locate.json").read_text(encoding="utf-8"))
        error = math.nan
        if is_made:
            # The model's centers are the true ones, at which `locate` does not look.
            found = json.loads(run_command("evaluate", out, model, "--json"))
            error = found["position_error"]["median"] / found["extent"]
        with closing(sqlite3.connect(f"file:{scene / 'database.db'}?mode=ro", uri=True)) as opened:
            (num_matches,) = opened.execute("SELECT sum(rows) FROM two_view_geometries").fetchone()
    return Located(
        name=name,
        num_images=facts["num_images"],
        num_pairs=facts["num_pairs"],
        num_matches=num_matches,
        num_placed=facts["num_placed"],
        median_error=error,
        forecast_mb=forecast["peak_mb"],
        stages=stages.found,
    )


def run_command(*words: object) -> str:
    """Run a command of sfm-shapefit and return what it printed.

    Raises:
        RuntimeError: if it fails, with its last lines.
    """
    command = [sys.executable, "-m", "sfm_shapefit.cli", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    if done.returncode:
        raise RuntimeError(f"{words[0]} ended with code {done.returncode}: {done.stderr.strip()[-300:]}")
    return done.stdout


def checks(one: Located) -> list[Check]:
    """Return the limits of the largest scene, and of every forecast."""
    used = one.usage
    off = max(ratio(one.forecast_mb, used.peak_mb), ratio(used.peak_mb, one.forecast_mb))
    limits = [Check(name="forecast, factor", value=off, limit=FORECAST_FACTOR)]
    if one.num_images >= LARGEST:
        limits.append(Check(name="s", value=used.wall_s, limit=MOST_S))
        limits.append(Check(name="MB", value=used.peak_mb, limit=MOST_MB))
    return limits


def tables(measured: Mapping[str, Located], args: argparse.Namespace) -> Iterator[str]:
    yield table_of(
        measured.values(),
        {
            "scene": lambda one: one.name,
            "images": lambda one: str(one.num_images),
            "pairs": lambda one: str(one.num_pairs),
            "matches": lambda one: str(one.num_matches),
            "placed": lambda one: str(one.num_placed),
            "error / extent": lambda one: f"{one.median_error:.2e}".replace("nan", "-"),
            "s": lambda one: number(one.usage.wall_s),
            "CPU s": lambda one: number(one.usage.cpu_s),
            "peak MB": lambda one: number(one.usage.peak_mb),
            "MB forecast": lambda one: number(one.forecast_mb),
            "verdict": lambda one: verdict(checks(one)),
        },
    )
    made = [one for one in measured.values() if one.name in [f"{size} images" for size in args.images]]
    if made:
        yield "Seconds / CPU seconds / peak MB by stage; exponents between smallest and largest:"
        yield _show_stages(made)


def _show_stages(made: Sequence[Located]) -> str:
    rows = []
    for name in made[-1].stages:
        used = [one.stages.get(name, Usage()) for one in made]
        cells = [f"{one.wall_s:.1f} / {one.cpu_s:.1f} / {one.peak_mb:.0f}" for one in used]
        exponent, first_s, last_s = math.nan, used[0].cpu_s, used[-1].cpu_s
        if len(made) > 1 and min(first_s, last_s) >= _SHORT_S:
            exponent = math.log(last_s / first_s) / math.log(made[-1].num_matches / made[0].num_matches)
        rows.append([name, *cells, f"{exponent:.2f}".replace("nan", "-")])
    return table(["stage", *[one.name for one in made], "exponent"], rows)


BENCHMARK = Benchmark(
    name="endtoend",
    title="End to end at scale",
    cases=cases,
    checks=checks,
    tables=tables,
    flags=flags,
    quick={"images": [30]},
    threads=2,
    quantities=(
        Quantity("error / extent", "1", "lower", 0.05, "median position error over the scene's extent"),
        Quantity("s, CPU s", "s", "lower", 0.3, "of reading, locating and writing, imports included"),
        Quantity("peak MB", "MB", "lower", 0.1, "peak resident memory of the process"),
        Quantity("MB forecast", "MB", "neither", 0.1, "what `inspect` forecasts of it, beforehand"),
    ),
)
