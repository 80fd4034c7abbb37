"""Our own bundle adjustment beside pycolmap's (Ceres): same start, same points, same loss.

The start of a real set is what `locate` places from the rotations of its sparse model, with the points that
it triangulates there; nothing is triangulated or filtered in between. Intrinsics are held, the loss is Cauchy
of 1 px. Both are run to a relative fall of the cost of 1e-6, which is timed. The loss has many minima that
are nearly as good, and two ways down from one start may end in two of them. So ours is run until the cost
does not fall any more, and Ceres from there until it stops: how far it goes is how far ours is from a minimum
of its own.

The made street has cameras in a row on both sides of which points are seen by some of their neighbors; it
starts a few pixels off. It grows by cameras at the same number of observations for each.
"""

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

import sfm_shapefit
from benchmarks.real import SCENES
from harness.driver import ROOT, Benchmark, Case, on_sets, positive
from harness.process import peak_memory_mb, time_call
from harness.record import Row, at_least, at_most, median, ratio, times
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.adjustment.solve import adjust
from sfm_shapefit.base.geometry import fit_similarity
from sfm_shapefit.scene.lens import Lens

LOSS_PX = 1.0
TIMED_FALL = 1e-6
TIMES_LESS = 5.0
"""CPU of Ceres over ours, to reach."""
SAME_OPTIMUM = 1e-6
"""Of the extent of the cameras."""
MOST_S, MOST_MB = 10.0, 1500.0
"""Of a made street of 1,000 cameras and a million observations."""
OBSERVATIONS_OF_A_CAMERA, VIEWS = 1000, 5
SETS = (*dict.fromkeys(scene.name for scene in SCENES.values()), "kerry-park")


def flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--cameras", type=positive, nargs="+", default=[500, 1000, 2000], help="of the made streets"
    )


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the real sets and the made streets."""
    folder, names = (ROOT / "data_synthetic", ("courtyard",)) if args.quick else (args.data, SETS)
    found = on_sets(folder, names, compare, args.repeats)
    return found | {f"street of {n}": partial(adjust_street, n) for n in args.cameras}


def compare(folder: Path, repeats: int) -> Row:
    """Adjust one start by both, in turns; to be called in a process of one thread."""
    located = sfm_shapefit.locate(folder / "sparse" / "0", adjust="none").reconstruction
    adjust_own(located, 1e-3)  # a warm-up
    own, ceres = [], []
    for _ in range(repeats):
        own.append(time_call(lambda: adjust_own(located, TIMED_FALL)))
        copy = pycolmap.Reconstruction(located)
        ceres.append(time_call(lambda copy=copy: adjust_by_ceres(copy, TIMED_FALL)))
    best = adjust_own(located, 0.0)
    copy = pycolmap.Reconstruction(best.reconstruction)
    adjust_by_ceres(copy, 0.0)
    apart, name = measure_apart(best.reconstruction, copy), folder.name
    ours, theirs = own[0].found.adjusted, ceres[0].found
    own_s, ceres_s = median([run.cpu_s for run in own]), median([run.cpu_s for run in ceres])
    less = ratio(ceres_s, own_s)
    cells = {
        "set": name,
        "cameras": located.num_reg_images(),
        "observations": located.compute_num_observations(),
        "own, CPU s": own_s,
        "Ceres, CPU s": ceres_s,
        "times less CPU": times(less),
        "steps": [ours.iterations, theirs.num_successful_steps + theirs.num_unsuccessful_steps - 1],
        "cost": f"{ours.cost / theirs.final_cost:.9f}",
        "apart": apart,
    }
    checks = at_least(times_less_CPU=(less, TIMES_LESS))
    checks += at_most(apart=(apart, SAME_OPTIMUM))
    return Row(cells, checks, "Beside pycolmap")


def adjust_own(start: pycolmap.Reconstruction, fall: float) -> Any:
    """Return our adjustment of a model, in a new one."""
    steps = 500 if fall == 0.0 else 100
    options = {"loss_scale_px": LOSS_PX, "cost_tolerance": fall, "max_iterations": steps}
    return sfm_shapefit.bundle_adjust(start, **options)


def adjust_by_ceres(model: pycolmap.Reconstruction, fall: float) -> Any:
    """Adjust a model in place by pycolmap; return the summary of Ceres."""
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


def measure_apart(own: pycolmap.Reconstruction, other: pycolmap.Reconstruction) -> float:
    """Return the largest distance between the centers of two models after a similarity, of their extent."""
    images = sorted(own.reg_image_ids())
    a, b = (np.array([model.image(i).projection_center() for i in images]) for model in (own, other))
    apart = np.linalg.norm(fit_similarity(b, a).apply(b) - a, axis=1).max()
    return float(apart / np.linalg.norm(np.ptp(a, axis=0)))


def make_street(num_cameras: int, seed: int = 0) -> AdjustmentProblem:
    """Return the truth: cameras one apart along x that look forward, and points on both sides."""
    rng = np.random.default_rng(seed)
    num_points = num_cameras * OBSERVATIONS_OF_A_CAMERA // VIEWS
    centers = np.stack([np.arange(num_cameras), *0.1 * rng.standard_normal((2, num_cameras))], axis=1)
    rotation = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    x = rng.uniform(VIEWS + 5.0, num_cameras + 8.0, num_points)
    side = rng.choice([-1.0, 1.0], num_points) * rng.uniform(3.0, 8.0, num_points)
    points = np.stack([x, side, rng.uniform(-2.0, 4.0, num_points)], axis=1)
    # The last camera that sees a point stands some way before it.
    before = np.floor(x - rng.uniform(4.0, 8.0, num_points)).astype(np.int64)
    last = np.clip(before, VIEWS - 1, num_cameras - 1)
    cameras = (last[:, None] - np.arange(VIEWS)).ravel()
    seen = np.repeat(np.arange(num_points), VIEWS)
    body = (points[seen] - centers[cameras]) @ rotation.T
    return AdjustmentProblem(
        rotations=np.tile(rotation, (num_cameras, 1, 1)),
        centers=centers,
        points=points,
        cameras_seeing=cameras,
        points_seen=seen,
        pixels=1000.0 * body[:, :2] / body[:, 2:] + 0.5 * rng.standard_normal((len(seen), 2)),
        lenses=(Lens("SIMPLE_PINHOLE", (1000.0, 0.0, 0.0)),),
        lens_of_camera=np.zeros(num_cameras, np.int64),
    )


def adjust_street(n: int) -> Row:
    """Adjust a made street; to be called in a process of one thread."""
    adjust(make_street(20), max_iterations=2, linear_solver="sparse")  # a warm-up
    truth, rng = make_street(n), np.random.default_rng(1)
    turns = Rotation.from_rotvec(2e-3 * rng.standard_normal((n, 3))).as_matrix()
    start = replace(
        truth,
        rotations=turns @ truth.rotations,
        centers=truth.centers + 0.02 * rng.standard_normal(truth.centers.shape),
        points=truth.points + 0.02 * rng.standard_normal(truth.points.shape),
    )
    run = time_call(lambda: adjust(start, loss_scale_px=LOSS_PX))
    found, peak_mb = run.found, peak_memory_mb()
    cells = {
        "cameras": n,
        "observations": start.num_observations,
        "CPU, s": run.cpu_s,
        "peak, MB": peak_mb,
        "steps": f"{found.iterations}" + ("" if found.converged else " (not converged)"),
        "error before": _local_error(start.centers, truth.centers),
        "error after": _local_error(found.problem.centers, truth.centers),
    }
    checks = at_most(CPU_s=(run.cpu_s, MOST_S), peak_MB=(peak_mb, MOST_MB))
    return Row(cells, checks if n == 1000 else (), "Made streets")


def _local_error(centers: np.ndarray, truth: np.ndarray) -> float:
    """Return the median error of the steps from camera to camera: a long street bends as a whole."""
    return float(np.median(np.linalg.norm(np.diff(centers - truth, axis=0), axis=1)))


BENCHMARK = Benchmark(
    name="adjustment",
    title="Bundle adjustment: our own beside pycolmap's, and large problems",
    cases=cases,
    flags=flags,
    quick={"cameras": [30], "repeats": 1},
    repeats=3,
    columns={
        "own, Ceres": "CPU s; median of the runs to a relative fall of 1e-6",
        "times less CPU": "1; Ceres over ours, from model to model",
        "steps": "linear systems solved, own / Ceres, or own",
        "cost": "1; ours over Ceres', both to a relative fall of 1e-6",
        "apart": "1; how far Ceres moves a center from our minimum, of the extent",
        "peak": "MB; of the process, the making of the street included",
        "error before, error after": "1; median, of the step between two cameras",
    },
)
