"""The door to scipy's compiled functions, without the packages around them.

Importing scipy.special, scipy.linalg and scipy.sparse.linalg takes as long as placing a small scene: two
hundred modules are loaded and hundreds of docstrings rewritten. Their compiled modules load in a twentieth of
that, and in the program they are loaded alone. In a Python session, where others may import scipy too, scipy
loads them its own way, and so it does wherever they are not as expected.
"""

import sys
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType


def compiled_module(package: str, name: str) -> ModuleType:
    """Return a compiled module of a package of scipy, such as "scipy.linalg" and "cython_blas".

    Raises:
        ImportError: if scipy has none of that name.
    """
    names = package.split(".")
    parents = [".".join(names[: k + 1]) for k in range(len(names))]
    absent = [parent for parent in parents if parent not in sys.modules]
    whole = find_spec("scipy")
    if not absent or "sfm_shapefit.cli" not in sys.modules or whole is None or whole.origin is None:
        return import_module(f"{package}.{name}")
    root = whole.origin.removesuffix("/__init__.py")
    for parent in absent:
        standin = ModuleType(parent)
        standin.__path__ = ["/".join([root, *parent.split(".")[1:]])]
        sys.modules[parent] = standin
    try:
        return import_module(f"{package}.{name}")
    finally:
        for parent in absent:
            sys.modules.pop(parent, None)


def _functions(package: str, name: str, public: str) -> ModuleType:
    """Return a module that has functions: a compiled one, or else the public one that offers them too."""
    try:
        return compiled_module(package, name)
    except ImportError:
        return import_module(public)


_special = _functions("scipy.special", "_ufuncs", "scipy.special")
_lapack = _functions("scipy.linalg", "_flapack", "scipy.linalg.lapack")

expit, logit, gammaln, chdtri = _special.expit, _special.logit, _special.gammaln, _special.chdtri
xlogy = _special.xlogy
dpotrs, dgeqp3 = _lapack.dpotrs, _lapack.dgeqp3
