"""Made scenes for the adjustment: cameras on a ring round a cloud of points, and pycolmap's of the same."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_shapefit.adjustment.problem import AdjustmentProblem, Rig
from sfm_shapefit.adjustment.residuals import reprojection_residuals
from sfm_shapefit.adjustment.solve import values_of
from sfm_shapefit.scene.lens import Lens

LENSES = {
    "SIMPLE_PINHOLE": (500.0, 320.0, 240.0),
    "PINHOLE": (500.0, 510.0, 320.0, 240.0),
    "SIMPLE_RADIAL": (500.0, 320.0, 240.0, -0.08),
    "RADIAL": (500.0, 320.0, 240.0, -0.08, 0.03),
    "OPENCV": (500.0, 510.0, 320.0, 240.0, -0.08, 0.03, 0.002, -0.003),
    "FULL_OPENCV": (500.0, 510.0, 320.0, 240.0, -0.08, 0.03, 0.002, -0.003, 0.01, 0.02, -0.03, 0.04),
    "SIMPLE_FISHEYE": (500.0, 320.0, 240.0),
    "FISHEYE": (500.0, 510.0, 320.0, 240.0),
    "SIMPLE_RADIAL_FISHEYE": (500.0, 320.0, 240.0, -0.08),
    "RADIAL_FISHEYE": (500.0, 320.0, 240.0, -0.08, 0.03),
    "OPENCV_FISHEYE": (500.0, 510.0, 320.0, 240.0, -0.08, 0.03, -0.02, 0.01),
    "THIN_PRISM_FISHEYE": (
        500.0,
        510.0,
        320.0,
        240.0,
        -0.08,
        0.03,
        0.002,
        -0.003,
        -0.02,
        0.01,
        0.004,
        -0.005,
    ),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        *(500.0, 510.0, 320.0, 240.0, -0.08, 0.03, -0.02, 0.01, 5e-4, -5e-5),
        *(0.002, -0.003, 4e-4, -5e-4, 6e-4, -7e-4),
    ),
    "FOV": (500.0, 510.0, 320.0, 240.0, 0.9),
    "SIMPLE_DIVISION": (500.0, 320.0, 240.0, -0.2),
    "DIVISION": (500.0, 510.0, 320.0, 240.0, -0.2),
    "EUCM": (500.0, 510.0, 320.0, 240.0, 0.6, 1.1),
}


def look_at(centers, targets):
    """Return cam_from_world rotations of cameras that look at targets, y down."""
    z = targets - centers
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = x / np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=1)


def ring_problem(
    rng,
    num_cameras=12,
    num_points=200,
    *,
    models=("SIMPLE_PINHOLE",),
    noise_px=0.5,
    share=0.5,
    sensors=0,
    offset=0.3,
):
    """Return the truth with noisy pixels; with `sensors` > 0, each frame is a rig of so many cameras.

    These stand about `offset` from its origin.
    """
    angles = 2.0 * np.pi * np.arange(num_cameras) / num_cameras
    centers = np.stack([4.0 * np.cos(angles), 4.0 * np.sin(angles), 0.5 * np.sin(3.0 * angles)], axis=1)
    points = rng.uniform(-1.0, 1.0, (num_points, 3))
    rotations = look_at(centers, np.zeros((num_cameras, 3)))
    lenses = tuple(Lens(model, LENSES[model]) for model in models)
    rig, count = Rig.of_single_cameras(num_cameras), num_cameras
    if sensors:
        count = num_cameras * sensors
        turns = Rotation.from_rotvec(0.1 * rng.standard_normal((sensors, 3))).as_matrix()
        rig = Rig(
            frame_of_camera=np.repeat(np.arange(num_cameras), sensors),
            rotations=np.tile(turns, (num_cameras, 1, 1)),
            translations=np.tile(offset * rng.standard_normal((sensors, 3)), (num_cameras, 1)),
            free_sensor_of_camera=np.full(count, -1),
        )
    cameras, seen = np.nonzero(rng.random((count, num_points)) < share)
    problem = AdjustmentProblem(
        rotations=rotations,
        centers=centers,
        points=points,
        cameras_seeing=cameras,
        points_seen=seen,
        pixels=np.zeros((len(cameras), 2)),
        lenses=lenses,
        lens_of_camera=np.arange(count) % len(lenses),
        rig=rig,
    )
    return project(problem, rng, noise_px)


def project(problem, rng, noise_px):
    """Return the problem, whose pixels are 0, with those of its points and noise."""
    exact = reprojection_residuals(problem, values_of(problem))
    assert np.isfinite(exact).all()
    return replace(problem, pixels=exact + noise_px * rng.standard_normal(exact.shape))


def disturb(problem, rng, center=0.05, rotation_rad=0.01, point=0.03):
    """Return the problem started elsewhere; fixed frames stay."""
    moves = ~problem.fixed
    n = problem.num_frames
    turns = Rotation.from_rotvec(rotation_rad * rng.standard_normal((n, 3)) * moves[:, None]).as_matrix()
    return replace(
        problem,
        centers=problem.centers + center * rng.standard_normal((n, 3)) * moves[:, None],
        rotations=np.where(moves[:, None, None], turns @ problem.rotations, problem.rotations),
        points=problem.points + point * rng.standard_normal(problem.points.shape),
    )


def observed(problem, rows):
    """Return the problem with some of its observations, by a mask or in an order."""
    return replace(
        problem,
        cameras_seeing=problem.cameras_seeing[rows],
        points_seen=problem.points_seen[rows],
        pixels=problem.pixels[rows],
    )
