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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """One mapper on one scene."""

    scene: str
    mapper: str
    min_matches: int
    """Of the setting; 0 where the mapper chose."""
    names: tuple[str, ...]
    errors: tuple[float, ...]
    """Position error of each placed camera, in the truth's units."""
    cpu_s: float
    wall_s: float

    @property
    def mean(self) -> float:
        """Mean error; NaN if nothing was placed."""
        return float(np.mean(self.errors)) if self.errors else math.nan

    def mean_among(self, names: Sequence[str]) -> float:
        """Mean error of some of the cameras."""
        chosen = [e for name, e in zip(self.names, self.errors, strict=True) if name in set(names)]
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
    errors = None if done.found is None else sfm_shapefit.evaluate(done.found, truth)
    return Outcome(
        scene=scene,
        mapper=mapper,
        min_matches=min_matches,
        names=() if errors is None else tuple(errors.names),
        errors=() if errors is None else tuple(errors.position_errors.tolist()),
        cpu_s=done.cpu_s,
        wall_s=done.wall_s,
    )


def checks(runs: Sequence[Outcome]) -> list[Check]:
    """Return the check of the mean error against the better peer, on all its cameras; ours comes first."""
    best = min((run.mean for run in runs[1:]), default=math.nan)
    return [Check(name="mean error / better peer", value=ratio(runs[0].mean, best), limit=LARGEST_RATIO)]


def tables(measured: Mapping[str, Sequence[Outcome]], _args: argparse.Namespace) -> Iterator[str]:
    yield (
        f"The limit is {LARGEST_RATIO} times the mean error of the better of pycolmap's mappers at its better"
        f" setting. The ring: {RING['num_images']} images with a share of {RING['wrong_match_fraction']} of"
        " all matches wrong; truth in its own units."
    )

    def show_mean(run: Outcome) -> str:
        among = "" if run.mapper == "map" else f" ({number(run.mean_among(measured[run.scene][0].names))})"
        return number(run.mean) + among

    yield table_of(
        [run for runs in measured.values() for run in runs],
        {
            "scene": lambda run: run.scene,
            "mapper": lambda run: run.mapper,
            "least matches": lambda run: str(run.min_matches or "chosen"),
            "placed": lambda run: str(len(run.names)),
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
        Quantity(
            *("mean error", "truth's", "lower", 0.05),
            "mean position error of the placed cameras; in brackets on those that `map` placed",
        ),
        Quantity("placed", "1", "higher", 0.0, "cameras of the largest model"),
        Quantity("CPU, wall", "s", "lower", 0.3, "time of the whole run"),
    ),
)
