"""The numbers behind the charts that look at everything: histograms, and the view-graph matrix."""

import itertools
import math
from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.report.drawing import PairClass, Pairs

_RANGE_DEG = (1e-3, 180.0)  # degrees from the first bin to the last; smaller residuals count in the first
_BINS = 42  # bins of the residuals; eight per decade
_TRACK_LENGTHS = np.array([2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 15, 20, 30, 50, 100])
"""Shortest track length of each bar, in images; long tracks are few, so that their bars are wide."""
_ERROR_BARS = 24  # bars of the reprojection errors; as many as are told apart at a glance
_ERROR_QUANTILE = 0.98  # quantile of the reprojection errors; all larger ones share the last bar
MOST_CELLS = 200
"""Cells per side of the matrix; with more cameras, several share a cell."""
_UNBINNED_RANK = np.array([1, 4, 2, 3])  # rank of each PairClass; a cell shows the worst of its pairs


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bars:
    """A histogram of bars of one width, whatever they hold."""

    counts: IntArray
    """(k,)"""
    texts: tuple[str, ...]
    """What each bar holds."""
    ticks: tuple[tuple[float, str], ...]
    """Places, in bars from the left, and their text."""


def track_length_bars(lengths: IntArray) -> Bars | None:
    """Return the histogram of track lengths; None if there are no points.

    Args:
        lengths: (s,) number of images that see each point.
    """
    if not len(lengths):
        return None
    edges = _TRACK_LENGTHS[: int(np.searchsorted(_TRACK_LENGTHS, lengths.max(), side="right"))]
    bar_of = np.maximum(np.searchsorted(edges, lengths, side="right") - 1, 0)
    ends = [*(edges[1:] - 1).tolist(), int(lengths.max())]
    names = [
        str(low) if low == high else f"{low}-{high}" for low, high in zip(edges.tolist(), ends, strict=True)
    ]
    return Bars(
        counts=np.bincount(bar_of, minlength=len(edges)),
        texts=tuple(f"seen by {name} images" for name in names),
        ticks=tuple((k + 0.5, str(low)) for k, low in enumerate(edges.tolist())),
    )


def reprojection_error_bars(errors_px: FloatArray) -> Bars | None:
    """Return the histogram of the points' errors in pixels; None if none is known.

    Args:
        errors_px: (s,) mean reprojection error of each point; NaN where it is not known.
    """
    known = errors_px[np.isfinite(errors_px)]
    if not len(known):
        return None
    largest = max(float(np.quantile(known, _ERROR_QUANTILE)), 1e-6)
    power = 10.0 ** math.floor(math.log10(largest / _ERROR_BARS))
    width = next(part * power for part in (1, 2, 2.5, 5, 10) if part * power * _ERROR_BARS >= largest)
    bars = max(math.ceil(largest / width - 1e-9), 1)
    bar_of = np.minimum((known / width).astype(np.int64), bars)
    every = max(bars // 6, 1)
    edges = [f"{k * width:.3g}" for k in range(bars + 1)]
    texts = [f"{low} to {high} px" for low, high in itertools.pairwise(edges)]
    return Bars(
        counts=np.bincount(bar_of, minlength=bars + 1),
        texts=(*texts, f"{edges[-1]} px or more"),
        ticks=tuple((float(k), edges[k]) for k in range(0, bars + 1, every)),
    )


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
