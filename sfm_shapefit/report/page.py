"""report.html: one file that works offline.

Python says what is true, as one JSON value; the scripts in `assets` draw it. Three things keep names, which
come from strangers, from doing anything: the JSON has no "<", the script sets text and never HTML, and the
page's own security policy lets no script run but the one whose hash it names, and nothing be fetched.

The file stays small enough to be opened anywhere: numbers are base64 of float32, points are thinned, and of
more than `MAX_PAIRS` pairs the worst are listed and drawn. Histogram and matrix count all of them.
"""

import base64
import hashlib
import html
import json
import re
from collections.abc import Callable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray, quantile
from sfm_shapefit.base.record import plain
from sfm_shapefit.base.settings import flat_values
from sfm_shapefit.facts.command_options import LocateOptions, MapOptions
from sfm_shapefit.facts.control_points import describe_control_points
from sfm_shapefit.facts.model import FactsOfModel, JoinedFacts
from sfm_shapefit.facts.placed import Facts, GraphFacts, Piece
from sfm_shapefit.files.colmap.seed import PickedPoints
from sfm_shapefit.judgement.evidence import ModelEvidence
from sfm_shapefit.report.charts import (
    MOST_CELLS,
    pack_array,
    reprojection_error_bars,
    residual_histogram,
    residuals_of_states,
    track_length_bars,
    view_graph_matrix,
)
from sfm_shapefit.report.drawing import MAX_PAIRS, MAX_POINTS, Drawing, PairClass, input_centers
from sfm_shapefit.report.first_screen import banner, scene_name, tiles
from sfm_shapefit.report.matched import DrawnMatches
from sfm_shapefit.report.sentences import MAX_TEXT, Hint, first_looks, shorten, summary_sentences

_HIGH_TRUST = 0.95  # trust; the chart of trust leaves out cameras above, which need no look
_NOTED_SHARE = 0.05  # share of points that only two images see; less is not worth a word
_MAX_HINGES = 20  # hinges named per piece; locate.json has all
_STARTING_ITERATIONS = 2  # iterations left out of the chart; their objectives may be far out of scale
_MAX_ROWS = 200  # control points, lenses and loops listed, of each; locate.json has all
_AXES = "xyz"
_PAIRS_WORDS = (
    "A pair agrees or contradicts as a whole, by its direction; single matches fit or miss. pairs.csv says "
    "inlier and outlier; an outlier that is off by less than a degree agrees here."
)
_COLORS = {
    PairClass.AGREES: "blue agrees",
    PairClass.CONTRADICTS: "red contradicts",
    PairClass.REJECTED: "violet is rejected",
    PairClass.UNDETERMINED: "yellow cannot be judged",
    PairClass.NO_DIRECTION: "gray has no direction",
}
# In the order in which they make one script.
_SCRIPTS = ("core.js", "scene.js", "view.js", "tables.js", "charts.js", "page.js")


class Pictures(NamedTuple):
    """Small pictures of the images."""

    thumbnails: dict[int, str]
    """Data URLs by row of the cameras, as of `read_thumbnails`."""
    matches: DrawnMatches | None = None
    """Matches between them; None where there are none at hand."""


class Occasion(NamedTuple):
    """When and where a page is written."""

    out: str = "OUT"
    """What the next command calls the folder of the model, as the user typed it."""
    images: str = "IMAGES"
    """The same of the images."""
    day: str = ""


UNKNOWN = Occasion()
"""Where a page is written that nobody keeps."""


def write_report(
    drawing: Drawing,
    facts: Facts,
    path: Path,
    pictures: Pictures | None = None,
    occasion: Occasion = UNKNOWN,
) -> None:
    """Write the report of a result; see `report_html`."""
    path.write_text(report_html(drawing, facts, pictures, occasion), encoding="utf-8", newline="\n")


def report_html(
    drawing: Drawing, facts: Facts, pictures: Pictures | None = None, occasion: Occasion = UNKNOWN
) -> str:
    """Return the page, with pictures if there are some."""
    data, script = page_data(drawing, facts, pictures, occasion), _script()
    values = {
        "title": html.escape(f"{data['title']} \N{EN DASH} sfm_shapefit"),
        "hashes": f"'sha256-{_hash(script)}'",
        "style": _asset("page.css"),
        "data": _json(data),
        "script": script,
    }
    # In one pass, so that nothing inside a value is taken for a place holder.
    return re.sub(r"\{\{(\w+)\}\}", lambda found: values[found[1]], _asset("page.html"))


def page_data(
    drawing: Drawing, facts: Facts, pictures: Pictures | None = None, occasion: Occasion = UNKNOWN
) -> dict[str, Any]:
    """Return everything that the page shows, as JSON values; cameras and pairs stand worst first."""
    trust = drawing.cameras.trust
    # Cameras of unknown trust come last; where trust is equal, as it is shown, doubted ones come first, then
    # those whose pairs are off most.
    every = zip(drawing.cameras.names, drawing.cameras.reasons, strict=True)
    is_doubted = np.array([bool(reason) or name in facts.verdict.cameras for name, reason in every], np.bool_)
    errors_deg = np.nan_to_num(drawing.pairs.per_camera(len(trust))[1])
    cameras = np.lexsort((-errors_deg, ~is_doubted, np.round(np.nan_to_num(trust), 2), np.isnan(trust)))
    pairs = drawing.pairs.worst_first()[:MAX_PAIRS]
    reasons: dict[str, int] = {"": 0}
    rank = np.empty(len(cameras), dtype=np.int64)
    rank[cameras] = np.arange(len(cameras))
    display = _Display(drawing)
    residuals_deg = residuals_of_states(drawing.pairs)
    return {
        "title": scene_name(facts),
        "subtitle": _subtitle(facts),
        "day": occasion.day,
        "banner": {
            name: shorten(text, 1000)
            for name, text in banner(drawing, facts, occasion.out, occasion.images).items()
        },
        "tiles": tiles(drawing, facts),
        "summary": summary_sentences(drawing, facts),
        "expertFacts": [shorten(text, 4 * MAX_TEXT) for text in facts.expert_sentences()],
        "looks": [_look(hint, rank, pairs) for hint in first_looks(drawing, facts)],
        "noun": drawing.noun,
        "dimension": drawing.dimension,
        "shownAxes": min(drawing.dimension, len(_AXES)),
        "frustum": drawing.frustum_depth,
        "axes": drawing.axes.T.ravel().tolist(),
        "middle": display.middle.tolist(),
        "cameras": _cameras(drawing, cameras, display, reasons) | _doubts(drawing, facts, cameras, display),
        "pictures": [pictures.thumbnails.get(k) for k in cameras.tolist()] if pictures else None,
        "matches": _matches(pictures.matches, pairs) if pictures and pictures.matches else None,
        "pairs": _pairs(drawing, pairs, rank, reasons),
        "points": {
            "positions": pack_array(display(drawing.points.xyz), "f4"),
            "colors": pack_array(drawing.points.colors, "u1"),
        },
        "reasons": [shorten(text) for text in reasons],
        "sceneNote": _scene_note(drawing),
        "pairsNote": _pairs_note(drawing),
        "pairsWords": _PAIRS_WORDS if np.any(drawing.pairs.support > 0) else "",
        "hasSupport": bool(np.any(drawing.pairs.support > 0)),
        "highTrust": _HIGH_TRUST,
        "minTrust": float(facts.options.get("min_trust", 0.0)),
        "histogram": residual_histogram(residuals_deg),
        "tracks": track_length_bars(drawing.points.lengths),
        "reprojection": reprojection_error_bars(drawing.points.errors_px),
        "matrix": view_graph_matrix(drawing.pairs, rank),
        "convergence": _convergence(drawing),
        "notes": _notes(drawing, residuals_deg) | {"control": _control_note(facts)},
        "lenses": [[shorten(cell) for cell in lens] for lens in drawing.lenses[:_MAX_ROWS]],
        "fields": [
            {
                "label": shorten(field.label),
                "aspect": field.aspect,
                "places": pack_array(field.places, "f4"),
                "means": pack_array(field.means_px, "f4"),
                "statement": field.statement,
            }
            for field in drawing.fields
        ],
        "intrinsics": _cells(facts, "intrinsics", lambda lens: -abs(lens.change)),
        "control": _cells(facts, "control_points", lambda point: -(point.error or 0.0)),
        "bars": _cells(facts, "scale_bars", lambda bar: -abs(bar.error_sigmas or 0.0)),
        "loops": _cells(facts, "loops", lambda loop: (-loop.num_refused, -loop.num_matches)),
        "pieces": [_piece(k, piece) for k, piece in enumerate(facts.pieces)],
        "timings": [[name, f"{seconds:.2f} s"] for name, seconds in facts.timings_s.items()],
        "options": _options(facts.options),
        "versions": [
            [shorten(str(name)), shorten(_option(value), 400)]
            for name, value in (facts.versions | plain(facts.inputs)).items()
        ],
    }


class _Display:
    """The map to the page's axes: around the middle, x to the right and z up, and float32 is enough."""

    def __init__(self, drawing: Drawing) -> None:
        self._axes = drawing.axes
        centers = drawing.cameras.centers[drawing.cameras.placed]
        self.middle = np.median(centers, axis=0) if len(centers) else np.zeros(3)

    def __call__(self, points: FloatArray) -> FloatArray:
        """Return points (..., 3) in the page's axes."""
        return self.turn(points - self.middle)

    def turn(self, vectors: FloatArray) -> FloatArray:
        """Return vectors (..., 3) in the page's axes."""
        return np.asarray(vectors @ self._axes.T)


# --- columns ---------------------------------------------------------------------------------------


def _cameras(drawing: Drawing, order: IntArray, display: _Display, reasons: dict[str, int]) -> dict[str, Any]:
    cameras = drawing.cameras
    agreeing, errors = drawing.pairs.per_camera(len(order))
    aligned = drawing.input_is_aligned
    return {
        "names": [shorten(cameras.names[k]) for k in order.tolist()],
        "placed": pack_array(cameras.placed[order], "u1"),
        "trust": pack_array(cameras.trust[order], "f4"),
        "sigma": pack_array(cameras.sigmas[order], "f4"),
        "ellipsoids": pack_array(display.turn(cameras.ellipsoids[order]), "f4"),
        "degree": pack_array(cameras.degrees[order], "i4"),
        "agreeing": pack_array(agreeing[order], "i4"),
        "error": pack_array(errors[order], "f4"),
        "piece": pack_array(cameras.pieces[order], "i4"),
        "reason": _encode([cameras.reasons[k] for k in order.tolist()], reasons),
        "center": pack_array(display(cameras.centers[order]), "f4"),
        "frusta": pack_array(_frusta(drawing, order, display), "f4"),
        "ghost": pack_array(display(_ghosts(drawing)[order]), "f4"),
        "inputCenter": pack_array(display(cameras.poses.centers[order]), "f4") if aligned else None,
        "shift": pack_array(drawing.shifts()[order], "f4") if aligned else None,
        "further": [
            {"title": column.title, "hint": column.hint, "values": pack_array(column.values[order], "f4")}
            for column in drawing.further
        ],
    }


def _doubts(drawing: Drawing, facts: Facts, order: IntArray, display: _Display) -> dict[str, Any]:
    """Return which groups stand apart from the rest, and where else two sets of pairs put a camera."""
    evidence = facts.evidence if isinstance(facts, FactsOfModel) else ModelEvidence()
    row_of = {name: k for k, name in enumerate(drawing.cameras.names)}
    groups = np.full(len(row_of), -1)
    groups[[row_of[name] for name in getattr(evidence.second, "wrong", ())]] = len(evidence.apart)
    for k, names in sorted(enumerate(evidence.apart), key=lambda one: -len(one[1])):
        groups[[row_of[name] for name in names]] = k  # the smallest wins
    others, counts = np.full((len(row_of), 3), np.nan), np.zeros((len(row_of), 2))
    for place in evidence.places:
        row = row_of[place.image]
        others[row] = drawing.cameras.centers[row] + place.offset
        counts[row] = place.num_here, place.num_there
    return {
        "group": pack_array(groups[order], "i4"),
        "other": pack_array(display(others[order]), "f4"),
        "otherCounts": pack_array(counts[order], "i4"),
    }


def _frusta(drawing: Drawing, order: IntArray, display: _Display) -> FloatArray:
    """Return half the width, half the height, and the depth of pictures at distance 1, (n, 3, 3) in rows."""
    poses = drawing.cameras.poses
    vectors = display.turn(poses.rotations[order])
    vectors[:, :2] *= poses.half_sizes[order][:, :, None]
    return vectors


def _ghosts(drawing: Drawing) -> FloatArray:
    """Return where the input has the cameras that are not placed; NaN for others, or if it is not known."""
    centers = input_centers(drawing)
    if centers is None:
        return np.full((len(drawing.cameras.names), 3), np.nan)
    return np.where(drawing.cameras.placed[:, None], np.nan, centers)


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
        "first": pack_array(ends[:, 0], "i4"),
        "second": pack_array(ends[:, 1], "i4"),
        "verdict": pack_array(pairs.classes[order], "u1"),
        "support": pack_array(pairs.support[order], "i4"),
        "reason": _encode([pairs.reasons[k] for k in order.tolist()], reasons),
    } | {name: pack_array(values[order], "f4") for name, values in columns.items()}


def _matches(matches: DrawnMatches, listed: IntArray) -> dict[str, Any]:
    """Return the matches of pairs by their rows on the page, which are those `listed` of the drawing."""
    row_of = {pair: row for row, pair in enumerate(listed.tolist())}
    return {
        "pair": pack_array(np.array([row_of[pair] for pair in matches.pairs.tolist()]), "i4"),
        "counts": pack_array(matches.counts, "i4"),
        "drawn": pack_array(matches.drawn, "u1"),
        "places": pack_array(matches.places, "u2"),
    }


def _encode(texts: Sequence[str], known: dict[str, int]) -> dict[str, str]:
    """Return the numbers of texts, and add those that are new to the known ones."""
    return pack_array(np.array([known.setdefault(text, len(known)) for text in texts], dtype=np.int64), "i4")


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


def _cells(facts: Facts, table: str, order: Callable[[Any], Any]) -> list[list[str]]:
    """Return the cells of a table of the facts, sorted by `order`; empty where they have no such table."""
    rows = sorted(getattr(facts, table, ()), key=order)
    return [[shorten(cell) for cell in row.cells] for row in rows[:_MAX_ROWS]]


# --- words -----------------------------------------------------------------------------------------


def _subtitle(facts: Facts) -> str:
    dimensions = f", in {facts.dimension} dimensions" if isinstance(facts, GraphFacts) else ""
    path = ", ".join(facts.models) if isinstance(facts, JoinedFacts) else facts.inputs.path
    return shorten(path + dimensions, 400)


def _look(hint: Hint, rank: IntArray, pairs: IntArray) -> dict[str, Any]:
    """Return a hint with the rows of the page; a pair that is not listed is only told."""
    rows = np.flatnonzero(pairs == (-1 if hint.pair is None else hint.pair))
    return {
        "text": hint.text,
        "camera": None if hint.camera is None else int(rank[hint.camera]),
        "pair": int(rows[0]) if len(rows) else None,
    }


def _scene_note(drawing: Drawing) -> str:
    notes = [f"Cameras span {drawing.extent:.4g} units."]
    if not np.isfinite(drawing.cameras.poses.rotations[drawing.cameras.placed]).any():
        notes = [f"Nodes span {drawing.extent:.4g} units."]
    if drawing.dimension > len(_AXES):
        notes.append(f"The first three of {drawing.dimension} dimensions are drawn.")
    if drawing.points.num_all > len(drawing.points.xyz):
        notes.append(
            f"{len(drawing.points.xyz):,} of {drawing.points.num_all:,} points are drawn "
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


def _notes(drawing: Drawing, residuals_deg: Mapping[str, FloatArray]) -> dict[str, str]:
    return {
        "histogram": _histogram_note(residuals_deg),
        "tracks": _tracks_note(drawing.points),
        "reprojection": _reprojection_note(drawing.points),
        "trust": _trust_note(drawing),
        "matrix": _matrix_note(drawing),
        "support": _support_note(drawing),
        "convergence": _convergence_note(drawing),
        "loops": "Pairs far apart in their order are used where the images between agree.",
        "pieces": "Nothing fixes size and place of one piece against another; they share the cameras named.",
    }


def _control_note(facts: Facts) -> str:
    off = shorten(describe_control_points(getattr(facts, "control_points", ())))
    note = "The position in the model minus the known one; check points do not set scale and axes."
    return f"{off[:1].upper()}{off[1:]}. {note}"


def _trust_note(drawing: Drawing) -> str:
    trust = drawing.cameras.trust
    known = int(np.isfinite(trust).sum())
    high = int(np.sum(trust >= _HIGH_TRUST))
    if not known:
        return ""
    who = f"{high:,} of {known:,} {drawing.noun}s"
    sentence = f"{who} have a trust of {_HIGH_TRUST} or more (1 is as good as it gets)"
    return f"{sentence}; the least trusted others are shown." if high < known else f"{sentence}."


def _histogram_note(residuals_deg: Mapping[str, FloatArray]) -> str:
    if not residuals_deg:
        return "No pair has a residual."
    where = {"input": " at the input's positions", "optimum": " at the solver's optimum"}
    last = " as delivered" if len(residuals_deg) > 1 else ""
    medians = ", ".join(
        f"{np.median(values):.3g}°{where.get(state, last)}" for state, values in residuals_deg.items()
    )
    return f"Angle between what the matches of a pair say and where its cameras stand; median: {medians}."


def _tracks_note(points: PickedPoints) -> str:
    if not len(points.lengths):
        return ""
    share = float(np.mean(points.lengths <= 2))
    median = float(np.median(points.lengths))
    sentence = f"Number of images that see a 3D point; a bar reaches to the next. The median is {median:.3g}."
    weak = f" {share:.0%} are seen by two only: nothing checks these." if share >= _NOTED_SHARE else ""
    return f"{sentence}{weak}{_sample(points)}"


def _reprojection_note(points: PickedPoints) -> str:
    known = points.errors_px[np.isfinite(points.errors_px)]
    if not len(known):
        return ""
    median, high = quantile(known, 0.5), quantile(known, 0.9)
    return (
        f"Mean error of a 3D point over the images that see it: {median:.2g} px in the median, "
        f"{high:.2g} px or less for nine of ten.{_sample(points)}"
    )


def _sample(points: PickedPoints) -> str:
    if len(points.lengths) >= points.num_all:
        return ""
    return f" Counted over {len(points.lengths):,} points, evenly picked."


def _matrix_note(drawing: Drawing) -> str:
    cameras_per_cell = -(-len(drawing.cameras.names) // MOST_CELLS)
    if cameras_per_cell > 1:
        return f"{cameras_per_cell} cameras share a cell; the redder it is, the more of its pairs contradict."
    most = int(drawing.pairs.support.max(initial=0))
    strength = f" The stronger the color, the more matches fit the pair (up to {most:,})." if most else ""
    told = [name for kind, name in _COLORS.items() if np.any(drawing.pairs.classes == kind)]
    return f"{', '.join(told).capitalize()}.{strength}"


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


def _piece(k: int, piece: Piece) -> dict[str, Any]:
    hinges = [shorten(name, 60) for name in piece.hinges[:_MAX_HINGES]]
    if len(piece.hinges) > _MAX_HINGES:
        hinges.append(f"and {len(piece.hinges) - _MAX_HINGES:,} more")
    return {
        "number": k,
        "cameras": piece.num_cameras,
        "placed": piece.num_placed,
        "hinges": ", ".join(hinges),
        "scale": shorten(piece.scale),
        "folder": piece.folder,
    }


def _options(options: dict[str, Any]) -> dict[str, list[list[str]]]:
    """Return names and values, those that differ from the defaults apart."""
    defaults = flat_values(MapOptions() if "join" in options else LocateOptions())
    rows: dict[bool, list[list[str]]] = {True: [], False: []}
    for name, value in options.items():
        is_default = name in defaults and _option(defaults[name]) == _option(value)
        rows[is_default].append([shorten(name.replace("_", " ")), shorten(_option(value), 400)])
    return {"changed": rows[False], "unchanged": rows[True]}


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


def _script() -> str:
    """Return the scripts of the page as one, with a scope of its own."""
    parts = "\n".join(_asset(name) for name in _SCRIPTS)
    return f'(() => {{\n"use strict";\n{parts}}})();\n'
