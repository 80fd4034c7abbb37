"""One call in a forked child that can neither take the parent down nor leave a trace unseen.

The parent imports and warms everything once; a case then costs a fork and its own work. The child has limits
on processor time, wall-clock time and address space, so that a loop without end, a deadlock and an absurd
allocation each end it, and the parent sees by which signal. Python's audit events tell what the child opens
for writing, moves or removes, and whether it starts a process or opens a socket.
"""

import contextlib
import os
import resource
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import NamedTuple

CPU_LIMIT_S = 10
# Several times the former, for the machine may be shared.
WALL_LIMIT_S = 90.0
MEMORY_LIMIT_BYTES = 2_000_000_000

_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_CHANGING = (
    *("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.truncate", "os.link", "os.symlink"),
    *("os.chmod", "os.chown", "os.utime"),
)
_FORBIDDEN = ("socket.", "subprocess.", "os.system", "os.exec", "os.posix_spawn", "os.spawn", "pickle.find")
_HARMLESS = ("/dev/null", "/dev/tty")


class Outcome(NamedTuple):
    """How a call ended."""

    code: int
    """Exit code; minus the signal's number if a signal ended the child."""
    stdout: str
    stderr: str
    cpu_s: float
    peak_bytes: int
    """Largest resident set, what the parent shares with the child included."""
    deeds: tuple[str, ...]
    """What the child did outside the folders it may write to, and what nobody may do, from audit events."""


class Child(NamedTuple):
    """A forked child that is at work."""

    pid: int
    logs: tuple[Path, ...]

    def finish(self) -> Outcome:
        """Wait for its end and tell how it ended."""
        _, status, usage = os.wait4(self.pid, 0)
        texts = [log.read_text(encoding="utf-8", errors="replace") for log in self.logs]
        for log in self.logs:
            log.unlink()
        return Outcome(
            code=os.waitstatus_to_exitcode(status),
            stdout=texts[0],
            stderr=texts[1],
            cpu_s=usage.ru_utime + usage.ru_stime,
            peak_bytes=usage.ru_maxrss * 1024,
            deeds=tuple(texts[2].splitlines()),
        )


def start_forked(
    function: Callable[[], None],
    work: Path,
    writable: Sequence[Path],
    *,
    encoding: str = "utf-8",
    logs: str = "log",
) -> Child:
    """Call a function in a forked child, and return as soon as it is called.

    SystemExit gives the exit code, any other exception a traceback on stderr and code 1. The folder `work`
    becomes the working directory; what the child prints is kept beside it, and `logs` tells children apart.
    """
    kinds = ("stdout", "stderr", "deeds")
    paths = tuple(work.parent / f"{work.name}.{logs}.{kind}" for kind in kinds)
    ready, tell = os.pipe()
    pid = os.fork()
    if pid == 0:
        _be_child(function, work, writable, paths, encoding, tell)
    os.close(tell)
    os.read(ready, 1)
    os.close(ready)
    return Child(pid, paths)


def run_forked(
    function: Callable[[], None], work: Path, writable: Sequence[Path], *, encoding: str = "utf-8"
) -> Outcome:
    """Call a function in a forked child and tell how it ended; see `start_forked`."""
    return start_forked(function, work, writable, encoding=encoding).finish()


def _be_child(
    function: Callable[[], None],
    work: Path,
    writable: Sequence[Path],
    logs: Sequence[Path],
    encoding: str,
    ready: int,
) -> None:
    """Run the function and end the process; never returns."""
    code = 1
    try:
        try:
            _redirect(logs, encoding)
            os.chdir(work)
            _limit()
            _watch(writable, os.open(logs[2], os.O_WRONLY | os.O_CREAT | os.O_APPEND))
            os.close(ready)
            function()
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        except BaseException:
            traceback.print_exc()
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
    finally:  # also of an interrupt that comes this late: the child must not go on as its parent
        os._exit(code)


def _redirect(logs: Sequence[Path], encoding: str) -> None:
    """Send both standard streams to files, those of native code too."""
    for number, log in zip((1, 2), logs, strict=False):
        descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(descriptor, number)
        os.close(descriptor)
    logs[2].touch()
    sys.stdout = os.fdopen(1, "w", encoding=encoding, closefd=False)
    sys.stderr = os.fdopen(2, "w", encoding=encoding, errors="backslashreplace", closefd=False)


def _limit() -> None:
    """Bound processor time, wall-clock time and address space of this process."""
    address_space = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limit = address_space + MEMORY_LIMIT_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_LIMIT_S, CPU_LIMIT_S + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, WALL_LIMIT_S)


def _loads_kernel() -> bool:
    """Return whether a compiled kernel is loaded from its cache, which unpickles what it wrote itself."""
    frame: FrameType | None = sys._getframe()
    while frame is not None and not frame.f_code.co_filename.endswith("kernel_cache.py"):
        frame = frame.f_back
    return frame is not None


def _watch(writable: Sequence[Path], log: int) -> None:
    """Write every deed that is not allowed to `log`."""
    allowed = tuple(f"{os.path.realpath(folder)}{os.sep}" for folder in writable)

    def is_allowed(path: object) -> bool:
        if not isinstance(path, str | bytes | os.PathLike):
            return isinstance(path, int)  # a descriptor that was opened before, and judged then
        text = os.fsdecode(path)
        absolute = os.path.join(os.path.realpath(os.path.dirname(text) or "."), os.path.basename(text))
        return absolute.startswith(allowed) or absolute in _HARMLESS or absolute in map(str, writable)

    def hook(event: str, arguments: tuple[object, ...]) -> None:
        if event == "open":
            path, mode, flags = arguments
            changes = isinstance(flags, int) and bool(flags & _WRITING)
            changes = changes or (isinstance(mode, str) and any(letter in mode for letter in "wax+"))
            if changes and not is_allowed(path):
                os.write(log, f"open {path!r} {mode} {flags}\n".encode())
        elif event in _CHANGING:
            for path in arguments[: 2 if event in ("os.rename", "os.link") else 1]:
                if not is_allowed(path):
                    os.write(log, f"{event} {path!r}\n".encode())
        elif event.startswith(_FORBIDDEN) and not (event == "pickle.find_class" and _loads_kernel()):
            os.write(log, f"{event} {arguments!r}\n".encode())

    sys.addaudithook(hook)
