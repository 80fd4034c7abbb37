"""Refine the given rotations before cameras are placed: opt-in, see `rotations`."""

from contextlib import ExitStack
from dataclasses import replace

import numpy as np

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.colmap.model import PosedModel, with_turned_cameras
from sfm_shapefit.commands.stages.clock import Clock
from sfm_shapefit.commands.stages.inputs import MatchSource, open_source
from sfm_shapefit.commands.stages.measure import build_graph, count_work, measure_directions
from sfm_shapefit.commands.stages.memory import keep_within_memory
from sfm_shapefit.directions.matches import RayMatches
from sfm_shapefit.locate_options import LocateOptions
from sfm_shapefit.placement.place import place
from sfm_shapefit.results.result import Inputs
from sfm_shapefit.rotations.acceptance import refine_rotations

_REFINEMENT_ROUNDS = 2
# Residual of a direction beyond which no error of rotations is to blame.
_REFINEMENT_RESIDUAL_DEG = 5.0
# Matches in all, which take 200 MB.
_REFINEMENT_MATCHES = 4_000_000
# Matches of a pair at least and at most; more were no better on any real scene.
_MATCHES_PER_PAIR = (50, 2000)


def refine_model_rotations(
    model: PosedModel, inputs: Inputs, options: LocateOptions, clock: Clock
) -> tuple[PosedModel, FloatArray]:
    """Return the model with refined rotations, and by how many degrees each camera turned, shape (n,).

    Directions need rotations and the refinement needs centers: cameras are placed, rotations refined, and
    both once more, for with better rotations more pairs have a direction. What a camera may turn is
    always judged against its given rotation.
    """
    turns = np.tile(np.eye(3), (model.num_images, 1, 1))
    turned, turned_deg = model, np.zeros(model.num_images)
    for repeat in range(_REFINEMENT_ROUNDS):
        with ExitStack() as resources:
            given, current = (
                resources.enter_context(open_source(m, inputs, options)) for m in (model, turned)
            )
            directions = measure_directions(current, options, clock)
            _, measured, settings = keep_within_memory(
                replace(count_work(current, directions), num_sampled=0),
                build_graph(current, directions, options),
                options,
                current.economy,
            )
            placement = place(measured, settings)
            residuals = placement.assessment.residuals_deg[placement.pairs]
            near = placement.edges[placement.pairs[residuals <= _REFINEMENT_RESIDUAL_DEG]]
            rays = _rays_of_pairs(given, directions.usable()[near], placement.cameras)
        refined = refine_rotations(rays, placement.locations, turns[placement.cameras] if repeat else None)
        turns[placement.cameras], turned_deg[placement.cameras] = refined.turns, refined.angles_deg
        turned = with_turned_cameras(model, turns)
    return turned, turned_deg


def _rays_of_pairs(source: MatchSource, rows: IntArray, cameras: IntArray) -> RayMatches:
    """Return matches, evenly picked, of rows (k,) of the pairs, their images as positions in `cameras`."""
    limit = int(np.clip(_REFINEMENT_MATCHES // max(len(rows), 1), *_MATCHES_PER_PAIR))
    parts, first = [], 0
    for batch in source.batches():
        chosen = rows[(rows >= first) & (rows < first + len(batch.pairs))] - first
        first += len(batch.pairs)
        counts = np.diff(batch.offsets)[chosen]
        picked = [
            start + np.arange(min(count, limit)) * count // min(count, limit)
            for start, count in zip(batch.offsets[chosen].tolist(), counts.tolist(), strict=True)
        ]
        kept = np.concatenate([np.zeros(0, dtype=np.int64), *picked])
        rays = batch.rays_i[kept], batch.rays_j[kept]
        parts.append((batch.pairs[chosen], np.minimum(counts, limit), *rays, batch.pixel_angles[chosen]))
    pairs, counts, rays_i, rays_j, angles = (np.concatenate(column) for column in zip(*parts, strict=True))
    return RayMatches(
        pairs=np.searchsorted(cameras, pairs),
        offsets=np.append(0, np.cumsum(counts)),
        rays_i=rays_i,
        rays_j=rays_j,
        pixel_angles=angles,
    )
