"""Scenes of results in memory and of output folders."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.placement import Placement
from sfm_shapefit.report import CameraRow, PairRow
from sfm_shapefit.visual.scene import Scene, build_scene

if TYPE_CHECKING:
    from sfm_shapefit.results import GraphResult, LocateResult


def scene_of_model(found: "LocateResult", cameras: Sequence[CameraRow], pairs: Sequence[PairRow]) -> Scene:
    """Return the scene of a placed model.

    Args:
        found: what `locate` returned.
        cameras, pairs: its rows, which are costly to make again.
    """
    return build_scene(
        cameras,
        pairs,
        model=found.model,
        points=found.reconstruction,
        certified=_certified(found.placement, len(cameras)),
        input_is_aligned=found.gauge.scale == "input",
        history=_history(found.placement),
    )


def scene_of_graph(found: "GraphResult", cameras: Sequence[CameraRow], pairs: Sequence[PairRow]) -> Scene:
    """Return the scene of a placed bare graph; arguments as of `scene_of_model`."""
    return build_scene(
        cameras,
        pairs,
        certified=_certified(found.placement, len(cameras)),
        dimension=found.placement.graph.dimension,
        history=_history(found.placement),
    )


def _certified(placement: Placement, num_rows: int) -> FloatArray:
    """Return the certified optimum by camera, NaN for those that it does not place."""
    locations = np.full((num_rows, placement.graph.dimension), np.nan)
    cameras = placement.cameras
    locations[cameras] = placement.solve.locations[: len(cameras)]
    return locations


def _history(placement: Placement) -> list[tuple[int, float, float | None]]:
    return [(info.iteration, info.objective, info.dual_bound) for info in placement.history]
