"""Models of OpenSfM as reconstructions, and pose graphs as relative poses."""

import numpy as np
import pycolmap

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.images import bytes_of_name
from sfm_shapefit.files.colmap.lenses import camera_of
from sfm_shapefit.files.colmap.points import add_points
from sfm_shapefit.files.onedsfm import EpipolarGeometries
from sfm_shapefit.files.opensfm import OpenSfmModel


def reconstruction_of(read: OpenSfmModel) -> pycolmap.Reconstruction:
    """Return a model of OpenSfM as a new reconstruction: a frame for each image, all focal lengths known."""
    model, images = pycolmap.Reconstruction(), read.images
    for lens in images.lenses:
        camera = camera_of(lens)
        camera.has_prior_focal_length = True
        model.add_camera_with_trivial_rig(camera)
    for k, xy in enumerate(read.keypoints):
        rotation, camera_id = images.frames.rotations[k], images.lenses[images.lens_of[k]].id
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ images.frames.centers[k])
        image = pycolmap.Image(
            name=bytes_of_name(images.names[k]),
            keypoints=xy,
            camera_id=camera_id,
            image_id=int(images.ids[k]),
        )
        model.add_image_with_trivial_frame(image, pose)
    add_points(model, images.ids, read.points, read.colors)
    model.update_point_3d_errors()
    return model


def relative_poses_of(graph: pycolmap.PoseGraph) -> EpipolarGeometries:
    """Return the valid edges of a pose graph that have a direction; the names are the image ids.

    Raises:
        InputError: if it has none.
    """
    ids, rotations, to_second, num_matches = [], [], [], []
    for pair_id in sorted(graph.edges):
        edge = graph.edges[pair_id]
        pose = edge.cam2_from_cam1
        length = np.linalg.norm(pose.translation)
        if edge.valid and np.isfinite(pose.matrix()).all() and length > 0.0:
            ids.append(pycolmap.pair_id_to_image_pair(pair_id))
            rotations.append(pose.rotation.matrix())
            to_second.append(-rotations[-1].T @ pose.translation / length)
            num_matches.append(float(edge.num_matches))
    if not ids:
        raise InputError("the pose graph has no valid edge with a translation; load it from verified matches")
    known, pairs = np.unique(np.array(ids, dtype=np.int64), return_inverse=True)
    return EpipolarGeometries(
        names=tuple(str(image_id) for image_id in known.tolist()),
        pairs=pairs.reshape(-1, 2).astype(np.int64),
        rotations=np.array(rotations),
        to_second=np.array(to_second),
        num_matches=np.array(num_matches) if min(num_matches) > 0.0 else None,  # 0 where nobody counted
    )
