"""Made scenes for the adjustment: cameras on a ring round a cloud of points, and pycolmap's of the same."""

from dataclasses import replace

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from sfm_shapefit.adjustment.layout import lay_out
from sfm_shapefit.adjustment.options import AdjustmentOptions
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
    exact = reprojection_residuals(lay_out(problem, AdjustmentOptions()), values_of(problem))
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


def problem_of(reconstruction):
    """Return the adjustment problem of a model without rigs, and the ids of its images and points."""
    images = sorted(reconstruction.reg_image_ids())
    cameras = sorted({reconstruction.image(i).camera_id for i in images})
    points = sorted(reconstruction.point3D_ids())
    place = {point: row for row, point in enumerate(points)}
    seeing, seen, pixels = [], [], []
    for row, image_id in enumerate(images):
        for point2d in reconstruction.image(image_id).points2D:
            if point2d.has_point3D():
                seeing.append(row)
                seen.append(place[point2d.point3D_id])
                pixels.append(point2d.xy)
    poses = [reconstruction.image(i).cam_from_world() for i in images]
    problem = AdjustmentProblem(
        rotations=np.array([pose.rotation.matrix() for pose in poses]),
        centers=np.array([reconstruction.image(i).projection_center() for i in images]),
        points=np.array([reconstruction.point3D(p).xyz for p in points]),
        cameras_seeing=np.array(seeing),
        points_seen=np.array(seen),
        pixels=np.array(pixels),
        lenses=[_lens(reconstruction.camera(c)) for c in cameras],
        lens_of_camera=np.array([cameras.index(reconstruction.image(i).camera_id) for i in images]),
    )
    return problem, images, points


def rig_problem_of(reconstruction):
    """Return the adjustment problem of a model with rigs, and the ids of its frames."""
    frames = sorted(reconstruction.reg_frame_ids())
    plain, images, _ = problem_of(reconstruction)
    poses = [reconstruction.frame(frame).rig_from_world for frame in frames]
    rotations = np.array([pose.rotation.matrix() for pose in poses])
    centers = np.array([-pose.rotation.matrix().T @ pose.translation for pose in poses])
    frame_of_camera = np.array([frames.index(reconstruction.image(i).frame_id) for i in images])
    turns = plain.rotations @ rotations[frame_of_camera].transpose(0, 2, 1)
    arms = centers[frame_of_camera] - plain.centers
    rig = Rig(
        frame_of_camera=frame_of_camera,
        rotations=turns,
        translations=np.einsum("cab,cb->ca", plain.rotations, arms),
        free_sensor_of_camera=np.full(len(images), -1),
    )
    fixed = np.zeros(len(frames), np.bool_)
    return replace(plain, rotations=rotations, centers=centers, rig=rig, fixed=fixed), frames


def _lens(camera):
    return Lens(camera.model.name, tuple(camera.params))


def with_values(reconstruction, problem, images, points):
    """Return a copy of a model with the poses and points of a problem."""
    copy = pycolmap.Reconstruction(reconstruction)
    for row, image_id in enumerate(images):
        rotation = problem.rotations[row]
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ problem.centers[row])
        copy.frame(copy.image(image_id).frame_id).set_cam_from_world(copy.image(image_id).camera_id, pose)
    for row, point in enumerate(points):
        copy.point3D(point).xyz = problem.points[row]
    return copy


def adjust_by_pycolmap(
    reconstruction, loss_scale_px, *, free_lenses=False, tolerance=1e-15, max_iterations=500, fixed_frame=None
):
    """Adjust a model in place by pycolmap, in one thread; return the summary of Ceres."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(reconstruction.reg_image_ids()):
        config.add_image(image_id)
    if fixed_frame is None:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    else:
        config.set_constant_rig_from_world_pose(fixed_frame)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = free_lenses
    options.refine_principal_point = options.refine_sensor_from_rig = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_scale_px
    solver = options.ceres.solver_options
    solver.function_tolerance = tolerance
    solver.gradient_tolerance = solver.parameter_tolerance = 1e-18 if tolerance < 1e-12 else 1e-10
    solver.max_num_iterations, solver.num_threads = max_iterations, 1
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
    return adjuster.solve().ceres_summary
