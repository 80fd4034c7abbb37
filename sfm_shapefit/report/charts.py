"""The charts that look at everything, as JSON values: histograms, and the view-graph matrix."""

import base64
import itertools
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import FloatArray, IntArray, quantile
from sfm_shapefit.report.drawing import PairClass, Pairs

_RANGE_DEG = (1e-3, 180.0)  # degrees from the first bin to the last; smaller residuals count in the first
_BINS = 42  # bins of the residuals; eight per decade
_TRACK_LENGTHS = np.array([2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 15, 20, 30, 50, 100])
"""Shortest track length of each bar, in images; long tracks are few, so that their bars are wide."""
_ERROR_BARS = 24  # bars of the reprojection errors; as many as are told apart at a glance
_ERROR_QUANTILE = 0.98  # quantile of the reprojection errors; all larger ones share the last bar
MOST_CELLS = 200
"""Cells per side of the matrix; with more cameras, several share a cell."""
_TYPES = {"f4": np.float32, "i4": np.int32, "u2": np.uint16, "u1": np.uint8}


def pack_array(values: npt.NDArray[Any], kind: str) -> dict[str, str]:
    """Return an array as base64 of little-endian numbers, which the page decodes."""
    raw = np.ascontiguousarray(values, dtype=np.dtype(_TYPES[kind]).newbyteorder("<")).tobytes()
    return {"type": kind, "bytes": base64.b64encode(raw).decode("ascii")}


def track_length_bars(lengths: IntArray) -> dict[str, Any] | None:
    """Return the histogram of track lengths, the numbers of images that see points (s,); None without points.

    Ticks are places, in bars from the left, and their text.
    """
    if not len(lengths):
        return None
    edges = _TRACK_LENGTHS[: int(np.searchsorted(_TRACK_LENGTHS, lengths.max(), side="right"))]
    bar_of = np.maximum(np.searchsorted(edges, lengths, side="right") - 1, 0)
    ends = [*(edges[1:] - 1).tolist(), int(lengths.max())]
    names = [
        str(low) if low == high else f"{low}-{high}" for low, high in zip(edges.tolist(), ends, strict=True)
    ]
    return {
        "counts": np.bincount(bar_of, minlength=len(edges)).tolist(),
        "texts": [f"seen by {name} images" for name in names],
        "ticks": [[k + 0.5, str(low)] for k, low in enumerate(edges.tolist())],
    }


def reprojection_error_bars(errors_px: FloatArray) -> dict[str, Any] | None:
    """Return the same of the points' mean errors in pixels (s,), NaN where not known; None if all are."""
    known = errors_px[np.isfinite(errors_px)]
    if not len(known):
        return None
    largest = max(float(quantile(known, _ERROR_QUANTILE)), 1e-6)
    power = 10.0 ** math.floor(math.log10(largest / _ERROR_BARS))
    width = next(part * power for part in (1, 2, 2.5, 5, 10) if part * power * _ERROR_BARS >= largest)
    bars = max(math.ceil(largest / width - 1e-9), 1)
    bar_of = np.minimum((known / width).astype(np.int64), bars)
    every = max(bars // 6, 1)
    edges = [f"{k * width:.3g}" for k in range(bars + 1)]
    texts = [f"{low} to {high} px" for low, high in itertools.pairwise(edges)]
    return {
        "counts": np.bincount(bar_of, minlength=bars + 1).tolist(),
        "texts": [*texts, f"{edges[-1]} px or more"],
        "ticks": [[float(k), edges[k]] for k in range(0, bars + 1, every)],
    }


def residuals_of_states(pairs: Pairs) -> dict[str, FloatArray]:
    """Return the residuals in degrees at the input's centers, at the convex optimum and at the output's.

    All are of the same pairs: those with a residual at the output and, where it is known, at the optimum.
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
    return {name: values for name, values in known.items() if len(values)}


def residual_histogram(residuals_deg: dict[str, FloatArray]) -> dict[str, Any]:
    """Return the edges of logarithmic bins in degrees, and how many residuals of each state are in each."""
    edges = np.geomspace(*_RANGE_DEG, _BINS + 1)
    counts = {
        name: np.histogram(np.clip(values, *_RANGE_DEG), edges)[0].tolist()
        for name, values in residuals_deg.items()
    }
    return {"edges": edges.tolist(), "counts": counts}


def view_graph_matrix(pairs: Pairs, rank: IntArray) -> dict[str, Any]:
    """Return the symmetric matrix of pairs, of at most 200 x 200 cells, in the order of cameras.csv.

    With several cameras a cell: how many pairs contradict the solution, and how many there are; with one, the
    listed pairs are all pairs. The rows of the cameras on the page are their `rank` (n,).
    """
    per_cell = max(-(-len(rank) // MOST_CELLS), 1)
    side = -(-len(rank) // per_cell)
    known = {"side": side, "perCell": per_cell, "rowOf": pack_array(rank, "i4")}
    if per_cell == 1:
        return known
    i, j = (pairs.cameras // per_cell).T
    # A pair inside a cell counts once, any other in two cells.
    cells = np.concatenate([i, j[i != j]]), np.concatenate([j, i[i != j]])
    against = np.append(pairs.classes, pairs.classes[i != j]) == PairClass.CONTRADICTS
    shown = {"against": against.astype(np.int64), "counts": np.ones(len(against), np.int64)}
    largest = np.iinfo(np.uint16).max
    for name, values in shown.items():
        sums = np.zeros((side, side), dtype=np.int64)
        np.add.at(sums, cells, values)
        known[name] = pack_array(np.minimum(sums, largest), "u2")
    return known
