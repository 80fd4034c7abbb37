"""Writes a rendered scene as the folder that COLMAP would leave: images, and what COLMAP finds in them.

    OUT/images         0001.jpg, ...: drawn by `sfm_shapefit.synthetic.rendering`
    OUT/database.db    SIFT keypoints, matches and verified two-view geometries, all by pycolmap
    OUT/sparse/0       the model: what `sfm-shapefit locate` is given
    OUT/truth          the exact model, where sparse/0 is not it

Nothing about keypoints and matches is made up: they err, miss and mistake one house for another as they do
for photographs. What is known is the truth: the surface point under every keypoint, and so of every match
whether it is right (`judge_matches`). The points of the exact model are those surface points, joined along
right matches. On the CPU and with a seed, all of it is the same on every run and for any number of threads.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from sfm_shapefit.arrays import BoolArray, FloatArray
from sfm_shapefit.atomic_folder import atomic_folder
from sfm_shapefit.colmap.database import open_database
from sfm_shapefit.colmap.model import read_model
from sfm_shapefit.colmap.quiet import quiet_log
from sfm_shapefit.directions.matches import MatchBatch
from sfm_shapefit.synthetic.options import WorkspaceOptions
from sfm_shapefit.synthetic.rendering import (
    RenderedScene,
    encode_image,
    project_distorted,
    surface_points,
)
from sfm_shapefit.synthetic.workspace import compact_database, image_name, rigid, write_models
from sfm_shapefit.viewgraph import connected_components

_CAMERA_ID = 1
# A right match is off by no more: this is COLMAP's own limit for inliers.
_LARGEST_ERROR_PX = 4.0
_POINT_COLOR = np.array([160, 160, 160], dtype=np.uint8)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JudgedMatches:
    """The verified pairs of a rendered workspace, and how much of each is right."""

    matches: MatchBatch
    """The inlier matches of m pairs; images are indices of the scene."""
    is_right: BoolArray
    """(M,) True where both keypoints show the same surface point."""
    pair_is_wrong: BoolArray
    """(m,) True where less than half of a pair's matches are right."""


def write_rendered_workspace(
    scene: RenderedScene, out: Path, options: WorkspaceOptions | None = None
) -> None:
    """Draw a scene and run COLMAP's feature detection, matching and verification on the images.

    Args:
        scene: what to photograph.
        out: a folder that does not exist yet; its parents are made.
        options: what stands in it; the defaults if None. Without `database` nothing is matched, and the model
            has poses but no points.

    Raises:
        InputError: if `out` exists or cannot be written.
    """
    options = options or WorkspaceOptions()
    with atomic_folder(out) as workspace:
        _write_images(scene, workspace / "images")
        if options.database:
            _match_images(scene, workspace, relative_poses=options.relative_poses)
        _write_models(scene, workspace, options)


def judge_matches(scene: RenderedScene, database: Path, min_matches: int = 1) -> JudgedMatches:
    """Tell right from wrong among the inlier matches of a database of the scene's images.

    A match is right if the surface point under its keypoint in either image projects to within 4 pixels of
    its keypoint in the other.

    Args:
        scene: what the images show.
        database: made from its images, by whatever detector and matcher; image k is named as by this module.
        min_matches: pairs with fewer are left out.

    Raises:
        InputError: if the database cannot be read or has none of the scene's images.
    """
    model = read_model(_posed_model(scene, scene.rotations))
    with open_database(database, model) as opened:
        keypoints = [opened.keypoints(k) for k in range(scene.num_images)]
        batches = list(opened.iter_matches(min_matches))
    joined = _join(batches)
    surface = [surface_points(scene, k, xy) for k, xy in enumerate(keypoints)]
    is_right = np.zeros(len(joined.keypoints), dtype=np.bool_)
    wrong = np.zeros(len(joined.pairs), dtype=np.bool_)
    for e, (i, j) in enumerate(joined.pairs.tolist()):
        rows = slice(joined.offsets[e], joined.offsets[e + 1])
        a, b = joined.keypoints[rows].T
        errors = np.maximum(
            _transfer_error_px(scene, j, surface[i][a], keypoints[j][b]),
            _transfer_error_px(scene, i, surface[j][b], keypoints[i][a]),
        )
        is_right[rows] = errors < _LARGEST_ERROR_PX
        wrong[e] = 2 * is_right[rows].sum() < len(a)
    return JudgedMatches(matches=joined, is_right=is_right, pair_is_wrong=wrong)


def _join(batches: list[MatchBatch]) -> MatchBatch:
    """Return batches as one."""
    offsets, num_matches = [np.zeros(1, dtype=np.int64)], 0
    for batch in batches:
        offsets.append(batch.offsets[1:] + num_matches)
        num_matches += len(batch.keypoints)
    none = np.empty((0, 3))
    return MatchBatch(
        pairs=np.concatenate([np.empty((0, 2), dtype=np.int64), *(batch.pairs for batch in batches)]),
        offsets=np.concatenate(offsets),
        keypoints=np.concatenate([np.empty((0, 2), dtype=np.int64), *(batch.keypoints for batch in batches)]),
        rays_i=np.concatenate([none, *(batch.rays_i for batch in batches)]),
        rays_j=np.concatenate([none, *(batch.rays_j for batch in batches)]),
        pixel_angles=np.concatenate([np.empty(0), *(batch.pixel_angles for batch in batches)]),
    )


def _transfer_error_px(scene: RenderedScene, image: int, points: FloatArray, xy: FloatArray) -> FloatArray:
    """Return (k,) distances of points, projected into an image, from keypoints; infinite if not in front."""
    depth = (points - scene.centers[image]) @ scene.rotations[image][2]
    seen = np.flatnonzero(depth > 0.0)  # not NaN either, which stands for the sky
    errors = np.full(len(points), np.inf)
    if len(seen):
        errors[seen] = np.linalg.norm(project_distorted(scene, image, points[seen]) - xy[seen], axis=1)
    return errors


# --- images and database -----------------------------------------------------------------------------------


def _write_images(scene: RenderedScene, folder: Path) -> None:
    """Write the photographs as JPEG files."""
    folder.mkdir()
    for k in range(scene.num_images):
        (folder / image_name(k)).write_bytes(encode_image(scene, k))


def _match_images(scene: RenderedScene, workspace: Path, *, relative_poses: bool) -> None:
    """Detect, match and verify on the CPU; nothing but database.db is left in the folder."""
    database = workspace / "database.db"
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "RADIAL"
    reader.camera_params = ",".join(repr(value) for value in _camera_parameters(scene))
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = scene.options.max_keypoints_per_image
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
    compact_database(database)


# --- models ------------------------------------------------------------------------------------------------


def _write_models(scene: RenderedScene, workspace: Path, options: WorkspaceOptions) -> None:
    """Write sparse/0, and the truth where that is not it."""
    tracks = _true_tracks(scene, workspace / "database.db") if options.database else None
    truth = _posed_model(scene, scene.rotations, tracks)
    if options.model == "rotations":
        model = _posed_model(scene, scene.stated_rotations, at_origin=True)
    elif np.array_equal(scene.rotations, scene.stated_rotations):
        model = truth
    else:
        model = _posed_model(scene, scene.stated_rotations, tracks)
    write_models(model, truth, workspace)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Tracks:
    """Keypoints, and which of them show the same surface point."""

    keypoints: list[FloatArray]
    points: FloatArray
    """(p, 3) world axes."""
    elements: list[list[tuple[int, int]]]
    """Per point: (image, keypoint), at most one per image."""


def _true_tracks(scene: RenderedScene, database: Path) -> _Tracks:
    """Return the tracks along right matches, each at the mean of the surface points under its keypoints."""
    judged = judge_matches(scene, database, scene.options.min_matches)
    model = read_model(_posed_model(scene, scene.rotations))
    with open_database(database, model) as opened:
        keypoints = [opened.keypoints(k) for k in range(scene.num_images)]
    first = np.cumsum([0] + [len(xy) for xy in keypoints])
    pair = np.repeat(np.arange(len(judged.matches.pairs)), np.diff(judged.matches.offsets))
    nodes = (judged.matches.keypoints + first[judged.matches.pairs[pair]])[judged.is_right]
    label = connected_components(int(first[-1]), nodes)
    order = np.argsort(label, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(label[order])) + 1)
    surface = np.concatenate([surface_points(scene, k, xy) for k, xy in enumerate(keypoints)])
    points, elements = [], []
    for group in groups:
        images = np.searchsorted(first, group, side="right") - 1
        images, once = np.unique(images, return_index=True)
        if len(images) < 2:
            continue
        points.append(surface[group[once]].mean(axis=0))
        elements.append(list(zip(images.tolist(), (group[once] - first[images]).tolist(), strict=True)))
    return _Tracks(keypoints=keypoints, points=np.array(points).reshape(-1, 3), elements=elements)


def _posed_model(
    scene: RenderedScene, rotations: FloatArray, tracks: _Tracks | None = None, *, at_origin: bool = False
) -> pycolmap.Reconstruction:
    """Return a model with the given rotations at the true centers, or all at the origin, and its tracks."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(_camera(scene))
    for k, (rotation, center) in enumerate(zip(rotations, scene.centers, strict=True)):
        keypoints = np.empty((0, 2)) if tracks is None else tracks.keypoints[k]
        image = pycolmap.Image(name=image_name(k), keypoints=keypoints, camera_id=_CAMERA_ID, image_id=k + 1)
        translation = np.zeros(3) if at_origin else -rotation @ center
        model.add_image_with_trivial_frame(image, rigid(rotation, translation))
    if tracks is not None:
        for xyz, seen in zip(tracks.points, tracks.elements, strict=True):
            track = pycolmap.Track([pycolmap.TrackElement(k + 1, keypoint) for k, keypoint in seen])
            model.add_point3D(xyz, track, _POINT_COLOR)
        model.update_point_3d_errors()
    return model


def _camera(scene: RenderedScene) -> pycolmap.Camera:
    """Return the one camera of a scene."""
    return pycolmap.Camera(
        camera_id=_CAMERA_ID,
        model="RADIAL",
        width=scene.options.image_width,
        height=scene.options.image_height,
        params=_camera_parameters(scene),
        has_prior_focal_length=True,
    )


def _camera_parameters(scene: RenderedScene) -> list[float]:
    """Return f, cx, cy, k1, k2 of COLMAP's RADIAL model."""
    k = scene.calibration
    return [float(k[0, 0]), float(k[0, 2]), float(k[1, 2]), *scene.distortion[:2].tolist()]
