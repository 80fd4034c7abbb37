"""Images and models of other programs as COLMAP's models, and pose graphs as relative poses."""

import numpy as np
import pycolmap

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.model_arrays import ImageRecords, ModelArrays, pose_of
from sfm_shapefit.files.colmap.seed import SeededModel
from sfm_shapefit.files.colmap.template import Template
from sfm_shapefit.files.onedsfm import EpipolarGeometries
from sfm_shapefit.files.opensfm import OpenSfmModel
from sfm_shapefit.scene.images import Images


def model_of_images(images: Images) -> ModelArrays:
    """Return the model of images in frames of their own, without keypoints, all focal lengths known."""
    order, frames = np.argsort(images.ids), images.frames
    poses = [
        pose_of(pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ center))
        for rotation, center in zip(frames.rotations[order], frames.centers[order], strict=True)
    ]
    camera_ids = np.array([lens.id for lens in images.lenses], dtype=np.int64)
    return ModelArrays.alone(
        tuple(images.lenses[k] for k in np.argsort(camera_ids).tolist()),
        ImageRecords(
            images.ids[order],
            camera_ids[images.lens_of[order]],
            order,
            tuple(images.names[k] for k in order.tolist()),
        ),
        np.array(poses),
        frozenset(camera_ids.tolist()),
    )


def model_of_opensfm(read: OpenSfmModel) -> pycolmap.Reconstruction:
    """Return a model of OpenSfM as a new reconstruction."""
    template = Template(model=model_of_images(read.images))
    seed = SeededModel(
        template=template,
        images=read.images,
        points=read.points,
        colors=read.colors,
        keypoints=tuple(read.keypoints),
    )
    seed.reconstruction.update_point_3d_errors()
    return seed.reconstruction


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
