"""Lenses of pycolmap's cameras."""

import pycolmap

from sfm_shapefit.scene.lens import Lens


def lens_of(camera: pycolmap.Camera) -> Lens:
    """Return the lens of a camera."""
    return Lens(
        camera.model_name,
        tuple(camera.params.tolist()),
        id=camera.camera_id,
        width=int(camera.width),
        height=int(camera.height),
    )
