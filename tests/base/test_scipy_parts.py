"""scipy's compiled functions without its packages: the same functions, and scipy can still be imported."""

import numpy as np
import pytest
from scipy.sparse import csc_array, random_array
from scipy.sparse.linalg import spilu, splu

from sfm_shapefit.laplacian import superlu
from tests.program import run_python

SCIPY = {"scipy.special", "scipy.linalg", "scipy.sparse", "scipy.spatial"}
OURS = (
    "rotations.average",
    "placement.diagnosis",
    "adjustment.iterative_factor",
    "files.colmap.priors",
    "files.nerf",
    "files.opensfm",
)
HEAVY = SCIPY | {"pydantic", "rich", "cvxpy", "multiprocessing.connection"}
HEAVY |= {f"sfm_shapefit.{name}" for name in OURS}
LOCATE = ["locate", "data_synthetic/courtyard/sparse/0", "{out}", "--quiet", "--threads", "1"]


def matrix(n=40):
    some = random_array((n, n), density=0.1, rng=1)
    return csc_array(some + some.T + 10.0 * np.diag(np.arange(1.0, n + 1.0)))


def test_what_locate_does_not_use_is_not_loaded(tmp_path):
    words = [word.format(out=tmp_path / "out") for word in LOCATE]
    code = f"import sys; sys.argv[1:] = {words!r}\nfrom sfm_shapefit.cli import main\ntry: main()\n"
    code += f"finally: print(*sorted({HEAVY!r} & set(sys.modules)))"
    done = run_python("-c", code)
    assert done.stdout == "\n", done.stderr


def test_scipy_can_be_imported_after_its_parts_and_has_the_same_functions():
    code = "import sys, sfm_shapefit.cli; from sfm_shapefit.base import scipy_parts as parts; "
    code += "print('scipy.special' in sys.modules); import scipy.special, scipy.linalg, scipy.sparse.linalg; "
    code += "print(scipy.special.expit is parts.expit, scipy.linalg.lapack.dpotrs is parts.dpotrs)"
    assert run_python("-c", code).stdout.split() == ["False", "True", "True"]


@pytest.mark.parametrize("is_there", [True, False])
def test_superlu_is_that_of_scipy(is_there, monkeypatch):
    if not is_there:
        monkeypatch.setattr(superlu, "compiled_module", lambda *_: None)
    a, right = matrix(), np.arange(40.0)
    places = (a.indices, np.repeat(np.arange(40), np.diff(a.indptr)))
    twice = (np.tile(places[0], 2), np.tile(places[1], 2)), np.concatenate([0.25 * a.data, 0.75 * a.data])
    np.testing.assert_array_equal(superlu.superlu(40, places, a.data).solve(right), splu(a).solve(right))
    np.testing.assert_allclose(superlu.superlu(40, *twice).solve(right), splu(a).solve(right), rtol=1e-12)
    order = superlu.superlu(40, places, a.data, order=True).perm_c
    expected = spilu(a, drop_tol=1.0, fill_factor=1.0, permc_spec="MMD_AT_PLUS_A").perm_c
    np.testing.assert_array_equal(order, expected)
    assert (order != splu(a).perm_c).any()
