"""End to end from a database: `map` with bundle adjustment beside pycolmap's global and incremental mapping.

All start from the same verified matches and intrinsics. The mappers of pycolmap run on a copy of the
database, with 15 and with 30 as the least number of matches of a pair, and the better one counts; `map`
chooses by itself. They refine focal lengths; `map` keeps those of the database. Errors are those of the
largest model against the truth after robust alignment; since `map` leaves out cameras it does not trust,
the peers' errors are also given on the cameras that `map` placed. One thread each, one run each in a fresh
process; `map` has its numba kernels loaded by a run on the bundled ring before.
"""

import argparse
import math
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.metrics import Check, Quantity, number, ratio, verdict
from benchmarks.process import call, thread_environment
from benchmarks.record import environment, legend, table, write_section

HELP = "From a database to an adjusted model: map, pycolmap's global mapping and its incremental mapping."
ROOT = Path(__file__).parents[2]
PACKAGES = ("numpy", "scipy", "numba", "pycolmap")
SCENES = ("castle-P30", "lego100", "ring")
MIN_MATCHES = (15, 30)
LARGEST_RATIO = 1.15
RING = {"shape": "ring", "num_images": 50, "num_points": 2000, "wrong_match_fraction": 0.02, "seed": 6}

QUANTITIES = (
    Quantity(
        name="mean error",
        unit="truth's",
        better="lower",
        rel_tol=0.05,
        meaning="mean position error of the placed cameras; in brackets on those that `map` placed",
    ),
    Quantity(name="placed", unit="1", better="higher", rel_tol=0.0, meaning="cameras of the largest model"),
    Quantity(name="CPU, wall", unit="s", better="lower", rel_tol=0.3, meaning="time of the whole run"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """One mapper on one scene."""

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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--data", type=Path, default=ROOT.parent / "shared" / "data", help="Folder of the scenes."
    )
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--output", type=Path, default=ROOT / "scripts" / "results.md")


def run(args: argparse.Namespace) -> int:
    about = environment(PACKAGES, f"python scripts/benchmark.py map --scenes {' '.join(args.scenes)}")
    measured: dict[str, list[Outcome]] = {}
    for scene in args.scenes:
        if scene != "ring" and not (args.data / scene).is_dir():
            print(f"{scene} is not at hand; skipped", file=sys.stderr)
            continue
        measured[scene] = measure_scene(scene, args.data)
        print("\n".join(" | ".join(row) for row in _rows(scene, measured[scene])), flush=True)
    write_section(args.output, "map", section(measured, about))
    return 0 if all(verdict(checks(runs)) == "met" for runs in measured.values()) else 1


def measure_scene(scene: str, data: Path) -> list[Outcome]:
    """Run all mappers on one scene, each in a fresh process."""
    with tempfile.TemporaryDirectory() as folder:
        database, truth = _inputs(scene, data, Path(folder))
        settings = [("map", 0), *((m, k) for m in ("global", "incremental") for k in MIN_MATCHES)]
        return [
            call(measure, mapper, database, truth, k, environment=thread_environment(1))
            for mapper, k in settings
        ]


def _inputs(scene: str, data: Path, folder: Path) -> tuple[Path, Path]:
    """Return database and true model of a scene; the ring is made."""
    if scene != "ring":
        return data / scene / "database.db", data / scene / "gt"
    from sfm_shapefit.synthetic import SceneOptions, make_scene
    from sfm_shapefit.synthetic.workspace import write_workspace

    write_workspace(make_scene(SceneOptions(**RING)), folder / "ring")  # type: ignore[arg-type]
    return folder / "ring" / "database.db", folder / "ring" / "sparse" / "0"


def measure(mapper: str, database: Path, truth: Path, min_matches: int) -> Outcome:
    """Run one mapper once, and compare its largest model with the truth."""
    import sfm_shapefit
    from sfm_shapefit.colmap.quiet import quiet_stderr

    if mapper == "map":
        _map(ROOT / "data_synthetic" / "ring8" / "database.db")  # compiles or loads the kernels
    wall, cpu = time.perf_counter(), time.process_time()
    with quiet_stderr():
        model = _map(database) if mapper == "map" else _peer(mapper, database, min_matches)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    errors = None if model is None else sfm_shapefit.evaluate(model, truth)  # type: ignore[arg-type]
    return Outcome(
        mapper=mapper,
        min_matches=min_matches,
        names=() if errors is None else tuple(errors.names),
        errors=() if errors is None else tuple(errors.position_errors.tolist()),
        cpu_s=cpu,
        wall_s=wall,
    )


def _map(database: Path) -> object:
    """Return the largest model of `map` with bundle adjustment."""
    import sfm_shapefit

    options = sfm_shapefit.MapOptions(bundle_adjust=True, threads=1)
    return sfm_shapefit.map_database(database, options).models[0].located.reconstruction


def _peer(mapper: str, database: Path, min_matches: int) -> object:
    """Return the largest model of one of pycolmap's mappers; None if there is none."""
    import pycolmap

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        copied = Path(shutil.copyfile(database, folder / "database.db"))
        (folder / "images").mkdir()
        options = (
            pycolmap.GlobalPipelineOptions() if mapper == "global" else pycolmap.IncrementalPipelineOptions()
        )
        options.min_num_matches, options.num_threads, options.random_seed = min_matches, 1, 0
        function = pycolmap.global_mapping if mapper == "global" else pycolmap.incremental_mapping
        models = function(str(copied), str(folder / "images"), str(folder), options)
    return max(models.values(), key=lambda model: model.num_reg_images()) if models else None


def checks(runs: Sequence[Outcome]) -> list[Check]:
    """Return the check of the mean error against the better peer, on all its cameras."""
    ours = next(run for run in runs if run.mapper == "map")
    best = min((run.mean for run in runs if run.mapper != "map"), default=math.nan)
    return [Check(name="mean error / better peer", value=ratio(ours.mean, best), limit=LARGEST_RATIO)]


def section(measured: dict[str, list[Outcome]], about: str) -> str:
    """Return the section of results.md."""
    header = ["scene", "mapper", "least matches", "placed", "mean error", "CPU, wall s", "result"]
    rows = [row for scene, runs in measured.items() for row in _rows(scene, runs)]
    return "\n\n".join(
        [
            "## map: from a database to an adjusted model",
            about,
            f"The limit is {LARGEST_RATIO} times the mean error of the better of pycolmap's mappers at its "
            f"better setting. The ring: {RING['num_images']} images with a share of "
            f"{RING['wrong_match_fraction']} of all matches wrong; truth in its own units.",
            legend(QUANTITIES),
            table(header, rows),
        ]
    )


def _rows(scene: str, runs: Sequence[Outcome]) -> list[list[str]]:
    ours = next(run for run in runs if run.mapper == "map")
    return [
        [
            scene,
            run.mapper,
            str(run.min_matches or "chosen"),
            str(len(run.names)),
            number(run.mean) + ("" if run is ours else f" ({number(run.mean_among(ours.names))})"),
            f"{run.cpu_s:.1f}, {run.wall_s:.1f}",
            verdict(checks(runs)) if run is ours else "",
        ]
        for run in runs
    ]
