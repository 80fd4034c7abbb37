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
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

from harness import driver
from harness.driver import Benchmark, positive
from harness.metrics import Check, Quantity, number, numbers, verdict
from harness.process import resident_memory_mb
from harness.record import table_of

if TYPE_CHECKING:
    from sfm_shapefit.base.arrays import FloatArray
    from sfm_shapefit.scene.matches import RayMatches

FOCAL_PX, WIDTH_PX, HEIGHT_PX, DEPTH = 1000.0, 1000.0, 750.0, 6.0
MATCHES = 100
BATCH = 10_000
MIN_PAIRS_PER_S = 3000.0
EXPECTED, SLACK = 2.0, 0.2
MAX_GROWTH_MB = 20.0
NO_PARALLAX_LIMIT = 0.01


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
    Case(name="general depth"),
    *(Case(name=f"{n} matches", matches=n) for n in (15, 30, 500)),
    *(Case(name=f"noise {noise} px", noise_px=noise) for noise in (0.3, 1.0, 2.0)),
    Case(name="planar", planar=True),
    Case(name="planar, 40 % wrong", planar=True, wrong=0.4),
    *(Case(name=f"baseline {share:.0%} of the depth", baseline=share) for share in (0.05, 0.02, 0.01)),
    *(Case(name=f"{wrong:.0%} wrong", wrong=wrong) for wrong in (0.2, 0.4)),
    Case(name="15 matches, noise 2 px", matches=15, noise_px=2.0),
    Case(name="30 matches, 40 % wrong", matches=30, wrong=0.4),
    *(Case(name=f"60 % wrong, {n} matches", wrong=0.6, matches=n) for n in (100, 300)),
)
STILL = (
    Case(name="pure rotation", baseline=0.0),
    Case(name="pure rotation, noise 2 px", baseline=0.0, noise_px=2.0),
    Case(name="pure rotation, 30 % wrong", baseline=0.0, wrong=0.3),
    Case(name="pure rotation, 500 matches, 30 % wrong", baseline=0.0, wrong=0.3, matches=500),
    Case(name="far points only (0.2 px of parallax)", baseline=2e-4),
)


class Calibration(NamedTuple):
    """What one case gave."""

    case: Case
    usable: float
    """Share of the pairs that have a direction."""
    no_parallax: float
    """Share of the pairs that are said to have no parallax."""
    mean: float = math.nan
    """Mean normalized error."""
    angles_deg: tuple[float, float] = (math.nan, math.nan)
    """Median and 95th percentile of the error."""


class Speed(NamedTuple):
    """How fast so many pairs went in one setting."""

    label: str
    pairs: int
    seconds: float
    cpu_s: float
    growth_mb: float
    """Resident memory at the end minus that after the first batch, of the worst process."""


def flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--pairs", type=positive, default=1_000_000, help="pairs in batches")
    parser.add_argument("--draws", type=positive, default=2000, help="pairs per calibration case")


def cases(args: argparse.Namespace) -> dict[str, driver.Case]:
    """Return speed by threads and processes, and the kinds of pairs."""
    tenth = max(args.pairs // 10, BATCH)
    found: dict[str, driver.Case] = {
        "1 thread": partial(measure_batches, BATCH if args.quick else tenth, 1),
        "2 threads": partial(measure_batches, BATCH if args.quick else tenth, 2),
        "2 processes": partial(measure_processes, args.pairs),
    }
    found |= {case.name: partial(measure_case, case, args.draws) for case in (*CASES, *STILL)}
    quick = ("1 thread", CASES[0].name, STILL[0].name)
    return {name: found[name] for name in quick} if args.quick else found


def make_pairs(case: Case, count: int, seed: int) -> "tuple[RayMatches, FloatArray]":
    """Return the matches of random pairs and their true directions (count, 3)."""
    import numpy as np

    from sfm_shapefit.base.geometry import normalized
    from sfm_shapefit.scene.matches import RayMatches

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

    def pixels(x: "FloatArray") -> "FloatArray":
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


def measure_case(case: Case, count: int) -> Calibration:
    """Estimate `count` pairs of one kind and compare errors with covariances."""
    import numpy as np

    from sfm_shapefit.base.geometry import angle_between_deg, tangent_bases
    from sfm_shapefit.pairs.estimate import estimate_directions
    from sfm_shapefit.pairs.options import DirectionOptions
    from sfm_shapefit.pairs.pair_directions import DirectionStatus

    matches, truth = make_pairs(case, count, seed=1)
    # Wrong matches are the case, not a reason for refusal; lists of 15 may lose some to the threshold.
    options = DirectionOptions(min_inlier_ratio=0.1, min_inliers=8)
    found = estimate_directions(matches, options)
    usable = found.usable()
    missing = found.counts().get(DirectionStatus.NO_PARALLAX, 0) / count
    if len(usable) == 0:
        return Calibration(case, 0.0, missing)
    d, truth = found.directions[usable], truth[usable]
    error = np.einsum("kdi,kd->ki", tangent_bases(d), truth)
    squares = np.einsum("ki,kij,kj->k", error, np.linalg.inv(found.covariance[usable]), error)
    angles_deg = tuple(np.quantile(angle_between_deg(d, truth), (0.5, 0.95)).tolist())
    return Calibration(case, len(usable) / count, missing, float(squares.mean()), angles_deg)


def measure_batches(pairs: int, threads: int) -> Speed:
    """Estimate one batch, a tenth of whose matches is wrong, again and again; drawing it is not timed."""
    from sfm_shapefit.pairs.estimate import estimate_directions

    matches, _ = make_pairs(Case(name="speed", wrong=0.1), BATCH, seed=2)
    estimate_directions(matches, threads=threads)
    before_mb, start, cpu = resident_memory_mb(), time.perf_counter(), time.process_time()
    batches = math.ceil(pairs / BATCH)
    for _ in range(batches):
        estimate_directions(matches, threads=threads)
    return Speed(
        label=f"{threads} thread{'s' * (threads > 1)}",
        pairs=batches * BATCH,
        seconds=time.perf_counter() - start,
        cpu_s=time.process_time() - cpu,
        growth_mb=resident_memory_mb() - before_mb,
    )


def measure_processes(pairs: int) -> Speed:
    """Estimate so many pairs in two processes of one thread each; the slower one counts."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=2, mp_context=context) as pool:
        parts = list(pool.map(measure_batches, [pairs // 2] * 2, [1] * 2))
    return Speed(
        label="2 processes",
        pairs=sum(part.pairs for part in parts),
        seconds=max(part.seconds for part in parts),
        cpu_s=sum(part.cpu_s for part in parts),
        growth_mb=max(part.growth_mb for part in parts),
    )


def checks(one: Speed | Calibration) -> list[Check]:
    """Return the limits of one case."""
    if isinstance(one, Speed):
        limits = [Check(name="growth", value=one.growth_mb, limit=MAX_GROWTH_MB)]
        if one.label == "2 processes":
            speed = one.pairs / one.seconds
            limits.append(Check(name="pairs/s", value=speed, limit=MIN_PAIRS_PER_S, better="higher"))
        return limits
    if one.case in STILL:
        return [Check(name="usable", value=one.usable, limit=NO_PARALLAX_LIMIT)]
    # The mean is to be within 20 % of 2 from either side.
    low, high = EXPECTED * (1.0 - SLACK), EXPECTED * (1.0 + SLACK)
    return [
        Check(name="normalized error", value=one.mean, limit=high),
        Check(name="normalized error", value=one.mean, limit=low, better="higher"),
    ]


def tables(measured: Mapping[str, Speed | Calibration], _args: argparse.Namespace) -> Iterator[str]:
    found = list(measured.values())
    calibrations = [one for one in found if isinstance(one, Calibration)]
    yield f"## Speed, {MATCHES} matches per pair, batches of {BATCH} pairs"
    yield table_of(
        [one for one in found if isinstance(one, Speed)],
        {
            "setting": lambda one: one.label,
            "pairs": lambda one: str(one.pairs),
            "pairs/s": lambda one: number(one.pairs / one.seconds),
            "pairs per CPU second": lambda one: number(one.pairs / one.cpu_s),
            "growth, MB": lambda one: number(one.growth_mb),
            "verdict": lambda one: verdict(checks(one)),
        },
    )
    yield f"## Calibration ({MATCHES} matches, noise 0.5 px, baseline 15 % unless told)"
    yield table_of(
        [one for one in calibrations if one.case not in STILL],
        {
            "case": lambda one: one.case.name,
            "usable": lambda one: f"{one.usable:.1%}",
            "normalized error": lambda one: number(one.mean),
            "error, median / 95 %, deg": lambda one: numbers(one.angles_deg),
            "verdict": lambda one: verdict(checks(one)),
        },
    )
    yield "## No parallax"
    yield table_of(
        [one for one in calibrations if one.case in STILL],
        {
            "case": lambda one: one.case.name,
            "said to have none": lambda one: f"{one.no_parallax:.2%}",
            "usable": lambda one: f"{one.usable:.2%}",
            "verdict": lambda one: verdict(checks(one)),
        },
    )


BENCHMARK = Benchmark(
    name="directions",
    title="Directions",
    cases=cases,
    checks=checks,
    tables=tables,
    flags=flags,
    packages=("numpy", "numba"),
    quick={"pairs": BATCH, "draws": 200},
    quantities=(
        Quantity("pairs/s", "1/s", "higher", 0.25, "wall-clock, without start-up"),
        Quantity("growth", "MB", "lower", 1.0, "of resident memory after the first batch, worst process"),
        Quantity("normalized error", "1", "neither", 0.05, "mean of r^T Sigma^-1 r; 2 where Sigma is right"),
        Quantity("error, median / 95 %", "deg", "lower", 0.05, "of the usable directions"),
    ),
)
