"""The images of a COLMAP database: what `map` starts from.

Every frame stands at the origin, its axes those of the world. Intrinsics are those of the database:
calibrated, or COLMAP's guess (focal length 1.2 times the larger side) where `prior_focal_length` is not set.
Images of cameras that cannot be are left out, see `database_cameras`.
"""

import itertools
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.database_cameras import read_cameras
from sfm_shapefit.files.colmap.database_pairs import MAX_NUM_IMAGES, NO_ID, refuse_no_features
from sfm_shapefit.files.colmap.database_rigs import DatabaseRigs, read_rigs
from sfm_shapefit.files.colmap.images import bytes_of_name, images_of, sensors_of
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile, is_between
from sfm_shapefit.files.colmap.template import FrameHead, Template
from sfm_shapefit.scene.images import Frames, Images


@dataclass(frozen=True, slots=True, kw_only=True)
class UnposedImages:
    """What a database says of its images."""

    images: Images
    """All of them, those of rigs in frames together, all frames at the origin and in its axes."""
    reconstruction: pycolmap.Reconstruction
    """All cameras and images; each image in a frame of its own."""
    rigs: DatabaseRigs
    """Which of the images were taken together."""
    left_out: Mapping[str, str]
    """Why images of the database are not among these, by their names."""

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

    What was read otherwise than it stands there is noted in `file`.

    Raises:
        InputError: if it is no COLMAP database, an image is damaged, or fewer than two can be used.
    """
    columns = ("image_id", "name", "camera_id")
    cameras, path = read_cameras(file), file.path
    images = file.rows("images", {columns: f"SELECT {', '.join(columns)} FROM images ORDER BY 1"})
    if len(images) < 2:
        raise InputError(
            f"{path} has {len(images)} images, but two or more are needed; extract features first"
        )
    model, lost = pycolmap.Reconstruction(), dict[int, list[str]]()
    for camera in cameras.usable.values():
        model.add_camera_with_trivial_rig(camera)
    for image_id, name, camera_id in images:
        is_sound = is_between(image_id, 0, MAX_NUM_IMAGES) and isinstance(name, str)
        if is_sound and is_between(camera_id, 0, NO_ID) and camera_id in cameras.impossible:
            lost.setdefault(camera_id, []).append(name)
            continue
        if not (is_sound and is_between(camera_id, 0, NO_ID) and model.exists_camera(camera_id)):
            refuse_no_features(file)
            raise InputError(
                f"{path}: the image with id {image_id!r} has no valid name and camera; it is damaged"
            )
        if model.exists_image(image_id):
            raise InputError(f"{path}: the image with id {image_id} stands twice; remove one of them")
        image = pycolmap.Image(name=bytes_of_name(name), camera_id=camera_id, image_id=image_id)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    notes = list(cameras.notes(lost))
    if model.num_images() < 2:
        raise InputError(f"{path}: fewer than two images are left; {'; '.join(notes)}")
    file.notes += [note for note in notes if note not in file.notes]
    rigs = read_rigs(file, model, cameras.impossible)
    return UnposedImages(
        images=_put_in_rigs(images_of(model), rigs),
        reconstruction=model,
        rigs=rigs,
        left_out={
            name: f"its camera {i} {cameras.impossible[i]}" for i, names in lost.items() for name in names
        },
    )


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
