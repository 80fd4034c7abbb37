"""The door between models and `Images`: read once, and written so that only what changed does.

A model has more than `Images`: quaternions, sensors that are no cameras, keypoints. So images are not written
into a new one but into what they were read from, and what is the same by value there keeps its bits.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.files.colmap.model_arrays import CAMERA_SENSOR, ModelArrays, RigRecord, pose_of
from sfm_shapefit.scene.images import Frames, Images, Sensors


def images_of(model: ModelArrays) -> Images:
    """Return all images of a model, in the order of their names, those of one name by their ids."""
    every = model.images
    rows = np.array(
        sorted(range(len(every.names)), key=lambda k: (every.names[k], every.ids[k])), dtype=np.int64
    )
    frames, frame_of = np.unique(every.frame_of[rows], return_inverse=True)
    camera_ids, lens_of = np.unique(every.camera_ids[rows], return_inverse=True)
    lenses = {lens.id: lens for lens in model.lenses}
    rotations, centers = _poses(model.frames.poses[frames])
    return Images(
        names=tuple(every.names[k] for k in rows.tolist()),
        ids=every.ids[rows],
        frame_of=frame_of.ravel(),
        lens_of=lens_of.ravel(),
        frames=Frames(ids=model.frames.ids[frames], rotations=rotations, centers=centers),
        lenses=tuple(lenses[i] for i in camera_ids.tolist()),
        sensors=sensors_of(model.rigs, camera_ids.tolist()),
    )


def put_images(model: ModelArrays, images: Images) -> ModelArrays:
    """Return a model whose frames, sensors and lenses are as in `images`.

    What has the same value there to the last bit keeps its bits. Frames of `images` without a pose have none,
    and observe nothing.
    """
    lenses = {lens.id: lens.parameters for lens in images.lenses}
    rows = np.searchsorted(model.frames.ids, images.frames.ids)
    poses, posed = model.frames.poses.copy(), images.frames.is_posed
    earlier = _poses(poses[rows])
    for k, row in enumerate(rows.tolist()):
        rotation, center = images.frames.rotations[k], images.frames.centers[k]
        turns = bool((rotation != earlier[0][k]).any())
        if posed[k] and (turns or (center != earlier[1][k]).any()):
            poses[row, 4:] = -(rotation @ center)
            if turns:
                poses[row, :4] = pycolmap.Rotation3d(rotation).quat[[3, 0, 1, 2]]
    moved = replace(
        model,
        frames=model.frames._replace(poses=poses),
        rigs=_put_sensors(model.rigs, images),
        lenses=tuple(replace(lens, parameters=lenses.get(lens.id, lens.parameters)) for lens in model.lenses),
    )
    lost = rows[~posed & np.isfinite(earlier[0]).all(axis=(1, 2))]  # its position may be NaN
    return moved.without_poses(lost) if len(lost) else moved


def _put_sensors(rigs: Sequence[RigRecord], images: Images) -> tuple[RigRecord, ...]:
    """Return rigs whose cameras stand as in `images`; other sensors of theirs scale with these."""
    ids, after = [lens.id for lens in images.lenses], images.sensors
    earlier, changed = sensors_of(rigs, ids), []
    for rig in rigs:
        members = [k for k, camera_id in enumerate(ids) if (CAMERA_SENSOR, camera_id) in rig.sensors]
        lengths = [
            np.linalg.norm(sensors.translations[members], axis=1).sum() for sensors in (earlier, after)
        ]
        sensors = dict(rig.sensors)
        if lengths[0] > 0.0 and lengths[1] > 0.0 and lengths[0] != lengths[1]:
            for sensor, pose in rig.poses.items():
                if sensor[1] not in ids:
                    sensors[sensor] = np.append(pose[:4], lengths[1] / lengths[0] * pose[4:])
        for k in members:
            rotation, translation = after.rotations[k], after.translations[k]
            changes = (rotation != earlier.rotations[k]).any() or (
                translation != earlier.translations[k]
            ).any()
            if changes and np.isfinite(translation).all():
                turn = pycolmap.Rotation3d(rotation)
                sensors[CAMERA_SENSOR, ids[k]] = pose_of(pycolmap.Rigid3d(turn, translation))
        changed.append(RigRecord(rig.id, sensors))
    return tuple(changed)


def _poses(poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rotations (f, 3, 3) and centers (f, 3) of frames' poses (f, 7); NaN of those without one."""
    rotations = rotation_matrices(poses[:, :4])
    return rotations, -np.einsum("nba,nb->na", rotations, np.ascontiguousarray(poses[:, 4:]))


def rotation_matrices(quaternions: FloatArray) -> FloatArray:
    """Return the (n, 3, 3) rotations of quaternions (n, 4) w, x, y, z, which need not be of length 1."""
    w, x, y, z = normalized(quaternions).T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), 2, 0))


def sensors_of(rigs: Iterable[RigRecord], camera_ids: Sequence[int]) -> Sensors:
    """Return where cameras are in their rigs; one without a rig is the reference of its own."""
    rig_of, count = {i: rig for rig in rigs for i in rig.camera_ids}, len(camera_ids)
    rotations, translations = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    is_reference = np.ones(count, dtype=np.bool_)
    for k, camera_id in enumerate(camera_ids):
        rig, sensor = rig_of.get(camera_id), (CAMERA_SENSOR, camera_id)
        if rig is not None and rig.reference != sensor:
            is_reference[k] = False
            pose = rig.sensors[sensor]
            rotations[k] = np.nan if pose is None else rotation_matrices(pose[None, :4])[0]
            translations[k] = np.nan if pose is None else pose[4:]
    numbers = [rig_of[i].id if i in rig_of else -1 - i for i in camera_ids]
    return Sensors(
        rotations=rotations,
        translations=translations,
        rig_of=np.unique(numbers, return_inverse=True)[1].ravel(),
        is_reference=is_reference,
    )
