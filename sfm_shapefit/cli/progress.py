"""How far a run is, on stderr: one line that vanishes on a terminal, a line for each long stage elsewhere."""

import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import TYPE_CHECKING, Any

from sfm_shapefit.cli.console import say
from sfm_shapefit.cli.forecast import Course

if TYPE_CHECKING:
    from sfm_shapefit.base.clock import Progress

_PATIENCE_S = 10.0  # seconds without a terminal before the first line; shorter runs leave a log clean
_AGAIN_S = 60.0  # seconds without a terminal between two lines on one stage; a log shows life by them
_BAR = 24  # columns; beside it a stage and its counts fit 80


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    if minutes >= 60:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


def _roughly(seconds: float) -> str:
    """Return a forecast in no more digits than it is worth."""
    if seconds >= 100.0:
        return _duration(60.0 * round(seconds / 60.0)).removesuffix(" 0 s")
    return _duration(5.0 * round(seconds / 5.0) if seconds >= 20.0 else seconds)


def _left(course: Course, now: float) -> str:
    """Say how long the run takes yet, or its stage where only that is known; empty where nothing is."""
    rest, rest_of_stage = course.rest(now), course.rest_of_stage(now)
    if rest is not None and rest >= 1.0:
        return f"about {_roughly(rest)} left"
    is_long = rest is None and rest_of_stage is not None and rest_of_stage >= 1.0
    return f"about {_roughly(rest_of_stage or 0.0)} left in this stage" if is_long else ""


@contextmanager
def show_progress(
    enabled: bool, verbose: bool = False, patience_s: float = _PATIENCE_S, plan: Sequence[str] = ()
) -> "Iterator[Progress | None]":
    """Show on stderr how far a run is; yield what hears of it, None if nothing is to be shown.

    On a terminal that is one line, gone at the end: the stage, of how many a `plan` has, how much of it is
    done, how long the run has taken, and how long it may take yet. Elsewhere, or `verbose`, since pycolmap's
    messages would break that line, stages get a line each: from the start if `verbose`, else where they are
    at work after `patience_s`.
    """
    from sfm_shapefit.base.jit import on_compilation
    from sfm_shapefit.commands.warm_up import compile_together

    course = Course(plan, time.monotonic())
    lines = _tell_lines(course, 0.0 if verbose else patience_s)
    on_one_line = enabled and sys.stderr.isatty() and not verbose
    with _one_line(course) if on_one_line else nullcontext(lines if enabled else _tell_nobody) as hear:
        compiling = partial(hear, "compiling kernels, once")
        with (
            on_compilation(partial(compiling, 0, 1)),
            compile_together(compiling, say if enabled else _tell_nobody),
        ):
            yield hear if enabled else None


def _tell_nobody(*_what: Any) -> None:
    pass


def _tell_lines(course: Course, patience_s: float) -> "Progress":
    """Return what writes a line where a stage begins, or is at work when its time comes, and every minute.

    Stages that are over in half of the patience share a line.
    """
    said, said_at = "", -patience_s

    def hear(stage: str, done: int, total: int) -> None:
        nonlocal said, said_at
        now = time.monotonic()
        course.hear(stage, done, total, now)
        if done == total:
            said = said if total > 1 else ""  # a stage that comes again has a line again
            return
        seconds = now - course.started
        if seconds >= patience_s and seconds - said_at >= (_AGAIN_S if stage == said else patience_s / 2.0):
            said, said_at = stage, seconds
            told = ", ".join(filter(None, [course.counts, _left(course, now)]))
            so_far = f"; {_duration(seconds)} so far" if seconds >= _PATIENCE_S else ""
            say(f"{course.title}{f': {told}' if told else ''}{so_far}")

    return hear


@contextmanager
def _one_line(course: Course) -> "Iterator[Progress]":
    """Show a line that is drawn again and again, on a copy of stderr, which nobody silences."""
    from rich.console import Console
    from rich.live import Live
    from rich.progress_bar import ProgressBar
    from rich.table import Table

    def draw() -> Table:
        now = time.monotonic()
        line = Table.grid(padding=(0, 1))
        for is_bar in (False, True, False):  # the bar is what becomes shorter where there is no room
            line.add_column(no_wrap=not is_bar)
        bar = ProgressBar(course.total, course.done, width=_BAR, pulse=not course.counts)
        told = [course.counts, _duration(now - course.started), _left(course, now)]
        line.add_row(course.title, bar, ", ".join(filter(None, told)))
        return line

    def hear(stage: str, done: int, total: int) -> None:
        course.hear(stage, done, total, time.monotonic())

    with (
        os.fdopen(os.dup(2), "w") as stream,
        Live(get_renderable=draw, console=Console(file=stream), transient=True),
    ):
        yield hear
