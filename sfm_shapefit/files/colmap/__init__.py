"""COLMAP's files: models as arrays, databases through sqlite3. The one door to both.

Nothing here writes to a model or a database that the user owns. Import the modules themselves: `model` and
`read_binary` read models, `write_binary` writes them, `database` reads matches, and `reconstructions` makes
arrays of pycolmap's models and these of arrays.

pycolmap's log takes over SIGTERM, to print a page of stack trace; the first import, here, takes it back.
"""

import signal
import sys
import threading


def _import_pycolmap() -> None:
    """Import pycolmap for the first time, and let SIGTERM do what it did."""
    if "pycolmap" in sys.modules or threading.current_thread() is not threading.main_thread():
        return
    handler = signal.getsignal(signal.SIGTERM)
    others = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
    try:
        import pycolmap  # noqa: F401

        if handler is not None:  # None: of another library
            signal.signal(signal.SIGTERM, handler)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, others)


_import_pycolmap()
