"""Lenses of pycolmap's cameras."""

import numpy as np
import pycolmap

from sfm_shapefit.scene.lens import Lens

_ADJUSTED_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")


def is_adjusted(camera: pycolmap.Camera) -> bool:
    """Return whether the adjustment knows the model of a camera; others are undistorted for it."""
    return camera.model_name in _ADJUSTED_MODELS


def lens_of(camera: pycolmap.Camera) -> Lens:
    """Return the lens of a camera, or that of the views of one that is undistorted."""
    if is_adjusted(camera):
        return Lens(camera.model_name, tuple(camera.params.tolist()))
    return Lens("SIMPLE_PINHOLE", (focal_length_px(camera), 0.0, 0.0), fixed=True)


def focal_length_px(camera: pycolmap.Camera) -> float:
    """Return pixels per radian at the axis; those of an equirectangular camera are the same everywhere."""
    if camera.model == pycolmap.CameraModelId.EQUIRECTANGULAR:
        return float(camera.params[0] / (2.0 * np.pi))
    return float(camera.mean_focal_length())
