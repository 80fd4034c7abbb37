"""Bare graphs: pytheia's and gtsam's translation averaging beside ours, on the same directions.

Every contender runs in its own fresh process with a limit of CPU time, once after a small warm-up problem, on
one thread. The clock covers the call alone: a peer's own input types are built before. All keep their default
options, except that our ShapeFit is certified to 1e-6, and gtsam's measurements have the noise model that
its interface demands, sigma 0.01, with or without a Huber loss of 1.345 on it. Rotations are identities, so
that pytheia's camera axes are the world's. Its nonlinear estimator starts at random, and may fail from a bad
start: it runs three times, and the median counts.

pytheia and gtsam are optional (`pip install pytheia gtsam`, the extra `peers`); without them their rows say
so.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

import sfm_shapefit
from harness.graphs import GraphSpec, draw, relative_error
from harness.process import call, peak_memory_mb, reset_peak, thread_environment, time_call
from harness.record import Check, ratio, text_of
from sfm_shapefit import ViewGraph
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.files.colmap.quiet import quiet_stderr

WALL_PER_CPU = 30
"""Wall-clock limit over the limit of CPU time: ends what waits instead of computing."""
FASTER = 5.0
"""Times faster than the fastest peer of equal or better error, to be reached."""
_GTSAM_SIGMA, _HUBER = 0.01, 1.345
_SHAPEFIT_TOL = 1e-6

PROBLEMS = {
    f"{family}-{n}": GraphSpec(family=family, n=n, degree=degree, sigma=0.01)
    for family, n, degree in (
        *(("er2", 100, 0.0), ("er2", 300, 0.0), ("geo", 1000, 40.0), ("geo", 5000, 40.0)),
        *(("comm", 1000, 67.0), ("lawn", 1000, 20.0), ("ring", 500, 20.0), ("corr", 500, 20.0)),
        ("seq", 300, 36.0),
    )
}
WARM_UP = {
    # Above 450 unknowns there are factors in single precision too.
    "er2": GraphSpec(family="er2", n=160, sigma=0.01),
    "geo": GraphSpec(family="geo", n=1000, degree=20.0, sigma=0.01),
    "comm": GraphSpec(family="comm", n=1000, degree=20.0, sigma=0.01),
    "small": GraphSpec(family="er2", n=60, sigma=0.01),
}


Solver = Callable[[], tuple[FloatArray, str]]
"""Solves the problem that it was prepared for; returns locations (n, 3) and a note."""


class Answer(NamedTuple):
    """What a contender gave on a problem or a scene."""

    name: str
    error: Any = math.nan
    """Against the truth: a number of a graph, `Errors` of a scene or None."""
    seconds: float = math.nan
    cpu_s: float = math.nan
    """CPU time of all threads while the clock ran; unknown where the clock covers a part of a call."""
    peak_mb: float = math.nan
    """Peak resident memory of its process while the clock ran, in 10^6 bytes."""
    note: str = ""
    """Why there is no answer, or what else it says."""

    @property
    def ours(self) -> bool:
        """Whether it is no peer's."""
        return self.name.startswith("ours")

    @property
    def spent_s(self) -> float:
        """What is raced: CPU time, which other programs do not lengthen; seconds where it is unknown."""
        return self.cpu_s if math.isfinite(self.cpu_s) else self.seconds


def ask(name: str, package: str | None, run: Callable[[], Answer], cpu_limit_s: int) -> Answer:
    """Return what a contender answers in a fresh process of one thread, or why there is none."""
    if package is not None and find_spec(package) is None:
        return Answer(name, note=f"skipped: {package} is not installed")
    limits = {"timeout_s": WALL_PER_CPU * cpu_limit_s, "cpu_limit_s": cpu_limit_s}
    try:
        found: Answer = call(run, environment=thread_environment(1), **limits)
    except (TimeoutError, RuntimeError) as reason:
        return Answer(name, note=f"failed: {reason}")
    return found


def _solve_shapefit(graph: ViewGraph) -> tuple[FloatArray, str]:
    found = sfm_shapefit.solve(graph, tol=_SHAPEFIT_TOL, uniqueness=False)
    return found.locations, f"{found.method}, certified gap {found.gap:.0e}"


def _place(graph: ViewGraph) -> tuple[FloatArray, str]:
    found = sfm_shapefit.place(graph, tol=_SHAPEFIT_TOL, uniqueness=False)
    points = dict(zip(found.cameras.tolist(), found.locations, strict=True))
    return _gather(points, graph.num_nodes), f"from {found.refined.finish.start}, verdicts included"


def _by_pytheia(nonlinear: bool, graph: ViewGraph) -> Solver:
    from pytheia import sfm

    pairs = {}
    for (i, j), v in zip(graph.edges.tolist(), graph.directions, strict=True):
        info = sfm.TwoViewInfo()
        info.rotation_2 = np.zeros(3)
        # Where the second camera is, seen from the first.
        info.position_2 = -v if i < j else v
        info.num_verified_matches = 100
        pairs[min(i, j), max(i, j)] = info
    orientations = {camera: np.zeros(3) for camera in range(graph.num_nodes)}

    def run_it() -> tuple[FloatArray, str]:
        with quiet_stderr():
            if nonlinear:
                options = sfm.NonlinearPositionEstimatorOptions()
                estimator = sfm.NonlinearPositionEstimator(options, sfm.Reconstruction())
            else:
                options = sfm.LeastUnsquaredDeviationPositionEstimatorOptions()
                estimator = sfm.LeastUnsquaredDeviationPositionEstimator(options)
            found = estimator.EstimatePositions(pairs, orientations)
        return _gather({k: np.ravel(p) for k, p in found.items()}, graph.num_nodes), ""

    return run_it


def _by_gtsam(robust: bool, bilinear: bool, graph: ViewGraph) -> Solver:
    import gtsam

    noise = gtsam.noiseModel.Isotropic.Sigma(2, _GTSAM_SIGMA)
    if robust:
        noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(_HUBER), noise)
    measurements = [
        gtsam.BinaryMeasurementUnit3(i, j, gtsam.Unit3(-v), noise)  # gtsam's points from i to j
        for (i, j), v in zip(graph.edges.tolist(), graph.directions, strict=True)
    ]
    recovery = gtsam.TranslationRecovery(gtsam.LevenbergMarquardtParams(), bilinear)

    def run_it() -> tuple[FloatArray, str]:
        with quiet_stderr():
            values = recovery.run(measurements, 1.0)
        points = {k: values.atPoint3(k) for k in range(graph.num_nodes) if values.exists(k)}
        return _gather(points, graph.num_nodes), ""

    return run_it


class Contender(NamedTuple):
    """A solver of bare graphs and the package it needs; None: ours."""

    name: str
    prepare: Callable[[ViewGraph], Solver]
    package: str | None = None
    runs: int = 1
    """The answer is the one of median error; 3 where a random start may fail."""


CONTENDERS = (
    Contender("ours, placed", lambda graph: partial(_place, graph)),
    Contender("ours, ShapeFit", lambda graph: partial(_solve_shapefit, graph)),
    Contender("pytheia LUD", partial(_by_pytheia, False), "pytheia"),
    Contender("pytheia Nonlinear", partial(_by_pytheia, True), "pytheia", runs=3),
    Contender("gtsam TranslationRecovery", partial(_by_gtsam, False, False), "gtsam"),
    Contender("gtsam with Huber", partial(_by_gtsam, True, False), "gtsam"),
    Contender("gtsam bilinear with Huber", partial(_by_gtsam, True, True), "gtsam"),
)


def answer(contender: Contender, spec: GraphSpec, cpu_limit_s: int) -> Answer:
    """Return a contender's answer, or why there is none."""
    return ask(contender.name, contender.package, partial(measure, contender.name, spec), cpu_limit_s)


def measure(name: str, spec: GraphSpec) -> Answer:
    """Return the answer of a contender; to be called once per process."""
    contender = next(one for one in CONTENDERS if one.name == name)
    if contender.package is None:
        # Compiled code is loaded.
        for warm_up in dict.fromkeys((spec.family if spec.family in WARM_UP else "geo", "er2", "small")):
            contender.prepare(draw(WARM_UP[warm_up]).view_graph)()
    problem = draw(spec)
    runs = []
    reset_peak()
    for _ in range(contender.runs):
        (locations, note), wall_s, cpu_s = time_call(contender.prepare(problem.view_graph))
        runs.append((relative_error(locations, problem.locations), wall_s, cpu_s, peak_memory_mb(), note))
    runs.sort()
    found = Answer(name, *runs[len(runs) // 2])
    if len(runs) == 1:
        return found
    note = f"median of {len(runs)} random starts, errors {text_of([run[0] for run in runs])}"
    return found._replace(peak_mb=max(run[3] for run in runs), note=note)


def _gather(points: dict[int, FloatArray], n: int) -> FloatArray:
    """Return the points as an array; RuntimeError if cameras are missing or not finite."""
    missing = n - len(points)
    if missing:
        raise RuntimeError(f"{missing} of {n} cameras have no position")
    locations: FloatArray = np.array([points[camera] for camera in range(n)], dtype=np.float64)
    if not np.isfinite(locations).all():
        raise RuntimeError("positions that are not finite")
    return locations


def checks(answers: Sequence[Answer]) -> list[Check]:
    """Return the checks of one problem: the lowest error of all, and the time of the equally accurate.

    A peer without an answer has no check; where no peer is as accurate as ours, there is none of the time.
    """
    answered = [answer for answer in answers if math.isfinite(answer.error)]
    peers = [answer for answer in answered if not answer.ours]
    if not peers:
        return []
    best = min((a for a in answered if a.ours), key=lambda answer: answer.error, default=Answer("ours"))
    error = best.error
    found = [Check("error", error, min(peer.error for peer in peers))]
    as_good = [peer.spent_s for peer in peers if peer.error <= error]
    if as_good:
        found.append(Check("times faster", ratio(min(as_good), best.spent_s), FASTER, "higher"))
    return found
