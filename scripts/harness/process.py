"""Where a figure is measured: fresh processes with a number of threads, a time limit, and their memory.

The number of BLAS threads is read when numpy is loaded, so it must stand in the environment of a process that
has not loaded it: every measurement runs in a spawned one.
"""

import contextlib
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

THREAD_VARIABLES = (
    "OPENBLAS_NUM_THREADS",
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "RAYON_NUM_THREADS",
)


class Timed(NamedTuple):
    """An answer and what it took."""

    found: Any
    wall_s: float
    cpu_s: float


def time_call(function: Callable[[], Any]) -> Timed:
    """Call a function once."""
    wall, cpu = time.perf_counter(), time.process_time()
    found = function()
    return Timed(found, time.perf_counter() - wall, time.process_time() - cpu)


def children_cpu_s() -> float:
    """Return the CPU seconds of all processes that were started here and ended, and of theirs."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def run_command(*words: object) -> str:
    """Run a command of sfm-shapefit and return what it printed.

    Raises:
        RuntimeError: if it fails, with its last lines.
    """
    command = [sys.executable, "-m", "sfm_shapefit", *map(str, words)]
    root = Path(__file__).parents[2]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=root)
    if done.returncode:
        raise RuntimeError(f"{words[0]} ended with code {done.returncode}: {done.stderr.strip()[-300:]}")
    return done.stdout


def thread_environment(threads: int) -> dict[str, str]:
    """Return the environment in which numerical libraries use so many threads."""
    return dict.fromkeys(THREAD_VARIABLES, str(threads))


def call(
    function: Callable[..., Any],
    *args: object,
    environment: Mapping[str, str] | None = None,
    timeout_s: float | None = None,
    cpu_limit_s: int | None = None,
) -> Any:
    """Call a function in a fresh process, with further environment variables, and return its result.

    Arguments and result are pickled. The limits of wall-clock and CPU time include imports.

    Raises:
        TimeoutError: if a limit passed; the process is ended.
        RuntimeError: if the function raised, with its message, or the process died without an answer.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    with patch.dict(os.environ, environment or {}):
        process = context.Process(target=_answer, args=(sender, function, args, cpu_limit_s))
        process.start()
    sender.close()
    try:
        if not receiver.poll(timeout_s):
            raise TimeoutError(f"no answer within {timeout_s:g} s")
        good, answer = receiver.recv()
    except EOFError:
        process.join()
        if process.exitcode == -signal.SIGXCPU:
            raise TimeoutError(f"no answer within {cpu_limit_s} s of CPU time") from None
        raise RuntimeError(f"the process ended with code {process.exitcode} and no answer") from None
    finally:
        if process.is_alive():
            process.join(1.0)
        if process.is_alive():
            process.kill()
        process.join()
        receiver.close()
    if not good:
        raise RuntimeError(answer)
    return answer


def _answer(
    sender: Connection, function: Callable[..., Any], args: tuple[object, ...], cpu_limit_s: int | None
) -> None:
    """Send what the function returns or why it failed."""
    if cpu_limit_s is not None:
        # Without this limit the system would write the memory to a file.
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (cpu_limit_s, cpu_limit_s + 1))
    try:
        sender.send((True, function(*args)))
    except Exception as error:
        # Whatever a library raises is an answer, to be shown as such.
        sender.send((False, f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"))
    finally:
        sender.close()


def peak_memory_mb() -> float:
    """Return the peak resident memory of this process since its start or `reset_peak`, in 10^6 bytes."""
    high_water = _status_mb("VmHWM:")
    if high_water is not None:  # Linux: unlike ru_maxrss, it does not start at the parent's peak
        return high_water
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def resident_memory_mb() -> float:
    """Return the resident memory of this process now, in 10^6 bytes; its peak where that is all there is."""
    resident = _status_mb("VmRSS:")
    return peak_memory_mb() if resident is None else resident


def reset_peak() -> None:
    """Let the peak start anew at the present memory, where the system can do that (Linux)."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def _status_mb(key: str) -> float | None:
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith(key):
                return int(line.split()[1]) * 1024 / 1e6
    return None
