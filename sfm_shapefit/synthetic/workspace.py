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
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pycolmap

from sfm_shapefit.base.atomic_folder import atomic_folder
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.files.colmap.quiet import quiet_log
from sfm_shapefit.scene.points import Points
from sfm_shapefit.synthetic import models
from sfm_shapefit.synthetic.models import ModelParts
from sfm_shapefit.synthetic.scene_options import WorkspaceOptions
from sfm_shapefit.synthetic.scenes import Scene

_CALIBRATED = 2  # value of COLMAP's TwoViewGeometry::ConfigurationType; see its header


def write_workspace(scene: Scene, out: Path, options: WorkspaceOptions | None = None) -> None:
    """Write a scene as a COLMAP workspace, whole or not at all; the default options if None.

    `out` is a folder that does not exist yet; its parents are made. InputError if it exists or cannot be
    written.
    """
    options = options or WorkspaceOptions()
    with workspace_folder(out) as workspace:
        if options.database:
            _write_database(scene, workspace / "database.db", relative_poses=options.relative_poses)
        points = _points(scene)
        parts = ModelParts(scene, _camera(scene), scene.keypoints, points, scene.colors[points.ids - 1])
        models.write_models(parts, workspace, options.model)


@contextlib.contextmanager
def workspace_folder(out: Path) -> Iterator[Path]:
    """Yield the folder of `atomic_folder`, whose InputError the errors of COLMAP's own writers become too."""
    with atomic_folder(out) as workspace:
        try:
            with quiet_log():
                yield workspace
        except (RuntimeError, sqlite3.Error) as error:
            raise InputError(
                f"{out} cannot be written; check the free space, or choose another place"
            ) from error


def _points(scene: Scene) -> Points:
    """Return the points that two images or more show; point p of the scene has id p + 1."""
    image = np.repeat(np.arange(scene.num_images), [len(ids) for ids in scene.keypoint_points])
    keypoint = np.concatenate([np.arange(len(ids)) for ids in scene.keypoint_points])
    point = np.concatenate(scene.keypoint_points)
    length = np.bincount(point[point >= 0], minlength=len(scene.points))
    visible = np.flatnonzero((point >= 0) & (length[point] >= 2))
    visible = visible[np.argsort(point[visible], kind="stable")]
    shown = np.flatnonzero(length >= 2)
    return Points(
        xyz=scene.points[shown],
        offsets=offsets_of(length[shown]),
        images=image[visible],
        keypoints=keypoint[visible],
        ids=shown + 1,
    )


def _camera(scene: Scene) -> pycolmap.Camera:
    k = scene.calibration
    return models.new_camera(scene, "PINHOLE", [k[0, 0], k[1, 1], k[0, 2], k[1, 2]])


def _write_database(scene: Scene, path: Path, *, relative_poses: bool) -> None:
    """Write a new database; nothing but the file itself is left in the folder."""
    database = pycolmap.Database.open(path)
    try:
        with pycolmap.DatabaseTransaction(database):
            _write_images(scene, database)
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
    cameras, made = models.new_rigs(scene.rigs, _camera(scene))
    images, frames = models.new_images(scene.rigs, [np.empty((0, 2))] * scene.num_images)
    for camera in cameras:
        database.write_camera(camera, use_camera_id=True)
    for rig in made:
        database.write_rig(rig, use_rig_id=True)
    for image, keypoints in zip(images, scene.keypoints, strict=True):
        database.write_image(image, use_image_id=True)
        database.write_keypoints(image.image_id, keypoints.astype(np.float32))
    for frame in frames:
        database.write_frame(frame, use_frame_id=True)


def _write_pairs(scene: Scene, database: pycolmap.Database, *, relative_poses: bool) -> None:
    """Write the matches of every pair, all of which pass as inliers of its two-view geometry."""
    # Each translation t as the matrix [t]_x with [t]_x y = t x y, (m, 3, 3).
    crosses = np.cross(scene.relative_translations[:, None, :], np.eye(3)).swapaxes(1, 2)
    essential = crosses @ scene.relative_rotations
    img_inverse = np.linalg.inv(scene.calibration)
    fundamental = img_inverse.T @ essential @ img_inverse
    for e, (i, j) in enumerate((scene.pairs + 1).tolist()):
        matches = scene.matches_of(e).astype(np.uint32)
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = _CALIBRATED
        geometry.E, geometry.F = essential[e], fundamental[e]
        geometry.inlier_matches = matches
        if relative_poses:
            geometry.cam2_from_cam1 = models.rigid(
                scene.relative_rotations[e], scene.relative_translations[e]
            )
        database.write_matches(i, j, matches)
        database.write_two_view_geometry(i, j, geometry)
