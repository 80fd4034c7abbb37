"""The images of a COLMAP database as a model without rotations: what `map` starts from.

Every image stands in a frame of its own, at the origin with the identity as its rotation, so that rays of
its keypoints in "world" axes are rays in camera axes. Intrinsics are those of the database: calibrated, or
COLMAP's guess (focal length 1.2 times the larger side) where `prior_focal_length` is not set.
"""

import itertools
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.database_pairs import MAX_NUM_IMAGES, NO_ID
from sfm_shapefit.files.colmap.database_rigs import DatabaseRigs, read_rigs
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile, is_between

# No image has a side of so many pixels.
_LARGEST_SIDE = 2**31


@dataclass(frozen=True, slots=True, kw_only=True)
class UnposedImages:
    """What a database says of its images."""

    reconstruction: pycolmap.Reconstruction
    """All cameras and images; every rotation is the identity, every center the origin."""
    rigs: DatabaseRigs
    """Which of the images were taken together; the model here does not have them."""

    def frames(self, image_ids: list[int]) -> tuple[IntArray, FloatArray]:
        """Return the frame of each image (n,) and the sensor_from_rig of its camera (n, 3, 3).

        Frames are numbered as their first images stand: without rigs each image is its own frame.
        """
        known, places = self.reconstruction, self.rigs.place_of_image
        frame_ids = [places[i].frame_id if i in places else i for i in image_ids]
        sensors = [self.rigs.sensor_from_rig(known.image(i)).rotation.matrix() for i in image_ids]
        number = {frame_id: k for k, frame_id in enumerate(dict.fromkeys(frame_ids))}
        return np.array([number[i] for i in frame_ids], dtype=np.int64), np.array(sensors)


def read_images(file: DatabaseFile) -> UnposedImages:
    """Read cameras and images of a database.

    Raises:
        InputError: if it is no COLMAP database, has fewer than two images, or a camera or image is damaged.
    """
    camera_columns = ("camera_id", "model", "width", "height", "params", "prior_focal_length")
    image_columns = ("image_id", "name", "camera_id")
    cameras, images = (
        file.rows(table, {columns: f"SELECT {', '.join(columns)} FROM {table} ORDER BY 1"})
        for table, columns in (("cameras", camera_columns), ("images", image_columns))
    )
    path = file.path
    if len(images) < 2:
        raise InputError(
            f"{path} has {len(images)} images, but two or more are needed; extract features first"
        )
    model = pycolmap.Reconstruction()
    for row in cameras:
        camera = _camera(path, row)
        if model.exists_camera(camera.camera_id):
            raise InputError(f"{path}: camera {camera.camera_id} stands twice; remove one of them")
        model.add_camera_with_trivial_rig(camera)
    for image_id, name, camera_id in images:
        is_sound = is_between(image_id, 0, MAX_NUM_IMAGES) and isinstance(name, str)
        if not (is_sound and is_between(camera_id, 0, NO_ID) and model.exists_camera(camera_id)):
            raise InputError(
                f"{path}: the image with id {image_id!r} has no valid name and camera; it is damaged"
            )
        if any("\ud800" <= letter <= "\udfff" for letter in name):  # what is no UTF-8 is read as these
            raise InputError(f"{path}: the name {name!r} of an image is no UTF-8; rename that image")
        if model.exists_image(image_id):
            raise InputError(f"{path}: the image with id {image_id} stands twice; remove one of them")
        image = pycolmap.Image(name=name, camera_id=camera_id, image_id=image_id)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    return UnposedImages(reconstruction=model, rigs=read_rigs(file, model))


def pose_at_origin(
    images: UnposedImages, image_ids: list[int], rotations: FloatArray
) -> pycolmap.Reconstruction:
    """Return a new model of k images with rotations (k, 3, 3) cam_from_world, all frames at the origin.

    Images of a rig are in the frames of that rig, whose rotation is that of their first image.
    """
    known, rigs = images.reconstruction, images.rigs
    model = pycolmap.Reconstruction()
    rig_ids = _add_cameras(model, images, image_ids)
    members: dict[int, list[pycolmap.Image]] = {}
    for image_id in image_ids:
        image = known.image(image_id)
        bare = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image_id)
        place = rigs.place_of_image.get(image_id)
        members.setdefault(image_id if place is None else place.frame_id, []).append(bare)
    rotation_of = dict(zip(image_ids, rotations, strict=True))
    for frame_id, together in members.items():
        first = together[0]
        rig_from_sensor = rigs.sensor_from_rig(first).rotation.inverse()
        rotation = rig_from_sensor * pycolmap.Rotation3d(rotation_of[first.image_id])
        pose = pycolmap.Rigid3d(rotation, np.zeros(3))
        place = rigs.place_of_image.get(first.image_id)
        if place is None:
            model.add_image_with_trivial_frame(first, pose)
        else:
            _add_frame(model, pycolmap.Frame(frame_id=frame_id, rig_id=rig_ids[place.rig_id]), together, pose)
    return model


def _add_cameras(
    model: pycolmap.Reconstruction, images: UnposedImages, image_ids: list[int]
) -> dict[int, int]:
    """Add the cameras of some images and their rigs; return the ids that these got."""
    known, rigs = images.reconstruction, images.rigs
    used = {rigs.place_of_image[i].rig_id for i in image_ids if i in rigs.place_of_image}
    in_rigs = {camera_id for rig_id in used for camera_id in rigs.camera_ids(rig_id)}
    for camera_id in sorted({known.image(i).camera_id for i in image_ids} - in_rigs):
        model.add_camera_with_trivial_rig(known.camera(camera_id))
    for camera_id in sorted(in_rigs):
        model.add_camera(known.camera(camera_id))
    rig_ids = _free_ids(used, model.rigs)
    for rig_id in sorted(used):
        model.add_rig(rigs.renumbered(rig_id, rig_ids[rig_id]))
    return rig_ids


def _add_frame(
    model: pycolmap.Reconstruction,
    frame: pycolmap.Frame,
    images: list[pycolmap.Image],
    pose: pycolmap.Rigid3d,
) -> None:
    """Add a frame of a rig at a pose, and its images."""
    for image in images:
        frame.add_data_id(image.data_id)
        image.frame_id = frame.frame_id
    frame.rig_from_world = pose
    model.add_frame(frame)
    for image in images:
        model.add_image(image)
    model.register_frame(frame.frame_id)


def _free_ids(wanted: set[int], taken: Collection[int]) -> dict[int, int]:
    """Return an id for each of the wanted ones: itself unless it is taken."""
    free = (i for i in itertools.count(1) if i not in taken and i not in wanted)
    return {i: next(free) if i in taken else i for i in sorted(wanted)}


def rotations_of(model: pycolmap.Reconstruction, image_ids: list[int]) -> tuple[FloatArray, BoolArray]:
    """Return (k, 3, 3) cam_from_world of some images, the identity without a pose, and (k,) who has one."""
    rotations, posed = np.tile(np.eye(3), (len(image_ids), 1, 1)), np.zeros(len(image_ids), dtype=np.bool_)
    for k, image_id in enumerate(image_ids):
        if model.exists_image(image_id) and model.image(image_id).has_pose:
            rotations[k], posed[k] = model.image(image_id).cam_from_world().rotation.matrix(), True
    return rotations, posed


def _camera(path: Path, row: tuple[object, ...]) -> pycolmap.Camera:
    """Return the camera of a row of the table cameras."""
    camera_id, model_id, width, height, params, prior = row
    sizes = is_between(width, 0, _LARGEST_SIDE) and is_between(height, 0, _LARGEST_SIDE)
    sound = is_between(camera_id, 0, NO_ID) and isinstance(model_id, int) and sizes
    if not (sound and isinstance(params, bytes) and len(params) % 8 == 0):
        raise InputError(f"{path}: the camera with id {camera_id!r} is damaged; extract features again")
    values = np.frombuffer(params, dtype="<f8")
    known = {int(model) for name, model in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
    if model_id not in known:
        raise InputError(f"{path}: camera {camera_id} has the model {model_id}, which pycolmap does not know")
    camera = pycolmap.Camera(
        camera_id=camera_id,
        model=pycolmap.CameraModelId(model_id),
        width=width,
        height=height,
        params=values.tolist(),
        has_prior_focal_length=bool(prior),
    )
    if not (camera.verify_params() and np.isfinite(values).all()):
        raise InputError(f"{path}: the parameters of camera {camera_id} are damaged; extract features again")
    return camera
