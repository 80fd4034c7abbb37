"""The published 1DSfM view graph of Madrid Metropolis, end to end: rotations, locations, residuals.

There is no ground truth of it here, so the table says how far the pairs are off each answer, and how long it
took: every objective and filter on the same directions, in a process of its own, after the default that
loads compiled code. ShapeKick's published seconds are those of its solver alone, on the same scene with
points added (k = 6), on an i5 with 2 cores at 2.6 GHz.

Source: Goldstein, Hand, Lee, Voroninski, Soatto, "ShapeFit and ShapeKick for robust, scalable structure from
motion", ECCV 2016, tables 1 and 2.
"""

import argparse
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from harness import ours
from harness.driver import NOT_FOUND, ROOT, Benchmark, Case
from harness.metrics import Quantity, number, numbers
from harness.record import table

SCENE = "1dsfm-Madrid_Metropolis"
PUBLISHED = (
    "Published seconds on it (341 cameras): ShapeKick 1.2, ShapeFit by ADMM 9.0, LUD 9.3, 1DSfM with a Huber"
    " loss 83, 1DSfM + ShapeKick 2.4; on the scenes of 332 to 450 cameras ShapeKick takes 1.2 to 2.4."
)
COLLAPSE = (
    "Least squares leaves two cameras far out and the others in a small cluster; ShapeFit's scale, L(T) > 0,"
    " then turns the cluster around."
)
RUNS: dict[str, dict[str, Any]] = {
    "default": {},
    "shapefit": {"objective": "shapefit"},
    "lud": {"objective": "lud"},
    "lud, unrefined": {"objective": "lud", "refine": False},
    "least-squares": {"objective": "least-squares"},
    "1dsfm + default": {"filter": "1dsfm"},
    "triangles + default": {"filter": "triangles"},
    "1dsfm + shapefit": {"filter": "1dsfm", "objective": "shapefit"},
}


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the runs; in quick mode, on the bundled graph."""
    source = ROOT / "data_synthetic" / "graph40.txt" if args.quick else args.data / SCENE
    if not source.exists():
        return {SCENE: NOT_FOUND}
    return {name: partial(measure, name, source) for name in RUNS}


def measure(name: str, source: Path) -> tuple[dict[str, str], str]:
    """Read the graph and average its rotations, then place it as the run says.

    Returns the cells of a row, and what was read in which time.
    """
    import numpy as np

    read = ours.place_file(source)
    graph = read.placement.graph
    stages = ", ".join(f"{stage} {number(seconds)} s" for stage, seconds in read.timings_s.items())
    run = ours.time_call(lambda: ours.place(graph, **RUNS[name]))
    placement = run.found
    residuals = placement.assessment.residuals_deg
    quartiles_deg = np.quantile(residuals, (0.25, 0.5, 0.75)).tolist()
    is_certified = RUNS[name].get("objective", "shapefit") == "shapefit"
    return {
        "run": name,
        "placed": str(len(placement.cameras)),
        "filtered": str(len(placement.dropped)),
        "seconds (CPU)": f"{number(run.wall_s)} ({number(run.cpu_s)})",
        "solve": number(placement.certified.seconds),
        "certified gap": number(placement.certified.gap) if is_certified else "-",
        "residuals": f"{numbers(quartiles_deg)}; {np.mean(residuals > 10.0):.0%}",
    }, f"{graph.num_nodes} cameras, {graph.num_edges} pairs; {read.statement}. Stages: {stages}."


def tables(measured: Mapping[str, tuple[dict[str, str], str]], _args: argparse.Namespace) -> Iterator[str]:
    rows, (source, *_) = zip(*measured.values(), strict=True)
    yield source
    yield PUBLISHED
    yield table([*rows[0]], [[*row.values()] for row in rows])
    yield COLLAPSE


BENCHMARK = Benchmark(
    name="onedsfm",
    title="1DSfM: Madrid Metropolis",
    cases=cases,
    tables=tables,
    quantities=(
        Quantity("seconds (CPU)", "s", "lower", 0.5, "of `place`: filter, rigidity, solve, finish, verdicts"),
        Quantity("solve", "s", "lower", 0.5, "of the certified solve, or of the baseline, in it"),
        Quantity("residuals", "deg", "lower", 0.05, "of the filtered pairs: quartiles; share beyond 10 deg"),
    ),
)
