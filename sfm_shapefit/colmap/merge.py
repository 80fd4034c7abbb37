"""Two reconstructions as one: a second one moved into the world of a first, which share no image."""

from collections.abc import Sequence

import numpy as np
import pycolmap

from sfm_shapefit.colmap.model import points2d_xy
from sfm_shapefit.colmap.seed import transform_model
from sfm_shapefit.geometry import Similarity


def merge_models(
    first: pycolmap.Reconstruction,
    second: pycolmap.Reconstruction,
    first_from_second: Similarity,
    same_points: Sequence[tuple[int, int]] = (),
) -> tuple[pycolmap.Reconstruction, dict[int, int], dict[int, int]]:
    """Return a new reconstruction of the posed images and points of both, and new ids of their points.

    Cameras of the same id and parameters are one; others of `second` get new ids. Each image is a frame.

    Args:
        first, second: without rigs of several cameras; neither is changed.
        first_from_second: how the second one stands in the first one's world.
        same_points: ids of points of both that are one; each point at most once.

    Returns:
        The model, the new ids of the first one's points that changed, and those of all of the second one's.
    """
    joined = pycolmap.Reconstruction(first)
    moved = transform_model(second, first_from_second)
    cameras = _add_cameras(joined, moved)
    for image_id in sorted(moved.reg_image_ids()):
        image = moved.image(image_id)
        added = pycolmap.Image(
            name=image.name,
            keypoints=points2d_xy(image),
            camera_id=cameras[image.camera_id],
            image_id=image_id,
        )
        if joined.exists_image(image_id):
            raise ValueError(f"both models have the image {image.name}")
        joined.add_image_with_trivial_frame(added, image.cam_from_world())
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


def _add_cameras(joined: pycolmap.Reconstruction, second: pycolmap.Reconstruction) -> dict[int, int]:
    """Add the cameras of a second model, and return their ids."""
    ids = {}
    free = max([*joined.cameras, *joined.rigs, *second.cameras, *second.rigs], default=0) + 1
    for camera_id in sorted({second.image(i).camera_id for i in second.reg_image_ids()}):
        camera = second.camera(camera_id)
        ids[camera_id] = camera_id
        if camera_id in joined.cameras:
            own = joined.camera(camera_id)
            if own.model == camera.model and np.array_equal(own.params, camera.params):
                continue
            ids[camera_id] = free
            free += 1
        copy = pycolmap.Camera(camera.todict())
        copy.camera_id = ids[camera_id]
        joined.add_camera_with_trivial_rig(copy)
    return ids
