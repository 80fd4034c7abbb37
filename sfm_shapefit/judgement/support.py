"""What a model's points say of its images: which see too few, and what share of the matches agrees."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.judgement.limits import CHECKED_BY, FEWEST_POINTS, OUTNUMBERED, RARE, SMALLEST_SHAPE
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import MatchBatch
from sfm_shapefit.scene.points import Points
from sfm_shapefit.tracks.joining import sampson_px


def images_of_few_points(points: Points, images: Images, least: IntArray, fixed: BoolArray) -> IntArray:
    """Return how many points images see that are to leave, -1 for those that stay, (i,).

    A frame leaves if each of its images sees too few points. It takes its observations along,
    which may leave others with too few; three frames stay.

    Args:
        points: of the images.
        images: some of them posed; others have no part.
        least: (f,) points.
        fixed: (f,) frames that stay whatever they see.
    """
    gone, frame_of = np.full(images.num_images, -1), images.frame_of
    while True:
        there = images.is_posed & (gone < 0)
        seen = points.taken(points.paired(there[points.images])).count_seen(images.num_images)
        most = np.full(len(images.frames.ids), -1)
        np.maximum.at(most, frame_of[there], seen[there])
        poor = (most >= 0) & (most < least) & ~fixed
        if not poor.any() or np.sum((most >= 0) & ~poor) < SMALLEST_SHAPE:
            return gone
        leaving = there & poor[frame_of]
        gone[leaving] = seen[leaving]


class ObservationShares(NamedTuple):
    """Shares of the keypoints that are matched in two or more other registered images; NaN without any."""

    agreeing: float
    """The share that sees a 3D point."""
    contradicting: float
    """The share that sees none, and most of whose matches miss the epipolar lines of the cameras."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObservationCounts:
    """Numbers of keypoints that are matched in two or more other posed images, by image; 0 without a pose."""

    checked: IntArray
    """(i,) their number."""
    agreeing: IntArray
    """(i,) number that sees a 3D point."""
    contradicting: IntArray
    """(i,) number that sees none, and most of whose matches miss the epipolar lines of the cameras."""

    def shares(self, chosen: BoolArray) -> ObservationShares:
        """Return the shares of some of the images (i,) together."""
        total = int(self.checked[chosen].sum())
        if not total:
            return ObservationShares(math.nan, math.nan)
        both = self.agreeing[chosen].sum(), self.contradicting[chosen].sum()
        return ObservationShares(*(int(part) / total for part in both))


def count_observations(
    points: Points,
    images: Images,
    num_keypoints: IntArray,
    batches: Iterable[MatchBatch],
    rotations: FloatArray,
    max_error_px: float,
) -> ObservationCounts:
    """Return how many observations of each image agree with the cameras, and how many contradict them.

    The others are merely without a point: seen under too small an angle, in too short a track, or along an
    epipolar line and yet not where another image has them.

    Args:
        points: triangulated from these matches.
        images: some of them posed.
        num_keypoints: (i,)
        batches: matches of all pairs of posed images, and maybe of others.
        rotations: (i, 3, 3) cam_from_world by which the rays of the matches are in world axes.
        max_error_px: distance from the epipolar line (of both images together, to first order) from which a
            match contradicts.
    """
    posed = images.is_posed
    sizes = np.where(posed, num_keypoints, 0)
    begins, image_of = np.append(0, np.cumsum(sizes)), np.repeat(np.arange(len(sizes)), sizes)
    counts = np.zeros((len(image_of), 3), dtype=np.int32)
    centers = np.where(posed[:, None], images.centers, 0.0)
    turns = np.where(posed[:, None, None], images.rotations.transpose(0, 2, 1) @ rotations, np.eye(3))
    for batch in batches:
        baselines = centers[batch.pairs[:, 1]] - centers[batch.pairs[:, 0]]
        lengths = np.maximum(np.linalg.norm(baselines, axis=1), np.finfo(np.float64).tiny)
        _count_misses(
            batch.pairs, batch.offsets, batch.keypoints, np.ascontiguousarray(batch.rays_i),
            np.ascontiguousarray(batch.rays_j), turns, baselines / lengths[:, None], batch.pixel_angles,
            max_error_px, posed, begins, counts,
        )  # fmt: skip
    checked, sees = counts[:, 0] >= CHECKED_BY, np.zeros(len(image_of), dtype=np.bool_)
    sees[begins[points.images] + points.keypoints] = True
    misses = 2 * counts[:, 1] > counts[:, 0]
    parts = (checked, checked & sees, checked & ~sees & misses)
    columns = (np.bincount(image_of[part], minlength=len(sizes)).astype(np.int64) for part in parts)
    return ObservationCounts(**dict(zip(("checked", "agreeing", "contradicting"), columns, strict=True)))


def images_without_support(counts: ObservationCounts, images: Images, fixed: BoolArray) -> BoolArray:
    """Return the images (i,) of frames whose matches could make points with those of others, and hardly do.

    Directions can agree with a wrong pose, of an image on a repeated structure for one: points, which need
    three images, do not. If fewer than three frames have points, none is returned.

    Args:
        counts: of the images.
        images: some of them posed.
        fixed: (f,) frames that are not asked.
    """
    could = counts.checked >= OUTNUMBERED * FEWEST_POINTS
    does = could & (counts.agreeing >= RARE * counts.checked)  # right images have .26 or more, a wrong one 0
    posed, lost, support = np.zeros((3, len(images.frames.ids)), dtype=np.bool_)
    posed[images.frame_of[images.is_posed]] = True
    lost[images.frame_of[could]], support[images.frame_of[does]] = True, True
    lost &= ~support & ~fixed
    return images.is_posed & (lost & (np.sum(posed & ~lost) >= SMALLEST_SHAPE))[images.frame_of]


@kernel
def _count_misses(
    pairs: Any, offsets: Any, keypoints: Any, rays_i: Any, rays_j: Any, turns: Any, baselines: Any,
    pixel_angles: Any, max_error_px: float, registered: Any, begins: Any, counts: Any,
) -> None:  # fmt: skip
    """Count the partners of each keypoint of all images, and those of them that miss their epipolar lines.

    The third column of `counts` has the image last counted, by its number from 1 on. `turns` (n, 3, 3) take
    the rays to the cameras' axes. Two images in one place, whose baseline is 0, contradict nothing.
    """
    u, v = np.empty(3), np.empty(3)
    for p in range(len(pairs)):
        i, j = pairs[p, 0], pairs[p, 1]
        if not (registered[i] and registered[j]):
            continue
        for m in range(offsets[p], offsets[p + 1]):
            for c in range(3):
                u[c] = v[c] = 0.0
                for a in range(3):
                    u[c] += turns[i, c, a] * rays_i[m, a]
                    v[c] += turns[j, c, a] * rays_j[m, a]
            misses = sampson_px(u, v, baselines[p], pixel_angles[p]) > max_error_px
            for side in range(2):
                own = counts[begins[pairs[p, side]] + keypoints[m, side]]
                other = 1 + pairs[p, 1 - side]
                if own[2] != other:  # a keypoint may be matched twice with one image
                    own[0] += 1
                    own[1] += misses
                    own[2] = other
