"""A baseline's answer in the form of a solver's result, so that the same reports can be written of it.

Its certificate is the trivial one: y = 0 is dual feasible and proves that no objective is below 0.
"""

import time

import numpy as np

from sfm_shapefit.baselines.locators import LOCATORS
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.solver.options import SolverResult, Status
from sfm_shapefit.solver.program import projected_length
from sfm_shapefit.solver.solve import uncertified
from sfm_shapefit.viewgraph import ViewGraph


def solve_baseline(graph: ViewGraph, name: str) -> SolverResult:
    """Return the locations of a baseline in ShapeFit's scale, with status NOT_SOLVED.

    Args:
        graph: connected and parallel rigid.
        name: a key of `LOCATORS`.

    Raises:
        UnsolvableError: if the baseline finds no locations that point the way the directions do.
    """
    start = time.perf_counter()
    located = LOCATORS[name](graph)
    if not (np.isfinite(located).all() and projected_length(graph, located) > 0.0):
        raise UnsolvableError(
            f"{name} found no finite locations; check the directions, or choose --objective auto"
        )
    reason = "as asked; ShapeFit was not solved, so nothing certifies these locations"
    return uncertified(graph, located, Status.NOT_SOLVED, name, reason, start)
