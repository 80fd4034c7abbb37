"""Real scenes: pytheia's and gtsam's translation averaging beside ours, on the same directions.

Peers get the directions that `locate` measures, all of its rigid piece, with the same rotations and before
any bundle adjustment. Ours stands twice: from the same directions alone, all cameras kept, and as `locate`
does it by default, with points as nodes and without the cameras it does not trust. Every contender runs in
its own fresh process, on one thread, once; errors are taken after robust alignment to the truth, over the
cameras that the contender places. Differences below 5 % count as equal: the truth is no better.
"""

import argparse
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.graph_peers import CONTENDERS as GRAPH_CONTENDERS
from benchmarks.graph_peers import Contender
from benchmarks.metrics import Check, Quantity, number, verdict
from benchmarks.process import call, thread_environment
from benchmarks.real import SCENES, Errors, Scene, scene_names
from benchmarks.record import environment, legend, table, write_section

if TYPE_CHECKING:
    from sfm_shapefit.results import LocateResult

HELP = (
    "Real scenes beside pytheia and gtsam on the same directions; a missing peer is skipped with a sentence."
)
ROOT = Path(__file__).parents[2]
PACKAGES = ("numpy", "scipy", "numba", "pycolmap", "pytheia", "gtsam")
TIMEOUT_S = 150.0
EQUAL = 1.05
PEERS = tuple(contender for contender in GRAPH_CONTENDERS if contender.package is not None)
SAME_DIRECTIONS, BY_DEFAULT = "ours, the same directions", "ours, `locate` by default"
OURS = (Contender(name=SAME_DIRECTIONS, prepare=None), Contender(name=BY_DEFAULT, prepare=None))

QUANTITIES = (
    Quantity(
        name="median / mean / max",
        unit="the set's",
        better="lower",
        rel_tol=0.05,
        meaning="position error after robust (L1) alignment, over the cameras that are placed",
    ),
    Quantity(
        name="seconds",
        unit="s",
        better="lower",
        rel_tol=0.5,
        meaning="the call that turns directions into positions, one run; for `locate`, placing and judging",
    ),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A contender's answer on a set."""

    name: str
    errors: Errors | None = None
    seconds: float = math.nan
    note: str = ""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `peers-real`."""
    parser.add_argument("--sets", type=scene_names, default=list(SCENES), help="names, with commas")
    parser.add_argument(
        "--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the sets"
    )
    parser.add_argument("--timeout", type=float, default=TIMEOUT_S, help="seconds per answer (default 150)")
    parser.add_argument("--out", type=Path, default=ROOT / "scripts" / "results.md", help="file of results")


def run(args: argparse.Namespace) -> int:
    """Measure, print the section and write it; a missed limit is no failure."""
    about = environment(PACKAGES, "python scripts/benchmark.py peers-real")
    found = {}
    for name in args.sets:
        scene, folder = SCENES[name], args.data / name
        if not folder.is_dir():
            print(f"skipped: {name} not found in {args.data}", file=sys.stderr)
            continue
        found[name] = [_answer(c, folder, scene, args.timeout) for c in (*OURS, *PEERS)]
        for row in found[name]:
            print(name, row.name, _cell(row.errors), row.note, file=sys.stderr, flush=True)
    if found:
        body = section(found, about)
        print(body)
        write_section(args.out, "peers-real", body)
    return 0


def _answer(contender: Contender, folder: Path, scene: Scene, timeout_s: float) -> Row:
    """Return a contender's answer, or why there is none."""
    empty = Row(name=contender.name)
    if contender.package is not None and find_spec(contender.package) is None:
        return replace(empty, note=f"skipped: {contender.package} is not installed")
    try:
        errors, seconds, note = call(
            measure, contender.name, folder, scene, environment=thread_environment(1), timeout_s=timeout_s
        )
    except TimeoutError:
        return replace(empty, note=f"failed: no answer within {timeout_s:g} s")
    except RuntimeError as reason:
        return replace(empty, note=f"failed: {reason}")
    return replace(empty, errors=errors, seconds=seconds, note=note)


def measure(name: str, folder: Path, scene: Scene) -> tuple[Errors, float, str]:
    """Return a contender's errors, seconds and note on a set; to be called once per process."""
    import numpy as np

    from sfm_shapefit import locate
    from sfm_shapefit.options import LocateOptions

    options = LocateOptions(threads=1)
    if name != BY_DEFAULT:
        options = replace(options, points="never", min_trust=0.0)
    model = folder / "sparse" / "0"
    found = locate(model, options=options)
    if name in (SAME_DIRECTIONS, BY_DEFAULT):
        found = locate(model, options=options)  # the first run also loads compiled code
        left = int(np.sum(~found.kept))
        cameras = found.placement.cameras[found.kept]
        note = f"{left} not trusted" if left else ""
        locations, seconds = found.placement.locations[found.kept], found.timings_s["solve"]
    else:
        contender = next(peer for peer in PEERS if peer.name == name)
        graph, cameras = found.placement.graph.restricted_to(found.placement.edges)
        solver = contender.prepare(graph)
        start = time.perf_counter()
        locations, note = solver()
        seconds = time.perf_counter() - start
    return _errors(found, cameras, locations, folder / scene.truth), seconds, note


def _errors(found: "LocateResult", cameras: Sequence[int], locations: object, truth: Path) -> Errors:
    """Return the position errors of some of a model's cameras."""
    from sfm_shapefit.colmap.model import read_model
    from sfm_shapefit.evaluation import evaluate_poses

    model, reference = found.model, read_model(truth)
    position = evaluate_poses(
        [model.names[c] for c in cameras],
        model.rotations[cameras],
        locations,
        reference.names,
        reference.rotations,
        reference.centers,
    ).position
    missing = sum(name in set(reference.names) for name in model.names) - len(cameras)
    return Errors(median=position.median, mean=position.mean, max=position.max, num_missing=missing)


def checks(rows: Sequence[Row]) -> list[Check]:
    """Return the limits of one set: our default's errors against the lowest of the peers'."""
    ours = next(row for row in rows if row.name == BY_DEFAULT)
    peers = [row.errors for row in rows if row.name not in (SAME_DIRECTIONS, BY_DEFAULT) and row.errors]
    if ours.errors is None or not peers:
        return []
    return [
        Check(name=kind, value=getattr(ours.errors, kind), limit=EQUAL * min(getattr(e, kind) for e in peers))
        for kind in ("median", "mean")
    ]


def section(found: dict[str, list[Row]], about: str) -> str:
    """Return the section of the file of results."""
    every = [check for rows in found.values() for check in checks(rows)]
    rows = [
        [f"{name} ({SCENES[name].unit})", row.name, _cell(row.errors), number(row.seconds), row.note]
        for name, answers in found.items()
        for row in answers
    ]
    verdicts = [[name, verdict(checks(answers))] for name, answers in found.items()]
    parts = [
        "## Peers on real scenes",
        about + "- Threads: 1; a fresh process each",
        f"**{sum(check.met for check in every)} of {len(every)} limits met**: by default `locate` has a"
        " median and a mean error at most 5 % above the lowest of the peers'.",
        table(["set", "method", "median / mean / max", "seconds", "note"], rows),
        table(["set", "verdict"], verdicts),
        "### What the columns mean",
        legend(QUANTITIES),
    ]
    return "\n\n".join(part.strip() for part in parts)


def _cell(errors: Errors | None) -> str:
    if errors is None:
        return "-"
    text = f"{number(errors.median)} / {number(errors.mean)} / {number(errors.max)}"
    return f"{text} ({errors.num_missing} missing)" if errors.num_missing else text
