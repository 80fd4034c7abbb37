"""End to end at scale: a synthetic workspace as COLMAP would leave it, and `locate` on it.

Each scene is made by `synth` in a folder that is kept if it is given, so that a run can be repeated: a facade
with 100 matches a pair, a fifth of them wrong, and a tenth of the pairs wrong as a whole. `locate` runs in a
process of its own, on real sets too, and the memory that `inspect` forecasts is compared with what it takes.
Stages are compared between sizes by exponents of processor times over matches, 1 where a stage is linear;
other users of the machine change the clock, and hardly that. Beside what each stage takes stands the least
that its arithmetic would take: bytes at the rate of a copy, operations at that of a scalar product, both
measured in the same process, by counts of what was worked on, see `floors`.
"""

import argparse
import json
import math
import sqlite3
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import sfm_shapefit
from harness.driver import Benchmark, Case, on_sets, positive
from harness.process import peak_memory_mb, reset_peak, run_command, time_call
from harness.record import Row, at_most, exponent, ratio, table, times
from sfm_shapefit.solver.splitting.linear import predict_factor

LARGEST = 10_000
MOST_S, MOST_MB = 600.0, 4000.0
"""Limits of the largest scene."""
FORECAST_FACTOR = 1.3
"""By which the forecast of memory may be off, either way."""
POINTS_PER_IMAGE = 33
SCENE_FLAGS = (
    "--shape facade --max-pairs-per-image 60 --min-matches 100 --max-matches-per-pair 100"
    " --wrong-match-fraction 0.2 --corrupted-pair-fraction 0.1 --seed 1"
)
RING = "ring363"
RING_FLAGS = (
    "--shape ring --num-images 363 --num-points 6000 --max-pairs-per-image 60 --min-matches 15"
    " --max-matches-per-pair 50 --wrong-match-fraction 0.2 --corrupted-pair-fraction 0.1 --seed 1"
)
"""Few matches each, of few images, as pictures of a figure all around have them."""
SETS = ("fountain-P11", "Herz-Jesus-P8", "Herz-Jesus-P25", "castle-P19", "castle-P30", "lego100", "liberty")
WITH_FLOORS = (RING, "castle-P30", "lego100")
"""Scenes beside the facades whose stages are compared with floors."""
FLOORS = """CPU seconds of a stage over the least that bytes and arithmetic would take. Bytes at the rate of a
copy, or operations at that of a scalar product, whichever takes longer; both measured in each process.

| stage | bytes | operations |
| --- | --- | --- |
| read | 8 a match, 16 a keypoint | - |
| directions | 56 a match | 5 Gauss-Newton steps of 60 a match |
| solve | - | 10 factors of the view graph, in blocks of 3 |
| adjustment | - | 10 steps of 300 an observation |
| trust | - | 3 such factors, for variances |
| structure | 16 a match | - |
| triangulation | 48 an observation | 3 passes of 100 an observation |
| model, and writing | 24 a keypoint, 12 an observation, files of the result | - |
"""
# CPU seconds below which a stage says nothing of an exponent.
_SHORT_S = 1.0


class Usage(NamedTuple):
    """What a process took."""

    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_mb: float = 0.0


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
    parser.add_argument(
        "--images", type=positive, nargs="*", default=[1000, 2500, LARGEST], help="of made scenes"
    )
    parser.add_argument("--folder", type=Path, help="where scenes are kept (default: a temporary folder)")


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the made scenes, smallest first, and the real sets."""
    made: dict[str, Case] = {
        f"{size} images": partial(measure_made, f"facade{size}", facade(size), args.folder, args.threads)
        for size in sorted(args.images)
    }
    if not args.quick:
        made[RING] = partial(measure_made, RING, RING_FLAGS, args.folder, args.threads)
    return made if args.quick else made | on_sets(args.data, SETS, measure, args.threads)


def facade(size: int) -> str:
    """Return the flags of a facade of so many images."""
    return f"--num-images {size} --num-points {POINTS_PER_IMAGE * size} {SCENE_FLAGS}"


def measure_made(name: str, scene_flags: str, folder: Path | None, threads: int) -> Row:
    """Make a scene if the folder has none of its name, and locate its cameras."""
    with tempfile.TemporaryDirectory() as temporary:
        scene = (folder or Path(temporary)) / name
        if not scene.exists():
            run_command("synth", scene, *scene_flags.split())
        return measure(scene, threads, is_made=True)


def measure(scene: Path, threads: int, is_made: bool = False) -> Row:
    """Locate the cameras of a scene, and write the result."""
    model, error = scene / "sparse" / "0", math.nan
    forecast = json.loads(run_command("inspect", model, "--json"))["expected"]
    with tempfile.TemporaryDirectory() as temporary:
        out, stages = Path(temporary) / "out", Stages()
        found = sfm_shapefit.locate(model, threads=threads, progress=stages)
        sfm_shapefit.write_result(found, out)
        stages("end")
        facts = json.loads((out / "locate.json").read_text(encoding="utf-8"))
        if is_made:
            # The model's centers are the true ones, at which `locate` does not look.
            off = json.loads(run_command("evaluate", out, model, "--json"))
            error = off["position_error"]["median"] / off["extent"]
        with closing(sqlite3.connect(f"file:{scene / 'database.db'}?mode=ro", uri=True)) as opened:
            (num_matches,) = opened.execute("SELECT sum(rows) FROM two_view_geometries").fetchone()
            (num_keypoints,) = opened.execute("SELECT sum(rows) FROM keypoints").fetchone()
        least = floors(found, num_matches, num_keypoints, sum(file.stat().st_size for file in out.iterdir()))
    cells = {
        "scene": scene.name,
        "images": facts["num_images"],
        "pairs": facts["num_pairs"],
        "matches": num_matches,
        "placed": facts["num_placed"],
        "error / extent": error,
    }
    return judge(cells, forecast["peak_mb"], stages.found, least)


def floors(found: Any, num_matches: int, num_keypoints: int, num_written: int) -> dict[str, float]:
    """Return the least CPU seconds of each stage, by what it must move and compute; see `FLOORS`."""
    observations = found.reconstruction.compute_num_observations()
    blocks = predict_factor(found.placement.graph).flops * found.placement.graph.dimension**3
    work = {
        "read": (8 * num_matches + 16 * num_keypoints, 0),
        "directions": (56 * num_matches, 5 * 60 * num_matches),
        "solve": (0, 10 * blocks),
        "adjustment": (0, 10 * 300 * observations),
        "trust": (0, 3 * blocks),
        "structure": (16 * num_matches, 0),
        "triangulation": (48 * observations, 3 * 100 * observations),
        "model": (24 * num_keypoints + 12 * observations + num_written, 0),
    }
    copied, multiplied = bytes_per_s(), flops_per_s()
    return {stage: max(moved / copied, done / multiplied) for stage, (moved, done) in work.items()}


def bytes_per_s() -> float:
    """Return how many bytes a second of CPU time copies, of arrays larger than the caches."""
    source = np.ones(1 << 24)
    target = np.empty_like(source)
    taken = [time_call(partial(np.copyto, target, source)).cpu_s for _ in range(5)]
    return source.nbytes / min(taken[1:])


def flops_per_s() -> float:
    """Return how many operations a second of CPU time does in scalar products of vectors in the cache."""
    vector = np.ones(1 << 11)
    number = 5000
    taken = [time_call(lambda: [vector.dot(vector) for _ in range(number)]).cpu_s for _ in range(3)]
    return 2.0 * len(vector) * number / min(taken)


def judge(
    cells: Mapping[str, Any],
    forecast_mb: float,
    stages: Mapping[str, Usage],
    least_s: Mapping[str, float] | None = None,
) -> Row:
    """Return the row of a scene: the forecast has limits, and the largest scene."""
    wall_s, cpu_s, peaks_mb = zip(*stages.values(), strict=True)
    s, mb, is_largest = sum(wall_s), max(peaks_mb), cells["images"] >= LARGEST
    checks = at_most(
        forecast_off_by=(max(ratio(forecast_mb, mb), ratio(mb, forecast_mb)), FORECAST_FACTOR),
        s=(s, MOST_S if is_largest else None),
        MB=(mb, MOST_MB if is_largest else None),
    )
    took = {"s": s, "CPU s": sum(cpu_s), "peak MB": mb, "MB forecast": forecast_mb}
    return Row({**cells, **took}, checks, more={"stages": stages, "floors": least_s or {}})


def show_stages(rows: Sequence[Row]) -> Iterator[str]:
    """Yield what each stage of the made scenes took, and what each of some scenes takes over its floor."""
    made = [row for row in rows if row["scene"].startswith("facade")]
    if made:
        yield "Seconds / CPU seconds / peak MB by stage; exponents between smallest and largest:"
        ends, shown = (made[0], made[-1]), []
        for name in made[-1]["stages"]:
            used = [row["stages"].get(name, Usage()) for row in made]
            cells = [f"{one.wall_s:.1f} / {one.cpu_s:.1f} / {one.peak_mb:.0f}" for one in used]
            spent = [used[0].cpu_s, used[-1].cpu_s]
            grown = exponent([row["matches"] for row in ends], spent) if min(spent) >= _SHORT_S else math.nan
            shown.append([name, *cells, f"{grown:.2f}".replace("nan", "-")])
        yield table(["stage", *[row["scene"] for row in made], "exponent"], shown)
    beside = [row for row in rows if row["floors"] and (row in made or row["scene"] in WITH_FLOORS)]
    if beside:
        yield FLOORS
        stages = dict.fromkeys(name for row in beside for name in row["floors"])
        lines = [[name, *(_over_floor(row, name) for row in beside)] for name in stages]
        yield table(["stage", *[row["scene"] for row in beside]], lines)


def _over_floor(row: Row, stage: str) -> str:
    """Return a stage's CPU seconds, the least it would take, and their ratio."""
    used, least = row["stages"].get(stage, Usage()).cpu_s, row["floors"][stage]
    return f"{used:.2f} / {least:.2g} = {times(ratio(used, least))}" if used else "-"


BENCHMARK = Benchmark(
    name="endtoend",
    title="End to end at scale",
    cases=cases,
    closing=show_stages,
    flags=flags,
    quick={"images": [30]},
    threads=2,
    columns={
        "error / extent": "1; median position error over the scene's extent",
        "s, CPU s": "of reading, locating and writing, imports included",
        "peak MB": "peak resident memory of the process",
        "MB forecast": "what `inspect` forecasts of it, beforehand",
    },
)
