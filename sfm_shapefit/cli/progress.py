"""How far a run is, on stderr: one line that vanishes on a terminal, a line for each long stage elsewhere."""

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import TYPE_CHECKING, Any

from sfm_shapefit.cli.console import say

if TYPE_CHECKING:
    from sfm_shapefit.base.clock import Progress

_PATIENCE_S = 10.0  # seconds without a terminal before the first line; shorter runs leave a log clean
_AGAIN_S = 60.0  # seconds without a terminal between two lines on one stage; a log shows life by them
_RATED_S = 1.0  # seconds of a stage before its rate is believed; what comes first loads what is needed
_BAR = 24  # columns; beside it a stage and its counts fit 80


class _Course:
    """The stage that a run is in, how much of it is done, when both began, and when the stage may end."""

    def __init__(self) -> None:
        self.started = self.began = time.monotonic()
        self.stage, self.first, self.done, self.total, self.end = "start", 0, 0, 1, 0.0

    def hear(self, stage: str, done: int, total: int) -> None:
        """Take what a stage reports; work done before its first report, as of a resumed run, has no rate."""
        now = time.monotonic()
        if (stage, total) != (self.stage, self.total):
            self.began, self.first, self.end = now, done, 0.0
        self.stage, self.done, self.total = stage, done, total
        if done > self.first and now - self.began >= _RATED_S:
            self.end = now + (now - self.began) * (total - done) / (done - self.first)

    @property
    def seconds(self) -> float:
        """Seconds since the run began."""
        return time.monotonic() - self.started

    @property
    def counts(self) -> str:
        """How much of the stage is done, and how long its rest takes; empty if it does not count."""
        left = self.end - time.monotonic()
        about = f", about {_duration(left)} left" if left >= 1.0 else ""
        return f"{self.done:,} of {self.total:,}{about}" if self.total > 1 else ""


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    if minutes >= 60:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


@contextmanager
def show_progress(
    enabled: bool, verbose: bool = False, patience_s: float = _PATIENCE_S
) -> "Iterator[Progress | None]":
    """Show on stderr how far a run is; yield what is told of it, None if nothing is to be shown.

    On a terminal that is one line, gone at the end: stage, how much of it is done, how long its rest takes,
    and how long the run has taken. Elsewhere, or `verbose`, since pycolmap's messages would break that line,
    stages get a line each: from the start if `verbose`, else where they are at work after `patience_s`.
    """
    from sfm_shapefit.base.jit import on_compilation
    from sfm_shapefit.pipeline.warm_up import compile_together

    lines = _tell_lines(0.0 if verbose else patience_s)
    on_one_line = enabled and sys.stderr.isatty() and not verbose
    with _one_line() if on_one_line else nullcontext(lines if enabled else _tell_nobody) as hear:
        compiling = partial(hear, "compiling kernels, once")
        with (
            on_compilation(partial(compiling, 0, 1)),
            compile_together(compiling, say if enabled else _tell_nobody),
        ):
            yield hear if enabled else None


def _tell_nobody(*_what: Any) -> None:
    pass


def _tell_lines(patience_s: float) -> "Progress":
    """Return what writes a line where a stage begins, or is at work when its time comes, and every minute.

    Stages that are over in half of the patience share a line.
    """
    course, said, said_at = _Course(), "", -patience_s

    def hear(stage: str, done: int, total: int) -> None:
        nonlocal said, said_at
        course.hear(stage, done, total)
        if done == total:
            said = said if total > 1 else ""  # a stage that comes again has a line again
            return
        seconds = course.seconds
        if seconds >= patience_s and seconds - said_at >= (_AGAIN_S if stage == said else patience_s / 2.0):
            said, said_at = stage, seconds
            counts = f": {course.counts}" if course.counts else ""
            say(f"{stage}{counts}" + (f"; {_duration(seconds)} so far" if seconds >= _PATIENCE_S else ""))

    return hear


@contextmanager
def _one_line() -> "Iterator[Progress]":
    """Show a line that is drawn again and again, on a copy of stderr, which nobody silences."""
    from rich.console import Console
    from rich.live import Live
    from rich.progress_bar import ProgressBar
    from rich.table import Table

    course = _Course()

    def draw() -> Table:
        line = Table.grid(padding=(0, 1))
        for is_bar in (False, True, False, False):  # the bar is what becomes shorter where there is no room
            line.add_column(no_wrap=not is_bar)
        bar = ProgressBar(course.total, course.done, width=_BAR, pulse=course.total <= 1)
        line.add_row(course.stage, bar, course.counts, f"({_duration(course.seconds)} so far)")
        return line

    with (
        os.fdopen(os.dup(2), "w") as stream,
        Live(get_renderable=draw, console=Console(file=stream), transient=True),
    ):
        yield course.hear
