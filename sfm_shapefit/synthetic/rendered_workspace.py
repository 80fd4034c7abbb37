"""Writes a rendered scene as the folder that COLMAP would leave: images, and what COLMAP finds in them.

    OUT/images         0001.jpg, ...: drawn by `sfm_shapefit.synthetic.rendering`
    OUT/database.db    SIFT keypoints, matches and verified two-view geometries, all by pycolmap
    OUT/sparse/0       the model: what `sfm-shapefit locate` is given
    OUT/truth          the exact model, where sparse/0 is not it

Keypoints and matches err, miss and mistake one house for another as they do for photographs. The truth is
known: the surface point under every keypoint, and so whether a match is right (`judge_matches`). The points
of the exact model are those surface points, joined along right matches. On the CPU and with a seed, all of it
is the same on every run, byte by byte.
"""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import BoolArray, FloatArray, sum_by
from sfm_shapefit.base.forests import connected_components
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.files.colmap.database import open_database
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.quiet import quiet_log
from sfm_shapefit.scene.matches import MatchBatch, Reading
from sfm_shapefit.scene.points import Points, number_points
from sfm_shapefit.synthetic.models import (
    ModelParts,
    image_name,
    new_camera,
    new_images,
    new_rigs,
    write_models,
)
from sfm_shapefit.synthetic.rendering import RenderedScene, encode_images, project_distorted, surface_points
from sfm_shapefit.synthetic.scene_options import WorkspaceOptions
from sfm_shapefit.synthetic.workspace import compact_database, workspace_folder

_LARGEST_ERROR_PX = 4.0  # pixels; COLMAP's own limit for inliers, a right match is off by no more
_POINT_GRAY = 160  # gray value of a point; its color in the pictures is not looked up
_NO_MATCHES = MatchBatch(
    pairs=np.empty((0, 2), dtype=np.int64),
    offsets=np.zeros(1, dtype=np.int64),
    keypoints=np.empty((0, 2), dtype=np.int64),
    rays_i=np.empty((0, 3)),
    rays_j=np.empty((0, 3)),
    pixel_angles=np.empty(0),
)


class JudgedMatches(NamedTuple):
    """The keypoints and verified pairs of a rendered workspace, and how much of each pair is right."""

    keypoints: list[FloatArray]
    """Per image, (k, 2) pixels."""
    surface: list[FloatArray]
    """Per image, (k, 3) the surface point under each keypoint, world axes; NaN where it is sky."""
    matches: MatchBatch
    """The inlier matches of m pairs; images are indices of the scene."""
    is_right: BoolArray
    """(M,) True where both keypoints show the same surface point."""
    pair_is_wrong: BoolArray
    """(m,) True where less than half of a pair's matches are right."""


def write_rendered_workspace(
    scene: RenderedScene,
    out: Path,
    options: WorkspaceOptions | None = None,
    progress: Callable[[str, int, int], None] = lambda _stage, _done, _total: None,
) -> None:
    """Draw a scene and run COLMAP's feature detection, matching and verification on the images.

    Args:
        scene: what to photograph.
        out: a folder that does not exist yet; its parents are made. InputError if it exists or cannot be
            written.
        options: what stands in it; the defaults if None. Without `database` nothing is matched, and the model
            has poses but no points.
        progress: called with a stage, the work done so far and the work in all.
    """
    options = options or WorkspaceOptions()
    with workspace_folder(out) as workspace:
        (workspace / "images").mkdir()
        for k, image in enumerate(encode_images(scene)):
            (workspace / "images" / image_name(k)).write_bytes(image)
            progress("images", k + 1, scene.num_images)
        judged = None
        if options.database:
            progress("features and matches", 0, 1)
            _match_images(scene, workspace, relative_poses=options.relative_poses)
            judged = judge_matches(scene, workspace / "database.db", scene.options.min_matches)
        write_models(_parts(scene, judged), workspace, options.model)


def judge_matches(scene: RenderedScene, database: Path, min_matches: int = 1) -> JudgedMatches:
    """Tell right from wrong among the inlier matches of a database of the scene's images.

    A match is right if the surface point under its keypoint in either image projects to within 4 pixels of
    its keypoint in the other. InputError if the database cannot be read or has none of the images.

    Args:
        scene: what the images show.
        database: made from its images, by whatever detector and matcher; image k is named as by this module.
        min_matches: pairs with fewer are left out.
    """
    images = read_model(_parts(scene, None).model(scene.rotations)).images
    with closing(open_database(database, images.names)) as matches:
        view = matches.at(images, reading=Reading(batch=int(matches.num_matches.sum())))
        keypoints = [view.keypoints(k) for k in range(scene.num_images)]
        joined = next(view.batches(min_matches), _NO_MATCHES)
    surface = [surface_points(scene, k, xy) for k, xy in enumerate(keypoints)]
    is_right = np.zeros(len(joined.keypoints), dtype=np.bool_)
    wrong = np.zeros(len(joined.pairs), dtype=np.bool_)
    for e, ((i, j), rows) in enumerate(zip(joined.pairs.tolist(), joined.slices(), strict=True)):
        a, b = joined.keypoints[rows].T
        errors = np.maximum(
            _transfer_error_px(scene, j, surface[i][a], keypoints[j][b]),
            _transfer_error_px(scene, i, surface[j][b], keypoints[i][a]),
        )
        is_right[rows] = errors < _LARGEST_ERROR_PX
        wrong[e] = 2 * is_right[rows].sum() < len(a)
    return JudgedMatches(keypoints, surface, joined, is_right, wrong)


def _transfer_error_px(scene: RenderedScene, image: int, points: FloatArray, xy: FloatArray) -> FloatArray:
    """Return (k,) distances of points, projected into an image, from keypoints; infinite if not in front."""
    depth = (points - scene.centers[image]) @ scene.rotations[image][2]
    seen = np.flatnonzero(depth > 0.0)  # not NaN either, which stands for the sky
    errors = np.full(len(points), np.inf)
    if len(seen):
        errors[seen] = np.linalg.norm(project_distorted(scene, image, points[seen]) - xy[seen], axis=1)
    return errors


def _match_images(scene: RenderedScene, workspace: Path, *, relative_poses: bool) -> None:
    """Detect, match and verify on the CPU; nothing but database.db is left in the folder."""
    database = workspace / "database.db"
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "RADIAL"
    reader.camera_params = ",".join(repr(value) for value in _camera(scene).params.tolist())
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = scene.options.max_keypoints_per_image
    # Images get their ids in the order in which threads finish; one thread keeps that of their names.
    extraction.num_threads = 1
    verification = pycolmap.TwoViewGeometryOptions()
    verification.min_num_inliers = scene.options.min_matches
    verification.compute_relative_pose = relative_poses
    verification.ransac.random_seed = scene.options.seed
    with quiet_log():
        pycolmap.extract_features(
            database,
            workspace / "images",
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )
        pycolmap.match_exhaustive(database, verification_options=verification, device=pycolmap.Device.cpu)
    if scene.options.rig != "none":
        _mount_cameras(scene, database)
    compact_database(database)


def _mount_cameras(scene: RenderedScene, path: Path) -> None:
    """Give a database of images by one camera the cameras, rigs and frames of a scene."""
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        cameras, rigs = new_rigs(scene.rigs, database.read_camera(1))
        images, frames = new_images(scene.rigs, [np.empty((0, 2))] * scene.num_images)
        database.clear_frames()
        database.clear_rigs()
        for camera in cameras[1:]:
            database.write_camera(camera, use_camera_id=True)
        for image in images:
            database.update_image(image)
        for rig in rigs:
            database.write_rig(rig, use_rig_id=True)
        for frame in frames:
            database.write_frame(frame, use_frame_id=True)


def _parts(scene: RenderedScene, judged: JudgedMatches | None) -> ModelParts:
    """Return what models are made of: judged keypoints and their points, or none."""
    keypoints, points = [np.empty((0, 2))] * scene.num_images, number_points([])
    if judged is not None:
        keypoints, points = judged.keypoints, _true_points(judged)
    colors = np.full((points.num_points, 3), _POINT_GRAY, dtype=np.uint8)
    return ModelParts(scene, _camera(scene), keypoints, points, colors)


def _true_points(judged: JudgedMatches) -> Points:
    """Return the points along right matches, each at the mean of the surface points under its keypoints."""
    counts = [len(xy) for xy in judged.keypoints]
    first, image = offsets_of(counts), np.repeat(np.arange(len(counts)), counts)
    firsts = judged.matches.spread(first[judged.matches.pairs])
    nodes = (judged.matches.keypoints + firsts)[judged.is_right]
    label = connected_components(int(first[-1]), nodes)
    rows = np.unique(label * len(counts) + image, return_index=True)[1]  # the first in each image
    rows = rows[np.bincount(label[rows])[label[rows]] >= 2]
    known, place, lengths = np.unique(label[rows], return_inverse=True, return_counts=True)
    surface = np.concatenate(judged.surface)[rows]
    return Points(
        xyz=sum_by(place, surface, len(known)) / lengths[:, None],
        offsets=offsets_of(lengths),
        images=image[rows],
        keypoints=rows - first[image[rows]],
        ids=np.arange(1, len(known) + 1),
    )


def _camera(scene: RenderedScene) -> pycolmap.Camera:
    """Return the camera of a scene: f, cx, cy, k1, k2 of COLMAP's RADIAL model."""
    k = scene.calibration
    return new_camera(scene, "RADIAL", [k[0, 0], k[0, 2], k[1, 2], *scene.distortion[:2]])
