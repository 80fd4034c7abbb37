"""The baselines by the names that command lines use, and their answers in the form of a solver's result.

The certificate of such an answer is the trivial one: y = 0 is dual feasible and proves that no objective is
below 0.
"""

import time
from collections.abc import Callable

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, frozen
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.baselines.least_squares import locate_least_squares
from sfm_shapefit.baselines.linf import locate_linf
from sfm_shapefit.baselines.lud import locate_lud
from sfm_shapefit.baselines.onedsfm import filter_1dsfm
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.pairs.triangles import filter_triangles
from sfm_shapefit.solver.options import SolverResult, Status
from sfm_shapefit.solver.program import normalize_locations, objective, projected_length

LOCATORS: dict[str, Callable[[ViewGraph], FloatArray]] = {
    "least-squares": locate_least_squares,
    "linf": locate_linf,
    "lud": locate_lud,
}
"""What turns a graph into locations (n, d)."""

FILTERS: dict[str, Callable[[ViewGraph], BoolArray]] = {
    "1dsfm": filter_1dsfm,
    "triangles": filter_triangles,
}
"""What says which pairs (m,) to keep."""


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
    locations = normalize_locations(graph, located)
    return SolverResult(
        locations=frozen(locations),
        status=Status.NOT_SOLVED,
        objective=objective(graph, locations),
        dual_bound=0.0,
        dual=frozen(np.zeros_like(graph.directions)),
        equality_residual=0.0,
        unique=None,
        iterations=0,
        seconds=time.perf_counter() - start,
        method=name,
        method_reason="as asked; ShapeFit was not solved, so nothing certifies these locations",
    )
