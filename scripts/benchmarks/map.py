"""End to end from a database: `map`, adjusted and bundle adjusted, beside pycolmap's two mappers.

All start from the same verified matches and intrinsics. The mappers of pycolmap, global and incremental, run
on a copy of the database with 15 and with 30 as the least number of matches of a pair, and the better setting
counts; `map` chooses by itself. They refine focal lengths; `map` keeps those of the database. Errors are
those of the largest model against the truth after robust alignment.

CPU seconds are those of a whole process with one thread, imports and writing included, and with kernels
compiled: a run on the bundled ring comes before. How far the averaged rotations are off, before anything is
placed, `averaging` measures.

The scenes of `LIMITS` were looked at when the method was chosen. Those of `FURTHER` were not: images drawn
with a seed, and SIFT, matches and verification by pycolmap.
"""

import argparse
import json
import math
import os
import sqlite3
import struct
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

import sfm_shapefit
from harness.driver import ROOT, Benchmark, Case, Kept, if_there
from harness.process import call, children_cpu_s, run_command, thread_environment
from harness.record import Check, Row, at_least, at_most, ratio, versions
from harness.scenes import write_scene

OURS = ("map", "map --adjust full")
MAPPERS, MIN_MATCHES = ("global", "incremental"), (15, 30)
LARGEST_RATIO = 1.15
"""Of the mean error of `map --adjust full` on a further scene, to that of the better peer."""


LIMITS: dict[str, tuple[tuple[float, float, int, float], ...]] = {
    "fountain-P11": ((0.0020, 0.0023, 11, 3.0), (0.0020, 0.0023, 11, 3.5)),
    "Herz-Jesus-P8": ((0.0028, 0.0036, 8, 2.5), (0.0025, 0.0034, 8, 3.0)),
    "Herz-Jesus-P25": ((0.0054, 0.0055, 25, 5.0), (0.0049, 0.0052, 25, 6.0)),
    "castle-P19": ((0.0150, 0.0235, 19, 4.0), (0.0175, 0.0245, 19, 5.0)),
    "castle-P30": ((0.0200, 0.0230, 30, 5.0), (0.0190, 0.0212, 30, 7.0)),
    "lego100": ((0.0041, 0.0050, 100, 5.0), (0.0028, 0.0036, 100, 7.0)),
    "liberty-calibrated": ((0.0114, 0.045, 106, 8.0), (0.0085, 0.0150, 106, 10.0)),
    "ring 300": ((0.0036, 0.0040, 300, 20.0), (0.0036, 0.0040, 300, math.inf)),
    "facade 300": ((0.0035, 0.0038, 300, 20.0), (0.0035, 0.0038, 300, math.inf)),
}
"""Median, mean, cameras placed and CPU seconds to reach, by each of `OURS`."""
_LARGE = {"num_images": 300, "wrong_match_fraction": 0.05, "seed": 1}
MADE: dict[str, dict[str, Any]] = {
    "ring 300": {**_LARGE, "shape": "ring", "num_points": 6000},
    "facade 300": {**_LARGE, "shape": "facade", "num_points": 10_000},
    "ring": {"shape": "ring", "num_images": 10, "num_points": 500, "wrong_match_fraction": 0.02, "seed": 6},
}
_SIZE = {"image_width": 800, "image_height": 600, "focal_length_px": 667.0}
SIMPLE_LENS = "further: simple lens"
"""Its camera stands in the database as SIMPLE_RADIAL, which has no second coefficient."""
FURTHER: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "further: houses": ({"shape": "facade", "num_images": 36, "seed": 101}, {"repeated_fraction": 0.5}),
    "further: courtyard": ({"shape": "courtyard", "num_images": 40, "seed": 102}, {"repeated_fraction": 0.5}),
    "further: tower": ({"shape": "ring", "num_images": 48, "seed": 103}, {"repeated_fraction": 0.375}),
    "further: street": ({"shape": "drive", "num_images": 36, "seed": 104}, {}),
    SIMPLE_LENS: (
        {"shape": "facade", "num_images": 25, "seed": 105},
        {"radial_k1": -0.15, "radial_k2": 0.0},
    ),
    "further: wide lens": (
        {"focal_length_px": 450.0, "shape": "courtyard", "num_images": 30, "seed": 106},
        {"radial_k1": -0.12, "radial_k2": 0.015},
    ),
}
"""Options of scenes that are photographed, and of their pictures."""


class Outcome(NamedTuple):
    """One mapper on one scene."""

    mapper: str
    setting: str
    cpu_s: float
    wall_s: float
    errors: Mapping[str, float]
    """Position error of each placed camera by name, in the truth's units."""
    says: str = ""
    """Shares of its pairs and observations that agree, and the verdict, as `map` says."""

    def mean(self) -> float:
        """Return the mean error; NaN if no camera is placed."""
        return float(np.mean(list(self.errors.values()))) if self.errors else math.nan

    def median(self) -> float:
        """Return the median error; NaN if no camera is placed."""
        return float(np.median(list(self.errors.values()))) if self.errors else math.nan


def flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--folder", type=Path, help="where made scenes and answers of peers are kept (a temporary folder)"
    )
    parser.add_argument(
        "--no-peers", action="store_true", help="leave out pycolmap's mappers: they take long"
    )


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the scenes: those with limits, and the further ones."""
    if args.quick:
        return {"ring": partial(measure_scene, "ring", args)}
    places = {name: ROOT if name in MADE else args.data / name for name in LIMITS} | dict.fromkeys(
        FURTHER, ROOT
    )
    return {name: if_there(folder, partial(measure_scene, name, args)) for name, folder in places.items()}


def measure_scene(name: str, args: argparse.Namespace) -> list[Row]:
    """Run all mappers on one scene, each in a fresh process."""
    with tempfile.TemporaryDirectory() as temporary:
        kept_in = args.folder or Path(temporary)
        folder = make_scene(name, kept_in) if name in MADE or name in FURTHER else args.data / name
        truth = folder / "gt" if (folder / "gt").exists() else folder / "sparse" / "0"
        database, variables = folder / "database.db", thread_environment(args.threads)
        settings = {"threads": args.threads, "versions": versions(["pycolmap"]), "scene": name}
        kept = Kept(kept_in / f"{folder.name}.peers" if args.folder else None, settings)
        peers = []
        for setting in ((mapper, least) for mapper in MAPPERS for least in MIN_MATCHES):
            if not args.no_peers or str(setting) in kept:
                ask = partial(
                    call, measure_peer, *setting, database, truth, args.threads, environment=variables
                )
                peers.append(kept.get(str(setting), ask))
        if not args.quick:  # which measures nothing that compiling would spoil
            ring = ROOT / "data_synthetic" / "ring8"
            measure_ours(OURS[1], ring / "database.db", ring / "sparse" / "0", Path(temporary) / "warm", 1)
        ours = [
            measure_ours(command, database, truth, Path(temporary) / str(k), args.threads)
            for k, command in enumerate(OURS)
        ]
        return judge(name, ours, peers)


def make_scene(name: str, folder: Path) -> Path:
    """Make a scene in a folder unless it has it, and return its own folder."""
    out = folder / name.replace(": ", "-").replace(" ", "-")
    if not out.exists() and name in MADE:
        write_scene(out, MADE[name])
    elif not out.exists():
        write_scene(out, _SIZE | FURTHER[name][0], FURTHER[name][1])
        if name == SIMPLE_LENS:
            _simplify_camera(out / "database.db")
    return out


def _simplify_camera(database: Path) -> None:
    """Let the only camera of a database, RADIAL with k2 = 0, be SIMPLE_RADIAL."""
    import pycolmap

    with closing(sqlite3.connect(database)) as opened, opened:
        ((params,),) = opened.execute("SELECT params FROM cameras").fetchall()
        *simple, last = struct.unpack("<5d", params)
        assert last == 0.0
        model = int(pycolmap.CameraModelId.SIMPLE_RADIAL)
        opened.execute("UPDATE cameras SET model = ?, params = ?", (model, struct.pack("<4d", *simple)))


def measure_ours(command: str, database: Path, truth: Path, out: Path, threads: int) -> Outcome:
    """Run `map` once, and compare its largest model with the truth."""
    before, start = children_cpu_s(), time.perf_counter()
    with patch.dict(os.environ, thread_environment(threads)):
        run_command(*command.split(), database, out, "--threads", threads, "-q")
    cpu_s, wall_s = children_cpu_s() - before, time.perf_counter() - start
    located = json.loads((out / "map.json").read_text(encoding="utf-8"))["models"][0]["located"]
    agreeing = ", ".join(f"{located['agreement'][of]:.2f}" for of in ("pairs", "observations"))
    errors = call(errors_by_name, out / "0", truth)
    return Outcome(command, "chosen", cpu_s, wall_s, errors, f"{agreeing}, {located['verdict']['grade']}")


def measure_peer(mapper: str, min_matches: int, database: Path, truth: Path, threads: int) -> Outcome:
    """Run one mapper of pycolmap once, and compare its largest model with the truth; in its own process."""
    from paper.colmap_peer import map_database
    from sfm_shapefit.files.colmap.quiet import quiet_stderr

    start, errors = time.perf_counter(), {}
    with quiet_stderr():
        try:
            found = map_database(
                database, min_matches, incremental=mapper == "incremental", num_threads=threads
            )
            errors = errors_by_name(found[0], truth)
        except RuntimeError:
            pass  # no model came out
    return Outcome(mapper, str(min_matches), time.process_time(), time.perf_counter() - start, errors)


def errors_by_name(found: Any, truth: Path) -> dict[str, float]:
    """Return the position error of each camera that a model and the truth have in common."""
    try:
        compared = sfm_shapefit.evaluate(found, truth)
    except sfm_shapefit.ShapeFitError:
        # A model of two cameras cannot be compared.
        return {}
    return dict(zip(compared.names, compared.position_errors.tolist(), strict=True))


def best(runs: Sequence[Outcome]) -> Outcome | None:
    """Return the run with the lowest mean error, if one placed a camera."""
    return min((run for run in runs if run.errors), key=Outcome.mean, default=None)


def judge(name: str, ours: Sequence[Outcome], peers: Sequence[Outcome]) -> list[Row]:
    """Return the rows of a scene; the better setting of a peer is bold."""
    kind = "Further scenes" if name in FURTHER else "Scenes with limits"
    better = [best([run for run in peers if run.mapper == mapper]) for mapper in MAPPERS]
    limits, rows = LIMITS.get(name, ()), []
    for k, run in enumerate([*ours, *peers]):
        checks: list[Check] = []
        if run in ours and limits:
            median, mean, placed, cpu_s = limits[k]
            checks = at_most(median=(run.median(), median), mean=(run.mean(), mean))
            checks += at_least(placed=(len(run.errors), placed))
            checks += at_most(CPU_s=(run.cpu_s, cpu_s if math.isfinite(cpu_s) else None))
        elif run is ours[-1] and name in FURTHER and (peer := best(peers)):
            checks = [Check("mean error / better peer", ratio(run.mean(), peer.mean()), LARGEST_RATIO)]
        common = [error for camera, error in run.errors.items() if camera in ours[0].errors]
        cells = {
            "scene": name,
            "mapper": f"**{run.mapper}**" if run in better else run.mapper,
            "least matches": run.setting,
            "placed": len(run.errors),
            "median / mean error": [run.median(), run.mean()],
            "of those `map` placed": float(np.mean(common)) if run in peers and common else "",
            "CPU, wall s": f"{run.cpu_s:.1f}, {run.wall_s:.1f}",
            "agreeing, verdict": run.says,
        }
        rows.append(Row(cells, checks, kind))
    return rows


def _say_what_was_made(_rows: Sequence[Row]) -> Iterator[str]:
    sizes = ", ".join(
        f"{name} of {made['num_points']} points" for name, made in MADE.items() if name in LIMITS
    )
    yield (
        f"Made scenes: {sizes}, a share of {_LARGE['wrong_match_fraction']} of all matches wrong. The limit"
        f" of further scenes is {LARGEST_RATIO} times the mean error of the better of pycolmap's mappers, for"
        " `map --adjust full`. The better setting of a mapper is bold. With `--folder`, what a peer"
        " reached in an earlier run with the same threads and versions is not measured again."
    )


BENCHMARK = Benchmark(
    name="map",
    title="map: from a database to an adjusted model",
    cases=cases,
    flags=flags,
    closing=_say_what_was_made,
    columns={
        "median / mean error": "truth's; positions of the placed cameras",
        "of those `map` placed": "truth's; mean error",
        "placed": "cameras of the largest model that have a truth",
        "CPU, wall": "s; time of the whole process",
        "agreeing": "1; shares of the pairs and observations that agree with the model, of those that say"
        " anything, by `map`",
    },
)
