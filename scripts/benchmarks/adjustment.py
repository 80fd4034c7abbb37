"""Our own bundle adjustment beside pycolmap's (Ceres): same start, same points, same loss.

The start of a real set is what `locate` places from the rotations of its sparse model, with the points that
it triangulates there; nothing is triangulated or filtered in between. Intrinsics are held, the loss is Cauchy
of 1 px. Both are run to a relative fall of the cost of 1e-6, which is timed. The loss has many minima that
are nearly as good, and two ways down from one start may end in two of them. So ours is run until the cost
does not fall any more, and Ceres from there until it stops: how far it goes is how far ours is from a minimum
of its own.

A fisheye lens is measured by us on ideal cameras, so that the minimum of kerry-park is another one.

The made street has cameras in a row on both sides of which points are seen by some of their neighbors; it
starts a few pixels off. It grows by cameras at the same number of observations for each.
"""

import argparse
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from benchmarks.real import SCENES
from harness import ours
from harness.driver import Benchmark, Case, if_there, positive
from harness.metrics import Check, Quantity, check_all, median, number, ratio, times, verdict
from harness.process import peak_memory_mb
from harness.record import table_of

if TYPE_CHECKING:
    import pycolmap

    from sfm_shapefit.adjustment import AdjustmentProblem

LOSS_PX = 1.0
TIMED_FALL = 1e-6
TIMES_LESS = 5.0
"""CPU of Ceres over ours, to reach."""
SAME_OPTIMUM = 1e-6
"""Of the extent of the cameras."""
LARGE_LIMITS = {"CPU, s": 10.0, "peak, MB": 1500.0}
"""Of a made street of 1,000 cameras and a million observations."""
OBSERVATIONS_OF_A_CAMERA, VIEWS = 1000, 5
FISHEYES = ("kerry-park",)
SETS = (*dict.fromkeys(scene.name for scene in SCENES.values()), "kerry-park")


class Compared(NamedTuple):
    """Both adjustments of one start."""

    name: str
    num_cameras: int
    num_observations: int
    own_cpu_s: tuple[float, ...]
    ceres_cpu_s: tuple[float, ...]
    own_steps: int
    ceres_steps: int
    cost_ratio: float
    """Ours over Ceres', of the runs that are timed."""
    apart: float
    """How far Ceres takes a center from our minimum, of the extent."""

    @property
    def times_less(self) -> float:
        """CPU of Ceres over ours."""
        return ratio(median(self.ceres_cpu_s), median(self.own_cpu_s))


class Large(NamedTuple):
    """A made street."""

    num_cameras: int
    num_observations: int
    cpu_s: float
    peak_mb: float
    steps: int
    converged: bool
    error_before: float
    error_after: float
    """Median distance of the centers from the truth, of their spacing."""


def flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--cameras", type=positive, nargs="+", default=[500, 1000, 2000], help="of the made streets"
    )


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the real sets and the made streets."""
    found: dict[str, Case] = {}
    if not args.quick:
        for name in SETS:
            folder = args.data / name
            found[name] = if_there(folder, partial(compare, name, folder, args.repeats))
    else:
        bundled = Path(__file__).parents[2] / "data_synthetic" / "courtyard"
        found["courtyard"] = partial(compare, "courtyard", bundled, args.repeats)
    return found | {f"street of {n}": partial(adjust_street, n) for n in args.cameras}


def compare(name: str, folder: Path, repeats: int) -> Compared:
    """Adjust one start by both, in turns; to be called in a process of one thread."""
    import pycolmap

    located = ours.locate(folder / "sparse" / "0", adjust="none").reconstruction
    adjust_own(located, 1e-3)  # a warm-up
    own, ceres = [], []
    for _ in range(repeats):
        own.append(ours.time_call(lambda: adjust_own(located, TIMED_FALL)))
        copy = pycolmap.Reconstruction(located)
        ceres.append(ours.time_call(lambda copy=copy: adjust_by_ceres(copy, TIMED_FALL)))
    best = adjust_own(located, 0.0)
    copy = pycolmap.Reconstruction(best.reconstruction)
    adjust_by_ceres(copy, 0.0)
    return Compared(
        name=name,
        num_cameras=located.num_reg_images(),
        num_observations=located.compute_num_observations(),
        own_cpu_s=tuple(run.cpu_s for run in own),
        ceres_cpu_s=tuple(run.cpu_s for run in ceres),
        own_steps=own[0].found.adjusted.iterations,
        ceres_steps=ceres[0].found.num_successful_steps + ceres[0].found.num_unsuccessful_steps - 1,
        cost_ratio=own[0].found.adjusted.cost / ceres[0].found.final_cost,
        apart=measure_apart(best.reconstruction, copy),
    )


def adjust_own(start: "pycolmap.Reconstruction", fall: float):
    """Return our adjustment of a model, in a new one."""
    from sfm_shapefit import bundle_adjust

    steps = 500 if fall == 0.0 else 100
    return bundle_adjust(start, loss_scale_px=LOSS_PX, cost_tolerance=fall, max_iterations=steps)


def adjust_by_ceres(model: "pycolmap.Reconstruction", fall: float):
    """Adjust a model in place by pycolmap; return the summary of Ceres."""
    import pycolmap

    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    if model.num_reg_frames() < model.num_reg_images():
        config.set_constant_rig_from_world_pose(min(model.reg_frame_ids()))
    else:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = False
    options.refine_principal_point = options.refine_sensor_from_rig = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_PX
    solver = options.ceres.solver_options
    solver.function_tolerance = fall
    if fall == 0.0:
        solver.gradient_tolerance = solver.parameter_tolerance = 1e-16
    solver.max_num_iterations, solver.num_threads = 300 if fall == 0.0 else 100, 1
    return pycolmap.create_default_ceres_bundle_adjuster(options, config, model).solve().ceres_summary


def measure_apart(own: "pycolmap.Reconstruction", other: "pycolmap.Reconstruction") -> float:
    """Return the largest distance between the centers of two models after a similarity, of their extent."""
    from sfm_shapefit.base.geometry import fit_similarity

    images = sorted(own.reg_image_ids())
    a, b = (np.array([model.image(i).projection_center() for i in images]) for model in (own, other))
    apart = np.linalg.norm(fit_similarity(b, a).apply(b) - a, axis=1).max()
    return float(apart / np.linalg.norm(np.ptp(a, axis=0)))


def make_street(num_cameras: int, seed: int = 0) -> "AdjustmentProblem":
    """Return the truth: cameras one apart along x that look forward, and points on both sides."""
    from sfm_shapefit.adjustment import AdjustmentProblem, Lens

    rng = np.random.default_rng(seed)
    num_points = num_cameras * OBSERVATIONS_OF_A_CAMERA // VIEWS
    centers = np.stack([np.arange(num_cameras), *0.1 * rng.standard_normal((2, num_cameras))], axis=1)
    rotation = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    x = rng.uniform(VIEWS + 5.0, num_cameras + 8.0, num_points)
    side = rng.choice([-1.0, 1.0], num_points) * rng.uniform(3.0, 8.0, num_points)
    points = np.stack([x, side, rng.uniform(-2.0, 4.0, num_points)], axis=1)
    # The last camera that sees a point stands some way before it.
    last = np.clip(
        np.floor(x - rng.uniform(4.0, 8.0, num_points)).astype(np.int64), VIEWS - 1, num_cameras - 1
    )
    cameras = (last[:, None] - np.arange(VIEWS)).ravel()
    seen = np.repeat(np.arange(num_points), VIEWS)
    body = (points[seen] - centers[cameras]) @ rotation.T
    pixels = 1000.0 * body[:, :2] / body[:, 2:] + 0.5 * rng.standard_normal((len(seen), 2))
    return AdjustmentProblem(
        rotations=np.tile(rotation, (num_cameras, 1, 1)),
        centers=centers,
        points=points,
        cameras_seeing=cameras,
        points_seen=seen,
        pixels=pixels,
        lenses=(Lens("SIMPLE_PINHOLE", (1000.0, 0.0, 0.0)),),
        lens_of_camera=np.zeros(num_cameras, np.int64),
    )


def adjust_street(num_cameras: int) -> Large:
    """Adjust a made street; to be called in a process of one thread."""
    from dataclasses import replace

    from scipy.spatial.transform import Rotation

    from sfm_shapefit.adjustment import adjust

    adjust(make_street(20), max_iterations=2, linear_solver="sparse")  # a warm-up
    truth = make_street(num_cameras)
    rng = np.random.default_rng(1)
    turns = Rotation.from_rotvec(2e-3 * rng.standard_normal((num_cameras, 3))).as_matrix()
    start = replace(
        truth,
        rotations=turns @ truth.rotations,
        centers=truth.centers + 0.02 * rng.standard_normal(truth.centers.shape),
        points=truth.points + 0.02 * rng.standard_normal(truth.points.shape),
    )
    run = ours.time_call(lambda: adjust(start, loss_scale_px=LOSS_PX))
    return Large(
        num_cameras=num_cameras,
        num_observations=start.num_observations,
        cpu_s=run.cpu_s,
        peak_mb=peak_memory_mb(),
        steps=run.found.iterations,
        converged=run.found.converged,
        error_before=_local_error(start.centers, truth.centers),
        error_after=_local_error(run.found.problem.centers, truth.centers),
    )


def _local_error(centers: np.ndarray, truth: np.ndarray) -> float:
    """Return the median error of the steps from camera to camera: a long street bends as a whole."""
    return float(np.median(np.linalg.norm(np.diff(centers - truth, axis=0), axis=1)))


def checks(one: Compared | Large) -> list[Check]:
    """Return the limits of one case."""
    if isinstance(one, Large):
        limits = LARGE_LIMITS if one.num_cameras == 1000 else {}
        return check_all({"CPU, s": one.cpu_s, "peak, MB": one.peak_mb}, limits)
    found = [Check(name="times less CPU", value=one.times_less, limit=TIMES_LESS, better="higher")]
    if one.name not in FISHEYES:
        found.append(Check(name="apart", value=one.apart, limit=SAME_OPTIMUM))
    return found


def tables(measured: Mapping[str, Compared | Large], _args: argparse.Namespace) -> Iterator[str]:
    compared = [one for one in measured.values() if isinstance(one, Compared)]
    large = [one for one in measured.values() if isinstance(one, Large)]
    if compared:
        yield "## Beside pycolmap"
        yield table_of(
            compared,
            {
                "set": lambda one: one.name,
                "cameras": lambda one: str(one.num_cameras),
                "observations": lambda one: str(one.num_observations),
                "own, CPU s": lambda one: number(median(one.own_cpu_s)),
                "Ceres, CPU s": lambda one: number(median(one.ceres_cpu_s)),
                "times less CPU": lambda one: times(one.times_less),
                "steps": lambda one: f"{one.own_steps} / {one.ceres_steps}",
                "cost": lambda one: f"{one.cost_ratio:.9f}",
                "apart": lambda one: number(one.apart),
                "verdict": lambda one: verdict(checks(one)),
            },
        )
    if large:
        yield "## Made streets"
        yield table_of(
            large,
            {
                "cameras": lambda one: str(one.num_cameras),
                "observations": lambda one: str(one.num_observations),
                "CPU, s": lambda one: number(one.cpu_s),
                "peak, MB": lambda one: number(one.peak_mb),
                "steps": lambda one: f"{one.steps}" + ("" if one.converged else " (not converged)"),
                "error before": lambda one: number(one.error_before),
                "error after": lambda one: number(one.error_after),
                "verdict": lambda one: verdict(checks(one)),
            },
        )


BENCHMARK = Benchmark(
    name="adjustment",
    title="Bundle adjustment: our own beside pycolmap's, and large problems",
    cases=cases,
    tables=tables,
    checks=checks,
    flags=flags,
    quick={"cameras": [30], "repeats": 1},
    repeats=3,
    quantities=(
        Quantity("own, Ceres", "CPU s", "lower", 0.25, "median of the runs to a relative fall of 1e-6"),
        Quantity("times less CPU", "1", "higher", 0.25, "Ceres over ours, from model to model"),
        Quantity("steps", "1", "lower", 0.1, "linear systems solved, own / Ceres, or own"),
        Quantity("cost", "1", "lower", 1e-9, "ours over Ceres', both to a relative fall of 1e-6"),
        Quantity("apart", "1", "lower", 1.0, "how far Ceres moves a center from our minimum, of the extent"),
        Quantity("peak", "MB", "lower", 0.1, "of the process, the making of the street included"),
        Quantity("error before, error after", "1", "lower", 0.1, "median, of the step between two cameras"),
    ),
)
