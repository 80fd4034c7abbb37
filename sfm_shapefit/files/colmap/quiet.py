"""Where pycolmap's own messages go: nowhere, unless the caller wants to hear them.

pycolmap logs through glog, resets its level in some calls, and links Ceres and CHOLMOD, which have no level
at all. So two things are silenced, each only as long as a call that needs it:

    quiet_log       glog's level             calls that read
    quiet_stderr    file descriptor 2        view graph calibration, and calls that read pictures, for libpng

The one switch for all is `hear_pycolmap`; it holds for the code that runs inside it, and not for other
threads. Errors arrive as exceptions either way.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import pycolmap

_QUIET = 3  # level of the log; glog calls it FATAL
_heard = ContextVar("pycolmap_is_heard", default=False)


@contextmanager
def hear_pycolmap(enabled: bool = True) -> Iterator[None]:
    """Let pycolmap's messages through while the block runs.

    Args:
        enabled: False silences them, as by default.
    """
    token = _heard.set(enabled)
    try:
        yield
    finally:
        _heard.reset(token)


@contextmanager
def quiet_log() -> Iterator[None]:
    """Keep pycolmap's log off stderr while the block runs."""
    if _heard.get():
        yield
        return
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = _QUIET
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


@contextmanager
def quiet_stderr() -> Iterator[None]:
    """Send file descriptor 2 to nowhere while the block runs.

    That holds for the whole process: messages of native code in other threads are lost too. What Python
    writes to `sys.stderr` arrives; a display with a stream of its own needs a duplicate of descriptor 2.
    """
    try:
        saved = None if _heard.get() else os.dup(2)
    except OSError:  # there is no such descriptor
        saved = None
    if saved is None:
        yield
        return
    nowhere, before = os.open(os.devnull, os.O_WRONLY), sys.stderr
    is_own = before is sys.__stderr__  # and nobody's who listens to Python
    try:
        _flush_stderr()
        os.dup2(nowhere, 2)
        if before is not None and is_own:
            how: Any = {"buffering": 1, "encoding": before.encoding, "errors": before.errors}
            sys.stderr = os.fdopen(saved, "w", closefd=False, **how)
        yield
    finally:
        _flush_stderr()
        sys.stderr = before
        os.dup2(saved, 2)
        os.close(saved)
        os.close(nowhere)


def _flush_stderr() -> None:
    if sys.stderr is not None:
        sys.stderr.flush()
