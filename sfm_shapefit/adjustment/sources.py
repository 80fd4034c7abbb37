"""Where points come from: the matches of images, or the points of a model with the same keypoints."""

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial

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
from sfm_shapefit.base.executors import in_slices, in_threads, overlapped
from sfm_shapefit.base.forests import connected_components
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.base.row_file import AnyRows
from sfm_shapefit.scene.images import Images, KeypointRays
from sfm_shapefit.scene.matches import KeypointMatches, lens_runs
from sfm_shapefit.scene.points import Points
from sfm_shapefit.tracks.links import MatchedKeypoints, ObservedTracks

Links = MatchedKeypoints | ObservedTracks
"""Matches, from which tracks are joined anew at each pose; or the tracks of a model."""

_MATCHES_A_SLICE = 250_000  # matches renumbered at once; more would take a second array of all


def collect_matches(
    images: Images,
    pictures: KeypointRays,
    place: IntArray,
    batches: Iterable[KeypointMatches],
    room: AnyRows,
    threads: int = 1,
) -> MatchedKeypoints:
    """Return all matches between posed images; batches are consumed one at a time.

    Args:
        images: all of them posed.
        pictures: of the images.
        place: (n,) row in `images` of each image that the batches' pairs index; -1 for those to be left out.
        batches: matches.
        room: (M, 2) rows for all matches that the batches may have, of a type for the numbers of all
            keypoints; they take the most memory, if they are not in a file.
        threads: number of threads to share batches among; the answer does not depend on it.
    """
    counts = np.array([pictures.count(k) for k in range(images.num_images)], dtype=np.int64)
    begins = offsets_of(counts)
    is_matched = np.zeros(int(begins[-1]), dtype=np.bool_)

    def tasks() -> Iterator[tuple[KeypointMatches, BoolArray, int]]:
        end = 0
        for batch in batches:
            kept = np.asarray((place[batch.pairs] >= 0).all(axis=1))
            yield batch, kept, end
            end += int(batch.lengths()[kept].sum())

    def enter(task: tuple[KeypointMatches, BoolArray, int]) -> int:
        batch, kept, begin = task
        ends, lengths, own = place[batch.pairs], batch.lengths(), batch.keypoints
        if not kept.all():
            ends, lengths, own = ends[kept], lengths[kept], own.compress(np.repeat(kept, lengths), axis=0)
        numbers = np.empty(own.shape, dtype=room.dtype)
        np.add(own, np.repeat(begins[ends], lengths, axis=0), out=numbers, casting="unsafe")
        room[begin : begin + len(own)], is_matched[numbers] = numbers, True
        return begin + len(own)

    end = max(overlapped(threads, enter, tasks()), default=0)
    _renumber(room, end, is_matched, threads)
    parts = [np.flatnonzero(part).astype(np.int32) for part in np.split(is_matched, begins[1:-1])]
    taken = np.repeat(np.arange(len(parts), dtype=np.int32), [len(part) for part in parts])
    keypoints = np.concatenate(parts)
    cameras, pixels, on_plane = _look_up(images, pictures, taken, keypoints, threads)
    return MatchedKeypoints(
        cameras=cameras,
        keypoints=keypoints,
        pixels=pixels,
        on_plane=on_plane,
        matches=room[:end] if isinstance(room, np.ndarray) else room,
    )


def _renumber(keypoints: AnyRows, count: int, chosen: BoolArray, threads: int) -> None:
    """Replace numbers (m, 2) of chosen keypoints by their rows among these, in place."""
    row_of: npt.NDArray[np.integer] = np.cumsum(chosen, dtype=keypoints.dtype)
    row_of -= 1

    def replace_some(begin: int, end: int) -> None:
        keypoints[begin:end] = row_of.take(keypoints[begin:end])

    in_slices(threads, count, _MATCHES_A_SLICE, replace_some)


def collect_tracks(
    images: Images, pictures: KeypointRays, points: Points, threads: int = 1
) -> ObservedTracks:
    """Return the tracks of points that posed images observe; they keep the points' ids and order."""
    order = stable_order(points.images)
    own = points.images[order], points.keypoints[order]
    cameras, pixels, on_plane = _look_up(images, pictures, *own, threads)
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
    images: Images,
    pictures: KeypointRays,
    of: IntArray | Int32Array,
    keypoints: IntArray | Int32Array,
    threads: int,
) -> tuple[Int32Array, npt.NDArray[np.floating], FloatArray]:
    """Return camera, pixels (m, 2) and x/z, y/z (m, 2) of keypoints; the images that they are `of` ascend."""
    first_cameras, ends = views_of(images).images, np.searchsorted(of, np.arange(images.num_images + 1))
    cameras, on_plane = np.empty(len(of), dtype=np.int32), np.empty((len(of), 2))

    def look(seen: npt.NDArray[np.floating], run: tuple[int, int]) -> bool:
        slices = [slice(*pair) for pair in itertools.pairwise(ends[run[0] : run[1] + 1].tolist())]
        own, lens = slice(slices[0].start, slices[-1].stop), images.lenses[images.lens_of[run[0]]]
        pixels = np.concatenate([pictures.pixels(k, keypoints[one]) for k, one in enumerate(slices, run[0])])
        rays = pictures.rays(run[0], pixels)
        cameras[own] = np.searchsorted(first_cameras, of[own])
        if lens.is_plane:
            on_plane[own] = rays[:, :2] / rays[:, 2:]
        else:
            view = np.argmax(rays @ CUBE[:, 2].T, axis=1)  # 0 for rays of NaN
            local = np.einsum("mab,mb->ma", CUBE[view], rays)
            on_plane[own] = local[:, :2] / local[:, 2:]
            if not lens.is_adjustable:
                pixels = lens.focal_px * on_plane[own]
            cameras[own] += view
        with np.errstate(over="ignore"):  # then 32 bits do not do
            seen[own] = pixels
        return np.array_equal(seen[own], pixels, equal_nan=True)

    runs = lens_runs(images.lens_of, np.diff(ends))
    seen: npt.NDArray[np.floating] = np.empty((len(of), 2), dtype=np.float32)
    if not all(in_threads(threads, partial(look, seen), runs)):  # 32 bits do not do
        seen = np.empty((len(of), 2))
        for _ in in_threads(threads, partial(look, seen), runs):
            pass
    return cameras, seen, on_plane
