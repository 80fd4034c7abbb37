"""What a model's points say of its images: which see too few, and what share of the matches agrees."""

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import BoolArray, IntArray
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.files.colmap.model import PosedModel
from sfm_shapefit.scene.matches import MatchBatch
from sfm_shapefit.tracks.joining import sampson_px

_FEWEST_FRAMES = 3  # frames; so many stay whatever they see, as a model of fewer is none
_CHECKED_BY = 2  # matches of a keypoint in other images; with as many its track can be checked
# Keypoints that can be checked, and share of them that sees points; less is chance. No right image of
# data_synthetic and eleven real scenes has less than 0.26; a wrong one, with which all its pairs agreed, 0.
_FEWEST_CHECKED, _LEAST_AGREEING = 30, 0.05


def deregister_of_few_points(
    structure: pycolmap.Reconstruction, least: int, fixed_frames: Collection[int] = ()
) -> dict[int, int]:
    """Deregister the frames each of whose images sees fewer than `least` points, with their observations.

    An image that goes takes observations along, which may leave others with too few; three frames, and the
    `fixed_frames`, stay. Returns the number of points that each such image saw then, by its id.
    """
    gone: dict[int, int] = {}
    while True:
        counts: dict[int, dict[int, int]] = {}
        for image in map(structure.image, sorted(structure.reg_image_ids())):
            counts.setdefault(image.frame_id, {})[image.image_id] = image.num_points3D
        poor = [frame for frame, seen in counts.items() if max(seen.values()) < least]
        poor = [frame for frame in poor if frame not in fixed_frames]
        if not poor or len(counts) - len(poor) < _FEWEST_FRAMES:
            return gone
        for frame in poor:
            gone |= counts[frame]
            structure.deregister_frame(frame)


class ObservationShares(NamedTuple):
    """Shares of the keypoints that are matched in two or more other registered images; NaN without any."""

    agreeing: float
    """The share that sees a 3D point."""
    contradicting: float
    """The share that sees none, and most of whose matches miss the epipolar lines of the cameras."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObservationCounts:
    """Numbers of keypoints that are matched in two or more other images, of n registered images."""

    image_ids: IntArray
    """(n,)"""
    checked: IntArray
    """(n,) their number."""
    agreeing: IntArray
    """(n,) number that sees a 3D point."""
    contradicting: IntArray
    """(n,) number that sees none, and most of whose matches miss the epipolar lines of the cameras."""

    def shares(self) -> ObservationShares:
        """Return the shares of all images together."""
        total = int(self.checked.sum())
        if not total:
            return ObservationShares(math.nan, math.nan)
        return ObservationShares(int(self.agreeing.sum()) / total, int(self.contradicting.sum()) / total)

    def subset(self, chosen: BoolArray) -> "ObservationCounts":
        """Return the counts of some of the images."""
        return ObservationCounts(
            image_ids=self.image_ids[chosen],
            checked=self.checked[chosen],
            agreeing=self.agreeing[chosen],
            contradicting=self.contradicting[chosen],
        )


def count_observations(
    structure: pycolmap.Reconstruction,
    model: PosedModel,
    batches: Iterable[MatchBatch],
    max_error_px: float,
) -> ObservationCounts:
    """Return how many observations of each image agree with the cameras, and how many contradict them.

    The others are merely without a point: seen under too small an angle, in too short a track, or along an
    epipolar line and yet not where another image has them.

    Args:
        structure: triangulated from these matches.
        model: model of the given rotations, whose images the batches' pairs index.
        batches: matches of all pairs, the rays in world axes by the given rotations.
        max_error_px: distance from the epipolar line (of both images together, to first order) from which a
            match contradicts.
    """
    registered = np.isin(model.image_ids, list(structure.reg_image_ids()))
    images = [
        structure.image(i) if is_in else None for i, is_in in zip(model.image_ids, registered, strict=True)
    ]
    begins = np.append(0, np.cumsum([0 if image is None else image.num_points2D() for image in images]))
    counts = np.zeros((int(begins[-1]), 3), dtype=np.int32)
    centers, turns = np.zeros((len(images), 3)), np.tile(np.eye(3), (len(images), 1, 1))
    for k, image in enumerate(images):
        if image is not None:
            pose = image.cam_from_world()
            centers[k] = image.projection_center()
            turns[k] = pose.rotation.matrix().T @ model.rotations[k]
    for batch in batches:
        baselines = centers[batch.pairs[:, 1]] - centers[batch.pairs[:, 0]]
        lengths = np.maximum(np.linalg.norm(baselines, axis=1), np.finfo(np.float64).tiny)
        _count_misses(
            batch.pairs, batch.offsets, batch.keypoints, np.ascontiguousarray(batch.rays_i),
            np.ascontiguousarray(batch.rays_j), turns, baselines / lengths[:, None], batch.pixel_angles,
            max_error_px, registered, begins, counts,
        )  # fmt: skip
    rows = []
    for image, own in zip(images, np.split(counts, begins[1:-1]), strict=True):
        if image is not None:
            checked = own[:, 0] >= _CHECKED_BY
            sees = np.zeros_like(checked)
            sees[image.get_observation_point2D_idxs()] = True
            misses = 2 * own[:, 1] > own[:, 0]
            found = checked, checked & sees, checked & ~sees & misses
            rows.append([image.image_id, *map(np.count_nonzero, found)])
    columns = np.array(rows, dtype=np.int64).reshape(-1, 4).T
    return ObservationCounts(
        image_ids=columns[0], checked=columns[1], agreeing=columns[2], contradicting=columns[3]
    )


def images_without_support(
    structure: pycolmap.Reconstruction, counts: ObservationCounts, fixed_frames: Collection[int] = ()
) -> dict[int, int]:
    """Return the images of frames whose matches could make points with those of others, and hardly make any.

    Directions can agree with a wrong pose, of an image on a repeated structure for one: points, which need
    three images, do not. The value is the number of points of each such image, by its id; `fixed_frames` are
    left out, and all are if fewer than three frames have points.
    """
    could = counts.checked >= _FEWEST_CHECKED
    does = could & (counts.agreeing >= _LEAST_AGREEING * counts.checked)
    frames = np.array([structure.image(i).frame_id for i in counts.image_ids.tolist()], dtype=np.int64)
    lost = set(frames[could].tolist()) - set(frames[does].tolist()) - set(fixed_frames)
    if len(set(frames.tolist())) - len(lost) < _FEWEST_FRAMES:
        return {}
    images = [structure.image(i) for i in sorted(structure.reg_image_ids())]
    return {image.image_id: image.num_points3D for image in images if image.frame_id in lost}


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
