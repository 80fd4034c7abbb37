"""End to end from a database: `map` with bundle adjustment beside pycolmap's global and incremental mapping.

All start from the same verified matches and intrinsics. The mappers of pycolmap run on a copy of the
database, with 15 and with 30 as the least number of matches of a pair, and the better one counts; `map`
chooses by itself. They refine focal lengths; `map` keeps those of the database. Errors are those of the
largest model against the truth after robust alignment; since `map` leaves out cameras it does not trust,
the peers' errors are also given on the cameras that `map` placed. One run each in a fresh process; `map` has
its numba kernels loaded by a run on the bundled ring before.
"""

import argparse
import math
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from harness import ours
from harness.driver import ROOT, Benchmark, Case, if_there
from harness.metrics import Check, Quantity, number, ratio, verdict
from harness.process import call, thread_environment
from harness.record import table_of

SCENES = ("castle-P30", "lego100", "ring")
SETTINGS = (("map", 0), *((m, k) for m in ("global", "incremental") for k in (15, 30)))
LARGEST_RATIO = 1.15
RING = {"shape": "ring", "num_images": 50, "num_points": 2000, "wrong_match_fraction": 0.02, "seed": 6}
QUICK_RING = {**RING, "num_images": 10, "num_points": 500}


class Outcome(NamedTuple):
    """One mapper on one scene."""

    scene: str
    mapper: str
    min_matches: int
    """Of the setting; 0 where the mapper chose."""
    cpu_s: float
    wall_s: float
    errors: Mapping[str, float]
    """Position error of each placed camera by name, in the truth's units."""

    def mean(self, names: Collection[str] | None = None) -> float:
        """Return the mean error, of some of the cameras if they are named; NaN if none is placed."""
        chosen = [e for name, e in self.errors.items() if names is None or name in names]
        return float(np.mean(chosen)) if chosen else math.nan


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the scenes; the ring is made."""
    if args.quick:
        return {"ring": partial(measure_scene, "ring", args.data, 1, QUICK_RING)}
    return {
        scene: if_there(
            ROOT if scene == "ring" else args.data / scene,
            partial(measure_scene, scene, args.data, args.threads, RING),
        )
        for scene in SCENES
    }


def measure_scene(scene: str, data: Path, threads: int, ring: Mapping[str, object]) -> list[Outcome]:
    """Run all mappers on one scene, each in a fresh process."""
    with tempfile.TemporaryDirectory() as name:
        folder = data / scene
        truth = folder / "gt"
        if scene == "ring":
            from sfm_shapefit.synthetic import SceneOptions, make_scene
            from sfm_shapefit.synthetic.workspace import write_workspace

            folder = Path(name) / "ring"
            write_workspace(make_scene(SceneOptions(**ring)), folder)  # type: ignore[arg-type]
            truth = folder / "sparse" / "0"
        return [
            call(
                *(measure, scene, mapper, folder / "database.db", truth, min_matches, threads),
                environment=thread_environment(threads),
            )
            for mapper, min_matches in SETTINGS
        ]


def measure(scene: str, mapper: str, database: Path, truth: Path, min_matches: int, threads: int) -> Outcome:
    """Run one mapper once, and compare its largest model with the truth."""
    import sfm_shapefit
    from peers.colmap import map_database
    from sfm_shapefit.colmap.quiet import quiet_stderr

    def run() -> object:
        with quiet_stderr():
            if mapper == "map":
                return ours.map_database(database, bundle_adjust=True, threads=threads)
            is_incremental = mapper == "incremental"
            try:
                return map_database(database, min_matches, incremental=is_incremental, num_threads=threads)[0]
            except RuntimeError:
                return None

    if mapper == "map":
        # Compiled code is loaded.
        ours.map_database(ROOT / "data_synthetic" / "ring8" / "database.db", bundle_adjust=True, threads=1)
    done = ours.time_call(run)
    errors = {}
    if done.found is not None:
        found = sfm_shapefit.evaluate(done.found, truth)
        errors = dict(zip(found.names, found.position_errors.tolist(), strict=True))
    return Outcome(scene, mapper, min_matches, done.cpu_s, done.wall_s, errors)


def checks(runs: Sequence[Outcome]) -> list[Check]:
    """Return the check of the mean error against the better peer, on all its cameras; ours comes first."""
    ours, *peers = (run.mean() for run in runs)
    off = ratio(ours, min(peers, default=math.nan))
    return [Check(name="mean error / better peer", value=off, limit=LARGEST_RATIO)]


def tables(measured: Mapping[str, Sequence[Outcome]], _args: argparse.Namespace) -> Iterator[str]:
    yield (
        f"The limit is {LARGEST_RATIO} times the mean error of the better of pycolmap's mappers at its better"
        f" setting. The ring: {RING['num_images']} images with a share of {RING['wrong_match_fraction']} of"
        " all matches wrong; truth in its own units."
    )

    def show_mean(run: Outcome) -> str:
        among = "" if run.mapper == "map" else f" ({number(run.mean(measured[run.scene][0].errors))})"
        return number(run.mean()) + among

    yield table_of(
        [run for runs in measured.values() for run in runs],
        {
            "scene": lambda run: run.scene,
            "mapper": lambda run: run.mapper,
            "least matches": lambda run: str(run.min_matches or "chosen"),
            "placed": lambda run: str(len(run.errors)),
            "mean error": show_mean,
            "CPU, wall s": lambda run: f"{run.cpu_s:.1f}, {run.wall_s:.1f}",
            "result": lambda run: verdict(checks(measured[run.scene])) if run.mapper == "map" else "",
        },
    )


BENCHMARK = Benchmark(
    name="map",
    title="map: from a database to an adjusted model",
    cases=cases,
    checks=checks,
    tables=tables,
    quantities=(
        Quantity("mean error", "truth's", "lower", 0.05, "of the placed cameras; (of those `map` placed)"),
        Quantity("placed", "1", "higher", 0.0, "cameras of the largest model"),
        Quantity("CPU, wall", "s", "lower", 0.3, "time of the whole run"),
    ),
)
