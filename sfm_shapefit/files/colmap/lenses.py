"""Lenses of pycolmap's cameras."""

import pycolmap

from sfm_shapefit.scene.lens import Lens


def camera_of(lens: Lens) -> pycolmap.Camera:
    """Return a camera with a lens."""
    sizes = {"width": lens.width, "height": lens.height}
    return pycolmap.Camera(model=lens.model, params=lens.parameters, camera_id=lens.id, **sizes)


def lens_of(camera: pycolmap.Camera) -> Lens:
    """Return the lens of a camera."""
    return Lens(
        camera.model_name,
        tuple(camera.params.tolist()),
        id=camera.camera_id,
        width=int(camera.width),
        height=int(camera.height),
    )
