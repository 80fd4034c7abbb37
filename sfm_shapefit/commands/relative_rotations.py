"""`relative_rotations`: those of all pairs of a database's images, by threads or by workers of a cluster."""

from contextlib import closing
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from sfm_shapefit.base.clock import Clock, Progress
from sfm_shapefit.files.colmap.database import DatabaseMatches
from sfm_shapefit.files.colmap.database_images import read_images
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.pairs.direction_options import LEAST_MATCHES
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.pipeline.execution import workers_of
from sfm_shapefit.pipeline.relative_rotations import measure_rotations
from sfm_shapefit.solver.solver_options import SolverOptions

if TYPE_CHECKING:
    from distributed import Client


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DatabaseRotations(RelativeRotations):
    """Relative rotations, and the images that they are of."""

    names: tuple[str, ...]
    """(n,) all images of the database, by name in ascending order; `pairs` are positions in this list."""


def relative_rotations(
    database: Path | str,
    *,
    min_matches: int = LEAST_MATCHES,
    threads: int = 0,
    client: "Client | None" = None,
    progress: Progress | None = None,
) -> DatabaseRotations:
    """Return the relative rotation of every pair of a database's images that has one, ascending by pair.

    The answer is the same, to the bit, for any number of threads and workers.

    Args:
        database: with keypoints and two-view geometries; it is never changed. Intrinsics are the database's.
        min_matches: pairs with fewer inlier matches are left out; at least 1.
        threads: among which the pairs are shared out; 0 for one per core.
        client: of dask.distributed; its workers estimate instead, and open the database themselves.
        progress: called with "relative rotations", the pairs that are done and their number.

    Returns:
        k pairs with rotation, information, number of matches, weight share, and the names of the images.
        `found.are_sound()` says which pairs to believe.

    Raises:
        ValueError: if an option has no such value.
        InputError: if the database cannot be used; the message says what to do.
        WorkerError: if a worker does not see the database, or a task failed again and again.
    """
    if min_matches < 1:
        raise ValueError(f"min_matches must be at least 1, got {min_matches}")
    clock = Clock.of(progress, SolverOptions(threads=threads).threads, workers_of(client, database))
    with clock("relative rotations"), closing(DatabaseFile(database)) as file:
        images = read_images(file).images
        view = DatabaseMatches(file, images.names).at(images.apart())
        measured = measure_rotations(view, min_matches, clock)
    columns = {field.name: getattr(measured, field.name) for field in fields(RelativeRotations)}
    return DatabaseRotations(**columns, names=images.names)
