"""Two reconstructions as one: a second one moved into the world of a first."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.files.colmap.reconstructions import (
    add_point,
    bytes_of_name,
    name_of,
    points2d_xy,
    transform_model,
)

_LEAST_TRACK = 2  # observations; a point with fewer is none
_SAME_PIXEL = 0.5  # pixels; keypoints of two models that are no farther apart are one


def merge_models(
    first: pycolmap.Reconstruction,
    second: pycolmap.Reconstruction,
    first_from_second: Similarity,
    same_points: Sequence[tuple[int, int]] = (),
) -> tuple[pycolmap.Reconstruction, dict[int, int], dict[int, int]]:
    """Return a new reconstruction of the posed images and points of both, and new ids of their points.

    Images without a pose are left out. Images of the same name are one, which stays where the first has it;
    keypoints of the second that are none of the first's follow these, so that no observation is lost. Cameras
    of the same id and parameters are one, rigs if also their sensors stand alike; others of `second` get new
    ids. Frames of rigs stay together.

    Args:
        first, second: neither is changed.
        first_from_second: how the second one stands in the first one's world.
        same_points: ids of points of both that are one; each point at most once.

    Returns:
        The model, the new ids of the first one's points that changed, and those of the second one's.

    Raises:
        InputError: if a rig took some images of one frame in the first model and others in the second.
    """
    joined = pycolmap.Reconstruction(first)
    joined.tear_down()
    moved = transform_model(second, first_from_second)
    cameras: dict[int, int] = {}
    used = sorted({moved.frame(frame_id).rig_id for frame_id in moved.reg_frame_ids()})
    rig_ids = {rig_id: _add_rig(joined, moved, moved.rig(rig_id), cameras) for rig_id in used}
    image_ids = _add_frames(joined, moved, cameras, rig_ids)
    places = {i: _add_keypoints(joined.image(now), moved.image(i)) for i, now in image_ids.items()}
    new, same = _add_points(joined, moved, image_ids, places)
    renamed: dict[int, int] = {}
    for one, other in [*((one, new[other]) for one, other in same_points if other in new), *same]:
        if one not in renamed and other not in renamed.values():
            renamed[one] = joined.merge_points3D(one, other)
            new = {point: renamed[one] if now == other else now for point, now in new.items()}
    joined.update_point_3d_errors()
    return joined, renamed, new


def _add_frames(
    joined: pycolmap.Reconstruction,
    second: pycolmap.Reconstruction,
    cameras: dict[int, int],
    rig_ids: dict[int, int],
) -> dict[int, int]:
    """Add the posed frames that only the second model has, and return the new ids of all its posed images."""
    first_ids = {name_of(joined.image(i)): i for i in joined.reg_image_ids()}
    named = {i: name_of(second.image(i)) for i in second.reg_image_ids()}
    ids = {i: first_ids[name] for i, name in named.items() if name in first_ids}
    fresh = max([*joined.images, *second.images, *joined.frames, *second.frames], default=0) + 1
    for frame_id in sorted(second.reg_frame_ids()):
        members = [data.id for data in second.frame(frame_id).image_ids]
        if shared := [i for i in members if i in ids]:
            if len(shared) < len(members):
                name = named[shared[0]]
                raise InputError(f"a rig took {name} with images that only one of two models has")
            continue
        for i in members:
            ids[i] = i if i not in joined.images else fresh
            fresh += ids[i] == fresh
        new_id = frame_id if frame_id not in joined.frames else fresh
        fresh += new_id == fresh
        _add_frame(
            joined,
            second.frame(frame_id),
            new_id,
            [second.image(i) for i in sorted(members)],
            _Renamed(cameras, rig_ids, ids),
        )
    return ids


class _Renamed(NamedTuple):
    """New ids of what the second model has, by the old ones."""

    cameras: dict[int, int]
    rigs: dict[int, int]
    images: dict[int, int]


def _add_frame(
    joined: pycolmap.Reconstruction,
    before: pycolmap.Frame,
    frame_id: int,
    images: Sequence[pycolmap.Image],
    renamed: _Renamed,
) -> None:
    copies = [
        pycolmap.Image(
            name=bytes_of_name(name_of(image)),
            keypoints=points2d_xy(image),
            camera_id=renamed.cameras[image.camera_id],
            image_id=renamed.images[image.image_id],
        )
        for image in images
    ]
    frame = pycolmap.Frame(frame_id=frame_id, rig_id=renamed.rigs[before.rig_id])
    for copy in copies:
        frame.add_data_id(copy.data_id)
        copy.frame_id = frame_id
    frame.rig_from_world = before.rig_from_world
    joined.add_frame(frame)
    for copy in copies:
        joined.add_image(copy)
    joined.register_frame(frame_id)


def _add_keypoints(image: pycolmap.Image, other: pycolmap.Image) -> IntArray:
    """Return which keypoint of an image each one (k,) of the same image in another model is.

    What lies at none of its own is added behind these.
    """
    mine, others = points2d_xy(image), points2d_xy(other)
    if mine.shape == others.shape and (np.abs(mine - others) <= _SAME_PIXEL).all():
        return np.arange(len(mine))
    places = np.full(len(others), -1)
    if len(mine) and len(others):
        from scipy.spatial import KDTree  # here, since it takes long to import

        apart, nearest = map(np.asarray, KDTree(mine).query(others))
        is_mutual = np.asarray(KDTree(others).query(mine)[1])[nearest] == np.arange(len(others))
        is_same = is_mutual & (apart <= _SAME_PIXEL)
        places[is_same] = nearest[is_same]
    fresh = np.flatnonzero(places < 0)
    places[fresh] = len(mine) + np.arange(len(fresh))
    points2d = [*image.points2D, *pycolmap.Image(keypoints=others[fresh]).points2D]
    image.points2D.clear()  # the setter insists on it
    image.points2D = pycolmap.Point2DList(points2d)
    return places


def _add_points(
    joined: pycolmap.Reconstruction,
    second: pycolmap.Reconstruction,
    image_ids: dict[int, int],
    places: dict[int, IntArray],
) -> tuple[dict[int, int], list[tuple[int, int]]]:
    """Add the points of a second model; return their new ids, and those of points that are one.

    Images and their keypoints have the new ids and `places`. Points that the first model sees with all of
    their keypoints are left out.
    """
    new, same = {}, []
    last = max(joined.point3D_ids(), default=0)
    for point_id in sorted(second.point3D_ids()):
        point = second.point3D(point_id)
        fresh, meets = list[tuple[int, int]](), set[int]()
        for element in point.track.elements:
            if element.image_id not in places:
                continue
            image_id, place = image_ids[element.image_id], int(places[element.image_id][element.point2D_idx])
            seen = joined.image(image_id).points2D[place]
            if seen.has_point3D():
                meets.add(int(seen.point3D_id))
            else:
                fresh.append((image_id, place))
        if len(fresh) + len(meets) < _LEAST_TRACK or not fresh:
            continue
        last += 1
        new[point_id] = last
        add_point(joined, last, point.xyz, point.color, fresh)
        same += [(one, last) for one in sorted(meets)[:1]]
    return new, same


def _add_rig(
    joined: pycolmap.Reconstruction,
    second: pycolmap.Reconstruction,
    rig: pycolmap.Rig,
    cameras: dict[int, int],
) -> int:
    """Add a rig and note the ids of its cameras; return its id. One that is there serves."""
    members = sorted(sensor.id for sensor in rig.sensor_ids())
    for rig_id, known in joined.rigs.items():
        if _is_same_rig(known, rig) and all(
            _is_same_camera(joined.camera(i), second.camera(i)) for i in members
        ):
            cameras |= {i: i for i in members}
            return int(rig_id)
    added = pycolmap.Rig(rig_id=_free_id(joined, second) if rig.rig_id in joined.rigs else rig.rig_id)
    for camera_id in members:
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
