"""Compiled libraries that a thread loads into the process while others import modules."""

import ctypes
import os
from contextlib import suppress
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.util import find_spec
from pathlib import Path
from threading import Thread


def load_ahead(package: str, name: str) -> None:
    """Begin to load the compiled module of a package, without importing it; importing it then takes less.

    Python holds up all threads while it loads a library itself. Where there is no such file, or the system
    loads libraries otherwise, nothing happens: the import will say what is wrong.
    """
    with suppress(RuntimeError):  # no more threads
        Thread(target=_load, args=(package, name)).start()


def _load(package: str, name: str) -> None:
    found = find_spec(package)
    folders = found.submodule_search_locations if found is not None else None
    with suppress(AttributeError, TypeError):
        load = ctypes.CDLL(None).dlopen  # called like this, it lets other threads run
        for folder in folders or ():
            load(os.fsencode(Path(folder) / f"{name}{EXTENSION_SUFFIXES[0]}"), os.RTLD_NOW)
