"""The published 1DSfM view graph of Madrid Metropolis, end to end: rotations, locations, residuals.

There is no ground truth of it here, so the table says how far the pairs are off each answer, and how long it
took: rotations averaged by pycolmap once, then every objective and filter on the same directions, in this
process, after a run that loads compiled code. ShapeKick's published seconds are those of its solver alone, on
the same scene with points added (k = 6), on an i5 with 2 cores at 2.6 GHz.

Source: Goldstein, Hand, Lee, Voroninski, Soatto, "ShapeFit and ShapeKick for robust, scalable structure from
motion", ECCV 2016, tables 1 and 2.
"""

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.metrics import Quantity, number, numbers
from benchmarks.record import environment, legend, table, write_section

if TYPE_CHECKING:
    from sfm_shapefit.refinement.options import PlacementOptions
    from sfm_shapefit.viewgraph import ViewGraph

HELP = "The published 1DSfM scene Madrid Metropolis: seconds per stage, and residuals of every objective."
ROOT = Path(__file__).parents[2]
PACKAGES = ("numpy", "scipy", "numba", "pycolmap")
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

QUANTITIES = (
    Quantity(
        name="seconds (CPU)",
        unit="s",
        better="lower",
        rel_tol=0.5,
        meaning="wall-clock and CPU time of `place`: filter, rigidity, certified solve, finish, verdicts",
    ),
    Quantity(
        name="solve",
        unit="s",
        better="lower",
        rel_tol=0.5,
        meaning="wall-clock of the certified ShapeFit solve, or of the baseline, in it",
    ),
    Quantity(
        name="residuals",
        unit="deg",
        better="lower",
        rel_tol=0.05,
        meaning="of the pairs between placed cameras that the filter kept: quartiles; share beyond 10 deg",
    ),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What one run gave."""

    name: str
    num_placed: int
    num_dropped: int
    wall_s: float
    cpu_s: float
    solve_s: float
    gap: float
    quartiles_deg: tuple[float, ...]
    beyond: float


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `onedsfm`."""
    parser.add_argument(
        "--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the sets"
    )
    parser.add_argument("--out", type=Path, default=ROOT / "scripts" / "results.md", help="file of results")


def run(args: argparse.Namespace) -> int:
    """Measure, print the section and write it."""
    source = args.data / SCENE
    if not source.is_dir():
        print(f"skipped: {SCENE} not found in {args.data}", file=sys.stderr)
        return 0
    about = environment(PACKAGES, "python scripts/benchmark.py onedsfm")
    statement, outcomes = measure(source)
    body = section(statement, outcomes, about)
    print(body)
    write_section(args.out, "onedsfm", body)
    return 0


def measure(source: Path) -> tuple[str, list[Outcome]]:
    """Return what was read and averaged in which time, and what every run gave."""
    from sfm_shapefit.commands.place import solve_graph_file
    from sfm_shapefit.refinement.options import PlacementOptions

    found = solve_graph_file(source, PlacementOptions())  # also loads compiled code
    graph = found.placement.graph
    stages = ", ".join(f"{name} {number(seconds)} s" for name, seconds in found.timings_s.items())
    statement = f"{graph.num_nodes} cameras, {graph.num_edges} pairs; {found.statement}. Stages: {stages}."
    return statement, [_outcome(name, graph, PlacementOptions(**given)) for name, given in RUNS.items()]


def _outcome(name: str, graph: "ViewGraph", options: "PlacementOptions") -> Outcome:
    import numpy as np

    from sfm_shapefit.placement.place import place

    wall, cpu = time.perf_counter(), time.process_time()
    placed = place(graph, options)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    residuals = placed.assessment.residuals_deg
    return Outcome(
        name=name,
        num_placed=len(placed.cameras),
        num_dropped=len(placed.dropped),
        wall_s=wall,
        cpu_s=cpu,
        solve_s=placed.solve.seconds,
        gap=placed.solve.gap if options.solves_shapefit else np.nan,
        quartiles_deg=tuple(np.quantile(residuals, (0.25, 0.5, 0.75)).tolist()),
        beyond=float(np.mean(residuals > 10.0)),
    )


def section(statement: str, outcomes: list[Outcome], about: str) -> str:
    """Return the section of the file of results."""
    rows = [
        [
            one.name,
            str(one.num_placed),
            str(one.num_dropped),
            f"{number(one.wall_s)} ({number(one.cpu_s)})",
            number(one.solve_s),
            number(one.gap),
            f"{numbers(one.quartiles_deg)}; {one.beyond:.0%}",
        ]
        for one in outcomes
    ]
    header = ["run", "placed", "filtered", "seconds (CPU)", "solve", "certified gap", "residuals"]
    parts = [
        "## 1DSfM: Madrid Metropolis",
        about,
        statement,
        PUBLISHED,
        table(header, rows),
        COLLAPSE,
        "### What the columns mean",
        legend(QUANTITIES),
    ]
    return "\n\n".join(part.strip() for part in parts)
