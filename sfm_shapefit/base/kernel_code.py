"""Compiled code as it is kept on disk: packed into bytes, and made ready to run again.

numba's own loader first sets up all that is needed to compile a kernel, and reads the kernel's LLVM code, of
use to other kernels only. Here both wait until something is compiled, which takes a fifth off a short run.
What is loaded is numba's own library; only what it hands to another kernel that takes it in is replaced.
"""

import pickle
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from types import ModuleType
from typing import Any

import llvmlite.binding as llvm
from numba.core.caching import CompileResultCacheImpl
from numba.core.runtime import rtsys
from numba.core.serialize import dumps


def pack(compiled: Any) -> bytes:
    """Return what `unpack` takes, without the text that numba keeps for those who inspect types."""
    # The methods of numba's class take nothing from an instance, which would look for a folder.
    library, *rest = CompileResultCacheImpl.reduce(None, compiled._replace(type_annotation=""))
    name, kind, (machine_code, llvm_code) = library
    names = [each.name for each in llvm.parse_bitcode(llvm_code).functions if not each.is_declaration]
    text = "".join(f'define void @"{each}"() {{ ret void }}\n' for each in names)
    outline = llvm.parse_assembly(text).as_bitcode()
    modules = {each.globals["__name__"] for each in (compiled.environment, *rest[-1])}
    reduced = dumps(((name, kind, (machine_code, outline)), *rest))
    return pickle.dumps((sorted(modules), reduced, llvm_code))


def unpack(content: bytes, target_context: Any) -> Any:
    """Return compiled code that is ready to run; raises anything if it is damaged or of another version."""
    modules, reduced, llvm_code = pickle.loads(content)
    rtsys.initialize(target_context)
    with _standing_in(modules):
        parts = pickle.loads(reduced)
    compiled = CompileResultCacheImpl.rebuild(None, target_context, parts)
    compiled.library._get_module_for_linking = cache(lambda: llvm.parse_bitcode(llvm_code))
    return compiled


@contextmanager
def _standing_in(modules: Iterable[str]) -> Iterator[None]:
    """Let no module be imported that code names as the place of its constants, and does not need."""
    absent = [name for name in modules if name not in sys.modules]
    sys.modules.update({name: ModuleType(name) for name in absent})
    try:
        yield
    finally:
        for name in absent:
            del sys.modules[name]
