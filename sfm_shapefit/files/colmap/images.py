"""The door between reconstructions and `Images`: read once, and written so that only what changed does.

A reconstruction knows more than arrays hold: quaternions, sensors that are no cameras, points2D, colors. So
images are not written into a new one but into what they were read from, and what is the same by value there
keeps its bits.
"""

from collections.abc import Iterable, Sequence

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.files.colmap.lenses import lens_of
from sfm_shapefit.scene.images import Frames, Images, Sensors


def name_of(image: pycolmap.Image) -> str:
    """Return the name of an image; its bytes that are no UTF-8 become lone surrogates, as Python's own do."""
    try:
        return str(image.name)
    except UnicodeDecodeError as error:
        return error.object.decode("utf-8", "surrogateescape")


def bytes_of_name(name: str) -> bytes:
    """Return the name that a new image of pycolmap is to have."""
    return name.encode("utf-8", "surrogateescape")


def images_of(reconstruction: pycolmap.Reconstruction) -> Images:
    """Return all images of a reconstruction, in the order of their names, those of one name by their ids."""
    every = ((name_of(image), image) for image in reconstruction.images.values())
    named = sorted(every, key=lambda one: (one[0], one[1].image_id))
    images = [image for _, image in named]
    frame_ids, frame_of = np.unique([image.frame_id for image in images], return_inverse=True)
    camera_ids, camera_of = np.unique([image.camera_id for image in images], return_inverse=True)
    rotations, centers = _poses(reconstruction, frame_ids.tolist())
    return Images(
        names=tuple(name for name, _ in named),
        ids=np.array([image.image_id for image in images], dtype=np.int64),
        frame_of=frame_of.ravel(),
        lens_of=camera_of.ravel(),
        frames=Frames(ids=frame_ids, rotations=rotations, centers=centers),
        lenses=tuple(lens_of(reconstruction.camera(i)) for i in camera_ids.tolist()),
        sensors=sensors_of(reconstruction.rigs.values(), camera_ids.tolist()),
    )


def put_images(reconstruction: pycolmap.Reconstruction, images: Images) -> None:
    """Let frames, sensors and lenses of our own `reconstruction` be as in `images`; points stay.

    Args:
        reconstruction: changed in place; what has the same value there to the last bit keeps its bits.
        images: some or all of it. Frames without a pose are deregistered, with what they observe.
    """
    own, posed = images.frames.ids.tolist(), images.frames.is_posed
    rotations, centers = _poses(reconstruction, own)
    for k, frame_id in enumerate(own):
        rotation, center = images.frames.rotations[k], images.frames.centers[k]
        if not posed[k]:
            if np.isfinite(rotations[k]).all():  # its position may be NaN
                reconstruction.deregister_frame(frame_id)
            continue
        turns = bool((rotation != rotations[k]).any())
        if turns or (center != centers[k]).any():
            frame = reconstruction.frame(frame_id)
            old = frame.rig_from_world
            turn = pycolmap.Rotation3d(rotation) if turns or old is None else old.rotation
            frame.rig_from_world = pycolmap.Rigid3d(turn, -(rotation @ center))
            if old is None:
                reconstruction.register_frame(frame_id)
    camera_ids = [lens.id for lens in images.lenses]
    before, after = sensors_of(reconstruction.rigs.values(), camera_ids), images.sensors
    _scale_other_sensors(reconstruction, camera_ids, before, after)
    for k, lens in enumerate(images.lenses):
        camera = reconstruction.camera(lens.id)
        rotation, translation = after.rotations[k], after.translations[k]
        changes = (rotation != before.rotations[k]).any() or (translation != before.translations[k]).any()
        if changes and np.isfinite(translation).all():
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)
            rigs_by_camera(reconstruction.rigs.values())[lens.id].set_sensor_from_rig(camera.sensor_id, pose)
        if lens.parameters != tuple(camera.params.tolist()):
            camera.params = list(lens.parameters)


def _scale_other_sensors(
    reconstruction: pycolmap.Reconstruction, camera_ids: list[int], before: Sensors, after: Sensors
) -> None:
    """Let sensors through which no image of ours was taken scale with those of their rig that are ours."""
    for rig in reconstruction.rigs.values():
        own = [k for k, camera_id in enumerate(camera_ids) if rig.has_sensor(sensor_id(camera_id))]
        lengths = [np.linalg.norm(sensors.translations[own], axis=1).sum() for sensors in (before, after)]
        if not (lengths[0] > 0.0 and lengths[1] > 0.0 and lengths[0] != lengths[1]):
            continue
        for sensor, pose in rig.non_ref_sensors.items():
            if pose is not None and sensor.id not in camera_ids:
                moved = pycolmap.Rigid3d(pose.rotation, lengths[1] / lengths[0] * pose.translation)
                rig.set_sensor_from_rig(sensor, moved)


def sensor_id(camera_id: int) -> pycolmap.sensor_t:
    """Return the id of a camera as a sensor."""
    return pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=camera_id)


def _poses(reconstruction: pycolmap.Reconstruction, frame_ids: list[int]) -> tuple[FloatArray, FloatArray]:
    """Return rotations (f, 3, 3) and centers (f, 3) of frames; NaN of those without a pose."""
    quaternions, translations = np.full((len(frame_ids), 4), np.nan), np.full((len(frame_ids), 3), np.nan)
    for k, frame_id in enumerate(frame_ids):
        pose = reconstruction.frame(frame_id).rig_from_world
        if pose is not None:
            quaternions[k], translations[k] = pose.rotation.quat, pose.translation
    rotations = rotation_matrices(quaternions)
    return rotations, -np.einsum("nba,nb->na", rotations, translations)


def rotation_matrices(quaternions: FloatArray) -> FloatArray:
    """Return the (n, 3, 3) rotations of quaternions (n, 4) x, y, z, w, which need not be of length 1."""
    w, x, y, z = normalized(quaternions[:, [3, 0, 1, 2]]).T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), 2, 0))


def sensors_of(all_rigs: Iterable[pycolmap.Rig], camera_ids: Sequence[int]) -> Sensors:
    """Return where cameras are in their rigs; one without a rig is the reference of its own."""
    rigs, count = rigs_by_camera(all_rigs), len(camera_ids)
    rotations, translations = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    is_reference = np.ones(count, dtype=np.bool_)
    for k, camera_id in enumerate(camera_ids):
        rig, sensor = rigs.get(camera_id), sensor_id(camera_id)
        if rig is not None and not rig.is_ref_sensor(sensor):
            is_reference[k] = False
            pose = rig.sensor_from_rig(sensor) if rig.has_sensor_from_rig(sensor) else None
            rotations[k] = np.nan if pose is None else rotation_matrices(pose.rotation.quat[None])[0]
            translations[k] = np.nan if pose is None else pose.translation
    numbers = [rigs[i].rig_id if i in rigs else -1 - i for i in camera_ids]
    return Sensors(
        rotations=rotations,
        translations=translations,
        rig_of=np.unique(numbers, return_inverse=True)[1].ravel(),
        is_reference=is_reference,
    )


def rigs_by_camera(rigs: Iterable[pycolmap.Rig]) -> dict[int, pycolmap.Rig]:
    """Return the rig of each camera by its id."""
    kind = pycolmap.SensorType.CAMERA
    return {sensor.id: rig for rig in rigs for sensor in rig.sensor_ids() if sensor.type == kind}
