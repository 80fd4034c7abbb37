"""Compiled code as it is kept on disk: packed into bytes, and made ready to run again.

numba's own loader first sets up all that is needed to compile a kernel, and reads the kernel's LLVM code, of
use to other kernels only. Here both wait until something is compiled: that takes a quarter of the time. It
rests on parts of numba that are not public; where they are not as expected, numba loads the kernel its way.
"""

import io
import pickle
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import llvmlite.binding as llvm
from numba.core.codegen import CodeLibrary, JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult
from numba.core.environment import Environment
from numba.core.registry import cpu_target
from numba.core.runtime import rtsys
from numba.core.serialize import dumps

# Symbols of string hashes in sets and dictionaries: numba defines them when it is ready to compile.
_NEEDS_COMPILER = b"_numba_hashsecret"


class LoadedLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Machine code from a file, whose LLVM code is read when another kernel takes it in."""

    _shared_module: Any

    @classmethod
    def load(cls, codegen: Any, name: str, machine_code: bytes, llvm_code: bytes) -> "LoadedLibrary":
        """Return a library that is ready to run."""
        library = cls.__new__(cls)
        CodeLibrary.__init__(library, codegen, name)  # numba's own sets up a module to compile
        library._linking_libraries, library._shared_module, library._finalized = [], None, True
        library._reload_init = set()  # which numba before 0.68 does not make there
        engine = codegen._engine._ee
        engine.add_object_file(llvm.ObjectFileRef.from_data(machine_code))
        engine.finalize_object()
        library._llvm_code = llvm_code
        return library

    def get_pointer_to_function(self, name: str) -> Any:
        """Return the address of a function of this library."""
        return self._codegen._engine.get_function_address(name)

    def _get_module_for_linking(self) -> Any:
        """Return the LLVM code, for a kernel that is being compiled."""
        if self._shared_module is None:
            self._shared_module = llvm.parse_bitcode(self._llvm_code)
            self._codegen._engine._load_defined_symbols(self._shared_module)
        return self._shared_module


class InnerLibrary(JITCodeLibrary):  # type: ignore[misc]
    """LLVM code of a function that only kernels call: they take it in, and optimize it with their own."""

    def _optimize_functions(self, module: Any) -> None:
        """Leave the code as it is, for the processor's layout of data."""
        module.data_layout = self._codegen._data_layout

    def finalize(self) -> None:
        """Take in what the function calls; nothing is made of it but room for the addresses of constants."""
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        room = self._codegen._create_empty_module(f"{self.name}.constants")
        for variable in self._final_module.global_variables:
            if variable.name.startswith("_ZN08NumbaEnv"):
                cpu_target.target_context.declare_env_global(room, variable.name)
        self._codegen._engine.add_module(llvm.parse_assembly(str(room)))
        self._finalized = True


class InnerCompiler(Compiler):  # type: ignore[misc]
    """Compiles functions that only kernels call."""

    def define_pipelines(self) -> list[Any]:
        """Return numba's own steps, whose result is an `InnerLibrary`."""
        codegen, name = self.state.targetctx.codegen(), self.state.func_id.func_qualname
        self.state.library = InnerLibrary(codegen, name)
        return list(super().define_pipelines())


class _Reader(pickle.Unpickler):
    """Reads what `pack` writes; modules of numba's functions, which code does not need, are not imported."""

    def find_class(self, module_name: str, name: str) -> Any:
        """Return an object of a module."""
        value = super().find_class(module_name, name)
        is_environment = (module_name, name) == ("numba.core.environment", "_rebuild_env")
        return partial(_environment, value) if is_environment else value


def _environment(rebuild: Callable[..., Any], module_name: str, constants: list[Any], name: str) -> Any:
    """Return the constants that a compiled function needs, as numba's `rebuild` does."""
    environments = getattr(Environment, "_memo", None)
    if environments is None or name in environments or module_name in sys.modules:
        return rebuild(module_name, constants, name)
    environment = Environment({"__name__": module_name})
    environment.consts[:] = constants
    environment.env_name = name
    environments[name] = environment
    return environment


def pack(compiled: Any) -> bytes:
    """Return what `unpack` takes, without the text that numba keeps for those who inspect types."""
    return bytes(dumps(compiled._replace(type_annotation="")._reduce()))


def unpack(content: bytes, target_context: Any) -> Any:
    """Return compiled code that is ready to run; raises anything if it is damaged or of another version."""
    reduced = _Reader(io.BytesIO(content)).load()
    try:
        return _load(target_context, reduced)
    except Exception:  # whatever another version of numba does
        target_context.refresh()
        return CompileResult._rebuild(target_context, *reduced)


def _load(target_context: Any, reduced: tuple[Any, ...]) -> Any:
    """Do what `CompileResult._rebuild` does; ValueError if the code needs more than is set up here."""
    (
        (name, kind, (machine_code, llvm_code)),
        description,
        environment,
        signature,
        is_object_mode,
        lifted,
        type_annotation,
        initializers,
        environments,
    ) = reduced
    if kind != "object" or initializers or _NEEDS_COMPILER in machine_code:
        raise ValueError("this code is for numba to load")
    rtsys.initialize(target_context)
    library = LoadedLibrary.load(target_context.codegen(), name, machine_code, llvm_code)
    function = target_context.get_executable(library, description, environment)
    for each in environments:
        library.codegen.set_env(each.env_name, each)
    return CompileResult(
        target_context=target_context,
        typing_context=target_context.typing_context,
        library=library,
        environment=environment,
        entry_point=function,
        fndesc=description,
        type_annotation=type_annotation,
        signature=signature,
        objectmode=is_object_mode,
        lifted=lifted,
        typing_error=None,
        call_helper=None,
        metadata=None,
        reload_init=initializers,
        referenced_envs=environments,
    )
