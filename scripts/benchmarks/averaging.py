"""Rotation averaging: made graphs against least squares on the right pairs, real sets beside pycolmap's.

Made graphs: `rotation_problem` on families of view graphs, a fifth of the pairs wrong. The oracle is told
which pairs are right and takes least squares with their information from the true rotations. The second run
counts: kernels are compiled by the first. Memory is the peak of the whole process.

Real sets: relative rotations from the matches, averaged by ours and by pycolmap, as its global mapper does,
on the same pairs. The truth of liberty-calibrated is its reference model.
"""

import argparse
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import sfm_shapefit
from harness.driver import Benchmark, Case, on_sets
from harness.process import peak_memory_mb, time_call
from harness.record import Row, at_least, at_most
from harness.scenes import WRONG_DEG, errors_deg
from paper.rotation_averaging import average_by_pycolmap
from sfm_shapefit import synthetic
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.rotations.average import average_relative_rotations
from sfm_shapefit.rotations.averaging_kernels import turn_cameras, weigh_blocks
from sfm_shapefit.rotations.averaging_system import plan_system
from sfm_shapefit.synthetic.rotation_graphs import RotationProblem, rotation_problem

FAMILIES = ("ring", "box", "expander", "community")
DEGREE = 40.0
"""Pairs of a camera: 20 pairs for each camera."""
LIMIT_S = {1_000: 1.5, 10_000: 3.0, 100_000: 60.0}
"""CPU seconds by the number of cameras; graphs of no such size have no limit."""
LEAST_RATIO = 1.2
"""Median error over that of the oracle."""
COVERAGE = (0.8, 1.25)
"""Root mean square of error over standard deviation."""
REAL: dict[str, tuple[float | None, int]] = {
    "Herz-Jesus-P25": (0.051, 0),
    "castle-P19": (0.075, 0),
    "castle-P30": (0.061, 0),
    "lego100": (0.15, 0),
    "liberty-calibrated": (None, 12),
}
"""Mean error in degrees, and rotations beyond 5 degrees, to reach by our own averaging."""
MADE_GRAPHS, REAL_SETS = (
    "Made graphs, a fifth of the pairs wrong",
    "Real sets, on the same relative rotations",
)


def add_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--large", action="store_true", help="graphs of 1e5 cameras too, which take minutes")


def cases(args: argparse.Namespace) -> dict[str, Case]:
    sizes = [200] if args.quick else [1_000, 10_000, *([100_000] if args.large else [])]
    families = FAMILIES[:1] if args.quick else FAMILIES
    found: dict[str, Case] = {
        f"{family} {n}": partial(measure_made, family, n) for n in sizes for family in families
    }
    for averaging in () if args.quick else ("own", "pycolmap"):
        real = on_sets(args.data, REAL, measure_real, averaging)
        found |= {f"{name}, {averaging}": case for name, case in real.items()}
    return found


def measure_made(family: str, n: int) -> Row:
    """Average the rotations of a made graph; to be called in a process of its own."""
    graph = getattr(synthetic, f"{family}_graph_problem")(n, min(DEGREE, n / 8), seed=1).view_graph
    problem = rotation_problem(n, graph.edges, seed=2)
    if n < 100_000:
        average_relative_rotations(n, problem.relative)
    else:
        measure_made(family, 5_000)  # compiles the same
    run = time_call(lambda: average_relative_rotations(n, problem.relative))
    gb = peak_memory_mb() / 1e3
    errors = errors_deg(run.found.rotations, problem.rotations)
    oracle_deg = float(np.median(errors_deg(solve_oracle(problem), problem.rotations)))
    middle_deg, wrong = float(np.median(errors)), int((errors > WRONG_DEG).sum())
    covered = _coverage(errors, run.found.sigmas_deg)
    checks = at_most(
        CPU_s=(run.cpu_s, LIMIT_S.get(n)),
        over_the_oracle=(middle_deg / oracle_deg, LEAST_RATIO),
        beyond_5_deg=(wrong, 0),
        rms_over_sigma=(covered, COVERAGE[1]),
    ) + at_least(rms_over_sigma=(covered, COVERAGE[0]))
    cells = {
        "family": family,
        "cameras": n,
        "pairs": graph.num_edges,
        "CPU, s": run.cpu_s,
        "memory, GB": gb,
        "median / oracle, deg": [middle_deg, oracle_deg],
        "ratio": middle_deg / oracle_deg,
        "beyond 5 deg": wrong,
        "rms over sigma": covered,
        "certified": run.found.certified,
    }
    return Row(cells, checks if n in LIMIT_S else (), MADE_GRAPHS)


def _coverage(errors: FloatArray, sigmas_deg: FloatArray) -> float:
    """Return the root mean square of errors over standard deviations, per axis, of what is not wrong."""
    near = (errors < WRONG_DEG) & np.isfinite(sigmas_deg)
    if not near.any():
        return np.nan
    return float(np.sqrt(np.mean((errors[near] / sigmas_deg[near]) ** 2) / 3.0))


def solve_oracle(problem: RotationProblem) -> FloatArray:
    """Return least squares on the right pairs, from the truth, (n, 3, 3)."""
    right = problem.relative.subset(~problem.wrong)
    n, k = len(problem.rotations), len(right.pairs)
    pairs, information = np.ascontiguousarray(right.pairs), np.ascontiguousarray(right.information)
    measured = Rotation.from_matrix(right.rotations).as_quat()
    turns = Rotation.from_matrix(problem.rotations).as_quat()
    system = plan_system(n, pairs, np.ones(k), 1)
    distances, blocks, pulls = np.empty(k), np.empty((k, 3, 3)), np.empty((k, 3))
    for _ in range(3):
        system.over_pairs(
            weigh_blocks, pairs, measured, turns, information, np.inf, np.inf, distances, blocks, pulls
        )
        turn_cameras(turns, system.solve_blocks(blocks, system.gradient_of(pulls), 1e-6), np.pi)
    return np.asarray(Rotation.from_quat(turns).as_matrix())


def measure_real(folder: Path, averaging: str) -> Row:
    """Average the rotations of a real set; to be called in a process of its own."""
    relative = sfm_shapefit.relative_rotations(folder / "database.db")
    stored = np.load(folder / "viewgraph.npz", allow_pickle=True)
    known = stored["gt_R"] if "gt_R" in stored.files else stored["ref_R"]
    row_of = {str(name): row for name, row in zip(stored["names"], known, strict=True)}
    truth = np.array([row_of[name] for name in relative.names])
    ways = {"own": average_relative_rotations, "pycolmap": average_by_pycolmap}
    average = partial(ways[averaging], len(truth), relative)
    average()
    run = time_call(average)
    found = run.found
    judged = found.registered & np.isfinite(truth).all(axis=(1, 2))
    errors = errors_deg(found.rotations[judged], truth[judged])
    mean_deg, wrong = float(errors.mean()), int((errors > WRONG_DEG).sum())
    limit_deg, most = REAL[folder.name]
    cells = {
        "set": folder.name,
        "averaging": averaging,
        "cameras": int(judged.sum()),
        "pairs": len(relative.pairs),
        "CPU, s": run.cpu_s,
        "mean / median, deg": [mean_deg, float(np.median(errors))],
        "beyond 5 deg": wrong,
        "agreeing share": f"{found.share:.2f}",
        "unsettled": int(found.unsettled.sum()),
        "rms over sigma": _coverage(errors, found.sigmas_deg[judged]),
        "certified": found.certified,
    }
    checks = at_most(mean_deg=(mean_deg, limit_deg), beyond_5_deg=(wrong, most))
    return Row(cells, checks if averaging == "own" else (), REAL_SETS)


BENCHMARK = Benchmark(
    name="averaging",
    title="Rotation averaging",
    cases=cases,
    flags=add_flags,
    closing=lambda _rows: [
        "Standard deviations count the errors of pairs as independent. On real sets pairs of a camera share"
        " errors of its features and its calibration, which do not average out; the ratio says how much these"
        " are. Unsettled are cameras that most of their pairs contradict in every answer."
    ],
    columns={
        "CPU": "s; processor time of a warm call, all of it",
        "memory": "GB; peak of the process, making the graph included",
        "median, mean": "deg; error after the best common rotation",
        "rms over sigma": "1; errors over sigmas, per axis; 1 is right",
    },
)
