"""What the literature compares with: each a short module with its source, all on a `ViewGraph`.

Locators return (n, d) locations, centred, of unit Frobenius norm, and pointing the way the directions do.
Filters return (m,) whether a pair is kept; what they leave is a graph for any locator, ShapeFit's too.
"""

from collections.abc import Callable

from sfm_shapefit.arrays import BoolArray, FloatArray
from sfm_shapefit.baselines.least_squares import locate_least_squares
from sfm_shapefit.baselines.linf import locate_linf
from sfm_shapefit.baselines.lud import locate_lud
from sfm_shapefit.baselines.onedsfm import filter_1dsfm
from sfm_shapefit.baselines.triangles import filter_triangles
from sfm_shapefit.viewgraph import ViewGraph

__all__ = [
    "FILTERS",
    "LOCATORS",
    "filter_1dsfm",
    "filter_triangles",
    "locate_least_squares",
    "locate_linf",
    "locate_lud",
]

LOCATORS: dict[str, Callable[[ViewGraph], FloatArray]] = {
    "least-squares": locate_least_squares,
    "linf": locate_linf,
    "lud": locate_lud,
}
"""By the name that command lines use."""

FILTERS: dict[str, Callable[[ViewGraph], BoolArray]] = {
    "1dsfm": filter_1dsfm,
    "triangles": filter_triangles,
}
"""By the name that command lines use."""
