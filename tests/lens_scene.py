"""A ring of cameras of any of pycolmap's models about a cloud of points: true model and database."""

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import FloatArray

MODELS = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
_EXTRA = {"EUCM": [0.4, 1.1], "FOV": [0.5], "SIMPLE_DIVISION": [-0.05], "DIVISION": [-0.05]}
_SENSOR = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.1, 0.0, 0.995])), np.array([0.3, 0.1, -0.2]))
_NOISE_PX = 0.3


def camera_of_model(name: str, camera_id: int = 1) -> pycolmap.Camera:
    """Return a calibrated camera of 640 x 480, with some distortion; a panorama is 1200 x 600."""
    size = (1200, 600) if name == "EQUIRECTANGULAR" else (640, 480)
    camera = pycolmap.Camera.create_from_model_name(camera_id, name, 500.0, *size)
    params, extra = camera.params, camera.extra_params_idxs()
    params[extra] = _EXTRA.get(name, (0.01 / np.arange(1, 1 + len(extra))).tolist())
    camera.params, camera.has_prior_focal_length = params, True
    return camera


def write_scene(
    folder: Path,
    cameras: Sequence[pycolmap.Camera],
    num_frames: int = 6,
    *,
    rig: bool = False,
    behind: bool = False,
    poses: Sequence[pycolmap.Rigid3d] | None = None,
    points: FloatArray | None = None,
) -> pycolmap.Reconstruction:
    """Write the true model, sparse/0, and database.db; return the model.

    Frames take the cameras in turn, or are those of a rig of all cameras; the points are before or behind
    them, unless poses, or points (n, 3), are given. A panorama goes on at its other edge.
    """
    model, noise = pycolmap.Reconstruction(), np.random.default_rng(8)
    if points is None:
        points = np.random.default_rng(7).uniform(-2.0, 2.0, (120, 3))
    for camera in cameras:
        model.add_camera(camera)
    for group in [cameras] if rig else [[camera] for camera in cameras]:
        own = pycolmap.Rig(rig_id=group[0].camera_id)
        own.add_ref_sensor(group[0].sensor_id)
        for camera in group[1:]:
            own.add_sensor(camera.sensor_id, _SENSOR)
        model.add_rig(own)
    tracks = [pycolmap.Track() for _ in points]
    for k, pose in enumerate(poses or _ring(num_frames, -1.0 if behind else 1.0)):
        taking = cameras if rig else [cameras[k % len(cameras)]]
        frame = pycolmap.Frame(frame_id=k + 1, rig_id=taking[0].camera_id)
        frame.rig_from_world = pose
        images = []
        for camera in taking:
            turn = pose if camera is taking[0] else _SENSOR * pose
            pixels = camera.img_from_cam(points @ turn.rotation.matrix().T + turn.translation)
            pixels = np.asarray(pixels) + noise.normal(0.0, _NOISE_PX, (len(points), 2))
            if camera.model_name == "EQUIRECTANGULAR":
                pixels[:, 0] %= camera.width
            seen = np.flatnonzero(((pixels >= 0.0) & (pixels < [camera.width, camera.height])).all(axis=1))
            image_id = len(cameras) * k + camera.camera_id if rig else k + 1
            for keypoint, point in enumerate(seen.tolist()):
                tracks[point].add_element(image_id, keypoint)
            images.append(
                pycolmap.Image(
                    name=f"{image_id:04d}.jpg",
                    camera_id=camera.camera_id,
                    image_id=image_id,
                    keypoints=pixels[seen],
                )
            )
            frame.add_data_id(images[-1].data_id)
        model.add_frame(frame)
        for image in images:
            image.frame_id = frame.frame_id
            model.add_image(image)
        model.register_frame(frame.frame_id)
    for xyz, track in zip(points, tracks, strict=True):
        model.add_point3D(xyz, track)
    model.update_point_3d_errors()
    (folder / "sparse/0").mkdir(parents=True)
    model.write(folder / "sparse/0")
    _write_database(folder / "database.db", model)
    return model


def _ring(count: int, ahead_is: float) -> list[pycolmap.Rigid3d]:
    """Return poses that look at the middle from six units away, or from it, each turned about its axis."""
    poses = []
    for k in range(count):
        angle = 2.0 * np.pi * k / count
        center = np.array([6.0 * np.cos(angle), 6.0 * np.sin(angle), np.sin(3.0 * angle)])
        ahead = -ahead_is * center / np.linalg.norm(center)
        right = np.cross(ahead, [np.sin(k), 0.3, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.array([right, np.cross(ahead, right), ahead])
        poses.append(pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ center))
    return poses


def _write_database(path: Path, model: pycolmap.Reconstruction) -> None:
    """Write cameras, rigs, frames, images and the matches of all pairs, as verified."""
    database = pycolmap.Database.open(path)
    with pycolmap.DatabaseTransaction(database):
        for camera in model.cameras.values():
            database.write_camera(camera, use_camera_id=True)
        for rig in model.rigs.values():
            database.write_rig(rig, use_rig_id=True)
        for frame in model.frames.values():
            database.write_frame(frame, use_frame_id=True)
        for image in model.images.values():
            database.write_image(image, use_image_id=True)
            pixels = np.array([point.xy for point in image.points2D], dtype=np.float32)
            database.write_keypoints(image.image_id, pixels)
        rows = {
            i: {p.point3D_id: k for k, p in enumerate(image.points2D)} for i, image in model.images.items()
        }
        for a, b in itertools.combinations(sorted(rows), 2):
            both = sorted(rows[a].keys() & rows[b].keys())
            matches = np.array([(rows[a][point], rows[b][point]) for point in both], dtype=np.uint32)
            if len(matches) >= 15:
                found = pycolmap.TwoViewGeometry()
                found.config, found.inlier_matches = pycolmap.TwoViewGeometryConfiguration.CALIBRATED, matches
                database.write_two_view_geometry(a, b, found)
    database.close()
