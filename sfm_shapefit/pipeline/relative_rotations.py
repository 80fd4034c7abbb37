"""`relative_rotations`: those of all pairs of a database's images, by threads or by an executor's workers."""

from concurrent.futures import Executor
from contextlib import closing
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import NamedTuple, get_args

from sfm_shapefit.base.executors import Advance, nobody
from sfm_shapefit.files.colmap.database import DatabaseMatches
from sfm_shapefit.files.colmap.database_images import read_images
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.pairs.essential import (
    RelativeSource,
    concatenate_rotations,
    estimate_relative_rotations,
    stored_relative_rotations,
)
from sfm_shapefit.pairs.options import LEAST_MATCHES
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.pipeline.clock import Clock, Progress
from sfm_shapefit.pipeline.execution import PairWork, measure_with_workers
from sfm_shapefit.scene.matches import View
from sfm_shapefit.solver.options import SolverOptions

_MATCHES_PER_TASK = 100_000  # matches; about a second of work, be they of many pairs or of few


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DatabaseRotations(RelativeRotations):
    """Relative rotations, and the images that they are of."""

    names: tuple[str, ...]
    """(n,) all images of the database, by name in ascending order; `pairs` are positions in this list."""


class Sharing(NamedTuple):
    """Among whom work is shared out, and who hears of it."""

    threads: int = 1
    executor: Executor | None = None
    """Its workers do the work instead of threads."""
    advance: Advance = nobody
    """Called with the pairs that are done and their number."""


def relative_rotations(
    database: Path | str,
    *,
    min_matches: int = LEAST_MATCHES,
    source: RelativeSource = "matches",
    threads: int = 0,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> DatabaseRotations:
    """Return the relative rotation of every pair of a database's images that has one, ascending by pair.

    The answer is the same, to the bit, for any number of threads and any executor.

    Args:
        database: with keypoints and two-view geometries; it is never changed. Intrinsics are the database's.
        min_matches: pairs with fewer inlier matches are left out; at least 1.
        source: "matches": estimated from the inlier matches; "stored": as the database stores them, see
            `stored_relative_rotations`.
        threads: among which the pairs are shared out; 0 for one per core.
        executor: of `concurrent.futures`; its workers estimate instead, and open the database themselves. It
            is not shut down.
        progress: called with "relative rotations", the pairs that are done and their number.

    Returns:
        k pairs with rotation, information, number of matches, weight share, and the names of the images.
        `found.are_sound()` says which pairs to believe.

    Raises:
        ValueError: if an option has no such value.
        InputError: if the database cannot be used; the message says what to do.
        WorkerError: if a worker died and the executor does not replace it.
    """
    if source not in get_args(RelativeSource):
        raise ValueError(f"source must be one of {', '.join(get_args(RelativeSource))}, got {source!r}")
    if min_matches < 1:
        raise ValueError(f"min_matches must be at least 1, got {min_matches}")
    clock = Clock.of(progress, SolverOptions(threads=threads), executor)
    with clock("relative rotations"), closing(DatabaseFile(database)) as file:
        images = read_images(file).images
        view = DatabaseMatches(file, images.names).at(images.apart())
        sharing = Sharing(clock.threads, executor, clock.advance)
        if source == "stored":
            found = stored_relative_rotations(view, min_matches)
        else:
            found = measure_rotations(view, min_matches, sharing)
    columns = {field.name: getattr(found, field.name) for field in fields(RelativeRotations)}
    return DatabaseRotations(**columns, names=images.names)


def measure_rotations(
    view: View,
    min_matches: int = LEAST_MATCHES,
    sharing: Sharing | None = None,
) -> RelativeRotations:
    """Return relative rotations estimated from matches; pairs are indices into the view's images.

    Args:
        view: of images in axes of their cameras, see `Images.apart`.
        min_matches: pairs with fewer inlier matches are left out.
        sharing: one thread if None.

    Raises:
        InputError: if the database cannot be read, or a row of it is damaged.
        WorkerError: if a worker died and the executor does not replace it.
    """
    sharing = sharing or Sharing()
    if sharing.executor is None:
        parts = _estimate_here(view, min_matches, sharing)
    else:
        work = PairWork(
            estimate=partial(estimate_relative_rotations, num_pairs=view.num_pairs),
            min_matches=min_matches,
            matches_per_task=_MATCHES_PER_TASK,
        )
        parts = measure_with_workers(view, work, sharing.executor, sharing.advance)
    return concatenate_rotations(parts)


def _estimate_here(view: View, min_matches: int, sharing: Sharing) -> list[RelativeRotations]:
    """Return the relative rotations of each batch."""
    parts, before, total = [], 0, view.num_pairs
    for batch in view.batches(min_matches):

        def advance(done: int, before: int = before) -> None:
            sharing.advance(before + done, total)

        parts.append(estimate_relative_rotations(batch, sharing.threads, advance, num_pairs=total))
        before += len(batch.pairs)
    sharing.advance(total, total)
    return parts
