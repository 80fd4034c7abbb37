"""The baselines by the names that command lines use."""

from collections.abc import Callable

from sfm_shapefit.arrays import BoolArray, FloatArray
from sfm_shapefit.baselines.least_squares import locate_least_squares
from sfm_shapefit.baselines.linf import locate_linf
from sfm_shapefit.baselines.lud import locate_lud
from sfm_shapefit.baselines.onedsfm import filter_1dsfm
from sfm_shapefit.directions.triangles import filter_triangles
from sfm_shapefit.viewgraph import ViewGraph

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
