"""What a model's points say of its images: which see too few, and what share of the matches agrees."""

import math
from collections.abc import Collection, Iterable

import numpy as np
import pycolmap

from sfm_shapefit.arrays import IntArray
from sfm_shapefit.colmap.model import observed_points
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


def share_of_agreeing_observations(
    structure: pycolmap.Reconstruction, image_ids: IntArray, batches: Iterable[MatchBatch]
) -> float:
    """Return the share of the keypoints matched in two or more other registered images that see a 3D point.

    Args:
        structure: triangulated from these matches.
        image_ids: (n,) ids of the images that the batches' pairs index.
        batches: matches of all pairs.
    """
    registered = np.isin(image_ids, list(structure.reg_image_ids()))
    images = [structure.image(i) if is_in else None for i, is_in in zip(image_ids, registered, strict=True)]
    num_matches = [np.zeros(0 if image is None else image.num_points2D(), dtype=np.int64) for image in images]
    for batch in batches:
        for pair in np.flatnonzero(registered[batch.pairs].all(axis=1)).tolist():
            rows = slice(batch.offsets[pair], batch.offsets[pair + 1])
            for side, image in enumerate(batch.pairs[pair].tolist()):
                num_matches[image][batch.keypoints[rows, side]] += 1
    matched, agreeing = 0, 0
    for image, counts in zip(images, num_matches, strict=True):
        if image is not None:
            matched += int(np.sum(counts >= _CHECKED_BY))
            agreeing += int(np.sum(counts[observed_points(image)[0]] >= _CHECKED_BY))
    return agreeing / matched if matched else math.nan
