"""Rough poses made exact: lists of poses whose rotations are off by degrees, beside `map` from scratch.

The true poses of a scene are spoiled and written as transforms.json: each rotation is turned by a standard
deviation about each axis, one in twenty by anything; focal lengths are off by 5 %, up or down; positions are
random. The database has its focal length 5 % off, as a guess, so that `map` has no better one. Both run on
one thread, the second time of two, and deliver an adjusted model.

Where the errors of both move no pixel by a thousandth (error / extent of the cameras x focal length), fifty
times less than the best keypoints are off, both are exact, and their ratio is one of roundings.
"""

import argparse
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

import sfm_shapefit
from harness.driver import ROOT, Benchmark, Case, if_there
from harness.process import Timed, time_call
from harness.record import Row, at_least, at_most, ratio
from sfm_shapefit.commands.convert import convert
from sfm_shapefit.facts.warnings import wrong_rotations

BUNDLED = {"courtyard": "truth", "photographed": "truth", "ring8": "sparse/0"}
REAL = ("castle-P30", "Herz-Jesus-P25", "fountain-P11", "lego100")
SIGMAS_DEG = (0.5, 1.0, 2.0, 5.0)
GROSS, OFF = 0.05, 0.05
"""Share of wrong rotations, and by what share focal lengths are off."""
_EXACT_PX = 1e-3  # pixels; see above


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the bundled scenes, and the real ones that are there."""
    known = {name: (ROOT / "data_synthetic" / name, truth) for name, truth in BUNDLED.items()}
    if args.quick:
        known = {"ring8": known["ring8"]}
    else:
        known |= {name: (args.data / name, "gt") for name in REAL}
    return {
        name: if_there(folder, partial(measure, name, folder, truth, args))
        for name, (folder, truth) in known.items()
    }


def measure(name: str, folder: Path, truth: str, args: argparse.Namespace) -> list[Row]:
    """Spoil the poses of a scene by each standard deviation, and make them exact."""
    with tempfile.TemporaryDirectory() as work:
        database = Path(work) / "database.db"
        shutil.copyfile(folder / "database.db", database)
        guess_focal_lengths(database, 1.0 + OFF)
        mapped, _, seconds = warm(lambda: sfm_shapefit.map_database(database, threads=args.threads))
        error = sfm_shapefit.evaluate(mapped.models[0], folder / truth).position.mean
        poses, rows, exact = Path(work) / "transforms.json", [], exact_error(folder / truth)
        for sigma_deg in SIGMAS_DEG[:1] if args.quick else SIGMAS_DEG:
            runs = [
                one_run(folder / truth, database, poses, sigma_deg, seed, args.threads)
                for seed in range(args.repeats)
            ]
            rows.append(row_of(name, sigma_deg, runs, error, seconds, exact))
        return rows


def exact_error(truth: Path) -> float:
    """Return the position error that moves no pixel of a scene by more than what counts as exact."""
    model = pycolmap.Reconstruction(truth)
    centers = [image.projection_center() for image in model.images.values() if image.has_pose]
    focal = max(camera.mean_focal_length() for camera in model.cameras.values())
    return float(_EXACT_PX / focal * np.linalg.norm(np.ptp(centers, axis=0)))


def guess_focal_lengths(database: Path, factor: float) -> None:
    """Let the focal lengths of a database be guesses, some factor too long."""
    connection = sqlite3.connect(database)
    for camera, model, params in connection.execute(
        "SELECT camera_id, model, params FROM cameras"
    ).fetchall():
        made = pycolmap.Camera(model=pycolmap.CameraModelId(model), width=1, height=1)
        values = np.frombuffer(params, "<f8").copy()
        values[made.focal_length_idxs()] *= factor
        connection.execute(
            "UPDATE cameras SET params = ?, prior_focal_length = 0 WHERE camera_id = ?",
            (values.tobytes(), camera),
        )
    connection.commit()
    connection.close()


def spoil(truth: Path, poses: Path, sigma_deg: float, seed: int) -> set[str]:
    """Write the spoiled poses of a model, and return the names of those that are wrong."""
    rng, model = np.random.default_rng(seed), pycolmap.Reconstruction(truth)
    posed = sorted(image.name for image in model.images.values() if image.has_pose)
    wrong = set(rng.permutation(posed)[: max(1, round(GROSS * len(posed)))].tolist())
    for image in sorted(model.images.values(), key=lambda image: image.name):
        if image.name not in posed:
            continue
        turn = Rotation.from_rotvec(np.radians(sigma_deg) * rng.standard_normal(3))
        turn = Rotation.random(random_state=rng) if image.name in wrong else turn
        rotation = turn.as_matrix() @ image.cam_from_world().rotation.matrix()
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), rng.standard_normal(3))
        model.frame(image.frame_id).rig_from_world = pose
    for camera in model.cameras.values():
        params = camera.params.copy()
        params[camera.focal_length_idxs()] *= 1.0 + OFF * (-1.0) ** seed
        camera.params = params
    convert(model, poses, overwrite=True)
    return wrong


def one_run(
    truth: Path, database: Path, poses: Path, sigma_deg: float, seed: int, threads: int
) -> dict[str, Any]:
    """Return what comes of one spoiled list."""
    wrong = spoil(truth, poses, sigma_deg, seed)
    found, _, seconds = warm(
        lambda: sfm_shapefit.locate(poses, database, rotations=sigma_deg, threads=threads)
    )
    named = {found.images.names[k] for k in wrong_rotations(found.turned_deg, sigma_deg).tolist()}
    return {
        "error": sfm_shapefit.evaluate(found, truth).position.mean,
        "images": found.reconstruction.num_reg_images(),
        "all": found.images.num_images,
        "wrong": len(wrong),
        "named": len(named & wrong),
        "falsely": len(named - wrong),
        "seconds": seconds,
    }


def warm(run: Callable[[], Any]) -> Timed:
    """Call a function a second time, its kernels loaded."""
    run()
    return time_call(run)


def row_of(
    name: str, sigma_deg: float, runs: list[dict[str, Any]], error: float, seconds: float, exact: float
) -> Row:
    """Return the row of a scene whose rotations are so rough."""
    total = {key: sum(run[key] for run in runs) for key in runs[0]}
    mean, cpu = total["error"] / len(runs), float(np.median([run["seconds"] for run in runs]))
    named, falsely = total["named"] / total["wrong"], total["falsely"] / (total["all"] - total["wrong"])
    over_map = 1.0 if max(mean, error) <= exact else ratio(mean, error)
    cells = {
        "scene": name,
        "off deg": sigma_deg,
        "images": f"{total['images'] / len(runs):.1f} of {runs[0]['all']}",
        "error": mean,
        "map": error,
        "over map": "both exact" if max(mean, error) <= exact else over_map,
        "named": f"{total['named']} of {total['wrong']}",
        "falsely": total["falsely"],
        "CPU s": cpu,
        "of map": ratio(cpu, seconds),
    }
    checks = at_most(over_map=(over_map, 1.05), falsely=(falsely, 0.02), of_map=(cells["of map"], 0.5))
    return Row(cells, checks + at_least(named=(named, 0.98)), more={"totals": total})


def closing(rows: Any) -> Iterator[str]:
    """Yield what all rows say together."""
    total = {key: sum(row["totals"][key] for row in rows) for key in rows[0]["totals"]}
    yield (
        f"All scenes: {total['named']} of {total['wrong']} wrong rotations named, {total['falsely']} of "
        f"{total['all'] - total['wrong']} others falsely."
    )


BENCHMARK = Benchmark(
    name="rough",
    title="Rough poses",
    cases=cases,
    closing=closing,
    quick={"repeats": 1},
    repeats=5,
    columns={
        "off deg": "degrees; standard deviation of given rotations about each axis, as `locate` is told",
        "images": "images placed, mean of the seeds",
        "error": "mean position error after a similarity, units of the truth; mean of the seeds",
        "map": "the same of `map` from the same database",
        "over map": "ratio of the two; at most 1.05",
        "named": "wrong rotations that are named",
        "falsely": "right ones that are; at most 2 %",
        "CPU s": "processor seconds, median of the seeds",
        "of map": "share of the processor seconds of `map`; at most half",
    },
)
