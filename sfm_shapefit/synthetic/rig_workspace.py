"""The rigs and frames of a synthetic scene in COLMAP's terms, for models and databases.

Sensor s of rig r is camera 3 r + s + 1, for COLMAP has every camera in one rig; frame f has id f + 1.
"""

import copy

import numpy as np
import pycolmap

from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.synthetic import RigScene


def camera_id_of(rigs: RigScene, index: int) -> int:
    """Return the id of the camera of image `index`."""
    rig = int(rigs.rig_of_frame[rigs.frame_of_image[index]])
    return rig * int(rigs.sensor_centers.shape[1]) + int(rigs.sensor_of_image[index]) + 1


def new_rigs(rigs: RigScene, camera: pycolmap.Camera) -> tuple[list[pycolmap.Camera], list[pycolmap.Rig]]:
    """Return the cameras, all alike, and the rigs with the poses of their sensors."""
    count, sensors = rigs.sensor_centers.shape[:2]
    cameras, made = [], []
    for r in range(count):
        rig = pycolmap.Rig(rig_id=r + 1)
        for s in range(sensors):
            own = copy.copy(camera)
            own.camera_id = r * sensors + s + 1
            cameras.append(own)
            if s == 0:
                rig.add_ref_sensor(own.sensor_id)
            else:
                rotation = rigs.sensor_rotations[r, s]
                pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ rigs.sensor_centers[r, s])
                rig.add_sensor(own.sensor_id, pose)
        made.append(rig)
    return cameras, made


def new_frames(rigs: RigScene, images: list[pycolmap.Image]) -> list[pycolmap.Frame]:
    """Return the frames of the images, without poses; each image is told its frame."""
    frames = [pycolmap.Frame(frame_id=f + 1, rig_id=int(rig) + 1) for f, rig in enumerate(rigs.rig_of_frame)]
    for index, image in enumerate(images):
        frames[rigs.frame_of_image[index]].add_data_id(image.data_id)
        image.frame_id = int(rigs.frame_of_image[index]) + 1
    return frames


def rig_model(
    rigs: RigScene, camera: pycolmap.Camera, images: list[pycolmap.Image], centers: FloatArray
) -> pycolmap.Reconstruction:
    """Return a model with the true rotations and no points.

    Args:
        rigs: the scene.
        camera: whose intrinsics all have.
        images: in the order of the scene, with their cameras' ids.
        centers: (f, 3) centers of the frames.
    """
    model = pycolmap.Reconstruction()
    cameras, made = new_rigs(rigs, camera)
    for own in cameras:
        model.add_camera(own)
    for rig in made:
        model.add_rig(rig)
    first = np.flatnonzero(rigs.sensor_of_image == 0)
    for f, frame in enumerate(new_frames(rigs, images)):
        rotation = rigs.scene.rotations[first[f]]  # the reference sensor's axes are the rig's
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centers[f])
        model.add_frame(frame)
    for image in images:
        model.add_image(image)
    return model
