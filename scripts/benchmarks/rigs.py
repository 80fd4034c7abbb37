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
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from harness import ours
from harness.driver import Benchmark, Case, positive
from harness.metrics import Check, Quantity, ratio, verdict
from harness.record import table_of

if TYPE_CHECKING:
    import pycolmap

    from sfm_shapefit.base.arrays import FloatArray
    from sfm_shapefit.synthetic import RigScene
    from sfm_shapefit.synthetic.layouts import SceneCameras

LOCATE, ADJUSTED, MAPPING = "locate", "locate --adjust full", "global mapping, its best setting"
MAP, MAP_ADJUSTED = "map", "map --adjust full"
HELD, FREE = "locate, true rotations held", "locate, true rotations free"
LARGEST_SCALE_ERROR, LARGEST_RATIO = 0.001, 1.2
"""Of `map` on a rendered yard: the scale, and the mean error to that of `locate`."""
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
    errors_m: "FloatArray"
    """Of each camera after shift and rotation, at the run's own scale."""
    wall_s: float


class Rendered(NamedTuple):
    """All runs on one rendered yard."""

    rig: str
    runs: Mapping[str, Outcome]

    def ratio(self, method: str, reference: str) -> float:
        """Return the mean error of one method, in times that of another."""
        return ratio(*(float(self.runs[name].errors_m.mean()) for name in (method, reference)))


def flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--images", type=positive, default=90, help="of a drive, six per meter and a half")


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return each method on each share of wrong pairs, and the rendered yards."""
    drives: dict[str, Case] = {
        f"{share:.0%} wrong, {method}": partial(measure, method, share, args.images, args.repeats)
        for share in _SHARES
        for method in (LOCATE, ADJUSTED, MAPPING)
    }
    return (
        drives if args.quick else drives | {f"rendered {rig}": partial(measure_yard, rig) for rig in _YARDS}
    )


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


def measure_yard(rig: str) -> Rendered:
    """Photograph a yard by a rig, and place the images by each method."""
    from sfm_shapefit.synthetic import SceneOptions, WorkspaceOptions, make_rendered_scene
    from sfm_shapefit.synthetic.rendered_workspace import write_rendered_workspace

    size: dict[str, Any] = {**_SIZE, **_YARDS[rig], "rig": rig}
    options = SceneOptions(max_keypoints_per_image=_MOST_KEYPOINTS, **size)
    scene = make_rendered_scene(options)
    with tempfile.TemporaryDirectory() as folder:
        workspace = Path(folder) / "yard"
        write_rendered_workspace(scene, workspace, WorkspaceOptions(model="rotations"))
        model = workspace / "sparse" / "0"
        runs = {
            MAP: lambda: _map_ours(workspace, "seed"),
            MAP_ADJUSTED: lambda: _map_ours(workspace, "full"),
            HELD: lambda: ours.locate(model, rotations="held").reconstruction,
            FREE: lambda: ours.locate(model, rotations="free").reconstruction,
        }
        timed = {name: ours.time_call(run) for name, run in runs.items()}
    return Rendered(rig, {name: compare(scene, run.found, run.wall_s) for name, run in timed.items()})


def _map_ours(workspace: Path, adjust: Any) -> "pycolmap.Reconstruction":
    from sfm_shapefit import map_database

    found = map_database(workspace / "database.db", adjust=adjust)
    return found.models[0].located.reconstruction


def _run(method: str, scene: "RigScene", workspace: Path) -> Outcome:
    if method == MAPPING:
        return _best_mapping(scene, workspace)
    adjust = "full" if method == ADJUSTED else "seed"
    run = ours.time_call(lambda: ours.locate(workspace / "sparse" / "0", adjust=adjust))
    return compare(scene.scene, run.found.reconstruction, run.wall_s)


def _best_mapping(scene: "RigScene", workspace: Path) -> Outcome:
    """Return the run of global mapping with most images and, of those, the lowest median error."""
    runs = [_map(scene, workspace, matches, refine) for matches in _MIN_MATCHES for refine in (False, True)]
    return min(runs, key=lambda run: (-run.num_images, float(np.median(run.errors_m))))


def _map(scene: "RigScene", workspace: Path, min_num_matches: int, refine_sensors: bool) -> Outcome:
    """Run global mapping on a copy of the database, whatever it may do to it."""
    from paper.colmap_peer import map_database
    from sfm_shapefit.files.colmap.quiet import quiet_log

    with quiet_log():
        try:
            model, wall_s = map_database(
                workspace / "database.db", min_num_matches, refine_sensors=refine_sensors
            )
        except RuntimeError:
            return Outcome(0, np.nan, np.full(1, np.nan), np.nan)
    return compare(scene.scene, model, wall_s)


def compare(scene: "SceneCameras", model: "pycolmap.Reconstruction", wall_s: float) -> Outcome:
    """Compare a model with the truth."""
    from sfm_shapefit.base.geometry import fit_similarity

    ids = sorted(i for i, image in model.images.items() if image.has_pose)
    centers = np.array([model.image(i).projection_center() for i in ids])
    truth = scene.centers[np.array(ids) - 1]
    fit = fit_similarity(centers, truth)
    aligned = (centers - centers.mean(axis=0)) @ fit.rotation.T + truth.mean(axis=0)
    errors = np.linalg.norm(aligned - truth, axis=1)
    return Outcome(len(ids), 1.0 / fit.scale - 1.0, errors, wall_s)


def checks(one: "Rendered | Sequence[Outcome]") -> list[Check]:
    """Return the limits of a rendered yard; drives are only compared."""
    if not isinstance(one, Rendered):
        return []
    found = []
    for method in (MAP, MAP_ADJUSTED):
        run = one.runs[method]
        found += [
            Check(
                name=f"{method}: placed",
                value=run.num_images,
                limit=one.runs[HELD].num_images,
                better="higher",
            ),
            Check(name=f"{method}: scale", value=abs(run.scale_error), limit=LARGEST_SCALE_ERROR),
        ]
        found += [
            Check(
                name=f"{method}: mean error / {reference}",
                value=one.ratio(method, reference),
                limit=LARGEST_RATIO,
            )
            for reference in (HELD, FREE)
        ]
    return found


def tables(measured: "Mapping[str, Rendered | Sequence[Outcome]]", args: argparse.Namespace) -> Iterator[str]:
    drives = {name: one for name, one in measured.items() if not isinstance(one, Rendered)}
    if drives:
        yield from _show_drives(drives, args)
    yards = [one for one in measured.values() if isinstance(one, Rendered)]
    if yards:
        yield from _show_yards(yards)


def _show_drives(measured: Mapping[str, Sequence[Outcome]], args: argparse.Namespace) -> Iterator[str]:
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


def _show_yards(yards: Sequence[Rendered]) -> Iterator[str]:
    yield (
        "## Rendered yards, by one rig each\n\n`map` is given the database alone. Its limits: the scale"
        f" within {LARGEST_SCALE_ERROR:.1%}, and {LARGEST_RATIO} times the mean error of `locate` with the"
        " true rotations, which is both held to them and free to leave them: what is held tells more than the"
        " pixels do."
    )
    yield table_of(
        [(one.rig, *run) for one in yards for run in one.runs.items()],
        {
            "rig": lambda row: row[0],
            "method": lambda row: row[1],
            "images": lambda row: str(row[2].num_images),
            "scale error": lambda row: f"{row[2].scale_error:+.3%}",
            "median (m)": lambda row: f"{np.median(row[2].errors_m):.4f}",
            "mean (m)": lambda row: f"{row[2].errors_m.mean():.4f}",
            "worst camera (m)": lambda row: f"{row[2].errors_m.max():.4f}",
            "seconds": lambda row: f"{row[2].wall_s:.1f}",
        },
    )
    yield table_of(yards, {"rig": lambda one: one.rig, "result": lambda one: verdict(checks(one))})


BENCHMARK = Benchmark(
    name="rigs",
    title="Rigs",
    cases=cases,
    checks=checks,
    tables=tables,
    flags=flags,
    packages=("pycolmap", "numpy"),
    quick={"repeats": 1, "images": 12},
    repeats=3,
    threads=2,
    quantities=(
        Quantity("images", "images", "higher", 0.0, "placed ones of each drive"),
        Quantity("scale error", "1", "lower", 0.1, "scale of the similarity onto the truth, minus 1; median"),
        Quantity("median, mean, worst camera", "m", "lower", 0.1, "after shift and rotation"),
        Quantity("seconds", "s", "lower", 0.5, "wall-clock of the call, median of the drives"),
    ),
)
