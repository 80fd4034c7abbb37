"""report.html: one file that works offline, with plotly.js inside. The door to plotly.

Python says what is true, as one JSON value; `page/page.js` draws it. Three things keep names, which come from
strangers, from doing anything: the JSON has no "<", the script sets text and never HTML, and the page's own
security policy lets no script run but the two whose hashes it names, and nothing be fetched.

The file stays small enough to be opened anywhere: numbers are base64 of float32, points are thinned, and of
more than `MAX_PAIRS` pairs the worst are listed and drawn. Histogram and matrix count all of them.
"""

import base64
import hashlib
import html
import json
import re
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.report.charts import MOST_CELLS, residual_histogram, view_graph_matrix
from sfm_shapefit.report.drawing import MAX_POINTS, Drawing, PairClass, frustum_corners
from sfm_shapefit.report.sentences import Hint, first_looks, shorten, summary_sentences
from sfm_shapefit.results.tables import IN_MEMORY

MAX_PAIRS = 20_000
"""Pairs that the page lists and draws."""
# The chart of trust has at most so many bars.
_MAX_BARS = 400
# The box around the drawing has a margin of this share of its largest side, and no side is smaller than the
# other share of it.
_MARGIN = 0.03
_FLATTEST = 0.02
# So many hinges are named per piece.
_MAX_HINGES = 20
# The objectives of the first iterations may be far out of scale.
_STARTING_ITERATIONS = 2
_AXES = "xyz"
_TYPES = {"f8": np.float64, "f4": np.float32, "i4": np.int32, "u1": np.uint8}


def write_report(drawing: Drawing, facts: dict[str, Any], path: Path) -> None:
    """Write the report of a result; the facts are those of locate.json."""
    path.write_text(report_html(drawing, facts), encoding="utf-8", newline="\n")


def report_html(drawing: Drawing, facts: dict[str, Any]) -> str:
    """Return the page; the facts are those of locate.json."""
    data = page_data(drawing, facts)
    plotly, script = _plotly(), _asset("page.js")
    values = {
        "title": html.escape(f"{data['title']} \N{EN DASH} sfm_shapefit"),
        "hashes": " ".join(f"'sha256-{_hash(text)}'" for text in (plotly, script)),
        "style": _asset("page.css"),
        "data": _json(data),
        "plotly": plotly,
        "script": script,
    }
    # In one pass, so that nothing inside a value is taken for a place holder.
    return re.sub(r"\{\{(\w+)\}\}", lambda found: values[found[1]], _asset("page.html"))


def page_data(drawing: Drawing, facts: dict[str, Any]) -> dict[str, Any]:
    """Return everything that the page shows, as JSON values; cameras and pairs stand worst first."""
    trust = drawing.cameras.trust
    # Cameras of unknown trust come last.
    cameras = np.lexsort((trust, np.isnan(trust)))
    pairs = drawing.pairs.worst_first()[:MAX_PAIRS]
    reasons: dict[str, int] = {"": 0}
    rank = np.empty(len(cameras), dtype=np.int64)
    rank[cameras] = np.arange(len(cameras))
    display = _Display(drawing)
    histogram = residual_histogram(drawing.pairs)
    return {
        "title": _title(facts),
        "subtitle": _subtitle(facts),
        "tiles": _tiles(drawing, facts),
        "summary": summary_sentences(drawing, facts),
        "looks": [_look(hint, rank, pairs) for hint in first_looks(drawing, facts)],
        "dimension": drawing.dimension,
        "shownAxes": min(drawing.dimension, len(_AXES)),
        "frustum": drawing.frustum_depth,
        "box": [*display.low.tolist(), *display.high.tolist()],
        "cameras": _cameras(drawing, cameras, display, reasons),
        "pairs": _pairs(drawing, pairs, rank, reasons),
        "points": {
            "positions": _pack(display(drawing.points.positions), "f4"),
            "colors": _pack(drawing.points.colors, "u1"),
        },
        "reasons": [shorten(text) for text in reasons],
        "sceneNote": _scene_note(drawing),
        "pairsNote": _pairs_note(drawing),
        "hasSupport": bool(np.any(drawing.pairs.support > 0)),
        "trustOrder": list(range(min(int(np.isfinite(trust).sum()), _MAX_BARS))),
        "histogram": {
            "edges": histogram.edges_deg.tolist(),
            "counts": {state: values.tolist() for state, values in histogram.counts.items()},
        },
        "matrix": _matrix(drawing, rank),
        "convergence": _convergence(drawing),
        "notes": _notes(drawing, histogram.medians_deg),
        "pieces": [_piece(k, piece) for k, piece in enumerate(facts["pieces"])],
        "timings": [[name, f"{seconds:.2f} s"] for name, seconds in facts["timings_s"].items()],
        "options": [[name.replace("_", " "), _option(value)] for name, value in facts["options"].items()],
        "versions": [
            [shorten(str(name)), shorten(_option(value), 400)]
            for name, value in (facts["versions"] | facts["inputs"]).items()
        ],
    }


class _Display:
    """The map to the page's axes: around the middle, x to the right and z up, and float32 is enough."""

    def __init__(self, drawing: Drawing) -> None:
        self._axes = drawing.axes
        centers = drawing.cameras.centers[drawing.cameras.placed]
        drawn = np.concatenate([centers, drawing.points.positions, np.zeros((int(len(centers) == 0), 3))])
        self._middle = np.median(centers, axis=0) if len(centers) else np.zeros(3)
        inside = self(drawn)
        low, high = inside.min(axis=0), inside.max(axis=0)
        largest = float((high - low).max()) or 1.0
        half = np.maximum((high - low) / 2, _FLATTEST * largest) + _MARGIN * largest + drawing.frustum_depth
        self.low, self.high = (low + high) / 2 - half, (low + high) / 2 + half

    def __call__(self, points: FloatArray) -> FloatArray:
        """Return points (..., 3) in the page's axes."""
        shown: FloatArray = (points - self._middle) @ self._axes.T
        return shown


# --- columns ---------------------------------------------------------------------------------------


def _cameras(drawing: Drawing, order: IntArray, display: _Display, reasons: dict[str, int]) -> dict[str, Any]:
    cameras = drawing.cameras
    corners = frustum_corners(drawing, order, cameras.centers[order])
    shown = display(cameras.poses.centers[order]) if drawing.input_is_aligned else None
    return {
        "names": [shorten(cameras.names[k]) for k in order.tolist()],
        "placed": _pack(cameras.placed[order], "u1"),
        "trust": _pack(cameras.trust[order], "f4"),
        "sigma": _pack(np.where(np.isfinite(cameras.sigmas), cameras.sigmas, np.nan)[order], "f4"),
        "degree": _pack(cameras.degrees[order], "i4"),
        "piece": _pack(cameras.pieces[order], "i4"),
        "reason": _encode([cameras.reasons[k] for k in order.tolist()], reasons),
        "world": _pack(cameras.centers[order], "f8"),
        "center": _pack(display(cameras.centers[order]), "f4"),
        "corners": _pack(display(corners), "f4"),
        "inputCenter": None if shown is None else _pack(shown, "f4"),
    }


def _pairs(drawing: Drawing, order: IntArray, rank: IntArray, reasons: dict[str, int]) -> dict[str, Any]:
    pairs = drawing.pairs
    ends = rank[pairs.cameras[order]]
    columns = {
        "residual": pairs.residuals_deg,
        "certified": pairs.certified_deg,
        "input": pairs.input_deg,
        "weight": pairs.weights,
        "leverage": pairs.leverages,
        "dual": pairs.dual_norms,
    }
    return {
        "first": _pack(ends[:, 0], "i4"),
        "second": _pack(ends[:, 1], "i4"),
        "verdict": _pack(pairs.classes[order], "u1"),
        "support": _pack(pairs.support[order], "i4"),
        "reason": _encode([pairs.reasons[k] for k in order.tolist()], reasons),
    } | {name: _pack(values[order], "f4") for name, values in columns.items()}


def _encode(texts: Sequence[str], known: dict[str, int]) -> dict[str, str]:
    """Return the numbers of texts, and add those that are new to the known ones."""
    return _pack(np.array([known.setdefault(text, len(known)) for text in texts], dtype=np.int64), "i4")


def _pack(values: npt.NDArray[Any], kind: str) -> dict[str, str]:
    """Return an array as base64 of little-endian numbers, which the page decodes."""
    raw = np.ascontiguousarray(values, dtype=np.dtype(_TYPES[kind]).newbyteorder("<")).tobytes()
    return {"type": kind, "bytes": base64.b64encode(raw).decode("ascii")}


def _matrix(drawing: Drawing, rank: IntArray) -> dict[str, Any]:
    matrix = view_graph_matrix(drawing.pairs, len(rank))
    return {
        "side": len(matrix.cells),
        "perCell": matrix.cameras_per_cell,
        "cells": _pack(matrix.cells, "f4"),
        "counts": _pack(matrix.counts, "i4"),
        "rowOf": _pack(rank, "i4"),
    }


def _convergence(drawing: Drawing) -> dict[str, Any]:
    """Return the history; the axis leaves out the first iterations where those are far out of scale."""
    objectives = [objective for _, objective, _ in drawing.history]
    bounds = [bound for _, _, bound in drawing.history if bound is not None]
    shown = (objectives[_STARTING_ITERATIONS:] or objectives) + (bounds[_STARTING_ITERATIONS:] or bounds)
    margin = 0.1 * (max(shown) - min(shown)) if shown else 0.0
    return {
        "iterations": [iteration for iteration, _, _ in drawing.history],
        "objectives": objectives,
        "bounds": [bound for _, _, bound in drawing.history],
        "range": [min(shown) - margin, max(shown) + margin] if margin > 0.0 else None,
    }


# --- words -----------------------------------------------------------------------------------------


def _title(facts: dict[str, Any]) -> str:
    """Name the input: a model in memory, as of `map`, by the database that its matches come from."""
    inputs = facts["inputs"]
    model, database = inputs.get("model"), inputs.get("database")
    named = database if model == IN_MEMORY and database else model or inputs.get("graph")
    return shorten(str(named))


def _subtitle(facts: dict[str, Any]) -> str:
    inputs = facts["inputs"]
    directions = inputs.get("directions")
    origin = f"directions from {directions}; " if directions else f"{facts.get('dimension', 3)} dimensions; "
    return shorten(origin + f"{sum(facts['timings_s'].values()):.1f} s in all", 400)


def _tiles(drawing: Drawing, facts: dict[str, Any]) -> list[list[str]]:
    cameras, classes = drawing.cameras, drawing.pairs.classes
    trust = cameras.trust[cameras.placed]
    tiles = [
        [f"{int(cameras.placed.sum()):,} / {len(cameras.names):,}", "cameras placed"],
        [f"{int(np.sum(classes == PairClass.AGREES)):,} / {len(classes):,}", "pairs agree"],
        [f"{facts['residual_level_deg']:.2g}°", "level of the residuals"],
    ]
    observations = facts.get("agreement", {}).get("observations")
    if observations is not None:
        tiles.append([f"{observations:.0%}", "of the observations see a point"])
    if np.isfinite(trust).any():
        tiles.append([f"{np.nanmin(trust):.2f}", f"least trust, median {np.nanmedian(trust):.2f}"])
    if drawing.points.num_all:
        error = facts.get("mean_reprojection_error_px")
        mean = f", mean error {error:.2f} px" if error is not None and np.isfinite(error) else ""
        tiles.append([f"{drawing.points.num_all:,}", f"points{mean}"])
    return tiles


def _look(hint: Hint, rank: IntArray, pairs: IntArray) -> dict[str, Any]:
    """Return a hint with the rows of the page; a pair that is not listed is only told."""
    found = np.flatnonzero(pairs == (-1 if hint.pair is None else hint.pair))
    return {
        "text": hint.text,
        "camera": None if hint.camera is None else int(rank[hint.camera]),
        "pair": int(found[0]) if len(found) else None,
    }


def _scene_note(drawing: Drawing) -> str:
    notes = [
        f"Cameras span {drawing.extent:.4g} units; frusta are drawn {drawing.frustum_depth:.2g} units deep."
    ]
    if not np.isfinite(drawing.cameras.poses.rotations[drawing.cameras.placed]).any():
        notes = [f"Nodes span {drawing.extent:.4g} units."]
    if drawing.dimension > len(_AXES):
        notes.append(f"The first three of {drawing.dimension} dimensions are drawn.")
    if drawing.points.num_all > len(drawing.points.positions):
        notes.append(
            f"{len(drawing.points.positions):,} of {drawing.points.num_all:,} points are drawn "
            f"(at most {MAX_POINTS:,}, without those far outside)."
        )
    return " ".join([*notes, _pairs_note(drawing)]).strip()


def _pairs_note(drawing: Drawing) -> str:
    total = len(drawing.pairs.classes)
    if total <= MAX_PAIRS:
        return ""
    return (
        f"Of {total:,} pairs the worst {MAX_PAIRS:,} are drawn and listed here: those that contradict the "
        "solution, then those that cannot be judged, then the largest residuals. pairs.csv has all."
    )


def _notes(drawing: Drawing, medians_deg: dict[str, float]) -> dict[str, str]:
    """Return what stands under each chart."""
    known = int(np.isfinite(drawing.cameras.trust).sum())
    return {
        "histogram": _histogram_note(medians_deg),
        "trust": f"The {_MAX_BARS} least trusted of {known:,} cameras." if known > _MAX_BARS else "",
        "matrix": _matrix_note(-(-len(drawing.cameras.names) // MOST_CELLS)),
        "support": _support_note(drawing),
        "convergence": _convergence_note(drawing),
        "pieces": "Directions fix neither scale nor place of one piece against another; a hinge is a camera "
        "that two pieces share.",
    }


def _histogram_note(medians_deg: dict[str, float]) -> str:
    if not medians_deg:
        return "No pair has a residual."
    where = {
        "input": "at the input's centers",
        "optimum": "at the convex optimum",
        "output": "at the output's centers",
    }
    medians = ", ".join(f"{value:.3g}° {where[state]}" for state, value in medians_deg.items())
    return f"Angle between each measured direction and its baseline; medians: {medians}."


def _matrix_note(cameras_per_cell: int) -> str:
    if cameras_per_cell > 1:
        return (
            f"{cameras_per_cell} cameras share a cell; its color is the share of its pairs that contradict "
            "the solution."
        )
    return "Blue agrees, red contradicts, yellow cannot be judged, gray has no direction."


def _support_note(drawing: Drawing) -> str:
    if not np.any(drawing.pairs.support > 0):
        return "A bare graph does not say how many matches a pair has."
    listed = " Shown are the listed pairs." if len(drawing.pairs.classes) > MAX_PAIRS else ""
    return f"Wrong pairs with many matches are repeated structure or wrong rotations.{listed}"


def _convergence_note(drawing: Drawing) -> str:
    if not drawing.history:
        return "The iterations of this solve were not recorded."
    if any(bound is not None for _, _, bound in drawing.history):
        return "The bound proves that no placement has a lower objective; it is certified anew at the end."
    return "The splitting method has no bound on the way; its certificate is computed at the end."


def _piece(k: int, piece: dict[str, Any]) -> dict[str, Any]:
    hinges = [shorten(name, 60) for name in piece["hinges"][:_MAX_HINGES]]
    if len(piece["hinges"]) > _MAX_HINGES:
        hinges.append(f"and {len(piece['hinges']) - _MAX_HINGES:,} more")
    return {
        "number": k,
        "cameras": piece["num_cameras"],
        "placed": piece["num_placed"],
        "hinges": ", ".join(hinges),
        "scale": shorten(piece["scale"]),
        "folder": piece["folder"],
    }


def _option(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "none" if value is None or value == "" else str(value)


# --- the file --------------------------------------------------------------------------------------


def _json(data: dict[str, Any]) -> str:
    """Return JSON in ASCII without "<", so that nothing in it can end the script element."""
    return json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _hash(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")


def _asset(name: str) -> str:
    """Return a file of the page, with the line ends that browsers hash."""
    return (files("sfm_shapefit.report") / "assets" / name).read_text(encoding="utf-8").replace("\r\n", "\n")


@cache
def _plotly() -> str:
    """Return plotly.js."""
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs())
