"""A seeded model: the input's rotations and intrinsics, our camera centers, and no 3D points yet."""

from collections.abc import Collection
from pathlib import Path

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.files.colmap.check import check_model_files
from sfm_shapefit.files.colmap.images import put_images
from sfm_shapefit.files.colmap.model import PYCOLMAP_ERRORS, PosedModel
from sfm_shapefit.files.colmap.points import Keypoints
from sfm_shapefit.scene.images import Images


def build_seed(
    model: PosedModel, images: Images, keypoints: Keypoints | None = None
) -> pycolmap.Reconstruction:
    """Return a new reconstruction with images where they are placed; the input is not touched.

    Cameras, rigs, frames and images keep their ids and names, rotations and intrinsics their bits. Images
    whose frame is not placed, and images that had no pose, are unregistered.

    Args:
        model: the input.
        images: those of the model where they are placed; frames that are not are NaN.
        keypoints: what becomes the images' points2D, for matches of a database to refer to. Images for which
            it has none (None, or no rows), and all images if None, keep those of the model.
    """
    seed = copy_without_points(model.reconstruction)
    put_images(seed, images)
    if keypoints is None:
        return seed
    for index, image_id in enumerate(images.ids.tolist()):
        xy, image = keypoints(index), seed.image(image_id)
        if xy is not None and len(xy):
            image.points2D.clear()  # the setter insists on it
            image.points2D = pycolmap.Image(keypoints=np.ascontiguousarray(xy, dtype=np.float64)).points2D
    return seed


def copy_without_points(reconstruction: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Return a copy that has no 3D points; its points2D stay and observe nothing."""
    copy = pycolmap.Reconstruction(reconstruction)
    for point_id in list(copy.point3D_ids()):
        copy.delete_point3D(point_id)
    return copy


def copy_without_keypoints(
    reconstruction: pycolmap.Reconstruction, image_ids: Collection[int]
) -> pycolmap.Reconstruction:
    """Return a copy without 3D points, and without the points2D of some images, by their ids."""
    copy = copy_without_points(reconstruction)
    for image_id in image_ids:
        copy.image(image_id).points2D.clear()
    return pycolmap.Reconstruction(copy)  # a list that is cleared keeps its memory, its copy does not


def turn_model(reconstruction: pycolmap.Reconstruction, axes: FloatArray) -> pycolmap.Reconstruction:
    """Return the model turned about the origin: cameras and points, x -> axes x."""
    copy = pycolmap.Reconstruction(reconstruction)
    copy.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(axes), np.zeros(3)))
    return copy


def transform_model(
    reconstruction: pycolmap.Reconstruction, similarity: Similarity, fixed_frames: Collection[int] = ()
) -> pycolmap.Reconstruction:
    """Return the model under a similarity: cameras and points, and sensors in rigs if it scales.

    Args:
        reconstruction: not changed.
        similarity: of the world.
        fixed_frames: ids of frames that it does not move; they keep their poses to the last bit.
    """
    copy = pycolmap.Reconstruction(reconstruction)
    rotation = pycolmap.Rotation3d(similarity.rotation)
    copy.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.translation))
    for frame_id in fixed_frames:
        copy.frame(frame_id).rig_from_world = reconstruction.frame(frame_id).rig_from_world
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
