"""The images of a COLMAP database: what `map` starts from.

Every frame stands at the origin, its axes those of the world. Intrinsics are those of the database:
calibrated, or COLMAP's guess (focal length 1.2 times the larger side) where `prior_focal_length` is not set.
Images of cameras that cannot be are left out, see `database_cameras`.
"""

import itertools
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.database_cameras import read_cameras
from sfm_shapefit.files.colmap.database_pairs import MAX_NUM_IMAGES, NO_ID, refuse_no_features
from sfm_shapefit.files.colmap.database_rigs import DatabaseRigs, read_rigs
from sfm_shapefit.files.colmap.images import images_of, sensors_of
from sfm_shapefit.files.colmap.lenses import lens_of
from sfm_shapefit.files.colmap.model_arrays import (
    CAMERA_SENSOR,
    ORIGIN,
    FrameRecords,
    ImageRecords,
    ModelArrays,
    trivial_rig,
)
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile, is_between
from sfm_shapefit.files.colmap.template import Template
from sfm_shapefit.scene.images import Frames, Images


@dataclass(frozen=True, slots=True, kw_only=True)
class UnposedImages:
    """What a database says of its images."""

    images: Images
    """All of them, those of rigs in frames together, all frames at the origin and in its axes."""
    model: ModelArrays
    """All cameras and images; each image in a frame of its own, at the origin."""
    rigs: DatabaseRigs
    """Which of the images were taken together."""
    left_out: Mapping[str, str]
    """Why images of the database are not among these, by their names."""

    def template(self, images: Images) -> Template:
        """Return the template of a model of some images, all frames at the origin."""
        every, places = self.model.images, self.rigs.place_of_image
        rows = every.rows(np.sort(images.ids))
        pairs = list(zip(every.ids[rows].tolist(), every.camera_ids[rows].tolist(), strict=True))
        used = sorted({places[image_id].rig_id for image_id, _ in pairs if image_id in places})
        in_rigs = {camera_id for rig_id in used for camera_id in self.rigs.rigs[rig_id].camera_ids}
        alone = {camera_id for _, camera_id in pairs} - in_rigs
        rig_ids = _free_ids(set(used), alone)
        rigs = [*map(trivial_rig, alone), *(self.rigs.rigs[i]._replace(id=rig_ids[i]) for i in used)]
        frames: dict[int, int] = {}
        data: dict[int, tuple[tuple[int, int, int], ...]] = {}
        for image_id, camera_id in pairs:
            place = places.get(image_id)
            frame_id = image_id if place is None else place.frame_id
            frames[frame_id] = camera_id if place is None else rig_ids[place.rig_id]
            data[frame_id] = (*data.get(frame_id, ()), (CAMERA_SENSOR, camera_id, image_id))
        ids = np.array(sorted(frames), dtype=np.int64)
        of_image = [places[i].frame_id if i in places else i for i, _ in pairs]
        names = tuple(every.names[row] for row in rows.tolist())
        return Template(
            model=replace(
                self.model,
                lenses=tuple(lens for lens in self.model.lenses if lens.id in alone | in_rigs),
                rigs=tuple(sorted(rigs, key=lambda rig: rig.id)),
                frames=FrameRecords(
                    ids=ids,
                    rig_ids=np.array([frames[i] for i in ids.tolist()], dtype=np.int64),
                    poses=np.tile(ORIGIN, (len(ids), 1)),
                    data=tuple(data[i] for i in ids.tolist()),
                ),
                images=ImageRecords(
                    every.ids[rows], every.camera_ids[rows], np.searchsorted(ids, of_image), names
                ),
                offsets=np.zeros(len(rows) + 1, dtype=np.int64),
            )
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
    lost, camera_of, names = dict[int, list[str]](), dict[int, int](), dict[int, str]()
    for image_id, name, camera_id in images:
        is_sound = is_between(image_id, 0, MAX_NUM_IMAGES) and isinstance(name, str)
        if is_sound and is_between(camera_id, 0, NO_ID) and camera_id in cameras.impossible:
            lost.setdefault(camera_id, []).append(name)
            continue
        if not (is_sound and is_between(camera_id, 0, NO_ID) and camera_id in cameras.usable):
            refuse_no_features(file)
            raise InputError(
                f"{path}: the image with id {image_id!r} has no valid name and camera; it is damaged"
            )
        if image_id in camera_of:
            raise InputError(f"{path}: the image with id {image_id} appears twice; remove one of them")
        camera_of[image_id], names[image_id] = camera_id, name
    notes = list(cameras.notes(lost))
    if len(camera_of) < 2:
        raise InputError(f"{path}: fewer than two images are left; {'; '.join(notes)}")
    file.notes += [note for note in notes if note not in file.notes]
    rigs = read_rigs(file, cameras.usable, camera_of, cameras.impossible)
    ids = sorted(names)
    image_ids, camera_ids = (np.array(a, dtype=np.int64) for a in (ids, [camera_of[i] for i in ids]))
    usable = cameras.usable.items()
    model = ModelArrays.alone(
        tuple(lens_of(camera) for _, camera in sorted(usable, key=lambda item: item[0])),
        ImageRecords(image_ids, camera_ids, image_ids, tuple(names[i] for i in ids)),
        np.tile(ORIGIN, (len(ids), 1)),
        frozenset(i for i, camera in usable if camera.has_prior_focal_length),
    )
    return UnposedImages(
        images=_put_in_rigs(images_of(model), rigs),
        model=model,
        rigs=rigs,
        left_out={
            name: f"its camera {i} {cameras.impossible[i]}" for i, names in lost.items() for name in names
        },
    )


def _put_in_rigs(alone: Images, rigs: DatabaseRigs) -> Images:
    places = rigs.place_of_image
    frame_ids = [places[i].frame_id if i in places else i for i in alone.ids.tolist()]
    ids, frame_of = np.unique(frame_ids, return_inverse=True)
    sensors = sensors_of(rigs.rigs.values(), [lens.id for lens in alone.lenses])
    frames = Frames(ids=ids, rotations=np.tile(np.eye(3), (len(ids), 1, 1)), centers=np.zeros((len(ids), 3)))
    return replace(alone, frame_of=frame_of.ravel(), frames=frames, sensors=sensors)


def _free_ids(wanted: set[int], taken: Collection[int]) -> dict[int, int]:
    """Return an id for each of the wanted ones: itself unless it is taken."""
    free = (i for i in itertools.count(1) if i not in taken and i not in wanted)
    return {i: next(free) if i in taken else i for i in sorted(wanted)}
