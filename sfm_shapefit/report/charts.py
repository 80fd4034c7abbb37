"""The numbers behind the charts that look at all pairs: residual histograms and the view-graph matrix."""

from dataclasses import dataclass

import numpy as np

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.report.drawing import PairClass, Pairs

# Smaller residuals count in the first bin.
_RANGE_DEG = (1e-3, 180.0)
_BINS = 42
MOST_CELLS = 200
"""Cells per side of the matrix; with more cameras, several share a cell."""
# Rank of each PairClass; a cell shows the worst of its pairs.
_UNBINNED_RANK = np.array([1, 4, 2, 3])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Histogram:
    """Residuals of the pairs that the solve used, in logarithmic bins."""

    edges_deg: FloatArray
    """(k + 1,)"""
    counts: dict[str, IntArray]
    """(k,) for each state of the locations, in the order in which they came about."""
    medians_deg: dict[str, float]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Matrix:
    """The view graph as a symmetric matrix; rows and columns are cameras in the order of cameras.csv."""

    cells: FloatArray
    """(k, k) With one camera a cell: 0 no pair, 1 agrees, 2 undetermined, 3 no direction, 4 contradicts. With
    several: the share of pairs that contradict the solution. NaN without a pair."""
    counts: IntArray
    """(k, k) pairs in each cell."""
    cameras_per_cell: int


def residual_histogram(pairs: Pairs) -> Histogram:
    """Return the residuals at the input's centers, at the convex optimum and at the output's centers.

    All count the same pairs: those with a residual at the output and, where it is known, at the optimum.
    """
    used = np.isfinite(pairs.residuals_deg)
    if np.isfinite(pairs.certified_deg).any():
        used &= np.isfinite(pairs.certified_deg)
    states = {
        "input": pairs.input_deg[used],
        "optimum": pairs.certified_deg[used],
        "output": pairs.residuals_deg[used],
    }
    known = {name: values[np.isfinite(values)] for name, values in states.items()}
    known = {name: values for name, values in known.items() if len(values)}
    edges = np.geomspace(*_RANGE_DEG, _BINS + 1)
    return Histogram(
        edges_deg=edges,
        counts={name: np.histogram(np.clip(v, *_RANGE_DEG), edges)[0] for name, v in known.items()},
        medians_deg={name: float(np.median(v)) for name, v in known.items()},
    )


def view_graph_matrix(pairs: Pairs, num_cameras: int) -> Matrix:
    """Return the matrix of pairs, of at most 200 x 200 cells."""
    per_cell = max(-(-num_cameras // MOST_CELLS), 1)
    side = -(-num_cameras // per_cell)
    i, j = (pairs.cameras // per_cell).T
    cells, counts = np.zeros((side, side)), np.zeros((side, side), dtype=np.int64)
    # A pair inside a cell counts once, any other in two cells.
    inside = i == j
    rows, columns = np.concatenate([i, j[~inside]]), np.concatenate([j, i[~inside]])
    classes = np.concatenate([pairs.classes, pairs.classes[~inside]])
    np.add.at(counts, (rows, columns), 1)
    if per_cell == 1:
        np.maximum.at(cells, (rows, columns), _UNBINNED_RANK[classes].astype(np.float64))
    else:
        np.add.at(cells, (rows, columns), (classes == PairClass.CONTRADICTS).astype(np.float64))
        cells = cells / np.maximum(counts, 1)
    return Matrix(cells=np.where(counts > 0, cells, np.nan), counts=counts, cameras_per_cell=per_cell)
