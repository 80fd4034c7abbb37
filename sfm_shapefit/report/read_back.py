"""Drawings of results in memory and of output folders."""

import csv
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.atomic_folder import MAP_MARKER, MARKER
from sfm_shapefit.colmap.model import PosedModel, read_model
from sfm_shapefit.errors import InputError
from sfm_shapefit.formats.lines import refuse_irregular_file
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.report.drawing import Drawing, build_drawing
from sfm_shapefit.results.result import GraphResult, LocateResult
from sfm_shapefit.results.tables import CameraRow, PairRow, axis_names


def draw_model(found: LocateResult) -> Drawing:
    """Return the drawing of a placed model."""
    return build_drawing(
        found.cameras,
        found.pairs,
        model=found.model,
        original=found.model,
        turn=found.gauge.axes,
        points=found.reconstruction,
        certified=_certified(found.placement, len(found.cameras)),
        input_is_aligned=found.gauge.scale == "input",
        history=_history(found.placement),
    )


def draw_graph(found: GraphResult) -> Drawing:
    """Return the drawing of a placed bare graph."""
    return build_drawing(
        found.cameras,
        found.pairs,
        certified=_certified(found.placement, len(found.cameras)),
        dimension=found.placement.graph.dimension,
        history=_history(found.placement),
    )


def _certified(placement: Placement, num_rows: int) -> FloatArray:
    """Return the certified optimum by camera, NaN for those that it does not place."""
    locations = np.full((num_rows, placement.graph.dimension), np.nan)
    cameras = placement.cameras
    locations[cameras] = placement.certified.locations[: len(cameras)]
    return locations


def _history(placement: Placement) -> list[tuple[int, float, float | None]]:
    return [(info.iteration, info.objective, info.dual_bound) for info in placement.history]


def read_output(folder: Path) -> tuple[Drawing, dict[str, Any]]:
    """Return the drawing of an output folder, and the contents of its locate.json.

    The convex optimum and its iterations are not in the files, and the input's centres only where the input
    still is where it was.

    Raises:
        InputError: if it is no output of `locate` or `solve`, or its files are damaged.
    """
    if (folder / MAP_MARKER).is_file():
        raise InputError(f"{folder} holds the models of map; give one of them, such as {folder / '0'}")
    if not (folder / MARKER).is_file():
        raise InputError(f"{folder} has no {MARKER}; give a folder that locate or solve wrote")
    try:
        facts = json.loads((folder / MARKER).read_text(encoding="utf-8"))
        dimension = int(facts.get("dimension", 3))
        axes = axis_names(dimension)
        cameras = [_camera_row(cells, axes) for cells in _read_csv(folder / "cameras.csv")]
        pairs = [_pair_row(cells, axes) for cells in _read_csv(folder / "pairs.csv")]
        model = None if "graph" in facts["inputs"] else read_model(folder)
        drawing = build_drawing(
            cameras,
            pairs,
            model=model,
            original=None if model is None else _input_of(facts),
            points=None if model is None else model.reconstruction,
            input_is_aligned=str(facts.get("scale", "")).startswith("input:"),
            dimension=dimension,
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError, csv.Error) as error:
        raise InputError(
            f"the files of {folder} are damaged or of another version ({error}); run locate again"
        ) from error
    return drawing, facts


def _input_of(facts: dict[str, Any]) -> PosedModel | None:
    """Return the input, if it can still be read."""
    path = Path(facts["inputs"]["model"])
    try:
        return read_model(path) if path.is_dir() else None
    except InputError:
        return None


def _read_csv(path: Path) -> Iterator[dict[str, str]]:
    refuse_irregular_file(path)
    with path.open(newline="", encoding="utf-8") as stream:
        yield from csv.DictReader(stream)


def _camera_row(cells: dict[str, str], axes: Sequence[str]) -> CameraRow:
    return CameraRow(
        name=cells["name"],
        placed=cells["placed"] == "true",
        reason=cells["reason"],
        piece=int(cells["piece"]) if cells["piece"] else None,
        center=_vector(cells, axes, ""),
        degree=int(cells["degree"]),
        trust=_number(cells["trust"]),
        sigma=_vector(cells, axes, "sigma_"),
    )


def _pair_row(cells: dict[str, str], axes: Sequence[str]) -> PairRow:
    return PairRow(
        name1=cells["name1"],
        name2=cells["name2"],
        direction=_vector(cells, axes, "v"),
        support=int(cells["support"]),
        weight=_number(cells["weight"]),
        residual_deg=_number(cells["residual_deg"]),
        dual_norm=_number(cells["dual_norm"]),
        leverage=_number(cells["leverage"]),
        verdict=cells["verdict"],
        reason=cells["reason"],
    )


def _vector(cells: dict[str, str], axes: Sequence[str], prefix: str) -> tuple[float, ...]:
    """Return the numbers of a vector's columns; nothing where one is empty."""
    values = [cells[f"{prefix}{axis}"] for axis in axes]
    return tuple(map(float, values)) if all(values) else ()


def _number(cell: str) -> float:
    return float(cell) if cell else float("nan")
