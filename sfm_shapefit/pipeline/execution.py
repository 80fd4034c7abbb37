"""Work shared out among the workers of a dask scheduler.

What is measured of pairs, directions or relative rotations, is a function of a batch of their matches. The
pairs of a database are cut into parts of some hundred thousand matches. A part names the file; the images,
without whose cameras matches are no rays, go to each worker once. It opens the file read-only for itself, and
sends back what it measured. Every pair is estimated by itself with draws of its own, and the parts are put
together in their order: the answer is that of one process, to the bit, whichever worker did what, and however
often. How adjustments are divided stands in `adjustment.divided`.

The work of a worker that dies is given to another one, by dask. Whoever can reach a scheduler can run code on
its workers: keep it inside a trusted network.
"""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sfm_shapefit import __version__
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.errors import MissingExtraError
from sfm_shapefit.base.executors import Answer, WorkerError
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import MatchBatch, MatchPart, View

if TYPE_CHECKING:
    from distributed import Client

MATCHES_PER_TASK = 1_000_000
"""Matches of a task; about 1.5 seconds of work for directions, and 230 MB."""
_RETRIES = 3  # times that dask gives a task to another worker; one that kills three is at fault itself
_PATIENCE_S = 10  # seconds; a scheduler that is there answers in less than one


class DaskWorkers(NamedTuple):
    """The workers of a dask scheduler, as a `Cluster`."""

    client: "Client"

    def submit(self, work: Callable[..., Answer], *given: Any) -> Any:
        """Return a future of `work(*given)`; what dies with a worker is computed again by another one."""
        with warnings.catch_warnings():  # dask warns of tasks of more than 10 MB, and few are
            warnings.filterwarnings("ignore", message="Sending large graph")
            return self.client.submit(work, *given, pure=False, retries=_RETRIES)


def workers_of(client: "Client | None", file: Path | str | None) -> DaskWorkers | None:
    """Return the workers of a client, all of which see the file of a database; None without a client.

    Raises:
        WorkerError: if there is none, or one has another version of the package, or does not see the file as
            it is here.
    """
    if client is None:
        return None
    here = _look_at(file if file is None else str(Path(file).absolute()))
    seen: dict[str, Any] = client.run(_look_at, here.path, on_error="return")
    if not seen:
        raise WorkerError("the dask scheduler has no worker; start one: dask worker ADDRESS")
    for name, there in seen.items():
        if not isinstance(there, _Seen) or there.version != here.version:
            has = f"sfm_shapefit {there.version}" if isinstance(there, _Seen) else "no sfm_shapefit"
            raise WorkerError(f"the worker {name} has {has}; install version {here.version} there")
        if there != here:
            raise WorkerError(
                f"the worker {name} does not see {here.path} as it is here; share it by the same path"
            )
    return DaskWorkers(client)


class _Seen(NamedTuple):
    """A file as a process sees it."""

    path: str | None
    size: int
    modified_ns: int
    version: str


def _look_at(path: str | None) -> _Seen:
    """Return what this process sees at a path; sizes of -1 where there is nothing."""
    try:
        found = Path(path).stat() if path is not None else None
    except OSError:
        return _Seen(path, -1, -1, __version__)
    return _Seen(path, found.st_size if found else 0, found.st_mtime_ns if found else 0, __version__)


def measure_with_workers(
    view: View,
    estimate: Callable[[MatchBatch], Answer],
    clock: Clock,
    min_matches: int = 1,
    matches_per_task: int = MATCHES_PER_TASK,
) -> list[Answer]:
    """Return what the clock's workers measure of all pairs of a database, in their order.

    What estimates them is a function of a module, or a `partial` of one, so that other processes find it.
    Pairs with fewer than `min_matches` are left out.

    Raises:
        WorkerError: if a task failed again and again.
        InputError: as a worker found the database.
    """
    crew, parts = clock.crew, view.parts(matches_per_task)
    results: list[Answer] = []
    done, work, images = 0, crew.share((estimate, min_matches)), crew.share(view.images)
    found = crew.stream(measure_part, [work] * len(parts), [images] * len(parts), parts)
    for part, measured in zip(parts, found, strict=True):
        results += measured
        done += part.num_pairs
        clock.advance(done, view.num_pairs)
    return results


def measure_part(
    work: tuple[Callable[[MatchBatch], Answer], int], images: Images, part: MatchPart
) -> list[Answer]:
    """Return what is measured of the pairs of a part with so many matches, a value per batch; in a worker."""
    estimate, min_matches = work
    with part.open(images) as view:
        return [estimate(batch) for batch in view.batches(min_matches)]


@contextmanager
def open_client(scheduler: str) -> "Iterator[Client | None]":
    """Connect to the dask scheduler at an address, if it is not empty, and disconnect in the end.

    Raises:
        MissingExtraError: if dask is not installed.
        WorkerError: if the scheduler cannot be reached.
    """
    if not scheduler:
        yield None
        return
    try:
        import dask
        from distributed import Client
    except ModuleNotFoundError:
        raise MissingExtraError("--scheduler", "dask.distributed", "dask") from None
    try:
        # Else the client keeps the last thousand messages of up to a megabyte.
        with dask.config.set({"distributed.admin.low-level-log-length": 0}):
            client = Client(scheduler, timeout=_PATIENCE_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise WorkerError(f"the dask scheduler {scheduler} cannot be reached; check its address") from error
    with client:
        yield client
