"""pycolmap's reconstructions: taken from users as arrays, and made of arrays where a user asks for one.

Both go through COLMAP's own binary files, in a private folder: pycolmap has no arrays of points and tracks,
and objects of them one by one take ten times as long. The files lack whether a focal length is a prior;
frames and sensors without a pose stand at the origin on their way.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.atomic_folder import private_folder
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.files.colmap.images import put_images
from sfm_shapefit.files.colmap.model_arrays import ORIGIN, ModelArrays, RigRecord
from sfm_shapefit.files.colmap.quiet import quiet_log
from sfm_shapefit.files.colmap.read_binary import ModelFiles, read_files
from sfm_shapefit.files.colmap.write_binary import write_binary
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points

PYCOLMAP_ERRORS = (ValueError, IndexError, KeyError, RuntimeError, MemoryError)
"""What pycolmap raises on bad data."""

# For this camera, pixel coordinates and normalized coordinates are the same numbers.
_IDENTITY_CAMERA = pycolmap.Camera(model="PINHOLE", width=1, height=1, params=[1.0, 1.0, 0.0, 0.0])


def name_of(image: pycolmap.Image) -> str:
    """Return the name of an image; its bytes that are no UTF-8 become lone surrogates, as Python's own do."""
    try:
        return str(image.name)
    except UnicodeDecodeError as error:
        return error.object.decode("utf-8", "surrogateescape")


def bytes_of_name(name: str) -> bytes:
    """Return the name that a new image of pycolmap is to have."""
    return name.encode("utf-8", "surrogateescape")


def points2d_xy(image: pycolmap.Image) -> FloatArray:
    """Return the pixels of all points of an image, (k, 2), without a Python loop over them."""
    if not len(image.points2D):
        return np.zeros((0, 2))
    return np.asarray(_IDENTITY_CAMERA.cam_from_img(image.points2D), dtype=np.float64).reshape(-1, 2)


def arrays_of(reconstruction: pycolmap.Reconstruction) -> tuple[ModelArrays, tuple[str, ...]]:
    """Return a reconstruction, which is not modified, as arrays; returns and raises as `read_folder`."""
    called = "the reconstruction"
    try:
        if not reconstruction.is_valid():
            raise InputError(
                f"{called} refers to an image, a frame or a 3D point that it does not have; "
                "write it again with COLMAP or pycolmap"
            )
        unposed = [i for i, frame in reconstruction.frames.items() if not frame.has_pose()]
        sensors = ((i, one) for i, rig in reconstruction.rigs.items() for one in rig.non_ref_sensors.items())
        unplaced = [(rig_id, sensor) for rig_id, (sensor, pose) in sensors if pose is None]
        priors = {i for i, camera in reconstruction.cameras.items() if camera.has_prior_focal_length}
        if unposed or unplaced:
            reconstruction = pycolmap.Reconstruction(reconstruction)
        for rig_id, sensor in unplaced:
            reconstruction.rig(rig_id).set_sensor_from_rig(sensor, pycolmap.Rigid3d())
        for frame_id in unposed:
            reconstruction.frame(frame_id).rig_from_world = pycolmap.Rigid3d()
            reconstruction.register_frame(frame_id)
        with private_folder() as folder, quiet_log():
            reconstruction.write_binary(folder)
            model, notes = read_files(ModelFiles(folder, called, ""))
    except PYCOLMAP_ERRORS as error:
        raise InputError(f"{called} is not a sound COLMAP model: {_first_line(error)}") from error
    poses = np.where(np.isin(model.frames.ids, unposed)[:, None], np.nan, model.frames.poses)
    rigs = {rig.id: rig for rig in model.rigs}
    for rig_id, sensor in unplaced:
        nowhere = {(int(sensor.type), int(sensor.id)): None}
        rigs[rig_id] = RigRecord(rig_id, {**rigs[rig_id].sensors, **nowhere})
    frames, by_id = model.frames._replace(poses=poses), tuple(rigs[i] for i in sorted(rigs))
    return replace(model, frames=frames, rigs=by_id, prior_focals=frozenset(priors)), notes


def _first_line(error: BaseException) -> str:
    """Return the first line of an exception's text, or its type if it has none."""
    text = str(error).strip().partition("\n")[0]
    if "Check failed" in text:  # its own assertions, which say nothing to users
        return "its parts contradict one another"
    return text or type(error).__name__


def reconstruction_of(model: ModelArrays) -> pycolmap.Reconstruction:
    """Return a new reconstruction of a model, with its images that have no pose.

    Raises:
        InputError: if there is no room for its files, or pycolmap refuses it.
    """
    unposed = ~model.frames.is_posed
    poses = np.where(unposed[:, None], ORIGIN, model.frames.poses)
    with private_folder() as folder, quiet_log():
        write_binary(replace(model, frames=model.frames._replace(poses=poses)), folder)
        try:
            built = pycolmap.Reconstruction(folder)
        except PYCOLMAP_ERRORS as error:
            raise InputError(f"pycolmap refuses the model: {_first_line(error)}") from error
    for frame_id in model.frames.ids[unposed].tolist():
        built.deregister_frame(frame_id)
    for camera_id in model.prior_focals & {lens.id for lens in model.lenses}:
        built.camera(camera_id).has_prior_focal_length = True
    return built


def moved_reconstruction(model: ModelArrays, images: Images, points: Points) -> pycolmap.Reconstruction:
    """Return a model with some images and points elsewhere, see `put_images`; all errors are updated."""
    places = model.points.copy()
    places["xyz"][np.searchsorted(places["id"], points.ids.astype(np.uint64))] = points.xyz
    moved = reconstruction_of(replace(put_images(model, images), points=places))
    moved.update_point_3d_errors()
    return moved


def transform_model(
    reconstruction: pycolmap.Reconstruction, similarity: Similarity
) -> pycolmap.Reconstruction:
    """Return the model under a similarity: cameras and points, and sensors in rigs if it scales."""
    copy = pycolmap.Reconstruction(reconstruction)
    rotation = pycolmap.Rotation3d(similarity.rotation)
    copy.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.translation))
    return copy


def add_point(
    model: pycolmap.Reconstruction, point_id: int, xyz: Any, color: Any, seen: Iterable[tuple[int, int]]
) -> None:
    """Add a point that observations see, each an image's id and the number of its points2D."""
    track = pycolmap.Track()
    for image_id, place in seen:
        track.add_element(image_id, place)
    model.add_point3D_with_id(point_id, pycolmap.Point3D(xyz=xyz, track=track, color=color))
