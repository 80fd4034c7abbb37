"""Two reconstructions as one: a second one moved into the world of a first, which share no image."""

from collections.abc import Sequence

import numpy as np
import pycolmap

from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.files.colmap.points import points2d_xy
from sfm_shapefit.files.colmap.seed import transform_model


def merge_models(
    first: pycolmap.Reconstruction,
    second: pycolmap.Reconstruction,
    first_from_second: Similarity,
    same_points: Sequence[tuple[int, int]] = (),
) -> tuple[pycolmap.Reconstruction, dict[int, int], dict[int, int]]:
    """Return a new reconstruction of the posed images and points of both, and new ids of their points.

    Cameras of the same id and parameters are one, rigs if also their sensors stand alike; others of `second`
    get new ids. Frames of rigs stay together.

    Args:
        first, second: neither is changed.
        first_from_second: how the second one stands in the first one's world.
        same_points: ids of points of both that are one; each point at most once.

    Returns:
        The model, the new ids of the first one's points that changed, and those of all of the second one's.
    """
    joined = pycolmap.Reconstruction(first)
    moved = transform_model(second, first_from_second)
    rigs = {rig_id: rig for rig_id, rig in moved.rigs.items() if rig.num_sensors() > 1}
    in_rigs = {sensor.id for rig in rigs.values() for sensor in rig.sensor_ids()}
    cameras = _add_cameras(joined, moved, in_rigs)
    rig_ids = {}
    for rig_id, rig in sorted(rigs.items()):
        rig_ids[rig_id] = _add_rig(joined, moved, rig, cameras)
    for frame_id in sorted(moved.reg_frame_ids()):
        _add_frame(joined, moved, frame_id, cameras, rig_ids)
    new = {}
    last = max(joined.point3D_ids(), default=0)
    for number, point_id in enumerate(sorted(moved.point3D_ids()), start=1):
        point = moved.point3D(point_id)
        new[point_id] = last + number
        copy = pycolmap.Point3D(xyz=point.xyz, track=point.track)
        copy.color = point.color
        joined.add_point3D_with_id(new[point_id], copy)
    renamed = {}
    for one, other in same_points:
        new[other] = renamed[one] = joined.merge_points3D(one, new[other])
    joined.update_point_3d_errors()
    return joined, renamed, new


def _add_frame(
    joined: pycolmap.Reconstruction,
    second: pycolmap.Reconstruction,
    frame_id: int,
    cameras: dict[int, int],
    rig_ids: dict[int, int],
) -> None:
    """Add a posed frame of a second model with its images; cameras and rigs of several have new ids."""
    before = second.frame(frame_id)
    images = [second.image(data.id) for data in sorted(before.image_ids, key=lambda data: data.id)]
    frame = None
    if before.rig_id in rig_ids:
        frame = pycolmap.Frame(frame_id=frame_id, rig_id=rig_ids[before.rig_id])
    added = []
    for image in images:
        if joined.exists_image(image.image_id):
            raise ValueError(f"both models have the image {image.name}")
        copy = pycolmap.Image(
            name=image.name,
            keypoints=points2d_xy(image),
            camera_id=cameras[image.camera_id],
            image_id=image.image_id,
        )
        if frame is None:
            joined.add_image_with_trivial_frame(copy, image.cam_from_world())
            continue
        frame.add_data_id(copy.data_id)
        copy.frame_id = frame_id
        added.append(copy)
    if frame is None:
        return
    frame.rig_from_world = before.rig_from_world
    joined.add_frame(frame)
    for copy in added:
        joined.add_image(copy)
    joined.register_frame(frame_id)


def _add_cameras(
    joined: pycolmap.Reconstruction, second: pycolmap.Reconstruction, in_rigs: set[int]
) -> dict[int, int]:
    """Add the cameras of a second model but those in rigs of several, and return their ids."""
    ids = {}
    for camera_id in sorted({second.image(i).camera_id for i in second.reg_image_ids()} - in_rigs):
        ids[camera_id] = camera_id
        if camera_id in joined.cameras:
            if _is_same_camera(joined.camera(camera_id), second.camera(camera_id)):
                continue
            ids[camera_id] = _free_id(joined, second)
        joined.add_camera_with_trivial_rig(_renamed(second.camera(camera_id), ids[camera_id]))
    return ids


def _add_rig(
    joined: pycolmap.Reconstruction,
    second: pycolmap.Reconstruction,
    rig: pycolmap.Rig,
    cameras: dict[int, int],
) -> int:
    """Add a rig of several cameras and note the ids of these; return its id. One that is there serves."""
    own = sorted(sensor.id for sensor in rig.sensor_ids())
    for rig_id, there in joined.rigs.items():
        if _is_same_rig(there, rig) and all(_is_same_camera(joined.camera(i), second.camera(i)) for i in own):
            cameras |= {i: i for i in own}
            return int(rig_id)
    added = pycolmap.Rig(rig_id=_free_id(joined, second))
    for camera_id in own:
        taken = camera_id in joined.cameras
        cameras[camera_id] = _free_id(joined, second) if taken else camera_id
        joined.add_camera(_renamed(second.camera(camera_id), cameras[camera_id]))
    added.add_ref_sensor(joined.camera(cameras[rig.ref_sensor_id.id]).sensor_id)
    for sensor, pose in rig.non_ref_sensors.items():
        added.add_sensor(joined.camera(cameras[sensor.id]).sensor_id, pose)
    joined.add_rig(added)
    return int(added.rig_id)


def _is_same_camera(one: pycolmap.Camera, other: pycolmap.Camera) -> bool:
    return one.model == other.model and np.array_equal(one.params, other.params)


def _is_same_rig(one: pycolmap.Rig, other: pycolmap.Rig) -> bool:
    """Return whether two rigs have the same sensors at the same poses, up to rounding."""
    if one.ref_sensor_id != other.ref_sensor_id or set(one.non_ref_sensors) != set(other.non_ref_sensors):
        return False
    pairs = [(one.sensor_from_rig(s), other.sensor_from_rig(s)) for s in one.non_ref_sensors]
    return all(a and b and np.allclose(a.matrix(), b.matrix(), rtol=0.0, atol=1e-9) for a, b in pairs)


def _free_id(joined: pycolmap.Reconstruction, second: pycolmap.Reconstruction) -> int:
    """Return an id that no camera and no rig of either model has."""
    return max([*joined.cameras, *joined.rigs, *second.cameras, *second.rigs], default=0) + 1


def _renamed(camera: pycolmap.Camera, camera_id: int) -> pycolmap.Camera:
    copy = pycolmap.Camera(camera.todict())
    copy.camera_id = camera_id
    return copy
