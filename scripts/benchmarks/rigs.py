"""A drive of two rigs of three cameras, beside pycolmap's global mapping on its database.

The scale is known here: `locate` takes it from the offsets of the sensors, and so may global mapping, which
holds their poses too. Its answer is aligned by shift and rotation alone; the scale that a similarity would
choose is reported. It estimates rotations itself, where `locate` is given the true ones, so the drive is also
run without wrong pairs. Of four settings of global mapping (least number of matches of a pair, freedom to
change sensors in their rigs) the best one of each drive stands in the table.
"""

import argparse
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from harness import ours
from harness.driver import Benchmark, Case, positive
from harness.metrics import Quantity
from harness.record import table_of

if TYPE_CHECKING:
    import pycolmap

    from sfm_shapefit.arrays import FloatArray
    from sfm_shapefit.synthetic import RigScene

LOCATE, ADJUSTED, MAPPING = "locate", "locate --bundle-adjust", "global mapping, its best setting"
_SHARES = (0.0, 0.2)
_MIN_MATCHES = (15, 50)


class Outcome(NamedTuple):
    """What one run gave."""

    num_images: int
    scale_error: float
    """Of the similarity onto the truth."""
    errors_m: "FloatArray"
    """Of each camera after shift and rotation, at the run's own scale."""
    wall_s: float


def flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--images", type=positive, default=90, help="of a drive, six per meter and a half")


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return each method on each share of wrong pairs."""
    return {
        f"{share:.0%} wrong, {method}": partial(measure, method, share, args.images, args.repeats)
        for share in _SHARES
        for method in (LOCATE, ADJUSTED, MAPPING)
    }


def measure(method: str, share: float, num_images: int, drives: int) -> list[Outcome]:
    """Run a method on so many drives with a share of wrong pairs."""
    from sfm_shapefit.synthetic import SceneOptions, WorkspaceOptions, make_rig_drive
    from sfm_shapefit.synthetic.workspace import write_workspace

    outcomes = []
    size = {"num_images": num_images, "num_points": 2000, "max_pairs_per_image": 12}
    for seed in range(drives):
        scene = make_rig_drive(SceneOptions(corrupted_pair_fraction=share, seed=seed, **size))
        with tempfile.TemporaryDirectory() as folder:
            workspace = Path(folder) / "drive"
            options = WorkspaceOptions(model="rotations", relative_poses=True)
            write_workspace(scene.scene, workspace, options)
            outcomes.append(_run(method, scene, workspace))
    return outcomes


def _run(method: str, scene: "RigScene", workspace: Path) -> Outcome:
    if method == MAPPING:
        return _best_mapping(scene, workspace)
    run = ours.time_call(lambda: ours.locate(workspace / "sparse" / "0", bundle_adjust=method == ADJUSTED))
    return compare(scene, run.found.reconstruction, run.wall_s)


def _best_mapping(scene: "RigScene", workspace: Path) -> Outcome:
    """Return the run of global mapping with most images and, of those, the lowest median error."""
    runs = [_map(scene, workspace, matches, refine) for matches in _MIN_MATCHES for refine in (False, True)]
    return min(runs, key=lambda run: (-run.num_images, float(np.median(run.errors_m))))


def _map(scene: "RigScene", workspace: Path, min_num_matches: int, refine_sensors: bool) -> Outcome:
    """Run global mapping on a copy of the database, whatever it may do to it."""
    from peers.colmap import map_database
    from sfm_shapefit.colmap.quiet import quiet_log

    with quiet_log():
        try:
            model, wall_s = map_database(
                workspace / "database.db", min_num_matches, refine_sensors=refine_sensors
            )
        except RuntimeError:
            return Outcome(0, np.nan, np.full(1, np.nan), np.nan)
    return compare(scene, model, wall_s)


def compare(scene: "RigScene", model: "pycolmap.Reconstruction", wall_s: float) -> Outcome:
    """Compare a model with the truth."""
    from sfm_shapefit.geometry import fit_similarity

    ids = sorted(i for i, image in model.images.items() if image.has_pose)
    centers = np.array([model.image(i).projection_center() for i in ids])
    truth = scene.scene.centers[np.array(ids) - 1]
    fit = fit_similarity(centers, truth)
    aligned = (centers - centers.mean(axis=0)) @ fit.rotation.T + truth.mean(axis=0)
    errors = np.linalg.norm(aligned - truth, axis=1)
    return Outcome(len(ids), 1.0 / fit.scale - 1.0, errors, wall_s)


def tables(measured: Mapping[str, Sequence[Outcome]], args: argparse.Namespace) -> Iterator[str]:
    yield (
        f"Two vehicles with three cameras each, {args.images} images, {args.repeats} drives: medians over"
        " these, and the worst camera of all. No position is given to anyone; `locate` is given rotations."
    )
    yield table_of(
        measured.items(),
        {
            "wrong pairs": lambda one: one[0].partition(" wrong, ")[0],
            "method": lambda one: one[0].partition(" wrong, ")[2],
            "images": lambda one: " / ".join(str(o.num_images) for o in one[1]),
            "scale error": lambda one: f"{np.median([abs(o.scale_error) for o in one[1]]):.2%}",
            "median (m)": lambda one: f"{np.median([np.median(o.errors_m) for o in one[1]]):.4f}",
            "worst camera (m)": lambda one: f"{max(o.errors_m.max() for o in one[1]):.4f}",
            "seconds": lambda one: f"{np.median([o.wall_s for o in one[1]]):.1f}",
        },
    )


BENCHMARK = Benchmark(
    name="rigs",
    title="Rigs",
    cases=cases,
    tables=tables,
    flags=flags,
    packages=("pycolmap", "numpy"),
    quick={"repeats": 1, "images": 12},
    repeats=3,
    threads=2,
    quantities=(
        Quantity("images", "images", "higher", 0.0, "placed ones of each drive"),
        Quantity("scale error", "1", "lower", 0.1, "scale of the similarity onto the truth, minus 1; median"),
        Quantity("median, worst camera", "m", "lower", 0.1, "after shift and rotation"),
        Quantity("seconds", "s", "lower", 0.5, "wall-clock of the call, median of the drives"),
    ),
)
