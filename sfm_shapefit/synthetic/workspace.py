"""Writes a synthetic scene as the folder that COLMAP would leave: database.db, sparse/0, and the truth.

    OUT/database.db    cameras, images, keypoints, matches and two-view geometries (E, F, inlier matches)
    OUT/sparse/0       the model: what `sfm-shapefit locate` is given
    OUT/truth          the exact model, where sparse/0 is not it

Image index k of the scene is image id k + 1, named "0001.jpg" and so on, in the database and in the models.
The database is made by pycolmap, here on a file of our own; COLMAP 4 sets such files to write-ahead logging,
which would leave companions beside the file for every reader, so it is switched off again at the end.
"""

import contextlib
import sqlite3
from pathlib import Path

import numpy as np
import pycolmap

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.atomic_folder import atomic_folder
from sfm_shapefit.colmap.seed import write_model
from sfm_shapefit.synthetic import RigScene, Scene, WorkspaceOptions
from sfm_shapefit.synthetic.rig_workspace import camera_id_of, new_frames, new_rigs, rig_model

_CAMERA_ID = 1
# This is a value of COLMAP's TwoViewGeometry::ConfigurationType.
_CALIBRATED = 2


def write_workspace(
    scene: Scene, out: Path, options: WorkspaceOptions | None = None, rigs: RigScene | None = None
) -> None:
    """Write a scene as a COLMAP workspace, whole or not at all.

    Args:
        scene: what to write.
        out: a folder that does not exist yet; its parents are made.
        options: what stands in it; the defaults if None.
        rigs: the rigs of that very scene; one camera and a frame per image if None.

    Raises:
        InputError: if `out` exists or cannot be written.
    """
    with atomic_folder(out) as workspace:
        _write_contents(scene, workspace, options or WorkspaceOptions(), rigs)


def _write_contents(scene: Scene, workspace: Path, options: WorkspaceOptions, rigs: RigScene | None) -> None:
    """Write the files of a workspace into an empty folder."""
    if options.database:
        _write_database(scene, workspace / "database.db", rigs, relative_poses=options.relative_poses)
    truth = _full_model(scene, scene.rotations, rigs)
    perturbed = not np.array_equal(scene.rotations, scene.stated_rotations)
    if options.model == "rotations":
        model = _rotations_only_model(scene, rigs)
    else:
        model = _full_model(scene, scene.stated_rotations, rigs) if perturbed else truth
    write_models(model, truth, workspace)


# --- models ----------------------------------------------------------------------------------------------


def write_models(model: pycolmap.Reconstruction, truth: pycolmap.Reconstruction, workspace: Path) -> None:
    """Write sparse/0, and the truth where it is another model."""
    for written, folder in ((model, workspace / "sparse" / "0"), (truth, workspace / "truth")):
        if folder.name != "truth" or truth is not model:
            folder.mkdir(parents=True)
            write_model(written, folder)


def _rotations_only_model(scene: Scene, rigs: RigScene | None) -> pycolmap.Reconstruction:
    """Return cameras and images with rotations, all centers (of frames) at the origin, and nothing else."""
    if rigs is not None:
        images = [_image(k, camera_id=camera_id_of(rigs, k)) for k in range(scene.num_images)]
        return rig_model(rigs, _camera(scene), images, np.zeros((len(rigs.rig_of_frame), 3)))
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(_camera(scene))
    for index, rotation in enumerate(scene.stated_rotations):
        model.add_image_with_trivial_frame(_image(index), rigid(rotation, np.zeros(3)))
    return model


def _full_model(scene: Scene, rotations: FloatArray, rigs: RigScene | None) -> pycolmap.Reconstruction:
    """Return the model at the true centers and points, with the given rotations.

    Points that fewer than two images show are left out. Point p of the scene has id p + 1.
    """
    if rigs is not None:
        images = [_image(k, xy, camera_id_of(rigs, k)) for k, xy in enumerate(scene.keypoints)]
        model = rig_model(rigs, _camera(scene), images, scene.centers[rigs.sensor_of_image == 0])
    else:
        model = pycolmap.Reconstruction()
        model.add_camera_with_trivial_rig(_camera(scene))
        for index, (rotation, center) in enumerate(zip(rotations, scene.centers, strict=True)):
            pose = rigid(rotation, -rotation @ center)
            model.add_image_with_trivial_frame(_image(index, scene.keypoints[index]), pose)

    point_ids, first, image_ids, keypoint_ids = _tracks(scene)
    for k, point in enumerate(point_ids):
        elements = range(first[k], first[k + 1])
        track = pycolmap.Track([pycolmap.TrackElement(image_ids[e], keypoint_ids[e]) for e in elements])
        point3d = pycolmap.Point3D(xyz=scene.points[point], color=scene.colors[point], track=track)
        model.add_point3D_with_id(int(point) + 1, point3d)
    model.update_point_3d_errors()
    return model


def _tracks(scene: Scene) -> tuple[IntArray, list[int], list[int], list[int]]:
    """Return the tracks of the points that two images or more show, as flat lists.

    Returns:
        point (k,), first element of each track (k + 1), and for every element the image id and the
        keypoint index.
    """
    image = np.repeat(np.arange(scene.num_images), [len(ids) for ids in scene.keypoint_points])
    keypoint = np.concatenate([np.arange(len(ids)) for ids in scene.keypoint_points])
    point = np.concatenate(scene.keypoint_points)
    length = np.bincount(point[point >= 0], minlength=len(scene.points))
    kept = np.flatnonzero((point >= 0) & (length[point] >= 2))
    kept = kept[np.argsort(point[kept], kind="stable")]
    point_ids = np.flatnonzero(length >= 2).astype(np.int64)
    first = np.concatenate([[0], np.cumsum(length[point_ids])])
    return point_ids, first.tolist(), (image[kept] + 1).tolist(), keypoint[kept].tolist()


def _camera(scene: Scene) -> pycolmap.Camera:
    """Return the one camera of a scene."""
    k = scene.calibration
    return pycolmap.Camera(
        camera_id=_CAMERA_ID,
        model="PINHOLE",
        width=scene.options.image_width,
        height=scene.options.image_height,
        params=[k[0, 0], k[1, 1], k[0, 2], k[1, 2]],
        has_prior_focal_length=True,
    )


def image_name(index: int) -> str:
    """Return the name of image `index` of a scene."""
    return f"{index + 1:04d}.jpg"


def _image(index: int, keypoints: FloatArray | None = None, camera_id: int = _CAMERA_ID) -> pycolmap.Image:
    """Return image `index` without pose."""
    return pycolmap.Image(
        name=image_name(index),
        keypoints=np.empty((0, 2)) if keypoints is None else keypoints,
        camera_id=camera_id,
        image_id=index + 1,
    )


def rigid(rotation: FloatArray, translation: FloatArray) -> pycolmap.Rigid3d:
    """Return the transform x -> rotation @ x + translation."""
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)


# --- database --------------------------------------------------------------------------------------------


def _write_database(scene: Scene, path: Path, rigs: RigScene | None, *, relative_poses: bool) -> None:
    """Write a new database; nothing but the file itself is left in the folder."""
    database = pycolmap.Database.open(path)
    try:
        with pycolmap.DatabaseTransaction(database):
            if rigs is None:
                _write_images(scene, database)
            else:
                _write_rig_images(rigs, database)
            _write_pairs(scene, database, relative_poses=relative_poses)
    finally:
        database.close()
    compact_database(path)


def compact_database(path: Path) -> None:
    """Make one small file of a database of our own: no write-ahead log, no free pages."""
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
        connection.execute("VACUUM")


def _write_images(scene: Scene, database: pycolmap.Database) -> None:
    """Write the camera with its trivial rig, and each image with its trivial frame and its keypoints."""
    camera = _camera(scene)
    database.write_camera(camera, use_camera_id=True)
    rig = pycolmap.Rig(rig_id=_CAMERA_ID)
    rig.add_ref_sensor(camera.sensor_id)
    database.write_rig(rig, use_rig_id=True)
    for index, keypoints in enumerate(scene.keypoints):
        image = _image(index)
        frame = pycolmap.Frame(frame_id=index + 1, rig_id=_CAMERA_ID)
        frame.add_data_id(image.data_id)
        database.write_image(image, use_image_id=True)
        database.write_frame(frame, use_frame_id=True)
        database.write_keypoints(index + 1, keypoints.astype(np.float32))


def _write_rig_images(rigs: RigScene, database: pycolmap.Database) -> None:
    """Write cameras, rigs, frames, images and keypoints."""
    cameras, made = new_rigs(rigs, _camera(rigs.scene))
    for camera in cameras:
        database.write_camera(camera, use_camera_id=True)
    for rig in made:
        database.write_rig(rig, use_rig_id=True)
    images = [_image(k, camera_id=camera_id_of(rigs, k)) for k in range(rigs.scene.num_images)]
    for frame in new_frames(rigs, images):
        database.write_frame(frame, use_frame_id=True)
    for image, keypoints in zip(images, rigs.scene.keypoints, strict=True):
        database.write_image(image, use_image_id=True)
        database.write_keypoints(image.image_id, keypoints.astype(np.float32))


def _write_pairs(scene: Scene, database: pycolmap.Database, *, relative_poses: bool) -> None:
    """Write the matches of every pair, all of which pass as inliers of its two-view geometry."""
    essential = _cross_product_matrices(scene.relative_translations) @ scene.relative_rotations
    img_inverse = np.linalg.inv(scene.calibration)
    fundamental = img_inverse.T @ essential @ img_inverse
    for e, (i, j) in enumerate((scene.pairs + 1).tolist()):
        matches = scene.matches_of(e).astype(np.uint32)
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = _CALIBRATED
        geometry.E, geometry.F = essential[e], fundamental[e]
        geometry.inlier_matches = matches
        if relative_poses:
            geometry.cam2_from_cam1 = rigid(scene.relative_rotations[e], scene.relative_translations[e])
        database.write_matches(i, j, matches)
        database.write_two_view_geometry(i, j, geometry)


def _cross_product_matrices(vectors: FloatArray) -> FloatArray:
    """Return [t]_x (m, 3, 3) with [t]_x y = t x y for each row t."""
    return np.cross(vectors[:, None, :], np.eye(3)).swapaxes(1, 2)
