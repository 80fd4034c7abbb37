"""Models without a database: what their own tracks can say of rotations and lenses, and what they leave open."""

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

_WIDTH, _HEIGHT = 960, 720


def model_of(turns, centers, points, focal_px, k1=0.0, seed=0, noise_px=0.4):
    """Return a model with pinhole cameras at true poses; pixels are noisy, through a lens with distortion k1."""
    rng, model = np.random.default_rng(seed), pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", focal_px, _WIDTH, _HEIGHT)
    model.add_camera_with_trivial_rig(camera)
    tracks = [pycolmap.Track() for _ in points]
    for k, (turn, center) in enumerate(zip(turns, centers, strict=True)):
        seen = (points - center) @ turn.T
        plane = seen[:, :2] / seen[:, 2:]
        pixels = focal_px * plane * (1.0 + k1 * np.sum(plane**2, axis=1))[:, None] + [_WIDTH / 2, _HEIGHT / 2]
        pixels += noise_px * rng.standard_normal(pixels.shape)
        inside = ((pixels > 0.0) & (pixels < [_WIDTH, _HEIGHT])).all(axis=1)
        rows = np.flatnonzero((seen[:, 2] > 0.2) & inside & (rng.random(len(points)) < 0.7))
        for keypoint, point in enumerate(rows.tolist()):
            tracks[point].add_element(k + 1, keypoint)
        image = pycolmap.Image(name=f"{k:03d}.jpg", camera_id=1, image_id=k + 1, keypoints=pixels[rows])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(Rotation.from_matrix(turn).as_quat()), -turn @ center)
        model.add_image_with_trivial_frame(image, pose)
    for xyz, track in zip(points, tracks, strict=True):
        if track.length() > 1:
            model.add_point3D(xyz, track, np.zeros(3, dtype=np.uint8))
    return model


def yawing_drone(seed, k1=0.03):
    """Return a model of a room: the camera yaws by 120 degrees on the spot, flies 1.5 m and yaws on."""
    rng = np.random.default_rng(seed)
    walls = rng.uniform(-1.0, 1.0, (900, 3)) * [5.0, 1.5, 5.0]
    side = rng.integers(0, 2, 900) * 2
    walls[np.arange(900), side] = 5.0 * np.sign(walls[np.arange(900), side])
    yaw = np.radians(np.concatenate([np.linspace(0, 120, 12), np.full(6, 120.0), np.linspace(120, 240, 12)]))
    along = np.concatenate([np.zeros(12), np.linspace(0.2, 1.5, 6), np.full(12, 1.6)])
    centers = np.column_stack([along, np.zeros(30), 0.4 * along]) + 0.02 * rng.standard_normal((30, 3))
    turns = Rotation.from_euler("y", -yaw[:, None]).as_matrix()
    return model_of(turns, centers, walls, 900.0, k1, seed)


def slalom(stretch, seed):
    """Return a straight drive with slaloms whose focal length and depths are `stretch` times too long."""
    rng = np.random.default_rng(seed)
    steps = np.arange(16.0)
    centers = np.column_stack([np.sin(steps), 0.5 * np.cos(0.7 * steps), 0.5 * steps])
    points = np.column_stack([rng.uniform(-6.0, 6.0, (400, 2)), rng.uniform(6.0, 40.0, 400)])
    long = np.array([1.0, 1.0, stretch])
    return centers, model_of(
        np.tile(np.eye(3), (16, 1, 1)), long * centers, long * points, 700.0 * stretch, seed=seed
    )
