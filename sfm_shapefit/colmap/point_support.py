"""What a model's points say of its images: which see too few, and what share of the matches agrees."""

import math
from collections.abc import Collection, Iterable
from typing import NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.arrays import BoolArray, FloatArray
from sfm_shapefit.colmap.model import PosedModel
from sfm_shapefit.directions.matches import MatchBatch

# So many frames stay whatever they see.
_FEWEST_FRAMES = 3
# Matches in other images that make a keypoint part of a track that can be checked.
_CHECKED_BY = 2


def deregister_of_few_points(
    structure: pycolmap.Reconstruction, least: int, fixed_frames: Collection[int] = ()
) -> dict[int, int]:
    """Deregister the frames each of whose images sees fewer than `least` points, with what they observe.

    An image that goes takes observations along, which may leave others with too few; three frames stay.

    Args:
        structure: ours, which is changed.
        least: points.
        fixed_frames: ids of frames that stay whatever they see.

    Returns:
        By the id of each image that went, the number of points it saw then.
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
    """Of the keypoints that are matched in two or more other registered images; NaN without any."""

    agreeing: float
    """The share that sees a 3D point."""
    contradicting: float
    """The share that sees none, and most of whose matches miss the epipolar lines of the cameras."""


def judge_observations(
    structure: pycolmap.Reconstruction,
    model: PosedModel,
    batches: Iterable[MatchBatch],
    max_error_px: float,
) -> ObservationShares:
    """Return what share of the observations agrees with the cameras, and what share contradicts them.

    The others are merely without a point: seen under too small an angle, in too short a track, or along an
    epipolar line and yet not where another image has them.

    Args:
        structure: triangulated from these matches.
        model: that has the given rotations, whose images the batches' pairs index.
        batches: matches of all pairs, the rays in world axes by the given rotations.
        max_error_px: distance from the epipolar line (of both images together, to first order) from which a
            match contradicts.
    """
    registered = np.isin(model.image_ids, list(structure.reg_image_ids()))
    images = [
        structure.image(i) if is_in else None for i, is_in in zip(model.image_ids, registered, strict=True)
    ]
    num_matches = [np.zeros(0 if image is None else image.num_points2D(), dtype=np.int64) for image in images]
    num_missing = [np.zeros_like(counts) for counts in num_matches]
    centers, turns = np.zeros((len(images), 3)), np.tile(np.eye(3), (len(images), 1, 1))
    for k, image in enumerate(images):
        if image is not None:
            pose = image.cam_from_world()
            centers[k] = image.projection_center()
            turns[k] = pose.rotation.matrix().T @ model.rotations[k]
    for batch in batches:
        misses = _miss_epipolar_lines(batch, turns, centers, max_error_px)
        for pair in np.flatnonzero(registered[batch.pairs].all(axis=1)).tolist():
            rows = slice(batch.offsets[pair], batch.offsets[pair + 1])
            for side, image in enumerate(batch.pairs[pair].tolist()):
                num_matches[image][batch.keypoints[rows, side]] += 1
                num_missing[image][batch.keypoints[rows, side]] += misses[rows]
    matched, agreeing, contradicting = 0, 0, 0
    for image, counts, missing in zip(images, num_matches, num_missing, strict=True):
        if image is not None:
            checked = counts >= _CHECKED_BY
            sees = np.zeros_like(checked)
            sees[image.get_observation_point2D_idxs()] = True
            matched += int(checked.sum())
            agreeing += int(np.sum(checked & sees))
            contradicting += int(np.sum(checked & ~sees & (2 * missing > counts)))
    return ObservationShares(agreeing / matched, contradicting / matched) if matched else _NO_OBSERVATIONS


_NO_OBSERVATIONS = ObservationShares(math.nan, math.nan)


def _miss_epipolar_lines(
    batch: MatchBatch, turns: FloatArray, centers: FloatArray, max_error_px: float
) -> BoolArray:
    """Return which matches miss the epipolar lines; `turns` (n, 3, 3) take the rays to the cameras' axes.

    Rays u, v and the baseline t span a volume (u x v) . t of 0. Over how it changes as u and v turn, that is
    the angle by which both together miss. Two images in one place contradict nothing.
    """
    counts = np.diff(batch.offsets)
    i, j = batch.pairs.T
    baselines = centers[j] - centers[i]
    lengths = np.linalg.norm(baselines, axis=1)
    t = np.repeat(baselines / np.maximum(lengths, np.finfo(np.float64).tiny)[:, None], counts, axis=0)
    u = np.einsum("kab,kb->ka", np.repeat(turns[i], counts, axis=0), batch.rays_i)
    v = np.einsum("kab,kb->ka", np.repeat(turns[j], counts, axis=0), batch.rays_j)
    volumes = np.abs(np.einsum("ka,ka->k", np.cross(u, v), t))
    slopes = np.hypot(np.linalg.norm(np.cross(v, t), axis=1), np.linalg.norm(np.cross(u, t), axis=1))
    return np.asarray(volumes > np.repeat(max_error_px * batch.pixel_angles, counts) * slopes)
