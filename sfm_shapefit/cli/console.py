"""What the user sees: errors as one sentence and an exit code on stderr, answers and tables on stdout.

Exit codes: 0 done; 2 wrong usage; 3 bad input; 4 the view graph cannot be solved;
5 a package is missing; 130 interrupted; 141 nobody reads any more.
"""

import errno
import os
import re
import signal
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer

from sfm_shapefit.base.display import NextStep, Row, Telling
from sfm_shapefit.base.errors import MissingExtraError, ShapeFitError, UnsolvableError
from sfm_shapefit.base.wording import make_printable

EXIT_INPUT, EXIT_UNSOLVABLE, EXIT_MISSING = 3, 4, 5  # exit codes; see the header
EXIT_INTERRUPTED, EXIT_PIPE = 130, 141  # exit codes; 128 and the number of the signal
NAMES_SHOWN = 8  # lines under one label of a table; the files have all

_LIBRARIES_BYTES = 850_000_000  # bytes of address space; with less, loading the libraries fails (measured)
_THREAD_BYTES = 50_000_000  # bytes; stack and work space of a thread of the linear algebra library

_NO_MEMORY = ("can't start new thread", "bad_alloc", "failed to map segment", "Cannot allocate memory")
"""Words of Python, C++ and the dynamic linker for a lack of memory."""

_WARNING_STYLE = "bold yellow"
_GRADE_STYLES = {
    "good": "bold green",
    "look": "bold yellow",
    "cannot be judged": "bold yellow",
    "do not use": "bold red",
}

_AGAIN_S = 0.02  # seconds after which a lost interrupt comes again; native code has returned by then

flag_names, key_names = set[str](), set[str]()
"""Names of the options of the command at work that are flags, and of those that may stand in --config."""


def flags_and_keys() -> set[str]:
    """Return the flags, as they are typed, and the keys of the command at work."""
    return {f"--{name.replace('_', '-')}" for name in flag_names} | key_names


_received: list[int] = []
"""Numbers of the signals that asked this process to end."""


@contextmanager
def report_errors(out: Path | None = None, begun: Path | None = None) -> Iterator[None]:
    """Turn every known error into one sentence on stderr and its exit code.

    Args:
        out: the folder or file that the block makes, in one step. An interrupt after that step finds another
            folder there than before, also where the output replaces one.
        begun: a file with which the same command goes on after an interrupt.
    """
    before = _identity(out)
    try:
        yield
        sys.stdout.flush()  # now, not when nobody hears of it
    except typer.Exit:
        raise
    except BrokenPipeError:  # whoever reads has seen enough
        _forget_stdout()
        raise typer.Exit(EXIT_PIPE) from None
    except (KeyboardInterrupt, Exception) as error:
        # Native code that a signal interrupts may turn the interrupt into an error of its own.
        if isinstance(error, KeyboardInterrupt) or _received:
            is_made = _identity(out) not in (None, before)
            state = "the output is complete" if is_made else "nothing was written"
            if not is_made and begun is not None and begun.is_file():
                state = f"the same command goes on with {begun}"
            _fail(f"interrupted; {state}", EXIT_INTERRUPTED)
        if isinstance(error, UnsolvableError):
            _fail(str(error), EXIT_UNSOLVABLE)
        if isinstance(error, MissingExtraError):
            _fail(str(error), EXIT_MISSING)
        if isinstance(error, ShapeFitError):
            _fail(str(error), EXIT_INPUT)
        if isinstance(error, OSError):
            _fail(_explain_failure(error), EXIT_INPUT)
        if isinstance(error, MemoryError) or any(words in str(error) for words in _NO_MEMORY):
            _fail(
                "the memory that this process may use is not enough; allow more, or give a smaller model",
                EXIT_INPUT,
            )
        raise


def _explain_failure(error: OSError) -> str:
    """Say what the system refused: a path, the working folder, or what is printed."""
    if error.filename is not None:
        return f"{os.fsdecode(error.filename)} cannot be used ({error.strerror}); choose another"
    if error.errno == errno.ENOENT:
        return "the working folder is gone; go to another, and start again"
    _forget_stdout()
    return f"what there is to print cannot be written ({error.strerror})"


def open_closed_streams() -> None:
    """Open what whoever started this process closed of stdin, stdout and stderr, so that it leads nowhere.

    Else the next files that are opened would take their numbers, and messages would go into these.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # which takes the lowest number that is free
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", encoding="utf-8", closefd=False))


def _forget_stdout() -> None:
    """Let what is still to be printed go nowhere."""
    sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  as long as the process lives


def _identity(path: Path | None) -> tuple[int, int] | None:
    """Return device and number of a file or folder, by which it is known; None if there is none."""
    try:
        status = None if path is None else path.stat()
    except OSError:
        return None
    return status and (status.st_dev, status.st_ino)


def catch_termination() -> None:
    """Turn SIGTERM into an interrupt.

    A signal that whoever started this process wants ignored, as nohup does, stays ignored.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _interrupt)


def ignore_signals() -> None:
    """Let what asks this process to end pass from here on, since it ends, with the exit code of what it did.

    As it ends, the interpreter puts its own handlers back, by which a signal would be its end.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def _interrupt(number: int, _frame: object) -> None:
    _received.append(number)
    raise KeyboardInterrupt


def repeat_lost_interrupts() -> None:
    """Repeat an interrupt that a callback of native code loses with no more than a traceback on stderr."""
    otherwise = sys.unraisablehook

    def again(lost: "sys.UnraisableHookArgs") -> None:
        if not (_received and isinstance(lost.exc_value, KeyboardInterrupt)):
            otherwise(lost)
        elif signal.getsignal(signal.SIGALRM) in (signal.SIG_DFL, _interrupt):
            signal.signal(signal.SIGALRM, _interrupt)
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)

    sys.unraisablehook = again


def refuse_little_memory() -> None:
    """Refuse an address space in which the libraries cannot even be loaded: they would crash or hang."""
    import resource

    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    needed = _LIBRARIES_BYTES + _THREAD_BYTES * (os.cpu_count() or 1)
    if limit != resource.RLIM_INFINITY and limit < needed:
        say(
            f"this process may use {limit / 1e6:.0f} MB of address space, but its libraries need "
            f"{needed / 1e6:.0f} MB; raise the limit (ulimit -v)"
        )
        sys.exit(EXIT_INPUT)


def _fail(message: str, code: int) -> None:
    say(message)
    raise typer.Exit(code)


def say(message: str) -> None:
    """Say a sentence on stderr, with options as they are typed."""
    print(f"sfm-shapefit: {make_printable(in_flags(message))}", file=sys.stderr)  # noqa: T201


def in_flags(text: str) -> str:
    """Return a message with its options as they are typed: min_trust=0 as --min-trust 0, or as a key."""

    def typed(option: re.Match[str]) -> str:
        name, value = option.groups()
        if name not in flag_names:
            return f"{name} = {value} in the file of --config" if name in key_names else option[0]
        flag = f"--{name.replace('_', '-')}"
        return flag if value == "True" else f"{flag} {value}"

    return re.sub(r"\b([a-z_]+)=([\w.]*\w)", typed, text)


def print_table(title: str, rows: Iterable[Row], elsewhere: str = "") -> None:
    """Print a two-column table on stdout; warnings have a color where the terminal has.

    If a file or flag has the lines `elsewhere`, only the first few are shown.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    # Text, not markup: names and paths come from strangers, and brackets in them mean nothing.
    table = Table(title=Text(_encodable(title), overflow="fold"), show_header=False, title_justify="left")
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for label, lines in rows:
        style = _WARNING_STYLE if label == "warning" else ""
        more = len(lines) - NAMES_SHOWN
        shown = [*lines[:NAMES_SHOWN], f"and {more} more, {elsewhere}"] if elsewhere and more > 0 else lines
        text = "\n".join(_encodable(in_flags(line)) for line in "\n".join(shown).split("\n"))
        if lines:
            table.add_row(Text(label, style), Text(text, style))
    Console().print(table)


def print_answer(told: Telling, time_taken: str = "") -> None:
    """Print on stdout what is told of a result, a line each, with the time at the end of the first line."""
    first, *others = told.lines
    gap = " " * min(8, max(2, 80 - len(first) - len(time_taken)))  # in a terminal of 80 columns on one line
    print_lines([f"{first}{gap}{time_taken}" if time_taken else first, *others])
    for label, lines in told.rows:
        more = len(lines) - NAMES_SHOWN
        shown = [*lines[:NAMES_SHOWN], f"and {more} more, {told.elsewhere}"] if more > 0 else lines
        print_lines([f"{label}: {line}" for line in shown], _WARNING_STYLE if label == "warning" else "")


def print_ending(grade: str, verdict: str, written: str, step: NextStep) -> None:
    """Print on stdout how good a model is, what was written, and the next command, which can be copied."""
    print_lines([f"verdict: {verdict}"], _GRADE_STYLES[grade])
    print_lines([line for line in (written, step.line) if line])


def print_lines(lines: Iterable[str], style: str = "") -> None:
    """Print lines on stdout; a terminal breaks sentences between words, but no command and no path."""
    from rich.console import Console
    from rich.text import Text

    console = Console()
    for line in lines:
        breaks = console.is_terminal and not line.startswith(("next: ", "next, ", "written to "))
        console.print(Text(_encodable(in_flags(line)), style), soft_wrap=not breaks)


def print_json(summary: dict[str, Any]) -> None:
    """Print a summary as JSON on stdout; one that is no UTF-8 gets escapes, which mean the same."""
    from sfm_shapefit.base.record import dumps

    text = dumps(summary)
    try:
        text.encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:
        text = dumps(summary, only_ascii=True)
    print(text)  # noqa: T201


def _encodable(text: str) -> str:
    """Return printable text with escapes for what stdout, perhaps an ASCII one, cannot show."""
    encoding = sys.stdout.encoding or "utf-8"
    return make_printable(text).encode(encoding, "backslashreplace").decode(encoding)
