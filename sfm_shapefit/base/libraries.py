"""The large packages that most commands need, brought into the process of the program in less time."""

import ctypes
import os
import sys
from contextlib import suppress
from importlib import import_module
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.util import find_spec
from pathlib import Path
from threading import Thread

_ASKED_FOR_BY_NUMBA = ("scipy", "yaml")
"""Packages that numba imports to see the version of one, and to read a file of settings with the other."""


def import_packages() -> None:
    """Import numba while a thread loads pycolmap's library, a tenth of what all imports take.

    numba is told that scipy and PyYAML are absent, which it takes longer to import than to do without.
    """
    load_ahead("pycolmap")
    hidden = [name for name in _ASKED_FOR_BY_NUMBA if name not in sys.modules]
    sys.modules.update(dict.fromkeys(hidden))  # type: ignore[arg-type]  # None: cannot be imported
    try:
        import_module("numba")
    finally:
        for name in hidden:
            del sys.modules[name]


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
