"""Subcommand `rigs`: a drive of two rigs of three cameras, against pycolmap's global mapping on its database.

The scale is known here: `locate` takes it from the offsets of the sensors, and so may global mapping, which
holds their poses too. Its answer is aligned by shift and rotation alone; the scale that a similarity would
choose is reported. It estimates rotations itself, where `locate` is given the true ones, so the drive is also
run without wrong pairs. Of four settings of global mapping (least number of matches of a pair, freedom to
change sensors in their rigs) the best one of each drive stands in the table.
"""

import argparse
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

import sfm_shapefit
from benchmarks.glomap import copy_database, quiet
from benchmarks.record import environment, table, write_section
from sfm_shapefit import LocateOptions
from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.colmap.quiet import quiet_stderr
from sfm_shapefit.geometry import fit_similarity
from sfm_shapefit.synthetic import RigScene, SceneOptions, WorkspaceOptions, make_rig_drive
from sfm_shapefit.synthetic.workspace import write_workspace

HELP = "metric scale and errors of a drive of two three-camera rigs, against pycolmap's global mapping"
RESULTS = Path(__file__).parents[1] / "results.md"

_SHARES = (0.0, 0.2)
_MIN_MATCHES = (15, 50)


class Outcome(NamedTuple):
    """What one run gave."""

    num_images: int
    scale_error: float
    """Of the similarity onto the truth."""
    errors_m: FloatArray
    """Of each camera after shift and rotation, at the run's own scale."""
    seconds: float


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--images", type=int, default=90, help="images of the drive, six per metre and a half"
    )
    parser.add_argument("--seeds", type=int, default=3, help="drives per share of wrong pairs")
    parser.add_argument("--no-record", action="store_true", help="print the table only")


def run(args: argparse.Namespace) -> int:
    """Measure, print, and write the section of results.md."""
    rows = [row for share in _SHARES for row in _rows(args.images, range(args.seeds), share)]
    header = ["wrong pairs", "method", "images", "scale error", "median (m)", "worst camera (m)", "seconds"]
    command = f"python scripts/benchmark.py rigs --images {args.images} --seeds {args.seeds}"
    body = (
        f"## Rigs\n\n{environment(['pycolmap', 'numpy'], command)}\n"
        f"Two vehicles with three cameras each, {args.images} images, {args.seeds} drives: medians over "
        "these, and the worst camera of all. No position is given to anyone; `locate` is given rotations.\n\n"
        f"{table(header, rows)}"
    )
    print(body)
    if not args.no_record:
        write_section(RESULTS, "rigs", body)
    return 0


def _rows(num_images: int, seeds: range, share: float) -> list[list[str]]:
    """Return the table's rows for one share of wrong pairs."""
    found: dict[str, list[Outcome]] = {}
    for seed in seeds:
        options = SceneOptions(
            num_images=num_images,
            num_points=2000,
            corrupted_pair_fraction=share,
            max_pairs_per_image=12,
            seed=seed,
        )
        rigs = make_rig_drive(options)
        with tempfile.TemporaryDirectory() as folder:
            workspace = Path(folder) / "drive"
            write_workspace(
                rigs.scene, workspace, WorkspaceOptions(model="rotations", relative_poses=True), rigs
            )
            for adjusted in (False, True):
                name = "locate --bundle-adjust" if adjusted else "locate"
                found.setdefault(name, []).append(_located(rigs, workspace, adjusted))
            found.setdefault("global mapping, its best setting", []).append(_best_mapping(rigs, workspace))
    return [[f"{share:.0%}", name, *_cells(outcomes)] for name, outcomes in found.items()]


def _cells(outcomes: list[Outcome]) -> list[str]:
    def median(values: list[float]) -> float:
        return float(np.median(values))

    return [
        " / ".join(str(o.num_images) for o in outcomes),
        f"{median([abs(o.scale_error) for o in outcomes]):.2%}",
        f"{median([float(np.median(o.errors_m)) for o in outcomes]):.4f}",
        f"{max(float(o.errors_m.max()) for o in outcomes):.4f}",
        f"{median([o.seconds for o in outcomes]):.1f}",
    ]


def _located(rigs: RigScene, workspace: Path, adjusted: bool) -> Outcome:
    start = time.perf_counter()
    found = sfm_shapefit.locate(workspace / "sparse" / "0", options=LocateOptions(bundle_adjust=adjusted))
    return _outcome(rigs, found.reconstruction, time.perf_counter() - start)


def _best_mapping(rigs: RigScene, workspace: Path) -> Outcome:
    """Return the run of global mapping with most images and, of those, the lowest median error."""
    runs = [_mapped(rigs, workspace, matches, refine) for matches in _MIN_MATCHES for refine in (False, True)]
    return min(runs, key=lambda run: (-run.num_images, float(np.median(run.errors_m))))


def _mapped(rigs: RigScene, workspace: Path, min_num_matches: int, refine_sensors: bool) -> Outcome:
    """Run global mapping on a copy of the database, whatever it may do to it."""
    options = pycolmap.GlobalPipelineOptions()
    options.min_num_matches = min_num_matches
    options.random_seed = 0
    options.mapper.refine_sensor_from_rig = refine_sensors
    with tempfile.TemporaryDirectory() as folder, quiet(), quiet_stderr():
        database = copy_database(workspace / "database.db", Path(folder))
        out, images = Path(folder) / "out", Path(folder) / "images"
        out.mkdir()
        images.mkdir()
        start = time.perf_counter()
        models = pycolmap.global_mapping(database, images, out, options)
        seconds = time.perf_counter() - start
    if not models:
        return Outcome(0, np.nan, np.full(1, np.nan), seconds)
    largest = max(models.values(), key=lambda model: model.num_reg_images())
    return _outcome(rigs, largest, seconds)


def _outcome(rigs: RigScene, model: pycolmap.Reconstruction, seconds: float) -> Outcome:
    ids = sorted(i for i, image in model.images.items() if image.has_pose)
    centers = np.array([model.image(i).projection_center() for i in ids])
    truth = rigs.scene.centers[np.array(ids) - 1]
    fit = fit_similarity(centers, truth)
    aligned = (centers - centers.mean(axis=0)) @ fit.rotation.T + truth.mean(axis=0)
    errors = np.linalg.norm(aligned - truth, axis=1)
    return Outcome(len(ids), 1.0 / fit.scale - 1.0, errors, seconds)
