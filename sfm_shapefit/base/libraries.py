"""Compiled libraries that a thread loads into the process while others import modules."""

import ctypes
import os
from contextlib import suppress
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.util import find_spec
from pathlib import Path
from threading import Thread


def load_ahead(package: str) -> None:
    """Begin to load the compiled modules of a package, without importing it; importing it then takes less.

    Python holds up all threads while it loads a library itself. Where there are none, or the system
    loads libraries otherwise, nothing happens: the import will say what is wrong.
    """
    with suppress(RuntimeError):  # no more threads
        Thread(target=_load, args=(package,)).start()


def _load(package: str) -> None:
    found = find_spec(package)
    folders = found.submodule_search_locations if found is not None else None
    with suppress(AttributeError, TypeError):
        load = ctypes.CDLL(None).dlopen  # called like this, it lets other threads run
        for folder in folders or ():
            for library in sorted(Path(folder).glob(f"*{EXTENSION_SUFFIXES[0]}")):
                load(os.fsencode(library), os.RTLD_NOW)
