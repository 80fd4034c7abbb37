"""Seeded models: cameras, rigs and image names of the input, our poses and points."""

from pathlib import Path

import numpy as np
import pycolmap

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.files.colmap.check import check_model_files
from sfm_shapefit.files.colmap.images import put_images
from sfm_shapefit.files.colmap.model import PYCOLMAP_ERRORS
from sfm_shapefit.files.colmap.point_colors import color_points
from sfm_shapefit.files.colmap.points import Keypoints, add_points
from sfm_shapefit.files.colmap.template import Template
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points


def build_seed(
    template: Template, images: Images, points: Points, keypoints: Keypoints | None = None
) -> pycolmap.Reconstruction:
    """Return a new reconstruction with images where they are placed, and points; the input is not touched.

    Cameras, rigs, frames and images keep their ids and names; rotations and intrinsics that did not change
    keep their bits. Images whose frame is not placed, and images that had no pose, are unregistered.

    Args:
        template: the input.
        images: those of the input, where they are placed; frames that are not are NaN.
        points: of these images; with ids of their own.
        keypoints: what becomes the images' points2D, for matches of a database to refer to. Images for which
            it has none (None, or no rows), and all images if None, keep those of the template.
    """
    seed = template.build()
    put_images(seed, images)
    for index, image_id in enumerate(images.ids.tolist()):
        xy, image = None if keypoints is None else keypoints(index), seed.image(image_id)
        if xy is not None and len(xy):
            image.points2D.clear()  # the setter insists on it
            image.points2D = pycolmap.Image(keypoints=np.ascontiguousarray(xy, dtype=np.float64)).points2D
    add_points(seed, images, points)
    if template.colors is not None:
        color_points(seed, template.colors)
    return seed


def transform_model(
    reconstruction: pycolmap.Reconstruction, similarity: Similarity
) -> pycolmap.Reconstruction:
    """Return the model under a similarity: cameras and points, and sensors in rigs if it scales."""
    copy = pycolmap.Reconstruction(reconstruction)
    rotation = pycolmap.Rotation3d(similarity.rotation)
    copy.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.translation))
    return copy


def write_model(reconstruction: pycolmap.Reconstruction, folder: Path, *, text: bool = False) -> None:
    """Write a model in COLMAP's binary or text format into an existing folder, and walk the files once more.

    pycolmap does not notice a disk that is full, hence the second look.

    Raises:
        InputError: if the files cannot be written, or are not complete afterwards.
    """
    try:
        if text:
            reconstruction.write_text(folder)
        else:
            reconstruction.write_binary(folder)
    except PYCOLMAP_ERRORS as error:
        raise InputError(f"{folder} cannot be written; check its permissions and the free space") from error
    try:
        check_model_files(folder)
    except InputError as error:
        raise InputError(
            f"the model in {folder} could not be written completely; check the free space"
        ) from error
