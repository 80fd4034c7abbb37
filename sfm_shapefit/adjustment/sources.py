"""Where points come from: the matches of a database, or the points of a model with the same points2D."""

import itertools
from collections.abc import Iterable
from dataclasses import replace
from typing import TypeVar

import numpy as np
import pycolmap

from sfm_shapefit.adjustment import AdjustmentProblem
from sfm_shapefit.adjustment.views import CUBE, PosedFrames, read_frames
from sfm_shapefit.base.arrays import BoolArray, FloatArray, Int32Array, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.lenses import lens_of
from sfm_shapefit.files.colmap.model import camera_rays, observed_points, points2d_xy
from sfm_shapefit.scene.matches import KeypointMatches
from sfm_shapefit.tracks.links import MatchedKeypoints, ObservedTracks

TrackSource = MatchedKeypoints | pycolmap.Reconstruction
"""The matches between the posed images of a model, or another model with the same points2D."""

Tracks = TypeVar("Tracks", bound=ObservedTracks | MatchedKeypoints)

# Matches that are looked at together.
_MATCHES_A_SLICE = 1_000_000


def collect_matches(
    seed: pycolmap.Reconstruction, image_ids: IntArray, batches: Iterable[KeypointMatches], num_matches: int
) -> MatchedKeypoints:
    """Return all matches between registered images; batches are consumed one at a time.

    Args:
        seed: the placed images, with the points2D that the matches refer to.
        image_ids: (n,) ids of the images that the batches' pairs index (`PosedModel.image_ids`).
        batches: matches; pairs with an image that is not registered in `seed` are skipped.
        num_matches: that the batches have at most.

    Raises:
        InputError: if a match refers to a keypoint that its image does not have.
    """
    frames = read_frames(seed)
    counts = np.array([seed.image(i).num_points2D() for i in frames.image_ids], dtype=np.int64)
    begins = np.append(0, np.cumsum(counts))
    registered: BoolArray = np.asarray(np.isin(image_ids, frames.image_ids))
    place = np.where(registered, np.searchsorted(frames.image_ids, image_ids), 0)
    number = np.uint32 if begins[-1] < 2**32 else np.int64
    # Memory is taken as rows are written; one array of each batch, to be joined, would take it twice.
    room, end = np.empty((num_matches, 2), dtype=number), 0
    is_matched = np.zeros(int(begins[-1]), dtype=np.bool_)
    for batch in batches:
        kept = registered[batch.pairs].all(axis=1)
        lengths, own = np.diff(batch.offsets), batch.keypoints
        if not kept.all():
            lengths, own = lengths[kept], own[np.repeat(kept, lengths)]
        ends = place[batch.pairs[kept]]
        missing = (own >= np.repeat(counts[ends], lengths, axis=0)).any(axis=1)
        if missing.any():
            pair = ends[np.repeat(np.arange(len(ends)), lengths)[np.argmax(missing)]]
            names = " and ".join(seed.image(frames.image_ids[i]).name for i in pair.tolist())
            raise InputError(
                f"the pair {names} has matches of keypoints that do not exist; match the images again"
            )
        numbers = room[end : end + len(own)]
        numbers[:] = own + np.repeat(begins[ends], lengths, axis=0)
        is_matched[numbers] = True
        end += len(own)
    row_of = np.cumsum(is_matched, dtype=number)
    for first in range(0, end, _MATCHES_A_SLICE):
        numbers = room[first : min(first + _MATCHES_A_SLICE, end)]
        numbers[:] = row_of[numbers] - 1
    images, keypoints = _images_of(np.flatnonzero(is_matched), begins)
    cameras, pixels, on_plane = _look_up(frames, seed, images, keypoints)
    return MatchedKeypoints(
        cameras=cameras.astype(np.int32),
        keypoints=keypoints,
        pixels=pixels,
        on_plane=on_plane,
        matches=room[:end],
    )


def _images_of(numbers: IntArray, begins: IntArray) -> tuple[Int32Array, Int32Array]:
    """Return the image of each keypoint, and which of its keypoints it is; image i begins at begins[i]."""
    images = np.searchsorted(begins, numbers, side="right") - 1
    return images.astype(np.int32), (numbers - begins[images]).astype(np.int32)


def collect_tracks(
    frames: PosedFrames, reconstruction: pycolmap.Reconstruction, source: pycolmap.Reconstruction
) -> ObservedTracks:
    """Return the tracks of a model's points that posed images observe.

    Args:
        frames: of `reconstruction`, which has the keypoints of its images.
        reconstruction: the same.
        source: the model, of the same keypoints.
    """
    seen = [observed_points(source.image(i)) for i in frames.image_ids]
    images = np.repeat(np.arange(len(seen)), [len(keypoints) for keypoints, _ in seen])
    keypoints = np.concatenate([keypoints for keypoints, _ in seen])
    points = np.concatenate([ids for _, ids in seen]).astype(np.int64)
    cameras, pixels, on_plane = _look_up(frames, reconstruction, images, keypoints)
    order = np.argsort(points, kind="stable")
    names, lengths = np.unique(points, return_counts=True)
    return ObservedTracks(
        offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        cameras=cameras[order],
        keypoints=keypoints[order],
        pixels=pixels[order],
        on_plane=on_plane[order],
        ids=names,
        may_split=False,
    )


def with_rays_of(frames: PosedFrames, tracks: Tracks) -> Tracks:
    """Return the same observations with the rays that the lenses of the frames give them now."""
    lens = frames.lens_of_camera[tracks.cameras]
    on_plane = tracks.on_plane.copy()
    for k, own in enumerate(frames.lenses):
        rows = np.flatnonzero(lens == k)
        if not own.fixed and len(rows):
            on_plane[rows] = own.undistort(tracks.pixels[rows])
    return replace(tracks, on_plane=on_plane)


def read_bundle(
    reconstruction: pycolmap.Reconstruction, frames: PosedFrames
) -> tuple[IntArray, AdjustmentProblem]:
    """Return the points that posed images observe, by id, and the problem of all that they observe.

    An observation that its lens gives no ray is left out.

    Args:
        reconstruction: with points.
        frames: of it.
    """
    tracks = collect_tracks(frames, reconstruction, reconstruction)
    points = np.array([reconstruction.point3D(i).xyz for i in tracks.ids.tolist()]).reshape(-1, 3)
    has_ray = np.isfinite(tracks.on_plane).all(axis=1)
    seen = np.repeat(np.arange(tracks.num_tracks), tracks.lengths())
    problem = frames.problem_of(points, tracks.cameras[has_ray], seen[has_ray], tracks.pixels[has_ray])
    return tracks.ids, problem


def _look_up(
    frames: PosedFrames,
    reconstruction: pycolmap.Reconstruction,
    images: IntArray | Int32Array,
    keypoints: IntArray | Int32Array,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return camera, pixels (m, 2) and rays on the plane z = 1 (m, 2) of keypoints; `images` ascend."""
    cameras = np.searchsorted(frames.images, images)
    pixels, on_plane = np.empty((len(images), 2)), np.empty((len(images), 2))
    ends = np.searchsorted(images, np.arange(len(frames.image_ids) + 1)).tolist()
    for k, (begin, end) in enumerate(itertools.pairwise(ends)):
        image = reconstruction.image(frames.image_ids[k])
        camera, own = reconstruction.camera(image.camera_id), slice(begin, end)
        xy = points2d_xy(image)[keypoints[own]]
        if lens_of(camera).is_adjustable:
            pixels[own], on_plane[own] = xy, np.asarray(camera.cam_from_img(xy)).reshape(-1, 2)
            continue
        rays = camera_rays(camera, xy)
        view = np.argmax(rays @ CUBE[:, 2].T, axis=1)  # 0 for rays of NaN
        local = np.einsum("mab,mb->ma", CUBE[view], rays)
        on_plane[own] = local[:, :2] / local[:, 2:]
        pixels[own] = lens_of(camera).focal_px * on_plane[own]
        cameras[own] += view
    return cameras, pixels, on_plane
