"""Lenses of pycolmap's cameras, and the rays that pycolmap gives their pixels."""

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.scene.lens import Lens

_ONE_TO_ONE = ("SIMPLE_PINHOLE", "PINHOLE")
# Distance in pixels by which a pixel may miss itself over its ray and back; solving for the ray leaves 1e-8.
_ROUND_TRIP_PX = 0.01
# Focal lengths in longer sides, least and largest, and other parameters; defaults of COLMAP's mapper.
_MAPPER_ALLOWS = (0.1, 10.0, 1.0)


def camera_of(lens: Lens) -> pycolmap.Camera:
    """Return a camera with a lens."""
    sizes = {"width": lens.width, "height": lens.height}
    return pycolmap.Camera(model=lens.model, params=lens.parameters, camera_id=lens.id, **sizes)


def focal_lengths(lens: Lens) -> list[float]:
    """Return the one or two focal lengths of a lens, in pixels; of a panorama its pixels per radian."""
    lengths = [lens.parameters[k] for k in camera_of(lens).focal_length_idxs()]
    return lengths or [lens.focal_px]


def lens_of(camera: pycolmap.Camera) -> Lens:
    """Return the lens of a camera."""
    return Lens(
        camera.model_name,
        tuple(camera.params.tolist()),
        id=camera.camera_id,
        width=int(camera.width),
        height=int(camera.height),
    )


def is_bogus(lens: Lens) -> bool:
    """Return whether COLMAP's mapper drops images for the parameters of their lens."""
    return bool(camera_of(lens).has_bogus_params(*_MAPPER_ALLOWS))


def rays_of(lens: Lens, pixels: FloatArray) -> FloatArray:
    """Return the unit rays (k, 3) of pixels (k, 2) in camera axes; NaN for those that are no image of a ray.

    pycolmap folds rays of a fisheye beyond 90 degrees back: 58 degrees where 90.3 is right. Such a ray has
    its image elsewhere, by which it is recognized.
    """
    camera, pixels = camera_of(lens), np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 2)
    rays = np.asarray(camera.cam_ray_from_img(pixels), dtype=np.float64).reshape(-1, 3)
    if len(rays) == 0 or lens.model in _ONE_TO_ONE:
        return rays
    with np.errstate(invalid="ignore"):
        ahead = rays[:, 2] > 0.0
        back = np.asarray(camera.img_from_cam(rays), dtype=np.float64).reshape(-1, 2)
        false = ahead & ~(np.abs(back - pixels).max(axis=1) <= _ROUND_TRIP_PX)
    rays[false] = np.nan
    return rays
