"""Two vehicles with a rig of three cameras each, which drive along a street: a scene whose scale is known.

A vehicle carries a camera that looks ahead and two that look 40 degrees to the left and to the right, 1.6 m
apart. The second vehicle's rig is higher and wider than the first's, and it drives 1.2 m to its left and half
a step behind. A frame is what the three cameras of a vehicle see at once; frames of the vehicles alternate.
Rotations are known; the metric offsets of the sensors in their rigs are what fixes the scale of the drive.

A rig's axes are those of its first camera: x to the right, y down, z ahead.
"""

from dataclasses import replace

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.synthetic.layouts import LAYOUTS, looking_along, street
from sfm_shapefit.synthetic.mounts import rigs_of
from sfm_shapefit.synthetic.scene_options import SceneOptions
from sfm_shapefit.synthetic.scenes import Scene, build_scene

NUM_RIGS, NUM_SENSORS = 2, 3  # rigs, cameras of each; the fewest that differ, ahead and to both sides

_STEP_M = 1.5  # meters between two frames of a vehicle; their views overlap
_YAW_DEG = np.array([0.0, 40.0, -40.0])  # degrees to the left of ahead; views of neighbors overlap
_OFFSETS_M = np.array(  # meters to the right, down and ahead, by rig and sensor; cars of two sizes
    [
        [[0.0, 0.0, 0.0], [-0.8, 0.1, -0.3], [0.8, 0.1, -0.3]],
        [[0.0, 0.0, 0.0], [-1.0, -0.3, -0.5], [1.0, -0.3, -0.5]],
    ]
)
_LANES_M, _HEIGHTS_M = np.array([0.0, 1.2]), np.array([1.5, 1.9])  # meters, by rig; two cars on one street


def make_rig_drive(options: SceneOptions) -> Scene:
    """Return the drive of two rigs of three cameras, with exact rotations.

    `options.num_images` is rounded down to whole frames; `shape` and `rig` are not read. ValueError if there
    is not a frame for each rig, or rotations are to be wrong; InputError as `make_scene`.
    """
    num_frames = options.num_images // NUM_SENSORS
    if num_frames < NUM_RIGS:
        raise ValueError(f"num_images must be {NUM_RIGS * NUM_SENSORS} or more, got {options.num_images}")
    if options.rotation_noise_deg:
        raise ValueError("rotation_noise_deg must be 0: the frames of a rig turn as one")
    layout_rng, *rngs = np.random.default_rng(options.seed).spawn(6)
    rigs = rigs_of(np.arange(num_frames) % NUM_RIGS, _YAW_DEG, _OFFSETS_M)
    rotations, centers = _frames(num_frames, rigs.rig_of_frame, layout_rng)
    layout = replace(
        LAYOUTS["drive"](num_frames // NUM_RIGS + 1, options.num_points, layout_rng),
        centers=rigs.centers_of(rotations, centers),
        rotations=rigs.rotations_of(rotations),
    )
    return build_scene(layout, rigs, options, rngs)


def _frames(
    num_frames: int, rig_of_frame: IntArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return rig_from_world rotations (f, 3, 3) and centers (f, 3) of the frames along the street."""
    at = _STEP_M / NUM_RIGS * np.arange(num_frames)
    road, ahead, left = street(at)
    centers = road + (_LANES_M[rig_of_frame] + 0.1 * rng.standard_normal(num_frames))[:, None] * left
    centers[:, 2] = _HEIGHTS_M[rig_of_frame] + 0.05 * rng.standard_normal(num_frames)
    return looking_along(normalized(ahead + 0.02 * rng.standard_normal((num_frames, 3)))), centers
