"""Drawings of results in memory and of output folders."""

import csv
import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from sfm_shapefit.base.atomic_folder import MAP_MARKER, MARKER
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.facts.model import FactsOfModel, read_facts
from sfm_shapefit.facts.placed import Facts, GraphFacts
from sfm_shapefit.facts.result import GraphResult, LocateResult
from sfm_shapefit.facts.tables import CameraRow, PairRow, read_rows
from sfm_shapefit.files.colmap.model import ColmapModel, read_model
from sfm_shapefit.report.drawing import Drawing, build_drawing, poses_of


def draw_result(found: LocateResult | GraphResult) -> Drawing:
    """Return the drawing of a placed model or bare graph."""
    placement, poses, points = found.placement, None, None
    if isinstance(found, LocateResult):
        poses, points = poses_of(found.images, [row.name for row in found.cameras]), found.reconstruction
        if found.gauge.axes is not None:
            poses = replace(poses, rotations=poses.rotations @ found.gauge.axes.T)
    # NaN stands for the cameras that the certified optimum does not place.
    certified = np.full((len(found.cameras), placement.graph.dimension), np.nan)
    certified[placement.cameras] = placement.certified.locations[: len(placement.cameras)]
    return replace(
        build_drawing(found.cameras, found.pairs, poses=poses, points=points, certified=certified),
        dimension=placement.graph.dimension,
        input_is_aligned=isinstance(found, LocateResult) and found.gauge.scale == "input",
        history=tuple((info.iteration, info.objective, info.dual_bound) for info in placement.history),
    )


def draw_model(model: ColmapModel) -> Drawing:
    """Return the drawing of a model's posed images and points, without pairs and trust."""
    centers = zip(model.images.names, model.images.centers.tolist(), strict=True)
    rows = [CameraRow(name=name, placed=True, center=tuple(center)) for name, center in centers]
    return build_drawing(
        rows, [], poses=poses_of(model.images, model.images.names), points=model.reconstruction
    )


def read_output(folder: Path) -> tuple[Drawing, Facts]:
    """Return the drawing of an output folder, and the contents of its locate.json.

    The convex optimum and its iterations are not in the files, and the input's centers only where the input
    still is where it was.

    Raises:
        InputError: if it is no output of `locate` or `place`, or its files are damaged.
    """
    if not folder.exists():
        raise InputError(f"the folder {folder} does not exist")
    if (folder / MAP_MARKER).is_file():
        raise InputError(f"{folder} holds the models of map; give one of them, such as {folder / '0'}")
    if not (folder / MARKER).is_file():
        raise InputError(f"{folder} has no {MARKER}; give a folder that locate or place wrote")
    try:
        facts = read_facts(json.loads((folder / MARKER).read_text(encoding="utf-8")))
        dimension = facts.dimension if isinstance(facts, GraphFacts) else 3
        cameras = read_rows(CameraRow, dimension, folder / "cameras.csv")
        pairs = read_rows(PairRow, dimension, folder / "pairs.csv")
        poses, points = None, None
        if not isinstance(facts, GraphFacts):
            model, names = read_model(folder), [row.name for row in cameras]
            points, given, before = model.reconstruction, Path(facts.inputs.path), None
            with suppress(InputError):
                before = read_model(given).images if given.is_dir() else None
            poses = replace(poses_of(model.images, names), centers=poses_of(before, names).centers)
        drawing = replace(
            build_drawing(cameras, pairs, poses=poses, points=points),
            input_is_aligned=isinstance(facts, FactsOfModel) and facts.scale.startswith("input:"),
            dimension=dimension,
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError, csv.Error) as error:
        raise InputError(
            f"the files of {folder} are damaged or of another version ({error}); run locate again"
        ) from error
    return drawing, facts
