"""What the literature compares with: each a short module with its source, all on a `ViewGraph`.

Locators return (n, d) locations, centered, of unit Frobenius norm, and pointing the way the directions do.
Filters return (m,) whether a pair is kept; what they leave is a graph for any locator, ShapeFit's too.
"""

from sfm_shapefit.baselines.least_squares import locate_least_squares
from sfm_shapefit.baselines.linf import locate_linf
from sfm_shapefit.baselines.locators import FILTERS, LOCATORS, solve_baseline
from sfm_shapefit.baselines.lud import locate_lud
from sfm_shapefit.baselines.onedsfm import filter_1dsfm
from sfm_shapefit.pairs.triangles import filter_triangles

__all__ = [
    "FILTERS",
    "LOCATORS",
    "filter_1dsfm",
    "filter_triangles",
    "locate_least_squares",
    "locate_linf",
    "locate_lud",
    "solve_baseline",
]
