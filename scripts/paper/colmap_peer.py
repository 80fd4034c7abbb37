"""pycolmap: GLOMAP's global positioning at given rotations, and whole mappings.

pycolmap binds the positioning itself (`run_global_positioning`: camera-to-point directions of all tracks,
from random positions) but not the track building before it. Tracks are built here the same way: components of
the keypoints under the inlier matches of the valid pairs, dropped if one image holds two of its keypoints
that are more than 10 px apart, kept if at least 3 images see them.

Three settings are run, for none is GLOMAP's best on every scene: all verified pairs with 15 matches or more;
those of them whose relative rotation agrees with the given rotations within 10 degrees, which is what
GLOMAP's own rotation stage does with its estimates; and the same with 30 matches or more. Then, as in GLOMAP,
only the largest component of the valid pairs stays. Cameras without any track are taken out as well: nothing
ties them, so their random start would be counted as an error.

pycolmap changes a database when it opens one, so a copy in a temporary folder is opened.
Source: Pan, Barath, Pollefeys, Schonberger, "Global Structure-from-Motion Revisited", ECCV 2024.
"""

import shutil
import tempfile
import time
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pycolmap
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

MIN_VIEWS = 3
MAX_SPREAD_PX = 10.0


class Setting(NamedTuple):
    """Which pairs GLOMAP's positioning sees."""

    min_num_matches: int
    max_rotation_error_deg: float | None

    @property
    def label(self) -> str:
        """The setting in words, for the table."""
        limit_deg = self.max_rotation_error_deg
        filtered = "" if limit_deg is None else f", rotations within {limit_deg:g} deg"
        return f"min_num_matches {self.min_num_matches}{filtered}"


SETTINGS = (
    Setting(min_num_matches=15, max_rotation_error_deg=None),
    Setting(min_num_matches=15, max_rotation_error_deg=10.0),
    Setting(min_num_matches=30, max_rotation_error_deg=10.0),
)


class Positioned(NamedTuple):
    """What one run of the positioning gave."""

    reconstruction: pycolmap.Reconstruction
    num_tracks: int
    positioning_s: float
    """`run_global_positioning` alone."""
    positioning_cpu_s: float
    """CPU time of it, all threads."""


def copy_database(database: Path, folder: Path) -> Path:
    """Copy a database, with a -wal file if it has one, and return the copy."""
    for suffix in ("", "-wal"):
        source = database.with_name(database.name + suffix)
        if source.is_file():
            target = folder / source.name
            shutil.copyfile(source, target)
            target.chmod(0o600)
    return folder / database.name


def position(database: Path, model: Path, setting: Setting) -> Positioned:
    """Run GLOMAP's positioning with the rotations and intrinsics of a model, not its centers and points.

    Raises:
        RuntimeError: if no pair is left, or pycolmap reports that the positioning failed.
    """
    reference = pycolmap.Reconstruction(str(model))
    reconstruction, graph, pose_graph = _read(database, setting.min_num_matches)
    take_rotations(reconstruction, reference)
    pose_graph.invalidate_pairs_outside_active_image_ids(set(reconstruction.reg_image_ids()))
    _invalidate_contradicting(pose_graph, reconstruction, setting.max_rotation_error_deg)
    keep_frames(reconstruction, pose_graph.largest_connected_frame_component(reconstruction))
    pose_graph.invalidate_pairs_outside_active_image_ids(set(reconstruction.reg_image_ids()))
    pairs = _valid_pairs(pose_graph)
    if not pairs:
        raise RuntimeError("no pair of the database stores a relative pose that GLOMAP may use")
    num_tracks = _add_tracks(reconstruction, graph, pairs)
    seen = [image for image in reconstruction.images.values() if image.num_points3D]
    keep_frames(reconstruction, {image.frame_id for image in seen})
    read, cpu = time.perf_counter(), time.process_time()
    settings = pycolmap.GlobalPositionerOptions()
    settings.use_gpu = False
    settings.random_seed = 0
    if not pycolmap.run_global_positioning(settings, pose_graph, reconstruction):
        raise RuntimeError("pycolmap.run_global_positioning reports failure")
    done, cpu = time.perf_counter(), time.process_time() - cpu
    return Positioned(reconstruction, num_tracks, done - read, cpu)


def map_database(
    database: Path,
    min_num_matches: int,
    *,
    incremental: bool = False,
    refine_sensors: bool | None = None,
    num_threads: int = -1,
) -> tuple[pycolmap.Reconstruction, float]:
    """Run pycolmap's whole mapping, global or incremental; return the largest model and the seconds.

    `refine_sensors` says whether global mapping changes sensors in their rigs; its default if None.

    Raises:
        RuntimeError: if no model came out.
    """
    options = pycolmap.IncrementalPipelineOptions() if incremental else pycolmap.GlobalPipelineOptions()
    options.min_num_matches, options.num_threads, options.random_seed = min_num_matches, num_threads, 0
    if not incremental:
        options.mapper.global_positioning.use_gpu = False
    if refine_sensors is not None:
        options.mapper.refine_sensor_from_rig = refine_sensors
    function = pycolmap.incremental_mapping if incremental else pycolmap.global_mapping
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "images").mkdir()
        (folder / "out").mkdir()
        copied = copy_database(database, folder)
        start = time.perf_counter()
        models = function(copied, folder / "images", folder / "out", options)
        seconds = time.perf_counter() - start
    if not models:
        raise RuntimeError(f"pycolmap.{function.__name__} made no model")
    return max(models.values(), key=lambda model: model.num_reg_images()), seconds


def _read(
    database: Path, min_num_matches: int
) -> tuple[pycolmap.Reconstruction, pycolmap.CorrespondenceGraph, pycolmap.PoseGraph]:
    """Return images, matches and pairs of a copy of a database."""
    with tempfile.TemporaryDirectory() as folder:
        copied = pycolmap.Database.open(str(copy_database(database, Path(folder))))
        options = pycolmap.DatabaseCacheOptions()
        options.min_num_matches = min_num_matches
        cache = pycolmap.DatabaseCache.create(copied, options)
        copied.close()
    reconstruction = pycolmap.Reconstruction()
    reconstruction.load(cache)
    pose_graph = pycolmap.PoseGraph()
    pose_graph.load(cache.correspondence_graph)
    return reconstruction, cache.correspondence_graph, pose_graph


def take_rotations(reconstruction: pycolmap.Reconstruction, reference: pycolmap.Reconstruction) -> None:
    """Give images of `reconstruction` the reference's rotations and intrinsics, by name, and centers 0."""
    ids = {image.name: image_id for image_id, image in reconstruction.images.items()}
    for image_id in sorted(reference.reg_image_ids()):
        known = reference.image(image_id)
        if known.name not in ids:
            continue
        image = reconstruction.image(ids[known.name])
        camera = reference.camera(known.camera_id)
        target = reconstruction.camera(image.camera_id)
        if target.model != camera.model:
            raise RuntimeError(
                f"image {known.name} has different camera models in the database and the model"
            )
        target.params = camera.params.tolist()
        pose = pycolmap.Rigid3d(known.cam_from_world().rotation, np.zeros(3))
        reconstruction.frame(image.frame_id).set_cam_from_world(image.camera_id, pose)
        reconstruction.register_frame(image.frame_id)


def keep_frames(reconstruction: pycolmap.Reconstruction, frames: Collection[int]) -> None:
    """Take the pose from all frames but these."""
    for frame_id in sorted(set(reconstruction.reg_frame_ids()) - set(frames)):
        reconstruction.deregister_frame(frame_id)


def _invalidate_contradicting(
    pose_graph: pycolmap.PoseGraph, reconstruction: pycolmap.Reconstruction, max_error_deg: float | None
) -> None:
    """Invalidate the pairs whose relative rotation contradicts the given rotations, if there is a limit."""
    if max_error_deg is None:
        return
    for id1, id2 in _valid_pairs(pose_graph):
        pair_id = pycolmap.image_pair_to_pair_id(id1, id2)
        first, second = (reconstruction.image(k).cam_from_world().rotation for k in (id1, id2))
        off = pose_graph.edges[pair_id].cam2_from_cam1.rotation * (second * first.inverse()).inverse()
        if np.degrees(off.angle()) > max_error_deg:
            pose_graph.set_invalid_edge(pair_id)


def _valid_pairs(pose_graph: pycolmap.PoseGraph) -> list[tuple[int, int]]:
    """Return the valid pairs as image ids, in order."""
    valid = [pair_id for pair_id in sorted(pose_graph.edges) if pose_graph.is_valid(pair_id)]
    return [pycolmap.pair_id_to_image_pair(pair_id) for pair_id in valid]


def _add_tracks(
    reconstruction: pycolmap.Reconstruction, graph: pycolmap.CorrespondenceGraph, pairs: list[tuple[int, int]]
) -> int:
    """Add a point at the origin for each consistent track of the pairs' matches; return their number."""
    image_ids = sorted(reconstruction.reg_image_ids())
    keypoints = [np.array([p.xy for p in reconstruction.image(k).points2D]).reshape(-1, 2) for k in image_ids]
    first = np.concatenate([[0], np.cumsum([len(xy) for xy in keypoints])])
    index = {image_id: k for k, image_id in enumerate(image_ids)}
    ends = [np.zeros((0, 2), dtype=np.int64)]
    for id1, id2 in pairs:
        matches = graph.extract_matches_between_images(id1, id2).astype(np.int64)
        ends.append(matches + np.array([first[index[id1]], first[index[id2]]]))
    image_of = np.repeat(np.arange(len(image_ids)), np.diff(first))
    tracks = consistent_tracks(np.concatenate(ends), image_of, np.concatenate(keypoints))
    for track in tracks:
        elements = [(image_ids[image_of[k]], int(k - first[image_of[k]])) for k in track.tolist()]
        reconstruction.add_point3D(
            np.zeros(3), pycolmap.Track([pycolmap.TrackElement(image_id, k) for image_id, k in elements])
        )
    return len(tracks)


def consistent_tracks(
    matches: npt.NDArray[np.int64], image_of: npt.NDArray[np.int64], xy: npt.NDArray[np.float64]
) -> list[npt.NDArray[np.int64]]:
    """Return the tracks of matched keypoints, each as ascending keypoint indices, one keypoint per image.

    Given are the pairs of keypoints (m, 2), and of each its image (k,), ascending, and pixels (k, 2). Left
    out are tracks of fewer than `MIN_VIEWS` images, and those with a keypoint farther than `MAX_SPREAD_PX`
    from the first one of its image.
    """
    count = len(image_of)
    joined = coo_array(
        (np.ones(len(matches), dtype=np.int8), (matches[:, 0], matches[:, 1])), shape=(count, count)
    )
    label = connected_components(joined.tocsr(), directed=False)[1]
    order = np.argsort(label, kind="stable")
    bounds = np.flatnonzero(np.diff(label[order])) + 1
    tracks = []
    for members in np.split(order, bounds):
        if len(members) < MIN_VIEWS:
            continue
        _, start, which = np.unique(image_of[members], return_index=True, return_inverse=True)
        spread = np.linalg.norm(xy[members] - xy[members[start]][which], axis=1)
        if len(start) >= MIN_VIEWS and spread.max() <= MAX_SPREAD_PX:
            tracks.append(members[start])
    return tracks
