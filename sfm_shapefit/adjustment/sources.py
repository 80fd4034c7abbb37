"""Where points come from: the matches of images, or the points of a model with the same keypoints."""

import itertools
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from sfm_shapefit.adjustment.views import CUBE, views_of
from sfm_shapefit.base.arrays import (
    BoolArray,
    FloatArray,
    Int32Array,
    IntArray,
    distinct,
    stable_order,
)
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.forests import connected_components
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.base.row_file import AnyRows
from sfm_shapefit.scene.images import Images, KeypointRays
from sfm_shapefit.scene.matches import KeypointMatches
from sfm_shapefit.scene.points import Points
from sfm_shapefit.tracks.links import MatchedKeypoints, ObservedTracks

Links = MatchedKeypoints | ObservedTracks
"""Matches, from which tracks are joined anew at each pose; or the tracks of a model."""

_MATCHES_A_SLICE = 1_000_000  # matches renumbered at once; more would take a second array of all


def collect_matches(
    images: Images,
    pictures: KeypointRays,
    place: IntArray,
    batches: Iterable[KeypointMatches],
    num_matches: int,
    make_rows: Callable[..., AnyRows] = np.empty,
) -> MatchedKeypoints:
    """Return all matches between posed images; batches are consumed one at a time.

    Args:
        images: all of them posed.
        pictures: of the images.
        place: (n,) row in `images` of each image that the batches' pairs index; -1 for those to be left out.
        batches: matches.
        num_matches: that the batches have at most.
        make_rows: makes room for matches, of a shape and a type; `RowFile` where there are very many.

    Raises:
        InputError: if a match refers to a keypoint that its image does not have.
    """
    counts = np.array([pictures.count(k) for k in range(images.num_images)], dtype=np.int64)
    begins = offsets_of(counts)
    number = np.uint32 if begins[-1] < 2**32 else np.int64
    # Memory is taken as rows are written; one array of each batch, to be joined, would take it twice.
    room, end = make_rows((num_matches, 2), dtype=number), 0
    is_matched = np.zeros(int(begins[-1]), dtype=np.bool_)
    for batch in batches:
        kept = (place[batch.pairs] >= 0).all(axis=1)
        lengths, own = batch.lengths(), batch.keypoints
        if not kept.all():
            lengths, own = lengths[kept], own[np.repeat(kept, lengths)]
        ends = place[batch.pairs[kept]]
        missing = (own >= np.repeat(counts[ends], lengths, axis=0)).any(axis=1)
        if missing.any():
            pair = ends[np.repeat(np.arange(len(ends)), lengths)[np.argmax(missing)]]
            names = " and ".join(images.names[k] for k in pair.tolist())
            raise InputError(
                f"the pair {names} has matches of keypoints that do not exist; match the images again"
            )
        numbers = own + np.repeat(begins[ends], lengths, axis=0)
        room[end : end + len(own)], is_matched[numbers] = numbers, True
        end += len(own)
    row_of = np.cumsum(is_matched, dtype=number)
    np.subtract(row_of, 1, out=row_of)
    for first in range(0, end, _MATCHES_A_SLICE):
        own_slice = slice(first, min(first + _MATCHES_A_SLICE, end))
        room[own_slice] = row_of[room[own_slice]]
    del row_of
    parts = [np.flatnonzero(part).astype(np.int32) for part in np.split(is_matched, begins[1:-1])]
    taken = np.repeat(np.arange(len(parts), dtype=np.int32), [len(part) for part in parts])
    keypoints = np.concatenate(parts)
    cameras, pixels, on_plane = _look_up(images, pictures, taken, keypoints)
    return MatchedKeypoints(
        cameras=cameras,
        keypoints=keypoints,
        pixels=pixels,
        on_plane=on_plane,
        matches=room[:end] if isinstance(room, np.ndarray) else room,
    )


def collect_tracks(images: Images, pictures: KeypointRays, points: Points) -> ObservedTracks:
    """Return the tracks of points that posed images observe; they keep the points' ids and order."""
    order = stable_order(points.images)
    cameras, pixels, on_plane = _look_up(images, pictures, points.images[order], points.keypoints[order])
    back = stable_order(points.points_seen()[order])
    return ObservedTracks(
        offsets=points.offsets,
        cameras=cameras[back],
        keypoints=points.keypoints[order][back],
        pixels=pixels[back],
        on_plane=on_plane[back],
        ids=points.ids,
        may_split=False,
    )


def links_touching(images: Images, links: Links, chosen: BoolArray) -> Links:
    """Return what some of the images (i,) see, and everything that is matched with it, however far."""
    own = chosen[views_of(images).images[links.cameras]]
    if isinstance(links, ObservedTracks):
        track_of = links.list_of_rows()
        return links.subset(distinct(track_of[own]))
    joined = connected_components(len(own), links.matches[:].astype(np.int64))
    touched = np.zeros(len(own), dtype=np.bool_)
    touched[joined[own]] = True
    return links.among(touched[joined])


def with_rays_of(images: Images, links: Links, changed: BoolArray) -> Links:
    """Return the same observations with the rays that lenses (l,) which have changed give them now."""
    views = views_of(images)
    lens_of, on_plane = images.lens_of[views.images][links.cameras], links.on_plane.copy()
    first = np.searchsorted(views.images, views.images)  # camera of the same image
    for k in np.flatnonzero(changed).tolist():
        rows, lens = np.flatnonzero(lens_of == k), images.lenses[k]
        pixels = links.pixels[rows].astype(np.float64)
        if lens.is_plane:
            on_plane[rows] = lens.undistort(pixels)
            continue
        rays, view = lens.rays(pixels), links.cameras[rows] - first[links.cameras[rows]]
        for v, turn in enumerate(CUBE):
            on_plane[rows[view == v]] = _on_plane(rays[view == v] @ turn.T)
    return replace(links, on_plane=on_plane)


def _on_plane(rays: FloatArray) -> FloatArray:
    """Return x/z and y/z (m, 2) of rays (m, 3); NaN for those that do not point ahead."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(rays[:, 2:] > 0.0, rays[:, :2] / rays[:, 2:], np.nan))


def _look_up(
    images: Images, pictures: KeypointRays, of: IntArray | Int32Array, keypoints: IntArray | Int32Array
) -> tuple[Int32Array, npt.NDArray[np.floating], FloatArray]:
    """Return camera, pixels (m, 2) and x/z, y/z (m, 2) of keypoints; the images that they are `of` ascend."""
    cameras = np.searchsorted(views_of(images).images, of).astype(np.int32)
    on_plane = np.empty((len(of), 2))
    seen: npt.NDArray[np.floating] = np.zeros((len(of), 2), dtype=np.float32)  # until 32 bits do not do
    ends = np.searchsorted(of, np.arange(images.num_images + 1)).tolist()
    for k, (begin, end) in enumerate(itertools.pairwise(ends)):
        own, lens = slice(begin, end), images.lenses[images.lens_of[k]]
        pixels = pictures.pixels(k, keypoints[own])
        rays = pictures.rays(k, pixels)
        if lens.is_plane:
            on_plane[own] = rays[:, :2] / rays[:, 2:]
        else:
            view = np.argmax(rays @ CUBE[:, 2].T, axis=1)  # 0 for rays of NaN
            local = np.einsum("mab,mb->ma", CUBE[view], rays)
            on_plane[own] = local[:, :2] / local[:, 2:]
            if not lens.is_adjustable:
                pixels = lens.focal_px * on_plane[own]
            cameras[own] += view
        if not np.array_equal(pixels.astype(seen.dtype), pixels, equal_nan=True):
            seen = seen.astype(np.float64)
        seen[own] = pixels
    return cameras, seen, on_plane
