"""The images of a COLMAP database: what `map` starts from.

Every frame stands at the origin, its axes those of the world. Intrinsics are those of the database:
calibrated, or COLMAP's guess (focal length 1.2 times the larger side) where `prior_focal_length` is not set.
"""

import itertools
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.database_pairs import MAX_NUM_IMAGES, NO_ID, refuse_no_features
from sfm_shapefit.files.colmap.database_rigs import DatabaseRigs, read_rigs
from sfm_shapefit.files.colmap.images import images_of, sensors_of
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile, is_between
from sfm_shapefit.files.colmap.template import FrameHead, Template
from sfm_shapefit.scene.images import Frames, Images

_LARGEST_SIDE = 2**31  # pixels; no image has such a side, so that the row is damaged


@dataclass(frozen=True, slots=True, kw_only=True)
class UnposedImages:
    """What a database says of its images."""

    images: Images
    """All of them, those of rigs in frames together, all frames at the origin and in its axes."""
    reconstruction: pycolmap.Reconstruction
    """All cameras and images; each image in a frame of its own."""
    rigs: DatabaseRigs
    """Which of the images were taken together."""

    def template(self, images: Images) -> Template:
        """Return the template of a model of some images, all frames at the origin."""
        known, places = self.reconstruction, self.rigs.place_of_image
        own = [known.image(image_id) for image_id in images.ids.tolist()]
        used = {places[image.image_id].rig_id for image in own if image.image_id in places}
        in_rigs = {camera_id for rig_id in used for camera_id in self.rigs.camera_ids(rig_id)}
        alone = sorted({image.camera_id for image in own} - in_rigs)
        rig_ids = _free_ids(used, alone)
        rigs = [trivial_rig(known.camera(camera_id)) for camera_id in alone]
        frames: dict[int, FrameHead] = {}
        for image in own:
            place = places.get(image.image_id)
            frame_id = image.image_id if place is None else place.frame_id
            rig_id = image.camera_id if place is None else rig_ids[place.rig_id]
            frame = frames.setdefault(frame_id, FrameHead(frame_id, rig_id, (), pycolmap.Rigid3d()))
            frames[frame_id] = frame._replace(data_ids=(*frame.data_ids, image.data_id))
        return Template(
            cameras=tuple(known.camera(camera_id) for camera_id in (*alone, *sorted(in_rigs))),
            rigs=(*rigs, *(self.rigs.renumbered(rig_id, rig_ids[rig_id]) for rig_id in sorted(used))),
            frames=tuple(frames.values()),
            images=tuple(own),
        )


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
            refuse_no_features(file)
            raise InputError(
                f"{path}: the image with id {image_id!r} has no valid name and camera; it is damaged"
            )
        if any("\ud800" <= letter <= "\udfff" for letter in name):  # what is no UTF-8 is read as these
            raise InputError(f"{path}: the name {name!r} of an image is no UTF-8; rename that image")
        if model.exists_image(image_id):
            raise InputError(f"{path}: the image with id {image_id} stands twice; remove one of them")
        image = pycolmap.Image(name=name, camera_id=camera_id, image_id=image_id)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    rigs = read_rigs(file, model)
    return UnposedImages(images=_put_in_rigs(images_of(model), rigs), reconstruction=model, rigs=rigs)


def _put_in_rigs(alone: Images, rigs: DatabaseRigs) -> Images:
    """Return images in the frames of their rigs."""
    places = rigs.place_of_image
    frame_ids = [places[i].frame_id if i in places else i for i in alone.ids.tolist()]
    ids, frame_of = np.unique(frame_ids, return_inverse=True)
    sensors = sensors_of(rigs.rigs.values(), [lens.id for lens in alone.lenses])
    frames = Frames(ids=ids, rotations=np.tile(np.eye(3), (len(ids), 1, 1)), centers=np.zeros((len(ids), 3)))
    return replace(alone, frame_of=frame_of.ravel(), frames=frames, sensors=sensors)


def trivial_rig(camera: pycolmap.Camera) -> pycolmap.Rig:
    """Return the rig of a camera alone, which has its id."""
    rig = pycolmap.Rig(rig_id=camera.camera_id)
    rig.add_ref_sensor(camera.sensor_id)
    return rig


def _free_ids(wanted: set[int], taken: Collection[int]) -> dict[int, int]:
    """Return an id for each of the wanted ones: itself unless it is taken."""
    free = (i for i in itertools.count(1) if i not in taken and i not in wanted)
    return {i: next(free) if i in taken else i for i in sorted(wanted)}


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
