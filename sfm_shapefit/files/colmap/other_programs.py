"""Models of OpenSfM as reconstructions, and reconstructions as plain scenes and relative poses."""

from pathlib import Path

import numpy as np
import pycolmap

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.points import add_points
from sfm_shapefit.files.onedsfm import EpipolarGeometries
from sfm_shapefit.scene.points import Points
from sfm_shapefit.scene.posed_model import Intrinsics, PosedModelFile, model_of_images


def reconstruction_of(scene: PosedModelFile, label: Path | str) -> pycolmap.Reconstruction:
    """Return a scene as a new reconstruction: cameras and images from id 1 on, a frame for each image.

    Points seen by fewer than two images are left out. If an image observes a point several times, the first
    observation counts.

    Raises:
        InputError: if a name stands twice, or a camera is refused by pycolmap; `label` names the file.
    """
    repeated = {name for k, name in enumerate(scene.names) if name in scene.names[:k]}
    if repeated:
        raise InputError(f"{label} has two images of the name {min(repeated)}; rename one")
    model = pycolmap.Reconstruction()
    for k, camera in enumerate(scene.cameras, start=1):
        made = make_camera(camera, k)
        if not made.verify_params():
            raise InputError(f"{label}: camera {k - 1} has parameters that do not fit {camera.model}")
        model.add_camera_with_trivial_rig(made)
    first = np.sort(np.unique(scene.observed, axis=0, return_index=True)[1])
    often = np.bincount(scene.observed[first, 0], minlength=1)[scene.observed[first, 0]] >= 2
    kept = first[often]
    kept = kept[np.argsort(scene.observed[kept, 1], kind="stable")]
    observed, pixels = scene.observed[kept], scene.pixels[kept]
    bounds = np.searchsorted(observed[:, 1], np.arange(len(scene.names) + 1))
    for k, name in enumerate(scene.names):
        image = pycolmap.Image(
            name=name,
            keypoints=np.ascontiguousarray(pixels[bounds[k] : bounds[k + 1]]).reshape(-1, 2),
            camera_id=int(scene.camera_of[k]) + 1,
            image_id=k + 1,
        )
        rotation = scene.rotations[k]
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ scene.centers[k])
        model.add_image_with_trivial_frame(image, pose)
    order = np.argsort(observed[:, 0], kind="stable")
    known, lengths = np.unique(observed[:, 0], return_counts=True)
    points = Points(
        xyz=scene.points[known],
        offsets=np.append(0, np.cumsum(lengths)),
        images=observed[order, 1],
        keypoints=(np.arange(len(observed)) - bounds[observed[:, 1]])[order],
        ids=known + 1,
    )
    add_points(model, np.arange(1, len(scene.names) + 1), points, scene.colors[known].astype(np.uint8))
    if len(observed):
        model.update_point_3d_errors()
    return model


def posed_model_of(model: pycolmap.Reconstruction) -> PosedModelFile:
    """Return the posed images of a reconstruction, by id, without points."""
    images = [model.image(i) for i in sorted(i for i, image in model.images.items() if image.has_pose)]
    camera_ids = sorted({image.camera_id for image in images})
    poses = [(image.cam_from_world().rotation.matrix(), image.projection_center()) for image in images]
    posed = [(i.name, camera_ids.index(i.camera_id), *pose) for i, pose in zip(images, poses, strict=True)]
    return model_of_images((intrinsics_of(model.camera(camera_id)) for camera_id in camera_ids), posed)


def relative_poses_of(graph: pycolmap.PoseGraph) -> EpipolarGeometries:
    """Return the valid edges of a pose graph that have a direction; the names are the image ids.

    Raises:
        InputError: if it has none.
    """
    ids, rotations, to_second = [], [], []
    for pair_id in sorted(graph.edges):
        edge = graph.edges[pair_id]
        pose = edge.cam2_from_cam1
        length = np.linalg.norm(pose.translation)
        if edge.valid and np.isfinite(pose.matrix()).all() and length > 0.0:
            ids.append(pycolmap.pair_id_to_image_pair(pair_id))
            rotations.append(pose.rotation.matrix())
            to_second.append(-rotations[-1].T @ pose.translation / length)
    if not ids:
        raise InputError("the pose graph has no valid edge with a translation; load it from verified matches")
    known, pairs = np.unique(np.array(ids, dtype=np.int64), return_inverse=True)
    return EpipolarGeometries(
        names=tuple(str(image_id) for image_id in known.tolist()),
        pairs=pairs.reshape(-1, 2).astype(np.int64),
        rotations=np.array(rotations),
        to_second=np.array(to_second),
    )


def intrinsics_of(camera: pycolmap.Camera) -> Intrinsics:
    """Return a camera of pycolmap's as plain values."""
    return Intrinsics(camera.model.name, int(camera.width), int(camera.height), tuple(camera.params.tolist()))


def make_camera(intrinsics: Intrinsics, camera_id: int) -> pycolmap.Camera:
    """Return a camera of pycolmap's whose focal length is known."""
    return pycolmap.Camera(**intrinsics._asdict(), camera_id=camera_id, has_prior_focal_length=True)
