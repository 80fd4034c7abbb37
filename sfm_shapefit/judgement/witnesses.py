"""Two witnesses: do the pixels of a doubted camera fit the points that the others make?

False pairs contradict a right camera, and a wrong one agrees with the false pairs that put it there. Points
tell the two apart. All observations of doubted cameras are taken away. A keypoint of such a camera then
speaks if it matches two observations of a point or more: one match is as false as its pair, and so may be
many of one pair together, but two false ones do not meet in one point. Where the camera is right nearly all
that speak fit, and hardly any where it is wrong: on drawn scenes with up to 40 % of false pairs 16 to 557
against 1 at most for right cameras, 3 at most against 42 or more for wrong ones.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, IntArray
from sfm_shapefit.judgement.limits import CHECKED_BY, FEWEST_POINTS, FITTING_PX, OUTNUMBERED
from sfm_shapefit.scene.matches import KeypointMatches
from sfm_shapefit.scene.structure import Structure
from sfm_shapefit.tracks.filter import keypoint_errors_px


def are_confirmed(
    structure: Structure, doubted: BoolArray, matches: tuple[IntArray, Sequence[KeypointMatches]]
) -> BoolArray:
    """Return which of the doubted images (i,) stand where their pixels see the points of the others.

    A frame is judged by the keypoints of all its images. Whoever is confirmed makes points for the next ones.

    Args:
        structure: the points of all images; those without a pose are not confirmed.
        doubted: (i,) images that are asked; others of their frames are, too.
        matches: numbers of keypoints (i,), and the matches of all pairs that the doubted images have.
    """
    points, images = structure.points, structure.images
    asked = np.isin(images.frame_of, images.frame_of[doubted]) & images.is_posed
    left = asked
    while left.any():
        those = points.taken(points.paired(~left[points.images])).seen_by(left, *matches, least=CHECKED_BY)
        own = left[those.images]
        frames = images.frame_of[those.images[own]]
        fits = keypoint_errors_px(replace(structure, points=those))[own] <= FITTING_PX
        fitting, missing = (
            np.bincount(frames[part], minlength=len(images.frames.ids)) for part in (fits, ~fits)
        )
        is_right = (fitting >= FEWEST_POINTS) & (fitting >= OUTNUMBERED * missing)
        if not (left & is_right[images.frame_of]).any():
            break
        left = left & ~is_right[images.frame_of]
    return np.asarray(asked & ~left)
