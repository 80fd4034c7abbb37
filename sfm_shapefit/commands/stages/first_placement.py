"""From averaged rotations to adjusted ones: a first placement, and its adjustment on few covering tracks.

Averaged rotations are a few hundredths of a degree off, wrong ones by much more. The cameras are placed with
them all the same, then rotations, centers and points are adjusted together. What comes out is far finer:
directions, verdicts and trust are measured anew from it.
"""

import numpy as np

from sfm_shapefit.arrays import BoolArray, FloatArray
from sfm_shapefit.colmap.bundle_adjustment import Uncertainty, adjust_thinly
from sfm_shapefit.colmap.database_images import rotations_of
from sfm_shapefit.commands.stages.clock import Clock
from sfm_shapefit.commands.stages.gauge_choice import GaugeRule
from sfm_shapefit.commands.stages.inputs import MatchSource
from sfm_shapefit.commands.stages.measure import build_graph, measure_directions
from sfm_shapefit.commands.stages.rigs import place_cameras
from sfm_shapefit.commands.stages.seed import Located, seed_and_tracks
from sfm_shapefit.geometry import mean_rotation_l1
from sfm_shapefit.placement.gauge import unit_gauge


def adjust_first_placement(
    source: MatchSource, rule: GaugeRule, clock: Clock
) -> tuple[FloatArray, FloatArray, Uncertainty]:
    """Return rotations (n, 3, 3) cam_from_world and centers (n, 3), adjusted, and how well these are known.

    Images that the first placement lacks keep their averaged rotations, turned as the others were on average,
    and have NaN for a center.

    Raises:
        UnsolvableError: if no camera can be placed, or nothing can be triangulated.
    """
    model, options = source.model, rule.options
    directions = measure_directions(source, options, clock)
    measured = rule.rigid.apply(build_graph(source, directions, options))
    placement = place_cameras(measured, options, clock)
    everyone = np.ones(len(placement.cameras), dtype=np.bool_)
    gauge = unit_gauge(placement.locations)
    if placement.unit is not None:  # the offsets of sensors have theirs
        gauge = rule.choose(placement.cameras, placement.locations, placement.unit)
    located = Located(placement, everyone, gauge)
    adjusted = adjust_thinly(*seed_and_tracks(source, located, clock.advance), options)
    rotations, posed = rotations_of(adjusted.reconstruction, model.image_ids.tolist())
    centers = np.full((model.num_images, 3), np.nan)
    for k in np.flatnonzero(posed).tolist():
        centers[k] = adjusted.reconstruction.image(int(model.image_ids[k])).projection_center()
    return _turn_the_others(model.rotations, rotations, posed), centers, adjusted.uncertainty


def _turn_the_others(averaged: FloatArray, adjusted: FloatArray, posed: BoolArray) -> FloatArray:
    """Return the adjusted rotations of the `posed`, and those of the others in the same axes."""
    common = mean_rotation_l1(averaged[posed].transpose(0, 2, 1) @ adjusted[posed])
    return np.where(posed[:, None, None], adjusted, averaged @ common)
