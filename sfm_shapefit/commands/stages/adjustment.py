"""Placed cameras adjusted to the pixels: centers and points, and rotations as far as they are doubtful.

Directions of pairs are placed with the rotations that are given. What is left to gain is joint: all tracks at
once, and rotations that the matches know better than whoever gave them.
"""

import math

import numpy as np

from sfm_shapefit.adjustment.given_rotations import RotationWeight
from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.colmap.bundle_adjustment import AdjustedPlacement, adjust_placement
from sfm_shapefit.colmap.model import with_frame_rotations
from sfm_shapefit.commands.stages.clock import Clock
from sfm_shapefit.commands.stages.inputs import MatchSource
from sfm_shapefit.commands.stages.seed import Located, seed_and_tracks
from sfm_shapefit.geometry import rotation_angles_deg
from sfm_shapefit.locate_options import LocateOptions
from sfm_shapefit.placement.move import move_cameras
from sfm_shapefit.placement.place import Placement


def weight_of_rotations(options: LocateOptions) -> RotationWeight | None:
    """Return how given rotations are treated; None: as the matches say."""
    if options.rotation_sigma_deg:
        return RotationWeight(sigma_rad=math.radians(options.rotation_sigma_deg))
    return {"auto": None, "measured": RotationWeight(hold=True), "free": RotationWeight()}[options.rotations]


def adjust_placed(
    source: MatchSource, located: Located, options: LocateOptions, clock: Clock
) -> tuple[MatchSource, Placement, AdjustedPlacement]:
    """Adjust all placed cameras, in the gauge that was chosen.

    Returns:
        The source at the adjusted rotations, the placement moved to the adjusted centers and judged there,
        and how it went.

    Raises:
        UnsolvableError: if no point can be triangulated.
    """
    model, placement = source.model, located.placement
    fixed = () if located.fixed is None else model.frame_ids[located.fixed].tolist()
    everyone = located._replace(kept=np.ones(len(placement.cameras), dtype=np.bool_))
    seed, tracks = seed_and_tracks(source, everyone, clock.advance)
    adjusted = adjust_placement(seed, tracks, options, weight_of_rotations(options), fixed_frames=fixed)
    images = [adjusted.reconstruction.image(i) for i in model.image_ids[placement.cameras].tolist()]
    centers = np.array([image.projection_center() for image in images])
    similarity = located.gauge.similarity
    locations = (centers - similarity.translation) / similarity.scale
    if not adjusted.weight.hold:
        source = source.turned(with_frame_rotations(model, adjusted.reconstruction))
    return source, move_cameras(placement, locations, options), adjusted


def turned_deg(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return by how many degrees rotations (n, 3, 3) turned, exactly 0 where they kept their bits."""
    same = (before == after).all(axis=(1, 2))
    return np.where(same, 0.0, rotation_angles_deg(after.transpose(0, 2, 1) @ before))
