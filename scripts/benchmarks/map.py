"""End to end from a database: `map`, adjusted and bundle adjusted, beside pycolmap's two mappers.

All start from the same verified matches and intrinsics. The mappers of pycolmap, global and incremental, run
on a copy of the database with 15 and with 30 as the least number of matches of a pair, and the better setting
counts; `map` chooses by itself. They refine focal lengths; `map` keeps those of the database. Errors are
those of the largest model against the truth after robust alignment.

CPU seconds are those of a whole process with one thread, imports and writing included, and with kernels
compiled: a run on the bundled ring comes before. Rotation errors are those of the averaged rotations, before
anything is placed.

The scenes of `LIMITS` were looked at when the method was chosen. Those of `FURTHER` were not: images drawn
with a seed, and SIFT, matches and verification by pycolmap.
"""

import argparse
import json
import math
import os
import resource
import sqlite3
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from harness.driver import ROOT, Benchmark, Case, Kept, if_there
from harness.metrics import Check, Quantity, check_all, number, numbers, ratio, verdict
from harness.process import call, thread_environment
from harness.record import table_of, versions

OURS = ("map", "map --adjust full")
PEERS = tuple((mapper, k) for mapper in ("global", "incremental") for k in (15, 30))
LARGEST_RATIO = 1.15
"""Of the mean error of `map --adjust full` on a further scene, to that of the better peer."""
WRONG_DEG = 5.0


class Limit(NamedTuple):
    """What one command has to reach on a scene."""

    median: float
    mean: float
    placed: int
    cpu_s: float

    def checks(self, run: "Outcome") -> list[Check]:
        """Return the checks of a run."""
        return [
            Check(name="median", value=run.median(), limit=self.median),
            Check(name="mean", value=run.mean(), limit=self.mean),
            Check(name="placed", value=len(run.errors), limit=self.placed, better="higher"),
            Check(name="CPU s", value=run.cpu_s, limit=self.cpu_s),
        ]


class Target(NamedTuple):
    """What is to be reached on a scene."""

    adjusted: Limit
    bundle_adjusted: Limit
    rotations: Mapping[str, float] = {}
    """Of the averaged ones."""


LIMITS = {
    "fountain-P11": Target(Limit(0.0020, 0.0023, 11, 3.0), Limit(0.0020, 0.0023, 11, 3.5)),
    "Herz-Jesus-P8": Target(Limit(0.0028, 0.0036, 8, 2.5), Limit(0.0025, 0.0034, 8, 3.0)),
    "Herz-Jesus-P25": Target(
        Limit(0.0054, 0.0055, 25, 5.0), Limit(0.0049, 0.0052, 25, 6.0), {"mean deg": 0.051}
    ),
    "castle-P19": Target(Limit(0.0150, 0.0235, 19, 4.0), Limit(0.0175, 0.0245, 19, 5.0), {"mean deg": 0.075}),
    "castle-P30": Target(Limit(0.0200, 0.0230, 30, 5.0), Limit(0.0190, 0.0212, 30, 7.0), {"mean deg": 0.061}),
    "lego100": Target(
        Limit(0.0041, 0.0050, 100, 5.0),
        Limit(0.0028, 0.0036, 100, 7.0),
        {"mean deg": 0.15, "beyond 5 deg": 0.0},
    ),
    "liberty-calibrated": Target(
        Limit(0.0114, 0.045, 106, 8.0), Limit(0.0085, 0.0150, 106, 10.0), {"beyond 5 deg": 12.0}
    ),
    "ring 300": Target(Limit(0.0036, 0.0040, 300, 20.0), Limit(0.0036, 0.0040, 300, math.inf)),
    "facade 300": Target(Limit(0.0035, 0.0038, 300, 20.0), Limit(0.0035, 0.0038, 300, math.inf)),
}
_LARGE = {"num_images": 300, "wrong_match_fraction": 0.05}
MADE: dict[str, dict[str, Any]] = {
    "ring 300": {**_LARGE, "shape": "ring", "num_points": 6000, "seed": 1},
    "facade 300": {**_LARGE, "shape": "facade", "num_points": 10_000, "seed": 1},
}
QUICK = {"shape": "ring", "num_images": 10, "num_points": 500, "wrong_match_fraction": 0.02, "seed": 6}
_SIZE = {"image_width": 800, "image_height": 600, "focal_length_px": 667.0}


class Drawn(NamedTuple):
    """A scene to be photographed."""

    scene: Mapping[str, Any]
    render: Mapping[str, Any]
    is_simple: bool = False
    """Whether the camera stands in the database as SIMPLE_RADIAL, which has no second coefficient."""


FURTHER = {
    "further: houses": Drawn(
        {**_SIZE, "shape": "facade", "num_images": 36, "seed": 101}, {"repeated_fraction": 0.5}
    ),
    "further: courtyard": Drawn(
        {**_SIZE, "shape": "courtyard", "num_images": 40, "seed": 102}, {"repeated_fraction": 0.5}
    ),
    "further: tower": Drawn(
        {**_SIZE, "shape": "ring", "num_images": 48, "seed": 103}, {"repeated_fraction": 0.375}
    ),
    "further: street": Drawn({**_SIZE, "shape": "drive", "num_images": 36, "seed": 104}, {}),
    "further: simple lens": Drawn(
        {**_SIZE, "shape": "facade", "num_images": 25, "seed": 105},
        {"radial_k1": -0.15, "radial_k2": 0.0},
        is_simple=True,
    ),
    "further: wide lens": Drawn(
        {**_SIZE, "focal_length_px": 450.0, "shape": "courtyard", "num_images": 30, "seed": 106},
        {"radial_k1": -0.12, "radial_k2": 0.015},
    ),
}


class Outcome(NamedTuple):
    """One mapper on one scene."""

    mapper: str
    min_matches: int
    """Of the setting; 0 where the mapper chose."""
    cpu_s: float
    wall_s: float
    errors: Mapping[str, float]
    """Position error of each placed camera by name, in the truth's units."""
    verdict: str = ""
    """What `map` says of its model."""
    agreeing: Sequence[float] = ()
    """The shares of its pairs and observations that agree, as `map` says."""

    def mean(self, names: Collection[str] | None = None) -> float:
        """Return the mean error, of some of the cameras if they are named; NaN if none is placed."""
        chosen = [e for name, e in self.errors.items() if names is None or name in names]
        return float(np.mean(chosen)) if chosen else math.nan

    def median(self) -> float:
        """Return the median error; NaN if no camera is placed."""
        return float(np.median(list(self.errors.values()))) if self.errors else math.nan


class Measured(NamedTuple):
    """All mappers on one scene."""

    scene: str
    ours: Sequence[Outcome]
    """As `OURS`."""
    peers: Sequence[Outcome]
    rotations: Mapping[str, float]
    """Errors of the averaged rotations."""

    def best_peer(self) -> Outcome | None:
        """Return the run of a peer with the lowest mean error, if one placed a camera."""
        return min((run for run in self.peers if run.errors), key=Outcome.mean, default=None)


def flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--folder", type=Path, help="where made scenes and answers of peers are kept (a temporary folder)"
    )
    parser.add_argument(
        "--no-peers", action="store_true", help="leave out pycolmap's mappers, which take long"
    )


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the scenes: those with limits, and the further ones."""
    if args.quick:
        return {"ring": partial(measure_scene, "ring", args)}
    names = (*LIMITS, *FURTHER)
    return {
        name: if_there(
            ROOT if name in MADE or name in FURTHER else args.data / name, partial(measure_scene, name, args)
        )
        for name in names
    }


def measure_scene(name: str, args: argparse.Namespace) -> Measured:
    """Run all mappers on one scene, each in a fresh process."""
    with tempfile.TemporaryDirectory() as temporary:
        kept_in = args.folder or Path(temporary)
        folder = _make(name, kept_in) or args.data / name
        truth = folder / "gt" if (folder / "gt").exists() else folder / "sparse" / "0"
        database = folder / "database.db"
        variables = thread_environment(args.threads)
        peers = []
        settings = {"threads": args.threads, "versions": versions(["pycolmap"]), "scene": name}
        kept = Kept(kept_in / f"{folder.name}.peers" if args.folder else None, settings)
        for mapper, limit in PEERS:
            if not args.no_peers or f"{mapper} {limit}" in kept:
                ask = partial(
                    *(call, measure_peer, mapper, limit, database, truth, args.threads),
                    environment=variables,
                )
                peers.append(kept.get(f"{mapper} {limit}", ask))
        if not args.quick:  # which measures nothing that compiling would spoil
            run_ours(ROOT / "data_synthetic" / "ring8" / "database.db", Path(temporary) / "warm", OURS[1], 1)
        ours = [
            measure_ours(command, database, truth, Path(temporary) / str(k), args.threads)
            for k, command in enumerate(OURS)
        ]
        return Measured(name, ours, peers, call(measure_rotations, database, truth, environment=variables))


def _make(name: str, folder: Path) -> Path | None:
    """Make a scene in a folder unless it has it, and return its own folder; None of a real scene."""
    from sfm_shapefit.synthetic import RenderOptions, SceneOptions, make_scene
    from sfm_shapefit.synthetic.rendered_workspace import write_rendered_workspace
    from sfm_shapefit.synthetic.rendering import make_rendered_scene
    from sfm_shapefit.synthetic.workspace import write_workspace

    out = folder / name.replace(": ", "-").replace(" ", "-")
    if name in FURTHER:
        drawn = FURTHER[name]
        if not out.exists():
            scene = make_rendered_scene(SceneOptions(**drawn.scene), RenderOptions(**drawn.render))
            write_rendered_workspace(scene, out)
            if drawn.is_simple:
                _simplify_camera(out / "database.db")
        return out
    options = QUICK if name == "ring" else MADE.get(name)
    if options is None:
        return None
    if not out.exists():
        write_workspace(make_scene(SceneOptions(**options)), out)  # type: ignore[arg-type]
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
    cpu_s, wall_s = run_ours(database, out, command, threads)
    located = json.loads((out / "map.json").read_text(encoding="utf-8"))["models"][0]["located"]
    return Outcome(
        mapper=command,
        min_matches=0,
        cpu_s=cpu_s,
        wall_s=wall_s,
        errors=call(errors_by_name, out / "0", truth),
        verdict=located["verdict"]["grade"],
        agreeing=[located["agreement"][of] for of in ("pairs", "observations")],
    )


def run_ours(database: Path, out: Path, command: str, threads: int) -> tuple[float, float]:
    """Run a command of ours in a process, and return the seconds of CPU and of the clock that it took.

    Raises:
        RuntimeError: if it fails, with its last lines.
    """
    words = [*command.split(), str(database), str(out), "--threads", str(threads), "-q"]
    before, start = _children_s(), time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "sfm_shapefit", *words],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
        env={**os.environ, **thread_environment(threads)},
    )
    if done.returncode:
        raise RuntimeError(f"{command} ended with code {done.returncode}: {done.stderr.strip()[-300:]}")
    return _children_s() - before, time.perf_counter() - start


def _children_s() -> float:
    """Return the CPU seconds of all child processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def measure_peer(mapper: str, min_matches: int, database: Path, truth: Path, threads: int) -> Outcome:
    """Run one mapper of pycolmap once, and compare its largest model with the truth; in its own process."""
    from paper.colmap_peer import map_database
    from sfm_shapefit.files.colmap.quiet import quiet_stderr

    start = time.perf_counter()
    with quiet_stderr():
        try:
            found = map_database(
                database, min_matches, incremental=mapper == "incremental", num_threads=threads
            )[0]
        except RuntimeError:
            found = None
    cpu_s, wall_s = time.process_time(), time.perf_counter() - start
    errors = {} if found is None else errors_by_name(found, truth)
    return Outcome(mapper, min_matches, cpu_s, wall_s, errors)


def errors_by_name(found: Any, truth: Path) -> dict[str, float]:
    """Return the position error of each camera that a model and the truth have in common."""
    import sfm_shapefit

    try:
        compared = sfm_shapefit.evaluate(found, truth)
    except sfm_shapefit.ShapeFitError:
        # A model of two cameras cannot be compared.
        return {}
    return dict(zip(compared.names, compared.position_errors.tolist(), strict=True))


def measure_rotations(database: Path, truth: Path) -> dict[str, float]:
    """Return the errors of the averaged rotations, of the images with truth; in its own process."""
    from benchmarks.averaging import errors_deg
    from sfm_shapefit import relative_rotations
    from sfm_shapefit.files.colmap.model import read_model
    from sfm_shapefit.rotations.average import average_relative_rotations

    relative, known = relative_rotations(database), read_model(truth)
    found = average_relative_rotations(len(relative.names), relative)
    row_of = {name: k for k, name in enumerate(known.names)}
    rows = [k for k, name in enumerate(relative.names) if found.registered[k] and name in row_of]
    true = known.rotations[[row_of[relative.names[k]] for k in rows]]
    errors = errors_deg(found.rotations[rows], true)
    return {"mean deg": float(errors.mean()), "beyond 5 deg": float((errors > WRONG_DEG).sum())}


def checks(one: Measured) -> list[Check]:
    """Return the limits of a scene."""
    if one.scene in LIMITS:
        target = LIMITS[one.scene]
        limits = zip((target.adjusted, target.bundle_adjusted), one.ours, strict=True)
        found = [check for limit, run in limits for check in _name(limit.checks(run), run.mapper)]
        # What is not finite is no limit.
        found = [check for check in found if math.isfinite(check.limit)]
        return found + check_all(one.rotations, target.rotations)
    best = one.best_peer()
    if best is None:
        return []
    off = ratio(one.ours[-1].mean(), best.mean())
    return [Check(name="mean error / better peer", value=off, limit=LARGEST_RATIO)]


def _name(found: Sequence[Check], mapper: str) -> list[Check]:
    return [
        Check(name=f"{mapper}: {one.name}", value=one.value, limit=one.limit, better=one.better)
        for one in found
    ]


def tables(measured: Mapping[str, Measured], _args: argparse.Namespace) -> Iterator[str]:
    for title, chosen in (
        ("## Scenes with limits", [one for one in measured.values() if one.scene not in FURTHER]),
        ("## Further scenes", [one for one in measured.values() if one.scene in FURTHER]),
    ):
        if chosen:
            yield title
            yield _show(chosen)
            yield _show_evidence(chosen)
    sizes = ", ".join(f"{name} of {made['num_points']} points" for name, made in MADE.items())
    yield (
        f"Made scenes: {sizes}, a share of {_LARGE['wrong_match_fraction']} of all matches wrong. The limit"
        f" of further scenes is {LARGEST_RATIO} times the mean error of the better of pycolmap's mappers, for"
        " `map --adjust full`. The better setting of a mapper is bold. With `--folder`, what a peer"
        " reached in an earlier run with the same threads and versions is not measured again."
    )


def _show(chosen: Sequence[Measured]) -> str:
    """Return all runs of some scenes; the cell of a better setting of a peer is bold."""
    rows = [(one, run) for one in chosen for run in (*one.ours, *one.peers)]
    better = {id(_better(one, mapper)) for one in chosen for mapper in ("global", "incremental")}
    columns: dict[str, Callable[[tuple[Measured, Outcome]], str]] = {
        "scene": lambda row: row[0].scene,
        "mapper": lambda row: f"**{row[1].mapper}**" if id(row[1]) in better else row[1].mapper,
        "least matches": lambda row: str(row[1].min_matches or "chosen"),
        "placed": lambda row: str(len(row[1].errors)),
        "median / mean error": lambda row: numbers([row[1].median(), row[1].mean()]),
        "of those `map` placed": lambda row: (
            "" if row[1].mapper in OURS else number(row[1].mean(row[0].ours[0].errors))
        ),
        "CPU, wall s": lambda row: f"{row[1].cpu_s:.1f}, {row[1].wall_s:.1f}",
    }
    return table_of(rows, columns)


def _better(one: Measured, mapper: str) -> Outcome | None:
    """Return the run of a peer at its better setting."""
    runs = [run for run in one.peers if run.mapper == mapper and run.errors]
    return min(runs, key=Outcome.mean, default=None)


def _show_evidence(chosen: Sequence[Measured]) -> str:
    """Return what `map` says of its models, and whether limits are met."""
    return table_of(
        chosen,
        {
            "scene": lambda one: one.scene,
            "averaged: mean deg": lambda one: number(one.rotations["mean deg"]),
            "beyond 5 deg": lambda one: f"{one.rotations['beyond 5 deg']:.0f}",
            "agreeing pairs, observations": lambda one: ", ".join(
                f"{share:.2f}" for share in one.ours[0].agreeing
            ),
            "verdict": lambda one: one.ours[0].verdict,
            "bundle adjusted": lambda one: ", ".join(
                [*(f"{share:.2f}" for share in one.ours[1].agreeing), one.ours[1].verdict]
            ),
            "result": lambda one: verdict(checks(one)),
        },
    )


BENCHMARK = Benchmark(
    name="map",
    title="map: from a database to an adjusted model",
    cases=cases,
    checks=checks,
    tables=tables,
    flags=flags,
    quantities=(
        Quantity("median / mean error", "truth's", "lower", 0.05, "positions of the placed cameras"),
        Quantity("of those `map` placed", "truth's", "lower", 0.05, "mean error"),
        Quantity("placed", "1", "higher", 0.0, "cameras of the largest model that have a truth"),
        Quantity("CPU, wall", "s", "lower", 0.3, "time of the whole process"),
        Quantity("averaged: mean deg", "deg", "lower", 0.05, "rotation error before anything is placed"),
        Quantity(
            "beyond 5 deg", "1", "lower", 0.0, "cameras with a truth whose averaged rotation is so wrong"
        ),
        Quantity(
            *("agreeing pairs, observations", "1", "higher", 0.02),
            "shares of what says anything that agrees with the model, by `map`",
        ),
    ),
)
