"""`warm-up`: compile all kernels at once, by running small examples.

What compiles a kernel is a call with arguments of the right types, so `commands.examples` calls everything.
Processes, one per core, take one example after the other and tell of each kernel that they compile or find.
What they compile is kept on disk, see `kernel_cache`, and so is the name of each example that is done. A
command that misses a kernel lets the examples that commands need run first, if they never did, and goes on
with what they compiled.
"""

import gc
import os
import re
import signal
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sfm_shapefit.base.errors import ShapeFitError
from sfm_shapefit.base.kernel_cache import (
    PACKAGE,
    counted_as_compiling,
    hear_of_kernels,
    here,
    is_noted,
    made_for,
    note,
    on_miss,
)

Tell = Callable[[int, int], None]
"""Called with the number of kernels that are ready and of all that will be."""

NEEDED = (
    "solve_dense",
    "adjust_bundle",
    "measure_pairs",
    "start_by_lud",
    "judge_placement",
    "find_pieces",
    "refine_in_angles",
    "locate_model",
)
"""Examples of what `locate`, `map`, `place` and `inspect` do in most runs.

Parts come first, so that no two processes compile the same kernels, and of them those that take longest; then
the whole.
"""
FURTHER = (
    "average_graphs",
    "place_flat_graph",
    "place_graph",
    "solve_by_splitting",
    "solve_sparse",
    "locate_rigs",
    "adjust_sparsely",
    "locate_from_tracks",
    "locate_around_fixed",
    "draw_images",
    "place_long_graph",
    "solve_iteratively",
    "map_matches",
    "relate_images",
    "join_halves",
)
"""Examples of the rest; that which takes longest first, or it would be waited for.

Two that need the same kernels stand apart: what runs at the same time compiles them in both processes.
"""

# Kernels of these rooms are compiled by further examples only, all but one.
_ROOMS_OF_FURTHER = ("rotations", "synthetic")
_MOST_PROCESSES = 8  # processes; each takes 300 MB
_KERNEL = re.compile(r"^@kernel\s+def (\w+)", re.MULTILINE)


class WarmUpError(ShapeFitError):
    """An example failed."""


@dataclass(frozen=True, slots=True)
class WarmUp:
    """What a warm-up did."""

    num_kernels: int
    """That were compiled, or found on disk."""
    failures: tuple[str, ...]
    """A sentence for each example that failed."""


def warm_up(examples: Sequence[str], report: Tell | None = None) -> WarmUp:
    """Compile the kernels that examples need and keep them on disk, in as many processes as there are cores.

    Examples are names of functions of `commands.examples` or `part_examples`; `report` is called whenever a
    kernel is ready.
    """
    if not examples:
        return WarmUp(0, ())
    report = report or (lambda _done, _total: None)
    expected, ready = _kernels(set(examples) <= set(NEEDED)), set[str]()
    failures = []
    for heard in _run(examples, min(num_cores(), len(examples), _MOST_PROCESSES)):
        if isinstance(heard, WarmUpError):
            failures.append(str(heard))
        else:
            ready.add(heard)
            report(len(ready & expected), len(expected))
    if not failures:
        report(len(expected), len(expected))
    return WarmUp(len(ready), tuple(failures))


@contextmanager
def compile_together(report: Tell, say: Callable[[str], None]) -> Iterator[None]:
    """Let the processes of a warm-up compile what the block misses; alone it compiles what they leave.

    There is no warm-up on a single core, nor where there was one already, as it would find nothing to do.

    `report` is called whenever a kernel is ready, and `say` told why the kernels of a wheel do not serve.
    """

    def act() -> None:
        if made_for() not in ("", here()):
            say(f"this installation brings kernels for {made_for()}; for {here()} they are compiled once")
        missing = not_done(NEEDED)
        if missing and num_cores() > 1:
            # Where no process can be started, as where memory is short, all is compiled here.
            with suppress(OSError, MemoryError), counted_as_compiling():
                warm_up(missing, report)

    with on_miss(act):
        yield


def not_done(examples: Sequence[str] = NEEDED + FURTHER) -> list[str]:
    """Return the examples that never ran with these sources, on this kind of processor."""
    return [name for name in examples if not is_noted(name, PACKAGE / "commands")]


def num_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _kernels(only_needed: bool) -> set[str]:
    """Return the names of the kernels that there are, as a cache tells of them."""
    left_out = tuple(str(PACKAGE / room) for room in _ROOMS_OF_FURTHER) if only_needed else ()
    return {
        f"{path.stem}.{name}"
        for path in PACKAGE.rglob("*.py")
        if not str(path).startswith(left_out or ("\0",))
        for name in _KERNEL.findall(path.read_text(encoding="utf-8"))
    }


def _run(examples: Iterable[str], num_processes: int) -> Iterator[str | WarmUpError]:
    """Run examples in processes; yield the names of kernels, and errors."""
    from multiprocessing import get_context  # here and not above: few commands start processes
    from multiprocessing.connection import Connection, wait

    context, waiting = get_context("spawn"), list(examples)
    workers, at_work = {}, dict[Any, str]()
    scratch = tempfile.TemporaryDirectory()  # not of a worker, which may be killed before it removes its own
    try:
        for _ in range(num_processes):
            ours, theirs = context.Pipe()
            given = theirs, scratch.name, gc.get_threshold()
            process = context.Process(target=_work, args=given, daemon=True)
            process.start()
            theirs.close()
            workers[ours] = process
        while workers:
            for connection in wait(list(workers)):
                assert isinstance(connection, Connection)
                try:
                    heard = connection.recv()
                    if heard is not None:
                        yield heard
                        continue
                    at_work[connection] = waiting.pop(0) if waiting else ""
                    connection.send(at_work[connection])
                except (EOFError, OSError):  # it ended, or died
                    workers.pop(connection).join()
                    if at_work.get(connection):
                        yield WarmUpError(f"{at_work[connection]}: its process died")
        if waiting:
            yield WarmUpError(f"{', '.join(waiting)}: no process is left to run it")
    finally:
        for process in workers.values():
            process.kill()
            process.join()
        scratch.cleanup()


def _work(connection: Any, scratch: str, objects_between_searches: tuple[int, int, int]) -> None:
    """Run the examples that the connection names, and tell of every kernel.

    Unused objects are looked for as often as in the parent: compiling makes very many of them.
    """
    gc.set_threshold(*objects_between_searches)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent gets it too, and ends this process
    # A parent that died needs no answer.
    with hear_of_kernels(connection.send), suppress(BrokenPipeError, EOFError):
        connection.send(None)
        while name := connection.recv():
            try:
                from sfm_shapefit.commands import examples, part_examples

                folder = Path(scratch, name)
                folder.mkdir()
                example = getattr(examples, name, None) or getattr(part_examples, name)
                example(folder)
                note(name, PACKAGE / "commands")
            except Exception as error:  # whatever it is, the others are worth running
                connection.send(WarmUpError(f"{name}: {type(error).__name__}: {error}"))
            connection.send(None)
