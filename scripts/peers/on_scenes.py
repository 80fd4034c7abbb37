"""Real scenes: pytheia's, gtsam's and pycolmap's ways to positions beside ours.

pytheia and gtsam get the directions that `locate` measures, all of its rigid piece, with the same rotations
and before any bundle adjustment. pycolmap's global positioning gets the same rotations and intrinsics and the
tracks of the same matches, in the three settings of `peers.colmap`; its global mapping gets the database,
averages rotations itself and ends with bundle adjustment, in two settings. Ours stands twice: from the same
directions alone, all cameras kept, and as `locate` does it by default, with points as nodes and without the
cameras it does not trust. Every contender runs in its own fresh process, on one thread, once; errors are
taken after robust alignment to the truth, over the cameras that the contender places.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from benchmarks.real import Errors, Scene
from harness import ours
from harness.metrics import Check
from harness.process import call, peak_memory_mb, reset_peak, thread_environment
from peers.on_graphs import CONTENDERS as GRAPH_CONTENDERS
from peers.on_graphs import WALL_PER_CPU

if TYPE_CHECKING:
    import pycolmap

    from sfm_shapefit.arrays import FloatArray

EQUAL = 1.05
"""Differences below count as equal: the truth is no better."""
SAME_DIRECTIONS, BY_DEFAULT = "ours, the same directions", "ours, `locate` by default"
SAME_OPTIONS: dict[str, Any] = {"threads": 1, "points": "never", "min_trust": 0.0}
POSITIONING, MAPPING = "pycolmap positioning", "pycolmap mapping"
_MAPPING_MATCHES = (15, 30)
_ON_DIRECTIONS = tuple(one.name for one in GRAPH_CONTENDERS if one.package is not None)


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A contender's answer on a set."""

    name: str
    errors: Errors | None = None
    seconds: float = math.nan
    cpu_s: float = math.nan
    """CPU time while the clock ran; unknown where the clock covers a part of a call."""
    peak_mb: float = math.nan
    note: str = ""


class Directions(NamedTuple):
    """The graph that peers get, as plain arrays that can be sent to another process."""

    cameras: Any
    """(n,) images of the model, by position."""
    edges: Any
    directions: Any
    weights: Any


class Located(NamedTuple):
    """What a contender gave, named as in the model."""

    names: tuple[str, ...]
    centers: Any
    seconds: float
    cpu_s: float
    peak_mb: float
    note: str


def contenders() -> tuple[str, ...]:
    """Return the names of all contenders, ours first."""
    from peers.colmap import SETTINGS

    positioning = (f"{POSITIONING}, {setting.label}" for setting in SETTINGS)
    mapping = (f"{MAPPING}, min_num_matches {count}" for count in _MAPPING_MATCHES)
    return (SAME_DIRECTIONS, BY_DEFAULT, *_ON_DIRECTIONS, *positioning, *mapping)


def answer(name: str, folder: Path, scene: Scene, directions: Directions | str, cpu_limit_s: int) -> Row:
    """Return a contender's answer on a set, or why there is none, such as no directions for a peer."""
    empty = Row(name=name)
    package = next((one.package for one in GRAPH_CONTENDERS if one.name == name), None)
    if package is not None and find_spec(package) is None:
        return replace(empty, note=f"skipped: {package} is not installed")
    if package is None:
        run = partial(_locate, name)
    elif isinstance(directions, str):
        return replace(empty, note=f"failed: {directions}")
    else:
        run = partial(_solve, name, directions)
    try:
        found = call(
            run,
            folder,
            environment=thread_environment(1),
            timeout_s=WALL_PER_CPU * cpu_limit_s,
            cpu_limit_s=cpu_limit_s,
        )
        errors = _errors(found, folder, scene)
    except (TimeoutError, RuntimeError) as reason:
        return replace(empty, note=f"failed: {reason}")
    costs = {"seconds": found.seconds, "cpu_s": found.cpu_s, "peak_mb": found.peak_mb}
    return replace(empty, errors=errors, **costs, note=found.note)


def measure_directions(folder: Path) -> Directions:
    """Return the directions of the rigid piece that `locate` places."""
    placement = ours.locate(folder / "sparse" / "0", **SAME_OPTIONS).placement
    graph, cameras = placement.graph.restricted_to(placement.edges)
    return Directions(cameras, graph.edges, graph.directions, graph.weights)


def _solve(name: str, directions: Directions, folder: Path) -> Located:
    """Run a solver of bare graphs; to be called once per process."""
    from sfm_shapefit import ViewGraph
    from sfm_shapefit.colmap.model import read_model

    model = read_model(folder / "sparse" / "0")
    graph = ViewGraph(len(directions.cameras), directions.edges, directions.directions, directions.weights)
    solver = next(one for one in GRAPH_CONTENDERS if one.name == name).prepare(graph)
    reset_peak()
    (locations, note), wall_s, cpu_s = ours.time_call(solver)
    names = tuple(model.names[c] for c in directions.cameras)
    return Located(names, locations, wall_s, cpu_s, peak_memory_mb(), note)


def _locate(name: str, folder: Path) -> Located:
    """Run what starts from the database; to be called once per process."""
    if name in (SAME_DIRECTIONS, BY_DEFAULT):
        return _ours(name, folder)
    from peers.colmap import SETTINGS, map_database, position, quiet

    database = folder / "database.db"
    reset_peak()
    with quiet():
        if name.startswith(MAPPING):
            cpu = time.process_time()
            model, seconds = map_database(database, int(name.rsplit(" ", 1)[1]))
            cpu_s = time.process_time() - cpu
            note = "own rotations, bundle adjusted"
        else:
            setting = next(one for one in SETTINGS if name == f"{POSITIONING}, {one.label}")
            found = position(database, folder / "sparse" / "0", setting)
            model, seconds, cpu_s = found.reconstruction, found.positioning_s, found.positioning_cpu_s
            note = f"{found.num_tracks} tracks"
    peak = peak_memory_mb()
    names, centers = _centers(model)
    return Located(names, centers, seconds, cpu_s, peak, note)


def _ours(name: str, folder: Path) -> Located:
    import numpy as np

    options = SAME_OPTIONS if name == SAME_DIRECTIONS else {"threads": 1}
    # Compiled code is loaded.
    ours.locate(folder / "sparse" / "0", **options)
    reset_peak()
    found = ours.locate(folder / "sparse" / "0", **options)
    peak, left = peak_memory_mb(), int(np.sum(~found.kept))
    cameras = found.placement.cameras[found.kept]
    return Located(
        tuple(found.model.names[c] for c in cameras),
        found.placement.locations[found.kept],
        found.timings_s["solve"],
        math.nan,
        peak,
        f"{left} not trusted" if left else "",
    )


def _centers(model: "pycolmap.Reconstruction") -> "tuple[tuple[str, ...], FloatArray]":
    import numpy as np

    images = [model.image(image_id) for image_id in sorted(model.reg_image_ids())]
    return tuple(image.name for image in images), np.array([image.projection_center() for image in images])


def _errors(found: Located, folder: Path, scene: Scene) -> Errors:
    """Return the position errors of the cameras that a contender placed."""
    import numpy as np

    from sfm_shapefit.colmap.model import read_model
    from sfm_shapefit.evaluation import CameraPoses, evaluate_poses

    truth = read_model(folder / scene.truth)
    if len(set(found.names) & set(truth.names)) < 3:
        raise RuntimeError("fewer than three cameras of the truth are placed")
    # Rotations are not compared.
    nowhere = np.tile(np.eye(3), (len(found.names), 1, 1))
    errors = evaluate_poses(
        CameraPoses(found.names, nowhere, found.centers),
        CameraPoses(truth.names, truth.rotations, truth.centers),
    )
    given = set(read_model(folder / "sparse" / "0").names) & set(truth.names)
    position = errors.position
    missing = len(given - set(found.names))
    return Errors(median=position.median, mean=position.mean, max=position.max, num_missing=missing)


def checks(rows: Sequence[Row]) -> list[Check]:
    """Return the limits of one set: our default's errors against the lowest of the peers'.

    Mapping ends with bundle adjustment and is no peer of positions alone; it is shown, not raced.
    """
    ours = next(row for row in rows if row.name == BY_DEFAULT)
    peers = [
        row.errors
        for row in rows
        if row.name not in (SAME_DIRECTIONS, BY_DEFAULT) and not row.name.startswith(MAPPING) and row.errors
    ]
    if ours.errors is None or not peers:
        return []
    return [
        Check(name=kind, value=getattr(ours.errors, kind), limit=EQUAL * min(getattr(e, kind) for e in peers))
        for kind in ("median", "mean")
    ]
