"""Tracks: which keypoints of which cameras are taken for the same point, before any point is known."""

from dataclasses import dataclass, replace

import numpy as np

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.viewgraph import connected_components


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObservedTracks:
    """Observations in tracks. Track t has the observations offsets[t]:offsets[t + 1], by ascending camera."""

    offsets: IntArray
    """(t + 1,)"""
    cameras: IntArray
    """(m,) the camera of each observation."""
    keypoints: IntArray
    """(m,) which of the camera's keypoints it is."""
    pixels: FloatArray
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

    def lengths(self) -> IntArray:
        """Return the number of observations of each track, (t,)."""
        return np.diff(self.offsets)

    def subset(self, chosen: IntArray) -> "ObservedTracks":
        """Return the given tracks, in that order."""
        lengths = self.lengths()[chosen]
        offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
        rows = np.repeat(self.offsets[chosen] - offsets[:-1], lengths) + np.arange(offsets[-1])
        return replace(
            self,
            offsets=offsets,
            cameras=self.cameras[rows],
            keypoints=self.keypoints[rows],
            pixels=self.pixels[rows],
            on_plane=self.on_plane[rows],
            ids=self.ids[chosen],
        )

    def of_points(self, points_seen: IntArray) -> "ObservedTracks":
        """Return the tracks of points, one each: what observations (m,) see, -1 for those to be left out."""
        rows = np.argsort(points_seen, kind="stable")[np.sum(points_seen < 0) :]
        offsets = np.concatenate([[0], np.cumsum(np.bincount(points_seen[rows]))]).astype(np.int64)
        return replace(
            self,
            offsets=offsets,
            cameras=self.cameras[rows],
            keypoints=self.keypoints[rows],
            pixels=self.pixels[rows],
            on_plane=self.on_plane[rows],
            ids=np.arange(len(offsets) - 1),
        )


def join_matches(num_keypoints: IntArray, pairs: IntArray, offsets: IntArray, matches: IntArray) -> IntArray:
    """Return the track of each keypoint, (K,), numbered by their first keypoints; -1 for those unmatched.

    A track is a connected component of matched keypoints, those of camera c being the keypoints from
    sum(num_keypoints[:c]) on.

    Args:
        num_keypoints: (c,) of each camera.
        pairs: (p, 2) of cameras.
        offsets: (p + 1,) the matches of pair k are offsets[k]:offsets[k + 1].
        matches: (m, 2) keypoints of the pair's two cameras, below their numbers.
    """
    first = np.concatenate([[0], np.cumsum(num_keypoints)])
    ends = matches + np.repeat(first[pairs], np.diff(offsets), axis=0)
    is_matched = np.zeros(int(first[-1]), dtype=np.bool_)
    is_matched[ends] = True
    matched = np.flatnonzero(is_matched)
    place = np.cumsum(is_matched) - 1
    tracks = np.full(int(first[-1]), -1)
    tracks[matched] = connected_components(len(matched), place[ends])
    return tracks
