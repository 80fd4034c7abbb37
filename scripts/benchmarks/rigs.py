"""Rigs, whose offsets fix the scale: a made drive beside global mapping, and rendered yards for `map`.

The drive has two rigs of three cameras, and pycolmap's global mapping runs on its database.

The scale is known here: `locate` takes it from the offsets of the sensors, and so may global mapping, which
holds their poses too. Its answer is aligned by shift and rotation alone; the scale that a similarity would
choose is reported. It estimates rotations itself, where `locate` is given the true ones, so the drive is also
run without wrong pairs. Of four settings of global mapping (least number of matches of a pair, freedom to
change sensors in their rigs) the best one of each drive stands in the table.

The yards are photographed by one rig each: a pair, two cameras back to back, and four; SIFT, matches and
verification are by pycolmap. `map` is given their database alone. `locate` is given the true rotations: held,
which is more than any database tells, and free, which is what the pixels alone allow from the best start.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap

import sfm_shapefit
from harness.driver import Benchmark, Case, positive
from harness.process import time_call
from harness.record import Check, Row, ratio
from harness.scenes import temporary_scene
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import fit_similarity
from sfm_shapefit.synthetic import SceneOptions, make_rig_drive
from sfm_shapefit.synthetic.layouts import SceneCameras

LOCATE, ADJUSTED, MAPPING = "locate", "locate --adjust full", "global mapping, its best setting"
MAP, MAP_ADJUSTED = "map", "map --adjust full"
HELD, FREE = "locate, true rotations held", "locate, true rotations free"
LARGEST_SCALE_ERROR, LARGEST_RATIO = 0.001, 1.2
"""Of `map` on a rendered yard: the scale, and the mean error to that of `locate`."""
DRIVES, YARDS = "Drives of two vehicles with three cameras each", "Rendered yards, by one rig each"
_SIZE = {"shape": "courtyard", "image_width": 640, "image_height": 480, "focal_length_px": 480.0}
_YARDS: dict[str, dict[str, Any]] = {
    "pair": {"num_images": 32, "seed": 401},
    "back-to-back": {"num_images": 48, "seed": 402},
    "four": {"num_images": 48, "seed": 403},
}
_MOST_KEYPOINTS = 1500
_SHARES = (0.0, 0.2)
_MIN_MATCHES = (15, 50)


class Outcome(NamedTuple):
    """What one run gave."""

    num_images: int
    scale_error: float
    """Of the similarity onto the truth."""
    errors_m: FloatArray
    """Of each camera after shift and rotation, at the run's own scale."""
    wall_s: float


def flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--images", type=positive, default=90, help="of a drive, six per meter and a half")


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return each method on each share of wrong pairs, and the rendered yards."""
    drives: dict[str, Case] = {
        f"{share:.0%} wrong, {method}": partial(measure, method, share, args.images, args.repeats)
        for share in (_SHARES[-1:] if args.quick else _SHARES)
        for method in (LOCATE, ADJUSTED, MAPPING)
    }
    yards = {f"rendered {rig}": partial(measure_yard, rig) for rig in _YARDS}
    return drives if args.quick else drives | yards


def measure(method: str, share: float, num_images: int, drives: int) -> Row:
    """Run a method on so many drives with a share of wrong pairs."""
    outcomes = []
    size = {"num_images": num_images, "num_points": 2000, "max_pairs_per_image": 12}
    for seed in range(drives):
        scene = make_rig_drive(SceneOptions(corrupted_pair_fraction=share, seed=seed, **size))
        with temporary_scene(scene, model="rotations", relative_poses=True) as (_, workspace):
            outcomes.append(_run(method, scene, workspace))
    cells = {
        "wrong pairs": f"{share:.0%}",
        "method": method,
        "images": [one.num_images for one in outcomes],
        "scale error": f"{np.median([abs(one.scale_error) for one in outcomes]):.2%}",
        "median (m)": f"{np.median([np.median(one.errors_m) for one in outcomes]):.4f}",
        "worst camera (m)": f"{max(one.errors_m.max() for one in outcomes):.4f}",
        "seconds": f"{np.median([one.wall_s for one in outcomes]):.1f}",
    }
    return Row(cells, table=DRIVES)


def measure_yard(rig: str) -> list[Row]:
    """Photograph a yard by a rig, and place the images by each method."""
    options = {**_SIZE, **_YARDS[rig], "rig": rig, "max_keypoints_per_image": _MOST_KEYPOINTS}
    with temporary_scene(options, {}, model="rotations") as (scene, workspace):
        model = workspace / "sparse" / "0"
        runs: dict[str, Callable[[], Any]] = {
            MAP: lambda: _map_ours(workspace, "seed"),
            MAP_ADJUSTED: lambda: _map_ours(workspace, "full"),
            HELD: lambda: sfm_shapefit.locate(model, rotations="held").reconstruction,
            FREE: lambda: sfm_shapefit.locate(model, rotations="free").reconstruction,
        }
        timed = {name: time_call(run) for name, run in runs.items()}
    return judge(rig, {name: compare(scene, run.found, run.wall_s) for name, run in timed.items()})


def _map_ours(workspace: Path, adjust: Any) -> pycolmap.Reconstruction:
    found = sfm_shapefit.map_database(workspace / "database.db", adjust=adjust)
    return found.models[0].reconstruction


def _run(method: str, scene: SceneCameras, workspace: Path) -> Outcome:
    if method == MAPPING:
        return _best_mapping(scene, workspace)
    locate = partial(
        sfm_shapefit.locate,
        workspace / "sparse" / "0",
        adjust="full" if method == ADJUSTED else "seed",
    )
    run = time_call(locate)
    return compare(scene, run.found.reconstruction, run.wall_s)


def _best_mapping(scene: SceneCameras, workspace: Path) -> Outcome:
    """Return the run of global mapping with most images and, of those, the lowest median error."""
    runs = [_map(scene, workspace, matches, refine) for matches in _MIN_MATCHES for refine in (False, True)]
    return min(runs, key=lambda run: (-run.num_images, float(np.median(run.errors_m))))


def _map(scene: SceneCameras, workspace: Path, min_num_matches: int, refine_sensors: bool) -> Outcome:
    """Run global mapping on a copy of the database, whatever it may do to it."""
    from paper.colmap_peer import map_database
    from sfm_shapefit.files.colmap.quiet import quiet_log

    database = workspace / "database.db"
    with quiet_log():
        try:
            model, wall_s = map_database(database, min_num_matches, refine_sensors=refine_sensors)
        except RuntimeError:
            return Outcome(0, np.nan, np.full(1, np.nan), np.nan)
    return compare(scene, model, wall_s)


def compare(scene: SceneCameras, model: pycolmap.Reconstruction, wall_s: float) -> Outcome:
    """Compare a model with the truth."""
    ids = sorted(i for i, image in model.images.items() if image.has_pose)
    centers = np.array([model.image(i).projection_center() for i in ids])
    truth = scene.centers[np.array(ids) - 1]
    fit = fit_similarity(centers, truth)
    aligned = (centers - centers.mean(axis=0)) @ fit.rotation.T + truth.mean(axis=0)
    errors = np.linalg.norm(aligned - truth, axis=1)
    return Outcome(len(ids), 1.0 / fit.scale - 1.0, errors, wall_s)


def judge(rig: str, runs: Mapping[str, Outcome]) -> list[Row]:
    """Return the rows of a rendered yard; those of `map` have limits."""
    rows = []
    for method, run in runs.items():
        mean = float(run.errors_m.mean())
        checks: Sequence[Check] = ()
        if method in (MAP, MAP_ADJUSTED):
            checks = [
                Check("placed", run.num_images, runs[HELD].num_images, "higher"),
                Check("scale", abs(run.scale_error), LARGEST_SCALE_ERROR),
                *(
                    Check(f"mean / {name}", ratio(mean, float(runs[name].errors_m.mean())), LARGEST_RATIO)
                    for name in (HELD, FREE)
                ),
            ]
        cells = {
            "rig": rig,
            "method": method,
            "images": run.num_images,
            "scale error": f"{run.scale_error:+.3%}",
            "median (m)": f"{np.median(run.errors_m):.4f}",
            "mean (m)": f"{mean:.4f}",
            "worst camera (m)": f"{run.errors_m.max():.4f}",
            "seconds": f"{run.wall_s:.1f}",
        }
        rows.append(Row(cells, checks, YARDS))
    return rows


BENCHMARK = Benchmark(
    name="rigs",
    title="Rigs",
    cases=cases,
    flags=flags,
    packages=("pycolmap", "numpy"),
    quick={"repeats": 1, "images": 12},
    repeats=3,
    threads=2,
    notes={
        DRIVES: "Medians over the drives, and the worst camera of all. No position is given to anyone;"
        " `locate` is given rotations.",
        YARDS: "`map` is given the database alone. Its limits: the scale"
        f" within {LARGEST_SCALE_ERROR:.1%}, and {LARGEST_RATIO} times the mean error of `locate` with the"
        " true rotations, which is both held to them and free to leave them: what is held tells more than"
        " the pixels do.",
    },
    columns={
        "images": "placed ones of each drive",
        "scale error": "1; scale of the similarity onto the truth, minus 1; median",
        "median, mean, worst camera": "m; after shift and rotation",
        "seconds": "wall-clock of the call, median of the drives",
    },
)
