"""Compiled code as it is kept on disk: packed into bytes, and made ready to run again.

numba's own loader first sets up all that is needed to compile a kernel, reads the kernel's LLVM code, of use
to other kernels only, and makes an empty LLVM module that stands for the machine code. Here the machine code
is handed to LLVM as it is, and the rest waits until something is compiled: a tenth of a short run.
"""

import pickle
from functools import cache
from typing import Any

import llvmlite.binding as llvm
from numba.core.caching import CompileResultCacheImpl
from numba.core.codegen import CodeLibrary, JITCodeLibrary
from numba.core.compiler import compile_result
from numba.core.environment import Environment
from numba.core.runtime import _nrt_python
from numba.core.serialize import dumps


def pack(compiled: Any) -> bytes:
    """Return what `unpack` takes, without the text that numba keeps for those who inspect types."""
    own, without = _anchored_here(compiled.environment), compiled._replace(type_annotation="")
    # The methods of numba's class take nothing from an instance, which would look for a folder.
    library, *rest, others = CompileResultCacheImpl.reduce(None, without._replace(environment=own))
    name, _, (machine_code, llvm_code) = library
    return pickle.dumps((dumps((name, *rest, tuple(map(_anchored_here, others)))), machine_code, llvm_code))


def unpack(content: bytes, target_context: Any) -> Any:
    """Return compiled code that is ready to run; raises anything if it is damaged or of another version."""
    reduced, machine_code, llvm_code = pickle.loads(content)
    name, described, environment, signature, objectmode, lifted, _, reload_init, others = pickle.loads(
        reduced
    )
    _offer_runtime()
    for initialize in reload_init:
        initialize()
    library = _LoadedLibrary(target_context.codegen(), name, machine_code, llvm_code)
    entry_point = target_context.get_executable(library, described, environment)
    for each in others:
        library.codegen.set_env(each.env_name, each)
    return compile_result(
        target_context=target_context,
        typing_context=target_context.typing_context,
        library=library,
        environment=environment,
        entry_point=entry_point,
        fndesc=described,
        signature=signature,
        objectmode=objectmode,
        lifted=lifted,
        reload_init=reload_init,
        referenced_envs=others,
    )


@cache
def _offer_runtime() -> None:
    """Tell LLVM where the functions of numba's runtime are that kernels call; the others are not compiled."""
    for name, address in _nrt_python.c_helpers.items():
        llvm.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


class _LoadedLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Machine code that runs, and the LLVM code that another kernel takes in."""

    def __init__(self, codegen: Any, name: str, machine_code: bytes, llvm_code: bytes) -> None:
        CodeLibrary.__init__(self, codegen, name)  # not that of its parent, which makes a module
        self._finalized = True
        self._get_module_for_linking = cache(lambda: llvm.parse_bitcode(llvm_code))
        codegen._engine._ee.add_object_file(llvm.ObjectFileRef.from_data(machine_code))
        codegen._engine.finalize_object()

    def get_pointer_to_function(self, name: str) -> int:
        """Return the address of a function."""
        return int(self.codegen._engine.get_function_address(name))


def _anchored_here(environment: Environment) -> Environment:
    """Return the constants of compiled code as those of this module.

    Whoever loads them imports the module that they name, for globals that code without Python objects does
    not read: by the functions of numba that kernels call, a quarter of numba.
    """
    anchored = Environment({"__name__": __name__})
    anchored.consts[:], anchored.env_name = environment.consts, environment.env_name
    return anchored
