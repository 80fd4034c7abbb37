"""Tracks: which keypoints of which cameras are taken for the same point, before any point is known."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import (
    BoolArray,
    FloatArray,
    IndexArray,
    Int32Array,
    IntArray,
)
from sfm_shapefit.base.executors import gathered, in_ranges, in_threads, overlapped
from sfm_shapefit.base.forests import merge_sets
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.base.lists import Lists, RowLists
from sfm_shapefit.base.row_file import AnyRows, Gathered
from sfm_shapefit.scene.epipolar import sampson_px, write_ray
from sfm_shapefit.tracks.joining import list_trees

_MATCHES_A_SLICE = 4_000_000  # matches that are counted at once; for each slice all keypoints are counted
_MATCHES_AT_ONCE = 500_000  # matches that are looked at together; Python can be interrupted in between


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraPoses:
    """Where cameras stand; what tracks and their triangulation must know of them."""

    rotations: FloatArray
    """(c, 3, 3) cam_from_world."""
    centers: FloatArray
    """(c, 3)"""
    focal_lengths_px: FloatArray
    """(c,)"""
    images: IntArray
    """(c,) the image of each; views of one image follow one another."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObservedTracks(Lists):
    """Observations in tracks. Track t has the observations offsets[t]:offsets[t + 1], by ascending camera."""

    offsets: IntArray
    """(t + 1,)"""
    cameras: IndexArray
    """(m,) the camera of each observation."""
    keypoints: IndexArray
    """(m,) which of the camera's keypoints it is."""
    pixels: npt.NDArray[np.floating]
    """(m, 2) as the adjustment's lens takes them."""
    on_plane: FloatArray
    """(m, 2) x/z and y/z of the ray in axes of the camera; NaN for rays that do not point ahead."""
    ids: IntArray
    """(t,) a number by which each track is known."""
    may_split: bool = True
    """Whether a track may be of several points, as one that wrong matches have joined; else it is of one."""

    @property
    def num_tracks(self) -> int:
        """Number of tracks, t."""
        return len(self.offsets) - 1

    def subset(self, chosen: IntArray) -> "ObservedTracks":
        """Return the given tracks, in that order."""
        return self._of_rows(self.rows_of(chosen), self.ids[chosen])

    def of_points(self, points_seen: IndexArray) -> "ObservedTracks":
        """Return the tracks of points, one each: what observations (m,) see, -1 for those to be left out."""
        if np.array_equal(points_seen, self.list_of_rows()):
            return replace(self, ids=np.arange(self.num_tracks))  # as of matches, and large
        joined = RowLists.by_label(points_seen)
        return self._of_rows(joined, np.arange(len(joined.offsets) - 1))

    def _of_rows(self, joined: RowLists, ids: IntArray) -> "ObservedTracks":
        rows = joined.rows
        return replace(
            self,
            offsets=joined.offsets,
            cameras=self.cameras[rows],
            keypoints=self.keypoints[rows],
            pixels=self.pixels.take(rows, axis=0),
            on_plane=self.on_plane.take(rows, axis=0),
            ids=ids,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatchedKeypoints:
    """Keypoints of cameras, and which of them are matched with which."""

    cameras: Int32Array
    """(K,) ascending by image."""
    keypoints: Int32Array
    """(K,) which of the image's keypoints it is."""
    pixels: npt.NDArray[np.floating]
    """(K, 2) as the adjustment's lens takes them; of 32 bits where these hold them."""
    on_plane: FloatArray
    """(K, 2) see `ObservedTracks`."""
    matches: AnyRows
    """(m, 2) rows of the above, of any type of integer."""

    def slices(self) -> Iterator[IndexArray]:
        """Yield the matches, some millions at a time."""
        for first in range(0, len(self.matches), _MATCHES_A_SLICE):
            yield self.matches[first : first + _MATCHES_A_SLICE]

    def count_partners(self) -> Int32Array:
        """Return how many matches each keypoint has, (K,)."""
        counts = np.zeros(len(self.cameras), dtype=np.int32)
        for ends in self.slices():
            counts += np.bincount(ends.astype(np.int64).ravel(), minlength=len(counts)).astype(np.int32)
        return counts

    def among(self, chosen: BoolArray, threads: int = 1) -> "MatchedKeypoints":
        """Return the chosen ones of the keypoints (K,), and the matches between them; threads share these."""
        if chosen.all():
            return self
        row_of = np.cumsum(chosen, dtype=self.matches.dtype)
        row_of -= 1

        def renumbered(first: int) -> npt.NDArray[np.integer]:
            own = self.matches[first : first + _MATCHES_AT_ONCE]
            i, j = own.T
            return row_of.take(own.compress(chosen.take(i) & chosen.take(j), axis=0))

        matches = list(in_threads(threads, renumbered, range(0, len(self.matches), _MATCHES_AT_ONCE)))
        return MatchedKeypoints(
            cameras=self.cameras[chosen],
            keypoints=self.keypoints[chosen],
            pixels=self.pixels.compress(chosen, axis=0),
            on_plane=self.on_plane.compress(chosen, axis=0),
            matches=np.concatenate([np.zeros((0, 2), dtype=self.matches.dtype), *matches]),
        )

    def join(self, poses: CameraPoses, limit_px: float, threads: int = 1) -> RowLists:
        """Return the connected components under the matches that agree with the poses.

        A wrong match would join two tracks; nearly all wrong ones miss their epipolar line.

        Args:
            poses: of the cameras.
            limit_px: largest Sampson error of a match that joins.
            threads: number of threads to share the matches among; they are joined by one, beside the others.
        """
        parents = np.arange(len(self.cameras), dtype=np.int32)
        given = self.on_plane, self.cameras, poses.rotations, poses.centers, poses.focal_lengths_px, limit_px

        def find_agreeing(first: int) -> tuple[npt.NDArray[np.integer], BoolArray]:
            matches = self.matches[first : first + _MATCHES_AT_ONCE]
            agree = np.empty(len(matches), dtype=np.bool_)
            in_ranges(threads, len(matches), _find_agreeing, matches, agree, *given)
            return matches, agree

        starts = range(0, len(self.matches), _MATCHES_AT_ONCE)
        for matches, agree in overlapped(threads, find_agreeing, starts):
            _merge(matches, agree, parents)
        return list_trees(parents)

    def observed(self, joined: RowLists, threads: int = 1) -> ObservedTracks:
        """Return tracks that are known by their rows."""
        return ObservedTracks(
            offsets=joined.offsets,
            cameras=gathered(threads, self.cameras, joined.rows),
            keypoints=gathered(threads, self.keypoints, joined.rows),
            pixels=gathered(threads, self.pixels, joined.rows),
            on_plane=gathered(threads, self.on_plane, joined.rows),
            ids=np.arange(len(joined.offsets) - 1),
        )


@dataclass(frozen=True, slots=True, eq=False)
class JoinedKeypoints(RowLists):
    """Tracks of matched keypoints, each of one point; what is known of an observation is not copied."""

    matched: MatchedKeypoints
    may_split = True

    @property
    def ids(self) -> IntArray:
        """(t,) as of `ObservedTracks`."""
        return np.arange(len(self.offsets) - 1)

    @property
    def cameras(self) -> Gathered:
        """(m,) as of `ObservedTracks`."""
        return Gathered(self.matched.cameras, self.rows)

    @property
    def keypoints(self) -> Gathered:
        """(m,) as of `ObservedTracks`."""
        return Gathered(self.matched.keypoints, self.rows)

    @property
    def pixels(self) -> Gathered:
        """(m, 2) as of `ObservedTracks`."""
        return Gathered(self.matched.pixels, self.rows)

    def of_points(self, points_seen: IndexArray) -> "JoinedKeypoints":
        """Return the tracks of points, as `ObservedTracks.of_points` does."""
        if np.array_equal(points_seen, self.spread(np.arange(len(self.offsets) - 1, dtype=np.int32))):
            return self
        joined = self.of(RowLists.by_label(points_seen))
        return JoinedKeypoints(joined.offsets, joined.rows, self.matched)


SeenTracks = ObservedTracks | JoinedKeypoints
"""Tracks whose observations can be looked up."""


@kernel
def _merge(matches: Any, chosen: Any, parents: Any) -> None:
    for m in range(len(matches)):
        if chosen[m]:
            merge_sets(parents, matches[m, 0], matches[m, 1])


@kernel
def _find_agreeing(
    begin: int, end: int, matches: Any, agree: Any, on_plane: Any, cameras: Any, rotations: Any,
    centers: Any, focal_lengths_px: Any, limit_px: float,
) -> None:  # fmt: skip
    """Write which of the matches begin..end-1 agree with the poses."""
    u, v, d = np.empty((3, 3))
    for m in range(begin, end):
        k, other = matches[m, 0], matches[m, 1]
        i, j = cameras[k], cameras[other]
        square = 0.0
        for c in range(3):
            d[c] = centers[j, c] - centers[i, c]
            square += d[c] * d[c]
        for c in range(3):
            d[c] /= np.sqrt(square)
        # Rays are made as they are needed: to hold those of all keypoints would take the most memory.
        write_ray(on_plane[k], rotations[i], u)
        write_ray(on_plane[other], rotations[j], v)
        agree[m] = sampson_px(u, v, d, 2.0 / (focal_lengths_px[i] + focal_lengths_px[j])) <= limit_px
