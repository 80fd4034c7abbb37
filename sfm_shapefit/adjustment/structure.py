"""Triangulation: the 3D points of posed images, from their matches or from tracks that they have already.

Matches are joined to tracks by whether they fit the given poses, and each track becomes the points that
explain it (`tracks.triangulation`). All in memory: no database is opened. Whatever survives fits its
observations to `max_reprojection_error_px`, lies in front of the cameras that see it, and is seen under at
least `min_triangulation_angle_deg` by two of them.

COLMAP's incremental triangulator makes points of matches too. It goes from image to image through one graph
of all of them, takes about twice as long, and 40 bytes of memory a match instead of 8. Beside it, points
from matches fit better here: on fountain-P11, Herz-Jesus-P25, castle-P30 and lego100 there are 0.5, 0.7, 0.8
and 4.3 % more observations, with mean errors of 0.44 instead of 0.53, 0.58 (0.71), 0.41 (0.51) and 0.47 px
(0.65). The mean length of tracks is 4.60 (4.54), 5.64 (5.54), 4.91 (4.95) and 4.59 (4.66).

No sample is random: the same input gives the same bits. The workers of a cluster have no part in it: to send
them the tracks takes as long as they would save.

Source: Schoenberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016, section 4.3.
"""

from collections.abc import Iterator

import numpy as np

from sfm_shapefit.adjustment.sources import Links
from sfm_shapefit.adjustment.views import views_of
from sfm_shapefit.base.arrays import IntArray, hand_back_memory
from sfm_shapefit.base.executors import Advance, nobody
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points, concatenate_points, number_points
from sfm_shapefit.tracks.links import MatchedKeypoints, ObservedTracks
from sfm_shapefit.tracks.structure_options import StructureOptions
from sfm_shapefit.tracks.triangulation import (
    PointLimits,
    joining_limits_px,
    triangulate_tracks,
)

# Tracks that are triangulated at a time; the answer does not depend on it.
_TRACKS_A_BLOCK = 20_000


def triangulate(
    images: Images,
    links: Links,
    options: StructureOptions,
    advance: Advance = nobody,
    threads: int = 1,
) -> Points:
    """Return the points of links at the poses of images, a block of tracks at a time; none is filtered.

    By COLMAP's rule a track of two keypoints that are matched with no other one is left out. Tracks that a
    model had keep their points' ids.

    Args:
        images: all of them posed.
        links: their matches, or tracks.
        options: what points must satisfy.
        advance: called with the tracks of the first joining that are done, and their number.
        threads: number of threads to share the work among; the answer does not depend on it.
    """
    limits = PointLimits(
        max_error_px=options.max_reprojection_error_px,
        min_angle_deg=options.min_triangulation_angle_deg,
        min_length=options.min_track_length,
    )
    if isinstance(links, ObservedTracks):
        return concatenate_points(_points_of_tracks(images, links, limits, advance, threads))
    fewest = options.fewest_views(images.num_images)
    return number_points(_points_of_matches(images, links, (limits, fewest), advance, threads))


def _points_of_tracks(
    images: Images, links: ObservedTracks, limits: PointLimits, advance: Advance, threads: int
) -> Iterator[Points]:
    views, done = views_of(images), 0
    poses = views.poses(images)
    for block in map(links.subset, _blocks(np.flatnonzero(links.lengths() >= limits.min_length))):
        yield views.seen_points(block, triangulate_tracks(block, poses, limits, threads))
        done += block.num_tracks
        advance(done, links.num_tracks)


def _points_of_matches(
    images: Images, matched: MatchedKeypoints, least: tuple[PointLimits, int], advance: Advance, threads: int
) -> Iterator[Points]:
    views, (limits, fewest) = views_of(images), least
    poses, joining_limits = (
        views.poses(images),
        (*joining_limits_px(limits.max_error_px, limits.max_error_px),),
    )
    partners = matched.count_partners()
    is_left = np.ones(len(partners), dtype=np.bool_)
    for limit_px in joining_limits:
        matched, partners = matched.among(is_left, threads), partners[is_left]
        hand_back_memory()  # before the rays of all keypoints take some
        joined = matched.join(poses, limit_px, threads)
        if limit_px < joining_limits[-1]:  # two keypoints may find a third one in the next joining
            sizes = joined.lengths()
        else:  # two keypoints count 2 if they have no other partner, 3 or more if one has
            sizes = np.diff(offsets_of(partners[joined.rows])[joined.offsets])
        chosen, is_left = np.flatnonzero(sizes >= fewest), np.ones_like(partners, dtype=np.bool_)
        done = 0
        for own in map(joined.subset, _blocks(chosen)):
            tracks = matched.observed(own, threads)
            found = triangulate_tracks(tracks, poses, limits, threads)
            yield views.seen_points(tracks, found)
            is_left[own.rows[found.points_seen >= 0]] = False
            done += tracks.num_tracks
            if limit_px == joining_limits[0]:  # nearly all tracks
                advance(done, len(chosen))
        del joined, sizes, chosen  # before the keypoints that are left are copied


def _blocks(chosen: IntArray) -> Iterator[IntArray]:
    return (chosen[first : first + _TRACKS_A_BLOCK] for first in range(0, len(chosen), _TRACKS_A_BLOCK))
