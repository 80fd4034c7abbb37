"""Directions from matches: pairs per second, memory over many batches, and whether the covariance is right.

The matches are synthetic: two cameras of 1000 px focal length and 1000 x 750 px see points 4 to 8 units
away, with Gaussian noise in each pixel coordinate; wrong matches end anywhere in the second image. The
baseline is given as a share of 6 units, the typical depth.

A normalized error is r^T Sigma^-1 r, r the error of the direction in its tangent plane and Sigma its
covariance; its mean is 2 where the covariance is right.
"""

import argparse
import math
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np

from harness import driver
from harness.driver import Benchmark, positive
from harness.process import resident_memory_mb
from harness.record import Row, at_least, at_most, text_of
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import angle_between_deg, normalized, tangent_bases
from sfm_shapefit.pairs.estimate import estimate_directions
from sfm_shapefit.pairs.options import DirectionOptions
from sfm_shapefit.pairs.pair_directions import DirectionStatus
from sfm_shapefit.scene.matches import RayMatches

FOCAL_PX, WIDTH_PX, HEIGHT_PX, DEPTH = 1000.0, 1000.0, 750.0, 6.0
MATCHES = 100
BATCH = 10_000
MIN_PAIRS_PER_S = 3000.0
EXPECTED, SLACK = 2.0, 0.2
MAX_GROWTH_MB = 20.0
NO_PARALLAX_LIMIT = 0.01
SPEED = f"Speed, {MATCHES} matches per pair, batches of {BATCH} pairs"
CALIBRATION = f"Calibration ({MATCHES} matches, noise 0.5 px, baseline 15 % unless told)"


class Case(NamedTuple):
    """Pairs of one kind."""

    name: str
    matches: int = MATCHES
    noise_px: float = 0.5
    wrong: float = 0.0
    """Share of the matches that end anywhere."""
    baseline: float = 0.15
    planar: bool = False


CASES = (
    Case("general depth"),
    *(Case(f"{n} matches", matches=n) for n in (15, 30, 500)),
    *(Case(f"noise {noise} px", noise_px=noise) for noise in (0.3, 1.0, 2.0)),
    Case("planar", planar=True),
    Case("planar, 40 % wrong", planar=True, wrong=0.4),
    *(Case(f"baseline {share:.0%} of the depth", baseline=share) for share in (0.05, 0.02, 0.01)),
    *(Case(f"{wrong:.0%} wrong", wrong=wrong) for wrong in (0.2, 0.4)),
    Case("15 matches, noise 2 px", matches=15, noise_px=2.0),
    Case("30 matches, 40 % wrong", matches=30, wrong=0.4),
    *(Case(f"60 % wrong, {n} matches", wrong=0.6, matches=n) for n in (100, 300)),
    Case("pure rotation", baseline=0.0),
    Case("pure rotation, noise 2 px", baseline=0.0, noise_px=2.0),
    Case("pure rotation, 30 % wrong", baseline=0.0, wrong=0.3),
    Case("pure rotation, 500 matches, 30 % wrong", baseline=0.0, wrong=0.3, matches=500),
    Case("far points only (0.2 px of parallax)", baseline=2e-4),
)


class Speed(NamedTuple):
    """How fast so many pairs went."""

    pairs: int
    seconds: float
    cpu_s: float
    growth_mb: float
    """Resident memory at the end minus that after the first batch."""


def flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--pairs", type=positive, default=1_000_000, help="pairs in batches")
    parser.add_argument("--draws", type=positive, default=2000, help="pairs per calibration case")


def cases(args: argparse.Namespace) -> dict[str, driver.Case]:
    """Return speed by threads and processes, and the kinds of pairs."""
    tenth = BATCH if args.quick else max(args.pairs // 10, BATCH)
    found: dict[str, driver.Case] = {
        "1 thread": partial(measure_speed, "1 thread", tenth, 1, 1),
        "2 threads": partial(measure_speed, "2 threads", tenth, 2, 1),
        "2 processes": partial(measure_speed, "2 processes", args.pairs // 2, 1, 2),
    }
    found |= {case.name: partial(measure_case, case, args.draws) for case in CASES}
    quick = ("1 thread", "general depth", "pure rotation")
    return {name: found[name] for name in quick} if args.quick else found


def make_pairs(case: Case, count: int, seed: int) -> tuple[RayMatches, FloatArray]:
    """Return the matches of random pairs and their true directions (count, 3)."""
    rng = np.random.default_rng(seed)
    shape = (count, case.matches)
    half = np.array([WIDTH_PX, HEIGHT_PX]) / 2.0
    image = rng.uniform(-half, half, (*shape, 2)) / FOCAL_PX
    depths = rng.uniform(4.0, 8.0, shape)
    if case.planar:
        tilts = rng.uniform(-0.5, 0.5, (count, 1, 2))
        depths = DEPTH / (1.0 + np.sum(tilts * image, axis=2))
    points = np.concatenate([image, np.ones((*shape, 1))], axis=2) * depths[:, :, None]
    directions = normalized(rng.standard_normal((count, 3)) * [1.0, 0.6, 0.6])
    seen_from_j = points + (case.baseline * DEPTH * directions)[:, None, :]

    def pixels(x: FloatArray) -> FloatArray:
        noise = case.noise_px * rng.standard_normal((*shape, 2))
        return np.asarray(FOCAL_PX * x[:, :, :2] / x[:, :, 2:] + noise)

    pixels_i, pixels_j = pixels(points), pixels(seen_from_j)
    is_wrong = rng.random(shape) < case.wrong
    pixels_j[is_wrong] = rng.uniform(-half, half, (int(is_wrong.sum()), 2))
    ones = np.ones((*shape, 1))
    rays_i, rays_j = (
        normalized(np.concatenate([xy / FOCAL_PX, ones], axis=2)).reshape(-1, 3)
        for xy in (pixels_i, pixels_j)
    )
    matches = RayMatches(
        pairs=np.column_stack([np.arange(count), np.arange(count) + 1]),
        offsets=np.arange(count + 1) * case.matches,
        rays_i=rays_i,
        rays_j=rays_j,
        pixel_angles=np.full(count, 1.0 / FOCAL_PX),
    )
    return matches, directions


def measure_case(case: Case, count: int) -> Row:
    """Estimate `count` pairs of one kind and compare errors with covariances."""
    matches, truth = make_pairs(case, count, seed=1)
    # Wrong matches are the case, not a reason for refusal; lists of 15 may lose some to the threshold.
    found = estimate_directions(matches, DirectionOptions(min_inlier_ratio=0.1, min_inliers=8))
    usable = found.usable()
    share, missing = len(usable) / count, found.counts().get(DirectionStatus.NO_PARALLAX, 0) / count
    if case.baseline < 0.001:
        cells = {"case": case.name, "said to have none": f"{missing:.2%}", "usable": f"{share:.2%}"}
        return Row(cells, at_most(usable=(share, NO_PARALLAX_LIMIT)), "No parallax")
    d, truth = found.directions[usable], truth[usable]
    error = np.einsum("kdi,kd->ki", tangent_bases(d), truth)
    squares = np.einsum("ki,kij,kj->k", error, np.linalg.inv(found.covariance[usable]), error)
    mean, angles_deg = float(squares.mean()), np.quantile(angle_between_deg(d, truth), (0.5, 0.95))
    checks = at_most(normalized_error=(mean, EXPECTED * (1 + SLACK)))
    checks += at_least(normalized_error=(mean, EXPECTED * (1 - SLACK)))
    cells = {"case": case.name, "usable": f"{share:.1%}", "normalized error": mean}
    cells["error, median / 95 %, deg"] = text_of(angles_deg.tolist())
    return Row(cells, checks, CALIBRATION)


def measure_batches(pairs: int, threads: int) -> Speed:
    """Estimate one batch, a tenth of whose matches is wrong, again and again; drawing it is not timed."""
    matches, _ = make_pairs(Case("speed", wrong=0.1), BATCH, seed=2)
    estimate_directions(matches, threads=threads)
    before_mb, start, cpu = resident_memory_mb(), time.perf_counter(), time.process_time()
    batches = math.ceil(pairs / BATCH)
    for _ in range(batches):
        estimate_directions(matches, threads=threads)
    seconds, cpu_s = time.perf_counter() - start, time.process_time() - cpu
    return Speed(batches * BATCH, seconds, cpu_s, resident_memory_mb() - before_mb)


def measure_speed(label: str, pairs: int, threads: int, processes: int) -> Row:
    """Estimate so many pairs in each of some processes; the slowest and the largest count."""
    if processes == 1:
        parts = [measure_batches(pairs, threads)]
    else:
        with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
            parts = list(pool.map(measure_batches, [pairs] * processes, [threads] * processes))
    total, seconds = sum(part.pairs for part in parts), max(part.seconds for part in parts)
    growth_mb = max(part.growth_mb for part in parts)
    cells = {
        "setting": label,
        "pairs": total,
        "pairs/s": total / seconds,
        "pairs per CPU second": total / sum(part.cpu_s for part in parts),
        "growth, MB": growth_mb,
    }
    checks = at_least(**{"pairs/s": (total / seconds, MIN_PAIRS_PER_S if processes > 1 else None)})
    return Row(cells, checks + at_most(growth=(growth_mb, MAX_GROWTH_MB)), SPEED)


BENCHMARK = Benchmark(
    name="directions",
    title="Directions",
    cases=cases,
    flags=flags,
    packages=("numpy", "numba"),
    quick={"pairs": BATCH, "draws": 200},
    columns={
        "pairs/s": "1/s; wall-clock, without start-up",
        "growth": "MB; of resident memory after the first batch, worst process",
        "normalized error": "1; mean of r^T Sigma^-1 r; 2 where Sigma is right",
        "error, median / 95 %": "deg; of the usable directions",
    },
)
