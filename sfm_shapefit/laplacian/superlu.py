"""SuperLU (Demmel, Eisenstat, Gilbert, Li, Liu 1999) by scipy, without scipy.sparse, which loads long."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.scipy_parts import compiled_module


def superlu(size: int, places: Sequence[IntArray], values: FloatArray, *, order: bool = False) -> Any:
    """Return SuperLU's factor of a sparse matrix, as `scipy.sparse.linalg.splu` does.

    Args:
        size: number of rows and of columns.
        places: rows and columns of the entries; those of one place are added.
        values: the entries.
        order: drop all that can be dropped, for `perm_c`, the order of least degree.
    """
    rows, columns = places
    choice: dict[str, Any] = dict.fromkeys(("DiagPivotThresh", "ColPerm", "PanelSize", "Relax"))
    if order:
        choice |= {"ILU_DropRule": None, "ILU_DropTol": 1.0, "ILU_FillFactor": 1.0}
        choice["ColPerm"] = "MMD_AT_PLUS_A"
    taken, entry_of = np.unique(columns * size + rows, return_inverse=True)
    sums = np.bincount(entry_of, values).astype(np.float64)
    columns, rows = np.divmod(taken, size)
    pointers = np.searchsorted(columns, np.arange(size + 1))
    parts = (sums, rows.astype(np.intc), pointers.astype(np.intc))
    try:
        factor = compiled_module("scipy.sparse.linalg._dsolve", "_superlu").gstrf
        return factor(size, len(sums), *parts, csc_construct_func=None, ilu=order, options=choice)
    except (ImportError, AttributeError, TypeError):  # another version of scipy
        from scipy.sparse import csc_array
        from scipy.sparse.linalg import spilu, splu

        matrix = csc_array(parts, shape=(size, size))
        if order:
            return spilu(matrix, drop_tol=1.0, fill_factor=1.0, permc_spec="MMD_AT_PLUS_A")
        return splu(matrix)
