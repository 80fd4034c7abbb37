"""Real scenes: pytheia's, gtsam's and pycolmap's ways to positions beside ours.

pytheia and gtsam get the directions that `locate` measures, all of its rigid piece, with the same rotations
and before any bundle adjustment. pycolmap's global positioning gets the same rotations and intrinsics and the
tracks of the same matches, in the three settings of `colmap_peer`. Ours stands twice: from the same
directions alone, all cameras kept, and as `locate` does it by default, with points as nodes and without the
cameras it does not trust. Every contender runs in its own fresh process, on one thread, once; errors are
taken after robust alignment to the truth, over the cameras that the contender places.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.real import Errors, Scene
from harness.process import peak_memory_mb, reset_peak, time_call
from harness.record import Check
from paper import colmap_peer
from paper.peers_on_graphs import CONTENDERS as GRAPH_CONTENDERS
from paper.peers_on_graphs import Answer, ask
from sfm_shapefit import ViewGraph, locate
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.quiet import quiet_log
from sfm_shapefit.scene.evaluation import evaluate_poses
from sfm_shapefit.scene.pose_errors import NamedPoses

EQUAL = 1.05
"""Differences below count as equal: the truth is no better."""
SAME_DIRECTIONS, BY_DEFAULT = "ours, the same directions", "ours, `locate` by default"
SAME_OPTIONS: dict[str, Any] = {"threads": 1, "points": "never", "min_trust": 0.0, "adjust": "none"}
POSITIONING = "pycolmap positioning"


class Directions(NamedTuple):
    """The graph that peers get; it can be sent to another process."""

    names: tuple[str, ...]
    """Of its nodes."""
    graph: ViewGraph


def contenders() -> tuple[str, ...]:
    """Return the names of all contenders, ours first."""
    on_directions = (one.name for one in GRAPH_CONTENDERS if one.package is not None)
    positioning = (f"{POSITIONING}, {setting.label}" for setting in colmap_peer.SETTINGS)
    return (BY_DEFAULT, SAME_DIRECTIONS, *on_directions, *positioning)


def answer(name: str, folder: Path, scene: Scene, directions: Directions | str, cpu_limit_s: int) -> Answer:
    """Return a contender's answer on a set, or why there is none, such as no directions for a peer."""
    package = next((one.package for one in GRAPH_CONTENDERS if one.name == name), None)
    run = partial(_locate, name, folder, scene)
    if package is not None:
        run = partial(_solve, name, folder, scene, directions)
    found = ask(name, package, run, cpu_limit_s)
    return found if isinstance(found.error, Errors) else found._replace(error=None)


def measure_directions(folder: Path) -> Directions:
    """Return the directions of the rigid piece that `locate` places."""
    found = locate(folder / "sparse" / "0", **SAME_OPTIONS)
    graph, cameras = found.placement.graph.restricted_to(found.placement.edges)
    return Directions(tuple(found.images.names[c] for c in cameras), graph)


def _solve(name: str, folder: Path, scene: Scene, directions: Directions | str) -> Answer:
    """Run a solver of bare graphs; to be called once per process."""
    if isinstance(directions, str):
        raise RuntimeError(directions)
    solver = next(one for one in GRAPH_CONTENDERS if one.name == name).prepare(directions.graph)
    reset_peak()
    (locations, note), wall_s, cpu_s = time_call(solver)
    peak_mb = peak_memory_mb()
    centers = dict(zip(directions.names, locations, strict=True))
    return Answer(name, _errors(centers, folder, scene), wall_s, cpu_s, peak_mb, note)


def _locate(name: str, folder: Path, scene: Scene) -> Answer:
    """Run what starts from the database; to be called once per process."""
    if name in (SAME_DIRECTIONS, BY_DEFAULT):
        return _ours(name, folder, scene)
    database = folder / "database.db"
    reset_peak()
    setting = next(one for one in colmap_peer.SETTINGS if name == f"{POSITIONING}, {one.label}")
    with quiet_log():
        model, num_tracks, seconds, cpu_s = colmap_peer.position(database, folder / "sparse" / "0", setting)
    peak_mb = peak_memory_mb()
    images = [model.image(image_id) for image_id in sorted(model.reg_image_ids())]
    centers = {image.name: image.projection_center() for image in images}
    errors = _errors(centers, folder, scene)
    return Answer(name, errors, seconds, cpu_s, peak_mb, f"{num_tracks} tracks")


def _ours(name: str, folder: Path, scene: Scene) -> Answer:
    options = SAME_OPTIONS if name == SAME_DIRECTIONS else {"threads": 1}
    # Compiled code is loaded.
    locate(folder / "sparse" / "0", **options)
    reset_peak()
    found = locate(folder / "sparse" / "0", **options)
    peak_mb, left, placement = peak_memory_mb(), int((~found.kept).sum()), found.placement
    names = [found.images.names[c] for c in placement.cameras[found.kept]]
    errors = _errors(dict(zip(names, placement.locations[found.kept], strict=True)), folder, scene)
    note = f"{left} not trusted" if left else ""
    return Answer(name, errors, found.timings_s["solve"], peak_mb=peak_mb, note=note)


def _errors(centers: Mapping[str, FloatArray], folder: Path, scene: Scene) -> Errors:
    """Return the position errors of the cameras that a contender placed, by name."""
    truth = read_model(folder / scene.truth).images
    if len(set(centers) & set(truth.names)) < 3:
        raise RuntimeError("fewer than three cameras of the truth are placed")
    # Rotations are not compared.
    nowhere = np.tile(np.eye(3), (len(centers), 1, 1))
    position = evaluate_poses(
        NamedPoses(tuple(centers), nowhere, np.array([*centers.values()])),
        NamedPoses(truth.names, truth.rotations, truth.centers),
    ).position
    given = set(read_model(folder / "sparse" / "0").images.names) & set(truth.names)
    return Errors(position.median, position.mean, position.max, len(given - set(centers)))


def checks(rows: Sequence[Answer]) -> list[Check]:
    """Return the limits of one set: our default's errors against the lowest of the peers'."""
    ours = next(row for row in rows if row.name == BY_DEFAULT)
    no_peers = (SAME_DIRECTIONS, BY_DEFAULT)
    peers = [row.error for row in rows if row.error and not row.name.startswith(no_peers)]
    if ours.error is None or not peers:
        return []
    return [
        Check(kind, getattr(ours.error, kind), EQUAL * min(getattr(e, kind) for e in peers))
        for kind in ("median", "mean")
    ]
