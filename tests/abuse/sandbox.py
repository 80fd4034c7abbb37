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
from pathlib import Path
from typing import NamedTuple

CPU_LIMIT_S = 10
# Several times the processor time, for the machine may be shared.
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
    """Largest resident set, including what the parent shares with the child."""
    deeds: tuple[str, ...]
    """What the child did outside the folders it may write to, and what nobody may do, from audit events."""


class Child(NamedTuple):
    """A forked child that is at work."""

    pid: int
    logs: tuple[Path, ...]

    def finish(self):
        """Wait for its end and tell how it ended."""
        _, status, usage = os.wait4(self.pid, 0)
        stdout, stderr, deeds = (log.read_text(encoding="utf-8", errors="replace") for log in self.logs)
        for log in self.logs:
            log.unlink()
        cpu_s, peak_bytes = usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024
        code = os.waitstatus_to_exitcode(status)
        return Outcome(code, stdout, stderr, cpu_s, peak_bytes, tuple(deeds.splitlines()))


def start_forked(function, work, writable, *, encoding="utf-8", logs="log"):
    """Call a function in a forked child, and return as soon as it is called.

    SystemExit gives the exit code, any other exception a traceback on stderr and code 1. The folder `work`
    becomes the working directory; what the child prints is kept beside it, and `logs` tells children apart.
    """
    paths = tuple(work.parent / f"{work.name}.{logs}.{kind}" for kind in ("stdout", "stderr", "deeds"))
    ready, tell = os.pipe()
    pid = os.fork()
    if pid == 0:
        _be_child(function, work, writable, paths, encoding, tell)
    os.close(tell)
    os.read(ready, 1)
    os.close(ready)
    return Child(pid, paths)


def run_forked(function, work, writable, *, encoding="utf-8"):
    """Call a function in a forked child and tell how it ended; see `start_forked`."""
    return start_forked(function, work, writable, encoding=encoding).finish()


def _be_child(function, work, writable, logs, encoding, ready):
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


def _redirect(logs, encoding):
    """Send both standard streams to files, those of native code too."""
    for number, log in ((1, logs[0]), (2, logs[1])):
        descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(descriptor, number)
        os.close(descriptor)
    logs[2].touch()
    sys.stdout = os.fdopen(1, "w", encoding=encoding, closefd=False)
    sys.stderr = os.fdopen(2, "w", encoding=encoding, errors="backslashreplace", closefd=False)


def mapped_bytes():
    """Return the size of this process's address space."""
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def _limit():
    """Bound processor time, wall-clock time and address space of this process."""
    resource.setrlimit(resource.RLIMIT_AS, (mapped_bytes() + MEMORY_LIMIT_BYTES,) * 2)
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_LIMIT_S, CPU_LIMIT_S + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, WALL_LIMIT_S)


def _loads_kernel():
    """Return whether a compiled kernel is loaded from its cache, or returns an array.

    Either unpickles what it wrote itself: numba, the class of the array that it makes first.
    """
    frame, doors = sys._getframe(), ("kernel_cache.py", os.path.join("numba", "core", "serialize.py"))
    while frame is not None and not frame.f_code.co_filename.endswith(doors):
        frame = frame.f_back
    return frame is not None


def _watch(writable, log):
    """Write every deed that is not allowed to `log`."""
    allowed = tuple(f"{os.path.realpath(folder)}{os.sep}" for folder in writable)

    def is_allowed(path):
        if not isinstance(path, str | bytes | os.PathLike):
            return isinstance(path, int)  # a descriptor that was opened before, and judged then
        text = os.fsdecode(path)
        absolute = os.path.join(os.path.realpath(os.path.dirname(text) or "."), os.path.basename(text))
        return absolute.startswith(allowed) or absolute in _HARMLESS or absolute in map(str, writable)

    def hook(event, arguments):
        touched = ()
        if event == "open":
            path, mode, flags = arguments
            by_flags = isinstance(flags, int) and flags & _WRITING
            by_mode = isinstance(mode, str) and any(letter in mode for letter in "wax+")
            touched = (path,) if by_flags or by_mode else ()
        elif event in _CHANGING:
            touched = arguments[: 2 if event in ("os.rename", "os.link") else 1]
        elif event.startswith(_FORBIDDEN) and not (event == "pickle.find_class" and _loads_kernel()):
            os.write(log, f"{event} {arguments!r}\n".encode())
        for path in touched:
            if not is_allowed(path):
                os.write(log, f"{event} {path!r}\n".encode())

    sys.addaudithook(hook)
