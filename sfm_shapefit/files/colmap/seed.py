"""A seeded model: the input's rotations and intrinsics, our camera centers, and no 3D points yet.

COLMAP keeps poses in frames, x_rig = R x_world + t with t = -R C. Moving a frame replaces t and hands on
the very same quaternion, so that rotations and intrinsics come out bit-identical. The poses of sensors in
their rigs are not touched: all images of a frame move with it.
"""

from collections.abc import Callable, Collection
from pathlib import Path

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.files.colmap.check import check_model_files
from sfm_shapefit.files.colmap.model import PYCOLMAP_ERRORS, PosedModel

Keypoints = Callable[[int], FloatArray | None]
"""Returns the pixels (k, 2) of the keypoints of an image, by its index into `PosedModel.image_ids`."""


def build_seed(
    model: PosedModel,
    placed: BoolArray,
    centers: FloatArray,
    keypoints: Keypoints | None = None,
    fixed: BoolArray | None = None,
) -> pycolmap.Reconstruction:
    """Return a new reconstruction with the cameras at `centers`; the input is not touched.

    Cameras, rigs, frames and images keep their ids and names, rotations and intrinsics their bits.

    Args:
        model: the input.
        placed: (n,) which images have a center; the others, and images that had no pose, are unregistered
            unless another image of their frame is placed.
        centers: (n, 3) camera centers in world axes; rows of images that are not placed are ignored.
        keypoints: what becomes the images' points2D, for matches of a database to refer to. Images for which
            it has none (None, or no rows), and all images if None, keep those of the model.
        fixed: (n,) images whose frame keeps its pose to the last bit; none if None.

    Raises:
        ValueError: if the shapes do not fit the model, or the center of a placed image is not finite.
    """
    n = model.num_images
    if placed.shape != (n,) or centers.shape != (n, 3):
        raise ValueError(f"expected placed ({n},) and centers ({n}, 3), got {placed.shape}, {centers.shape}")
    if not np.isfinite(centers[placed]).all():
        worst = int(np.flatnonzero(placed & ~np.isfinite(centers).all(axis=1))[0])
        raise ValueError(f"the center of image {model.names[worst]} is not finite")

    seed = copy_without_points(model.reconstruction)
    still = np.zeros(n, dtype=np.bool_) if fixed is None else fixed
    settled = set(model.frame_ids[still].tolist())
    for index, image_id in enumerate(model.image_ids.tolist()):
        image = seed.image(image_id)
        if placed[index] and image.frame_id not in settled:
            frame = seed.frame(image.frame_id)
            old = frame.rig_from_world
            assert old is not None  # a posed image's frame has a pose
            rotation = old.rotation
            is_reference = not model.frame_offsets[index].any() and image.is_ref_in_frame()
            turn = model.rotations[index] if is_reference else rotation.matrix()
            translation = -(turn @ (centers[index] - model.frame_offsets[index]))
            frame.rig_from_world = pycolmap.Rigid3d(rotation, translation)
            settled.add(image.frame_id)
        xy = None if keypoints is None else keypoints(index)
        if xy is not None and len(xy):
            image.points2D.clear()  # the setter insists on it
            image.points2D = pycolmap.Image(keypoints=np.ascontiguousarray(xy, dtype=np.float64)).points2D
    registered = set(model.frame_ids[placed | still].tolist())
    for frame_id in sorted(set(seed.reg_frame_ids()) - registered):
        seed.deregister_frame(frame_id)
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
