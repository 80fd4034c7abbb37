"""What the user sees: errors as one sentence and an exit code, progress on stderr, tables on stdout.

The door to rich. Exit codes: 0 done; 2 wrong usage; 3 bad input; 4 the view graph cannot be solved;
130 interrupted.
"""

import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer

from sfm_shapefit.errors import ShapeFitError, UnsolvableError

if TYPE_CHECKING:
    from sfm_shapefit.pipeline import Progress

Rows = list[tuple[str, str]]
"""A two-column table: label and what stands beside it."""

EXIT_INPUT, EXIT_UNSOLVABLE, EXIT_INTERRUPTED = 3, 4, 130
NAMES_SHOWN = 8
SEE_JSON = "see --json"


@contextmanager
def reported() -> Iterator[None]:
    """Turn every known error into one sentence on stderr and its exit code."""
    try:
        yield
    except KeyboardInterrupt:
        _fail("interrupted; nothing was written", EXIT_INTERRUPTED)
    except UnsolvableError as error:
        _fail(str(error), EXIT_UNSOLVABLE)
    except ShapeFitError as error:
        _fail(str(error), EXIT_INPUT)


def catch_termination() -> None:
    """Turn SIGTERM into an interrupt; again once pycolmap is loaded, which brings a handler of its own."""
    signal.signal(signal.SIGTERM, _interrupt)


def _interrupt(_signal: int, _frame: object) -> None:
    raise KeyboardInterrupt


def _fail(message: str, code: int) -> None:
    print(f"sfm-shapefit: {printable(message)}", file=sys.stderr)  # noqa: T201
    raise typer.Exit(code)


def printable(text: str) -> str:
    """Return text without control characters: names come from strangers, and may move the cursor."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


@contextmanager
def shown_progress(enabled: bool) -> "Iterator[Progress | None]":
    """Show stages on stderr if it is a terminal. Written to a copy of it, which nobody silences."""
    if not (enabled and sys.stderr.isatty()):
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Display

    columns = (TextColumn("{task.description:<20}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with (
        os.fdopen(os.dup(2), "w") as stream,
        Display(*columns, console=Console(file=stream, force_terminal=True)) as display,
    ):
        tasks: dict[str, Any] = {}

        def advance(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = display.add_task(stage, total=total)
            if total > 1 or display.tasks[tasks[stage]].total == 1:
                display.update(tasks[stage], completed=done, total=total)

        yield advance


def print_table(title: str, rows: Rows) -> None:
    """Print a two-column table on stdout."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    # Text, not markup: names and paths come from strangers, and brackets in them mean nothing.
    table = Table(title=Text(printable(title)), show_header=False, title_justify="left")
    for label, value in rows:
        table.add_row(label, Text("\n".join(printable(line) for line in value.split("\n"))))
    Console().print(table)


def shortened(lines: Sequence[str], elsewhere: str = "see cameras.csv") -> str:
    """Return the first lines, and how many there are more and where."""
    more = [f"and {len(lines) - NAMES_SHOWN} more, {elsewhere}"] if len(lines) > NAMES_SHOWN else []
    return "\n".join([*lines[:NAMES_SHOWN], *more])
