"""Real scenes: camera positions against ground truth, before and after bundle adjustment, and their time.

Every set is measured in its own fresh process, one after the other, so that the first run is a cold one and
the peak of memory is the set's own. Order in the process: cold run, peak memory read, warm runs; then, if
asked, GLOMAP's positioning and a run with bundle adjustment. Rotations and intrinsics are those of the set's
sparse/0, directions come from its database, and errors are taken by `sfm_shapefit.evaluate`.

For the sets liberty*, sparse/0 is the truth as well: rotations and truth come from one model, so their errors
are lower than with independent rotations.
"""

import argparse
import math
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.metrics import Check, Quantity, median, number, numbers, ratio, times, verdict
from benchmarks.process import peak_memory_mb
from benchmarks.record import environment, legend, table, write_section

if TYPE_CHECKING:
    from sfm_shapefit import LocateOptions, LocateResult

HELP = "Real scenes against their ground truth; skipped with a sentence where the data is missing."
ROOT = Path(__file__).parents[2]
PACKAGES = ("numpy", "scipy", "numba", "cvxpy", "clarabel", "pycolmap")


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """A data set and what is to be reached on it; limits of the median and mean position error."""

    name: str
    unit: str
    truth: str = "gt"
    limits: tuple[float, float] | None = None
    """Median and mean before bundle adjustment."""
    adjusted_reference: float | None = None
    """Mean error of the better of COLMAP incremental and GLOMAP, both after bundle adjustment."""
    averaged_limits: tuple[float, float] | None = None
    """Median and mean on rotations from averaging."""
    limit_s: float | None = None
    """End-to-end seconds without bundle adjustment."""


SCENES = {
    scene.name: scene
    for scene in (
        Scene(
            name="fountain-P11",
            unit="m",
            limits=(0.0024, 0.0025),
            adjusted_reference=0.0023,
            averaged_limits=(0.007, 0.010),
        ),
        Scene(name="Herz-Jesus-P8", unit="m", limits=(0.0036, 0.0042)),
        Scene(name="Herz-Jesus-P25", unit="m", limits=(0.0060, 0.0058), adjusted_reference=0.0053),
        Scene(name="castle-P19", unit="m", limits=(0.022, 0.050), adjusted_reference=0.0263),
        Scene(
            name="castle-P30",
            unit="m",
            limits=(0.027, 0.032),
            adjusted_reference=0.0232,
            limit_s=8.0,
            averaged_limits=(0.08, 0.11),
        ),
        Scene(name="lego100", unit="scene units", limits=(0.0052, 0.012)),
        Scene(name="liberty", unit="reference units", truth="sparse/0", limits=(0.004, 0.008), limit_s=15.0),
        Scene(name="liberty-calibrated", unit="reference units", truth="sparse/0", limits=(0.004, 0.008)),
    )
}
ADJUSTED_SLACK = 1.15  # "within 15 %" of the reference's mean error


@dataclass(frozen=True, slots=True, kw_only=True)
class Errors:
    """Position errors in the truth's units, over the cameras that model and truth have in common."""

    median: float
    mean: float
    max: float
    num_missing: int
    """Cameras of the truth that the model does not have; they are in no average."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Peer:
    """GLOMAP's positioning in one setting."""

    label: str
    errors: Errors | None = None
    """None if the positioning failed."""
    tracks_s: float = math.nan
    positioning_s: float = math.nan


@dataclass(frozen=True, slots=True, kw_only=True)
class Averaged:
    """One run on rotations from averaging."""

    refined: bool
    """Whether `locate` refined the rotations."""
    errors: Errors
    rotation_deg: tuple[float, float, float]
    """Median, mean and maximum of the rotation errors."""
    num_turned: int
    cpu_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """What one set gave; seconds are wall-clock unless they say CPU."""

    name: str
    num_posed: int
    num_placed: int
    num_pairs: int
    num_pairs_used: int
    errors: Errors
    gap: float
    converged: bool
    method: str
    cold_s: float
    warm_s: tuple[float, ...]
    cpu_s: tuple[float, ...]
    solve_s: float
    positions_s: float
    """Reading, directions, rigidity and solve, without structure and writing; compared with GLOMAP's time."""
    peak_memory_mb: float
    peers: tuple[Peer, ...] = ()
    adjusted: Errors | None = None
    adjustment_s: float = math.nan
    averaged: tuple[Averaged, ...] = ()


QUANTITIES = (
    Quantity(name="placed", unit="cameras", better="higher", rel_tol=0.0, meaning="of those with a rotation"),
    Quantity(
        name="pairs used",
        unit="pairs",
        better="neither",
        rel_tol=0.0,
        meaning="of all pairs with verified matches",
    ),
    Quantity(
        name="median / mean / max",
        unit="the set's",
        better="lower",
        rel_tol=0.01,
        meaning="position error after robust (L1) alignment, over the placed cameras of the truth",
    ),
    Quantity(
        name="gap",
        unit="1",
        better="lower",
        rel_tol=1.0,
        meaning="certified: objective minus a rigorous dual bound",
    ),
    Quantity(
        name="warm",
        unit="s",
        better="lower",
        rel_tol=0.5,
        meaning="`locate` and writing its output, wall-clock, median of the repeats after the cold run",
    ),
    Quantity(
        name="CPU",
        unit="s",
        better="lower",
        rel_tol=0.25,
        meaning="the same in processor time of all threads",
    ),
    Quantity(
        name="cold",
        unit="s",
        better="lower",
        rel_tol=0.5,
        meaning="first run of a fresh process, imports included; a first run ever also compiles and caches",
    ),
    Quantity(
        name="solve",
        unit="s",
        better="lower",
        rel_tol=0.5,
        meaning="the solver alone, by its own clock, median of the warm runs",
    ),
    Quantity(
        name="memory",
        unit="MB",
        better="lower",
        rel_tol=0.15,
        meaning="peak resident memory of the fresh process after the cold run, libraries included",
    ),
)


# --- the subcommand --------------------------------------------------------------------------------


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `real`."""
    parser.add_argument(
        "--sets", type=scene_names, default=list(SCENES), help="names, with commas; all by default"
    )
    parser.add_argument("--repeats", type=_positive, default=3, help="warm runs per set (default 3)")
    parser.add_argument("--bundle-adjust", action="store_true", help="also run with bundle adjustment, once")
    parser.add_argument(
        "--averaged",
        action="store_true",
        help="also run on rotations from averaging, as they are and with --refine-rotations, once each",
    )
    parser.add_argument(
        "--glomap", action="store_true", help="also run GLOMAP's positioning, once per setting"
    )
    parser.add_argument(
        "--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the sets"
    )
    parser.add_argument("--out", type=Path, default=ROOT / "scripts" / "results.md", help="file of results")


def scene_names(text: str) -> list[str]:
    """Parse `--sets`."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in SCENES]
    if unknown or not names:
        raise argparse.ArgumentTypeError(
            f"unknown set {', '.join(unknown) or '(none)'}; known: {', '.join(SCENES)}"
        )
    return list(dict.fromkeys(names))


def _positive(text: str) -> int:
    """Parse a number that is at least 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of 1 or more")
    return int(text)


def run(args: argparse.Namespace) -> int:
    """Measure the sets that are there, print the section and write it; a missed limit is no failure."""
    present = [name for name in args.sets if (args.data / name / "sparse" / "0").is_dir()]
    absent = [name for name in args.sets if name not in present]
    if absent:
        print(f"skipped: {', '.join(absent)} not found in {args.data}; give their folder with --data")
    if not present:
        return 0
    about = environment(PACKAGES, command_line(args))
    measured = []
    for name in present:
        print(f"measuring {name}", file=sys.stderr, flush=True)
        measured.append(_in_fresh_process(SCENES[name], args))
    body = section(measured, about, absent)
    print(body)
    write_section(args.out, "real", body)
    return 0


def command_line(args: argparse.Namespace) -> str:
    """Return the command that repeats the measurement, without paths."""
    sets = "" if args.sets == list(SCENES) else f" --sets {','.join(args.sets)}"
    flags = "".join(
        f" --{name.replace('_', '-')}"
        for name in ("bundle_adjust", "averaged", "glomap")
        if getattr(args, name)
    )
    return f"python scripts/benchmark.py real{sets} --repeats {args.repeats}{flags}"


# --- measuring -------------------------------------------------------------------------------------


def _in_fresh_process(scene: Scene, args: argparse.Namespace) -> Measured:
    """Call `measure` in a new process, which starts without anything imported."""
    with ProcessPoolExecutor(max_workers=1, mp_context=multiprocessing.get_context("spawn")) as pool:
        folder = args.data / scene.name
        extras = (args.bundle_adjust, args.glomap, args.averaged)
        return pool.submit(measure, scene, folder, args.repeats, *extras).result()


def measure(
    scene: Scene, folder: Path, repeats: int, bundle_adjust: bool, glomap: bool, averaged: bool = False
) -> Measured:
    """Measure one set; to be called once per process."""
    start = time.perf_counter()
    from sfm_shapefit import LocateOptions

    model = folder / "sparse" / "0"
    _timed_locate(model, LocateOptions())
    cold_s = time.perf_counter() - start
    peak_mb = peak_memory_mb()
    runs = [_timed_locate(model, LocateOptions()) for _ in range(repeats)]
    found = runs[-1][0]
    adjusted, adjustment_s = None, math.nan
    peers = _measure_glomap(folder, folder / scene.truth) if glomap else ()
    if bundle_adjust:
        refined = _timed_locate(model, LocateOptions(bundle_adjust=True))[0]
        adjusted = _errors(refined.reconstruction, folder / scene.truth)
        adjustment_s = refined.timings_s["bundle adjustment"]
    return Measured(
        name=scene.name,
        num_posed=found.model.num_images,
        num_placed=len(found.placement.cameras),
        num_pairs=len(found.directions.pairs),
        num_pairs_used=len(found.placement.pairs),
        errors=_errors(found.reconstruction, folder / scene.truth),
        gap=found.certified.gap,
        converged=found.certified.status.name == "CONVERGED",
        method=found.certified.method,
        cold_s=cold_s,
        warm_s=tuple(run[1] for run in runs),
        cpu_s=tuple(run[2] for run in runs),
        solve_s=median([run[0].solve.seconds for run in runs]),
        positions_s=median([_positions_s(run[0]) for run in runs]),
        peak_memory_mb=peak_mb,
        peers=peers,
        adjusted=adjusted,
        adjustment_s=adjustment_s,
        averaged=_measure_averaged(folder, folder / scene.truth) if averaged else (),
    )


def _measure_averaged(folder: Path, truth: Path) -> "tuple[Averaged, ...]":
    """Locate on rotations from averaging, as they are and refined."""
    from benchmarks.averaging import averaged_model
    from sfm_shapefit import LocateOptions, evaluate, locate

    model = averaged_model(folder / "database.db", folder / "sparse" / "0")
    measured = []
    for refine in (False, True):
        start = time.process_time()
        found = locate(model, folder / "database.db", options=LocateOptions(refine_rotations=refine))
        rotation = evaluate(found.reconstruction, truth).rotation_deg
        turned = 0 if found.turned_deg is None else int((found.turned_deg > 0.0).sum())
        measured.append(
            Averaged(
                refined=refine,
                errors=_errors(found.reconstruction, truth),
                rotation_deg=(rotation.median, rotation.mean, rotation.max),
                num_turned=turned,
                cpu_s=time.process_time() - start,
            )
        )
    return tuple(measured)


def _timed_locate(model: Path, options: "LocateOptions") -> "tuple[LocateResult, float, float]":
    """Locate and write; return the result, wall-clock seconds and CPU seconds."""
    from sfm_shapefit import locate, write_result

    with tempfile.TemporaryDirectory() as folder:
        start, cpu_start = time.perf_counter(), time.process_time()
        found = locate(model, options=options)
        write_result(found, Path(folder) / "out")
        return found, time.perf_counter() - start, time.process_time() - cpu_start


def _positions_s(found: "LocateResult") -> float:
    """Return the seconds until the positions were known."""
    later = ("structure", "triangulation", "bundle adjustment")
    return sum(seconds for stage, seconds in found.timings_s.items() if stage not in later)


def _errors(reconstruction: object, truth: Path) -> Errors:
    """Evaluate a pycolmap.Reconstruction against the truth."""
    from sfm_shapefit import evaluate

    found = evaluate(reconstruction, truth)  # type: ignore[arg-type]
    position = found.position
    return Errors(
        median=position.median, mean=position.mean, max=position.max, num_missing=len(found.missing)
    )


def _measure_glomap(folder: Path, truth: Path) -> tuple[Peer, ...]:
    """Run GLOMAP's positioning once in each of its settings."""
    from benchmarks.glomap import SETTINGS, position, quiet

    peers = []
    with quiet():
        for setting in SETTINGS:
            try:
                found = position(folder / "database.db", folder / "sparse" / "0", setting)
            except RuntimeError as error:
                print(f"GLOMAP, {setting.label}, on {folder.name}: {error}", file=sys.stderr)
                peers.append(Peer(label=f"{setting.label}: failed"))
                continue
            peers.append(
                Peer(
                    label=setting.label,
                    errors=_errors(found.reconstruction, truth),
                    tracks_s=found.tracks_s,
                    positioning_s=found.positioning_s,
                )
            )
    return tuple(peers)


# --- what is to be reached -------------------------------------------------------------------------


def error_checks(one: Measured) -> list[Check]:
    """Return the checks of accuracy before bundle adjustment."""
    limits = SCENES[one.name].limits
    if limits is None:
        return []
    return [
        Check(name="median", value=one.errors.median, limit=limits[0]),
        Check(name="mean", value=one.errors.mean, limit=limits[1]),
    ]


def adjusted_checks(one: Measured) -> list[Check]:
    """Return the check of the mean error after bundle adjustment."""
    reference = SCENES[one.name].adjusted_reference
    if reference is None or one.adjusted is None:
        return []
    return [Check(name="mean", value=one.adjusted.mean, limit=ADJUSTED_SLACK * reference)]


def time_checks(one: Measured) -> list[Check]:
    """Return the check of the warm time end to end."""
    limit = SCENES[one.name].limit_s
    return [] if limit is None else [Check(name="seconds", value=median(one.warm_s), limit=limit)]


def all_checks(one: Measured) -> list[Check]:
    """Return every check of one set."""
    return error_checks(one) + adjusted_checks(one) + time_checks(one)


# --- the section -----------------------------------------------------------------------------------


def section(measured: Sequence[Measured], about: str, absent: Sequence[str]) -> str:
    """Return the section of the file of results."""
    parts = ["## Real scenes", about]
    if absent:
        parts.append(f"Skipped, because the data is missing: {', '.join(absent)}.")
    checks = [check for one in measured for check in all_checks(one)]
    parts += [
        f"**{sum(check.met for check in checks)} of {len(checks)} limits met.** Errors are in the set's unit;"
        " a limit is compared with the unrounded value.",
        "### Before bundle adjustment",
        _accuracy_table(measured),
        "### Time and memory of `locate`, without bundle adjustment",
        _time_table(measured),
    ]
    if any(one.adjusted for one in measured):
        parts += [
            f"### After bundle adjustment (intrinsics fixed)\n\n{_ADJUSTED_NOTE}",
            _adjusted_table(measured),
        ]
    if any(one.averaged for one in measured):
        parts += [f"### Rotations from averaging\n\n{_AVERAGED_NOTE}", _averaged_table(measured)]
    if any(one.peers for one in measured):
        parts += [f"### GLOMAP's positioning, same rotations\n\n{_GLOMAP_NOTE}", _glomap_table(measured)]
    parts += ["### What the columns mean", legend(QUANTITIES), _CAVEATS]
    return "\n\n".join(part.strip() for part in parts)


_ADJUSTED_NOTE = (
    "The reference is the mean error of the better of COLMAP incremental and GLOMAP (its better setting of"
    " min_num_matches) after their own bundle adjustment, as recorded for the data, not run again here; the"
    " limit is 15 % above it. One run, one thread; lower is better."
)
_AVERAGED_NOTE = (
    "Rotations by pycolmap's rotation averaging of the database's relative poses (pairs of 15 matches or"
    " more), intrinsics of sparse/0, no centres; position error median / mean / max and rotation error in"
    " degrees, once with the rotations kept and once with `--refine-rotations`. The target is that of the"
    " kept rotations."
)
_GLOMAP_NOTE = (
    "Positions straight after `run_global_positioning`, no bundle adjustment, once per setting and in the"
    " same process. Its time is that call alone, in seconds; reading and track building, here partly in"
    " Python, stand apart and are not in the ratio. Ours is reading, directions, rigidity and solve (median"
    " of the warm runs). GLOMAP's cameras outside the largest component of valid pairs are missing and in no"
    " average. Ratios are GLOMAP's value over ours: above 1 ours is lower, and lower is better."
)
_CAVEATS = (
    "Caveats: liberty* are judged against the model that gives their rotations, which flatters every method"
    " in the tables. Five of lego100's given rotations are wrong; they set its mean and maximum, so look at"
    " its median. Differences below about 1 mm on the sets in metres mean nothing: that is the accuracy of"
    " their truth. Where the load average is above the number of cores, times are upper bounds, GLOMAP's"
    " too, and their ratios are rough; the CPU column depends less on the load."
)


def _accuracy_table(measured: Sequence[Measured]) -> str:
    rows = []
    for one in measured:
        scene = SCENES[one.name]
        rows.append(
            [
                f"{one.name} ({scene.unit})",
                f"{one.num_placed} of {one.num_posed}",
                f"{one.num_pairs_used} of {one.num_pairs}",
                _error_cell(one.errors),
                "-" if scene.limits is None else numbers(scene.limits),
                _with_coverage(verdict(error_checks(one)), one.errors),
                f"{one.gap:.0e}" + ("" if one.converged else " (not converged)"),
            ]
        )
    header = [
        "set",
        "placed",
        "pairs used",
        "median / mean / max",
        "to reach, median / mean",
        "verdict",
        "gap",
    ]
    return table(header, rows)


def _with_coverage(text: str, errors: Errors) -> str:
    """Return a verdict that says how many cameras of the truth it leaves out."""
    return f"{text}, without {errors.num_missing} cameras" if errors.num_missing else text


def _error_cell(errors: Errors) -> str:
    """Return the errors, and how many cameras of the truth are in none of them."""
    missing = f" ({errors.num_missing} missing)" if errors.num_missing else ""
    return numbers([errors.median, errors.mean, errors.max]) + missing


def _time_table(measured: Sequence[Measured]) -> str:
    rows = []
    for one in measured:
        limit = SCENES[one.name].limit_s
        rows.append(
            [
                one.name,
                one.method,
                number(median(one.warm_s)),
                numbers([min(one.warm_s), max(one.warm_s)]),
                number(median(one.cpu_s)),
                number(one.cold_s),
                number(one.solve_s),
                number(one.peak_memory_mb),
                "-" if limit is None else f"{limit:g} s",
                verdict(time_checks(one)),
            ]
        )
    header = [
        "set",
        "solver",
        "warm",
        "min / max",
        "CPU",
        "cold",
        "solve",
        "memory",
        "to reach, warm",
        "verdict",
    ]
    return table(header, rows)


def _adjusted_table(measured: Sequence[Measured]) -> str:
    rows = []
    for one in measured:
        if one.adjusted is None:
            continue
        reference = SCENES[one.name].adjusted_reference
        rows.append(
            [
                f"{one.name} ({SCENES[one.name].unit})",
                _error_cell(one.adjusted),
                "-" if reference is None else number(reference),
                "-" if reference is None else f"{ratio(one.adjusted.mean, reference):.2f}",
                _with_coverage(verdict(adjusted_checks(one)), one.adjusted),
                number(one.adjustment_s),
            ]
        )
    header = ["set", "median / mean / max", "reference mean", "mean / reference", "verdict", "adjustment, s"]
    return table(header, rows)


def _averaged_table(measured: Sequence[Measured]) -> str:
    rows = []
    for one in measured:
        limits = SCENES[one.name].averaged_limits
        for run in one.averaged:
            rows.append(
                [
                    f"{one.name} ({SCENES[one.name].unit})",
                    f"refined, {run.num_turned} cameras" if run.refined else "kept",
                    _error_cell(run.errors),
                    numbers(run.rotation_deg),
                    "-" if limits is None else numbers(limits),
                    verdict(_averaged_checks(one.name, run)),
                    number(run.cpu_s),
                ]
            )
    header = [
        "set",
        "rotations",
        "median / mean / max",
        "rotation error, deg",
        "to reach, median / mean",
        "verdict",
        "CPU, s",
    ]
    return table(header, rows)


def _averaged_checks(name: str, run: Averaged) -> list[Check]:
    """Return the checks of accuracy on averaged rotations."""
    limits = SCENES[name].averaged_limits
    if limits is None:
        return []
    return [
        Check(name="median", value=run.errors.median, limit=limits[0]),
        Check(name="mean", value=run.errors.mean, limit=limits[1]),
    ]


def _ratio_cell(peer: Errors | None, ours: Errors) -> str:
    """Return how many times larger the peer's median and mean errors are."""
    if peer is None:
        return "-"
    return f"{times(ratio(peer.median, ours.median))} / {times(ratio(peer.mean, ours.mean))}"


def _glomap_table(measured: Sequence[Measured]) -> str:
    rows = []
    for one in measured:
        for peer in one.peers:
            rows.append(
                [
                    f"{one.name} ({SCENES[one.name].unit})",
                    peer.label,
                    "-" if peer.errors is None else _error_cell(peer.errors),
                    _error_cell(one.errors),
                    _ratio_cell(peer.errors, one.errors),
                    number(peer.tracks_s),
                    number(peer.positioning_s),
                    number(one.positions_s),
                    times(ratio(peer.positioning_s, one.positions_s)),
                ]
            )
    header = [
        "set",
        "GLOMAP's setting",
        "GLOMAP, median / mean / max",
        "ours",
        "ratio, median / mean",
        "GLOMAP's tracks, s",
        "GLOMAP, s",
        "ours, s",
        "ratio of times",
    ]
    return table(header, rows)
