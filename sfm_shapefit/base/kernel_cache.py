"""Where compiled kernels are kept, and for which processor they are compiled.

numba's own caches look in one folder only, and only if it can be written. Kernels are looked for here in

1. `_kernels` in the package, which comes with a wheel (`scripts/wheel`);
2. the folder `NUMBA_CACHE_DIR` if that is set, else `__pycache__` beside the source and the user's cache;

and a new one is written to the first folder of 2. that can be written. A file holds one kernel for one kind
of arguments. Its name holds all that the machine code depends on: the source of the kernel's module and of
every module of this package that it imports, also through others; the versions of Python and numba, of which
a patch keeps the code; the processor; the types of the arguments. So there is no index that two processes
could write at the same time, a copy of the files is as good as the originals, and what is stale is not found.
A file that cannot be loaded counts as absent.

The processor is not the one at hand but the least of its kind, so that the code of one machine runs, and
gives the same bits, on others: x86-64-v3, which has AVX2 and FMA, apple-m1, or else numba's "generic".
`NUMBA_CPU_NAME` names another, "host" the one at hand.
"""

import hashlib
import inspect
import os
import platform
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
from numba.core import config
from numba.core.caching import NullCache
from numba.core.event import Listener, install_listener
from numba.misc.appdirs import AppDirs

from sfm_shapefit.base.kernel_code import pack, unpack

PACKAGE = Path(__file__).parents[1]
SHIPPED = PACKAGE / "_kernels"
"""Kernels that a wheel carries; absent in a checkout."""

RUNTIME = f"py{sys.version_info[0]}{sys.version_info[1]}-numba{'.'.join(numba.__version__.split('.')[:2])}"
"""What machine code and its wrapping are made for, beside the processor."""

_X86_64_V3 = ("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe")
_IMPORT = re.compile(rb"from (sfm_shapefit[\w.]*) import ")

_missed: list[Callable[[], None]] = []
"""What is called when a kernel is not found, once, before it is looked for again."""
_hearing: list[Callable[[str], None]] = []
"""What is told the names of kernels that are found, or compiled and kept."""
_said: list[bool] = []
"""Not empty once a caller was told that kernels are compiled."""
_COMPILING = (
    "sfm_shapefit: compiling kernels, once, which may take a minute or two; they are kept on disk "
    "(`sfm-shapefit warm-up` compiles all of them beforehand)"
)
_measuring: "list[CompileTime]" = []
"""What counts the seconds that are spent compiling."""


def choose_target() -> str:
    """Return, and set unless it is set, numba's one target: the processor that kernels are compiled for."""
    if config.CPU_NAME == "host":
        config.CPU_NAME = config.CPU_FEATURES = None
    elif config.CPU_NAME is None:
        config.CPU_NAME = portable_target(platform.machine(), sys.platform, llvm.get_host_cpu_features)
        config.CPU_FEATURES = ""
    return config.CPU_NAME or str(llvm.get_host_cpu_name())


def portable_target(machine: str, system: str, read_features: Callable[[], Mapping[str, bool]]) -> str:
    """Return the name of the least processor of a machine's kind; that of x86-64 depends on its features."""
    if machine.lower() in ("x86_64", "amd64"):
        features = read_features()
        return "x86-64-v3" if all(features.get(name) for name in _X86_64_V3) else "generic"
    return "apple-m1" if (system, machine.lower()) == ("darwin", "arm64") else "generic"


@contextmanager
def on_miss(act: Callable[[], None]) -> Iterator[None]:
    """Call `act`, once, when a kernel is in no folder; then it is looked for again."""
    _missed.append(act)
    try:
        yield
    finally:
        _missed.clear()


@contextmanager
def hear_of_kernels(hear: Callable[[str], None]) -> Iterator[None]:
    """Call `hear` with the name of each kernel that is found, or compiled and kept."""
    _hearing.append(hear)
    try:
        yield
    finally:
        _hearing.remove(hear)


class CompileTime(Listener):  # type: ignore[misc]
    """Adds up the seconds that are spent compiling; what is compiled inside another kernel counts once.

    `begun` is called at the first kernel that is compiled. Kernels that are loaded are not heard of.
    """

    def __init__(self, begun: Callable[[], None] | None = None) -> None:
        self.seconds = 0.0
        self._begun, self._depth, self._since = begun, 0, 0.0

    def on_start(self, _event: Any) -> None:
        """Begin to compile something."""
        begun, self._begun = self._begun, None
        if begun is not None:
            begun()
        if self._depth == 0:
            self._since = time.perf_counter()
        self._depth += 1

    def on_end(self, _event: Any) -> None:
        """Add up the seconds once the outermost compilation has ended."""
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.perf_counter() - self._since


@contextmanager
def measure_compilation() -> Iterator[CompileTime]:
    """Yield what counts the seconds that the block spends compiling, or waiting for others that do."""
    spent = CompileTime()
    _measuring.append(spent)
    try:
        with install_listener("numba:compile", spent):
            yield spent
    finally:
        _measuring.remove(spent)


@contextmanager
def counted_as_compiling() -> Iterator[None]:
    """Count the block as time that is spent compiling: other processes compile meanwhile."""
    for spent in _measuring:
        spent.on_start(None)
    try:
        yield
    finally:
        for spent in _measuring:
            spent.on_end(None)


class KernelCache(NullCache):  # type: ignore[misc]
    """The compiled code of one function, for numba's dispatchers."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._source = _resolved(inspect.getfile(function))
        code, name = function.__code__, function.__qualname__.replace("<", "").replace(">", "")
        self._name = f"{self._source.stem}.{name}"
        self._prefix = f"{self._name}-{RUNTIME}-"
        self._code = (code.co_code, code.co_firstlineno)

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return the code for a signature, or None."""
        name = self._file_name(signature, target_context.codegen())
        if not name:
            return None
        code = self._find(name, target_context)
        if code is None and _missed:
            _missed.pop()()
            code = self._find(name, target_context)
        if code is None:
            self._say_once()
        if code is not None:
            self._tell()
        return code

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Keep the code for a signature, if any folder can be written."""
        name = self._file_name(signature, compiled.codegen)
        if not name or compiled.library.has_dynamic_globals:
            return
        content = pack(compiled)
        for folder in own_folders(self._source.parent):
            try:
                write_whole(folder / name, content)
            except OSError:
                continue
            self._remove_stale(folder)
            break
        self._tell()

    def _say_once(self) -> None:
        """Say on stderr that kernels are compiled, to who calls from Python; the program says it itself."""
        is_ours = self._source.is_relative_to(PACKAGE)
        if is_ours and not (_said or _hearing or "sfm_shapefit.cli" in sys.modules):
            _said.append(True)
            print(_COMPILING, file=sys.stderr)  # noqa: T201

    def _tell(self) -> None:
        for hear in _hearing:
            hear(self._name)

    def _file_name(self, signature: Any, codegen: Any) -> str:
        """Return the name of the file for a signature and a processor; none without a source."""
        stamp = stamp_of(self._source)
        what = repr((signature, _processor(codegen), self._code))
        return stamp and f"{self._prefix}{stamp}-{hashlib.sha256(what.encode()).hexdigest()[:16]}.nbc"

    def _find(self, name: str, target_context: Any) -> Any:
        """Return the code in the first file of a name that can be loaded."""
        folder_of_source = self._source.parent
        for folder in (*shipped_folders(folder_of_source), *own_folders(folder_of_source)):
            try:
                return unpack((folder / name).read_bytes(), target_context)
            except Exception:  # absent, unreadable, damaged: whatever it is, the kernel is compiled
                continue
        return None

    def _remove_stale(self, folder: Path) -> None:
        """Remove what this kernel left there when its source was another."""
        stamp = stamp_of(self._source)
        for name in os.listdir(folder):
            if name.startswith(self._prefix) and not name.startswith(self._prefix + stamp):
                (folder / name).unlink(missing_ok=True)


def here() -> str:
    """Return what kernels are compiled for here, for users."""
    return f"{RUNTIME} on {choose_target()}"


def made_for() -> str:
    """Return what the kernels of a wheel are compiled for, in the words of `here`; empty without any."""
    try:
        return (SHIPPED / "made_for.txt").read_text(encoding="utf-8").strip()
    except OSError:
        return ""


def shipped_folders(source_folder: Path) -> list[Path]:
    """Return where a wheel has the kernels of a folder of sources."""
    is_ours = SHIPPED.is_dir() and source_folder.is_relative_to(PACKAGE)
    return [SHIPPED / source_folder.relative_to(PACKAGE)] if is_ours else []


def own_folders(source_folder: Path) -> list[Path]:
    """Return where the kernels of a folder of sources may be written, the first choice first."""
    return _own_folders(source_folder, config.CACHE_DIR)


@cache
def _own_folders(source_folder: Path, chosen: str) -> list[Path]:
    place = f"{source_folder.name}_{hashlib.sha256(str(source_folder).encode()).hexdigest()[:16]}"
    if chosen:
        return [Path(chosen) / place]
    user = Path(AppDirs(appname="sfm_shapefit", appauthor=False).user_cache_dir)
    return [source_folder / "__pycache__", user / place]


def write_whole(path: Path, content: bytes) -> None:
    """Write a file in one step, and its folder if there is none; after an OSError nothing stays behind."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, unfinished = tempfile.mkstemp(dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.chmod(unfinished, 0o644)
        os.replace(unfinished, path)
    except BaseException:
        Path(unfinished).unlink(missing_ok=True)
        raise


def note(name: str, source_folder: Path) -> None:
    """Note that something is compiled, for these sources and this processor, if any folder can be written."""
    for folder in own_folders(source_folder):
        with suppress(OSError):
            write_whole(folder / _note_name(name), b"")
            return


def is_noted(name: str, source_folder: Path) -> bool:
    """Return whether something is noted."""
    folders = (*shipped_folders(source_folder), *own_folders(source_folder))
    return any((folder / _note_name(name)).exists() for folder in folders)


def _note_name(name: str) -> str:
    stamp = stamp_of(PACKAGE / "commands" / "examples.py")
    return f"{name}-{RUNTIME}-{stamp}-{choose_target()}.nbc"


@cache
def stamp_of(source: Path) -> str:
    """Return a hash of a source and of all of this package that it imports; empty without a source."""
    texts: dict[Path, bytes] = {}
    waiting = [source]
    while waiting:
        path = waiting.pop()
        if path not in texts:
            text, imported = _read(path)
            texts[path] = text
            waiting += imported
    if not texts[source]:
        return ""
    whole = b"".join(texts[path] for path in sorted(texts))
    return hashlib.sha256(whole).hexdigest()[:12]


@cache
def _read(path: Path) -> tuple[bytes, tuple[Path, ...]]:
    """Return the hash of a source, empty if it cannot be read, and the sources of this package it imports."""
    try:
        text = path.read_bytes()
    except OSError:
        return b"", ()
    files = {_source_of(name.decode()) for name in _IMPORT.findall(text)}
    # This module has no part in the code.
    return hashlib.sha256(text).digest(), tuple(sorted(files - {Path(__file__)}))


@cache
def _source_of(module: str) -> Path:
    """Return the file of a module of this package, which hundreds of imports name."""
    place = PACKAGE.joinpath(*module.split(".")[1:])
    return place / "__init__.py" if place.is_dir() else place.with_suffix(".py")


@cache
def _processor(codegen: Any) -> tuple[str, ...]:
    """Return what numba says of the processor that it compiles for."""
    return tuple(map(str, codegen.magic_tuple()))


@cache
def _resolved(file: str) -> Path:
    """Return the path of a source, which several kernels share."""
    return Path(file).resolve()
