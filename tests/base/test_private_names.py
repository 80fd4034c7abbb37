"""Private names of other packages: few, each known, and each still there as it was when it was last seen."""

import ast
import re
from importlib import import_module
from importlib.metadata import version

import numba
import pytest
from numba.core.registry import cpu_target

from harness.rooms import MODULES, tree_of


def count_references(number):
    return number + 1


def numba_keeps_its_cache_there():
    return hasattr(numba.njit(count_references), "_cache")


def numba_hands_code_to_it():
    engine = cpu_target.target_context.codegen()._engine
    return callable(engine._ee.add_object_file) and callable(engine.finalize_object)


def numba_names_its_runtime_there():
    return "MemInfo_call_dtor" in import_module("numba.core.runtime._nrt_python").c_helpers


def numba_takes_the_option():
    return numba.njit(_nrt=False)(count_references)(1) == 2


def scipy_has_ufuncs():
    return import_module("scipy.special._ufuncs").expit(0.0) == 0.5


def scipy_has_lapack():
    return callable(import_module("scipy.linalg._flapack").dpotrs)


def scipy_has_superlu():
    return callable(import_module("scipy.sparse.linalg._dsolve._superlu").gstrf)


SEEN = {
    "_cache": ("numba", "0.68.1", numba_keeps_its_cache_there),
    "_engine._ee": ("numba", "0.68.1", numba_hands_code_to_it),
    "_nrt_python": ("numba", "0.68.1", numba_names_its_runtime_there),
    "_nrt": ("numba", "0.68.1", numba_takes_the_option),
    "_ufuncs": ("scipy", "1.17.1", scipy_has_ufuncs),
    "_flapack": ("scipy", "1.17.1", scipy_has_lapack),
    "_dsolve._superlu": ("scipy", "1.17.1", scipy_has_superlu),
}
"""What is used, the package and the version in which it was last seen, and whether it is there."""

OF_NAMED_TUPLES = {"_make", "_replace", "_asdict", "_fields"}  # public, by Python's documentation
# Folders, variables, keys, endings: in strings; and a function of ours that the room below asks for.
OF_OURS = {"_kernels", "_claimed", "_cameras", "_offset", "_dense", "_load_writers", "_mapped", "_path"}


@pytest.mark.parametrize("name", SEEN)
def test_a_private_name_is_there(name):
    package, seen_in, is_there = SEEN[name]
    assert is_there(), f"{name}, seen in {package} {seen_in}, is not so in {package} {version(package)}"


def names_of(tree):
    """Return the private names that a module asks of others, and those that it defines."""
    asked, defined = set(), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and re.match(r"_[a-z]", node.attr):
            own = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
            (defined if own else asked).add(node.attr)
        elif isinstance(node, ast.ImportFrom) and not (node.module or "").startswith("sfm_shapefit"):
            asked |= {alias.name for alias in node.names if re.match(r"_[a-z]", alias.name)}
            asked |= {part for part in (node.module or "").split(".") if re.match(r"_[a-z]", part)}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            asked |= {part for part in node.value.split(".") if re.fullmatch(r"_[a-z]\w*", part)}
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            defined.add(node.name)
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            defined.add(node.target.id)
    return asked, defined


def test_no_other_private_name_is_used():
    names = zip(*(names_of(tree_of(path)) for path in MODULES), strict=True)
    asked, defined = (set().union(*sets) for sets in names)
    assert asked - defined - OF_NAMED_TUPLES - OF_OURS == {part for name in SEEN for part in name.split(".")}
