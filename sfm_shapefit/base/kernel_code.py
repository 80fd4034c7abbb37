"""Compiled code as it is kept on disk: packed into bytes, and made ready to run again.

numba's own loader first sets up all that is needed to compile a kernel, and reads the kernel's LLVM code, of
use to other kernels only. Here both wait until something is compiled, which takes a fifth off a short run.
What is loaded is numba's own library; only what it hands to another kernel that takes it in is replaced.
"""

import pickle
from functools import cache
from typing import Any

import llvmlite.binding as llvm
from numba.core.caching import CompileResultCacheImpl
from numba.core.environment import Environment
from numba.core.runtime import rtsys
from numba.core.serialize import dumps


def pack(compiled: Any) -> bytes:
    """Return what `unpack` takes, without the text that numba keeps for those who inspect types."""
    # The methods of numba's class take nothing from an instance, which would look for a folder.
    own, without = _anchored_here(compiled.environment), compiled._replace(type_annotation="")
    library, *rest, others = CompileResultCacheImpl.reduce(None, without._replace(environment=own))
    name, kind, (machine_code, llvm_code) = library
    names = [each.name for each in llvm.parse_bitcode(llvm_code).functions if not each.is_declaration]
    text = "".join(f'define void @"{each}"() {{ ret void }}\n' for each in names)
    outline = llvm.parse_assembly(text).as_bitcode()
    others = tuple(map(_anchored_here, others))
    reduced = dumps(((name, kind, (machine_code, outline)), *rest, others))
    return pickle.dumps((reduced, llvm_code))


def unpack(content: bytes, target_context: Any) -> Any:
    """Return compiled code that is ready to run; raises anything if it is damaged or of another version."""
    reduced, llvm_code = pickle.loads(content)
    rtsys.initialize(target_context)
    compiled = CompileResultCacheImpl.rebuild(None, target_context, pickle.loads(reduced))
    compiled.library._get_module_for_linking = cache(lambda: llvm.parse_bitcode(llvm_code))
    return compiled


def _anchored_here(environment: Environment) -> Environment:
    """Return the constants of compiled code as those of this module.

    Whoever loads them imports the module that they name, for globals that code without Python objects does
    not read: by the functions of numba that kernels call, a quarter of numba.
    """
    anchored = Environment({"__name__": __name__})
    anchored.consts[:], anchored.env_name = environment.consts, environment.env_name
    return anchored
