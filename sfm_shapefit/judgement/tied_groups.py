"""Which images are tied to one another, by points, pairs and what is known, and which groups hardly are."""

from dataclasses import replace

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, IntArray, distinct
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.judgement.limits import FITTING_PX, OUTNUMBERED
from sfm_shapefit.judgement.pair_fits import PairFits
from sfm_shapefit.judgement.ties import (
    Rays,
    UntiedGroup,
    find_groups,
    find_hanging,
    links_of_pairs,
    rigid_groups,
)
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import View
from sfm_shapefit.scene.points import Points
from sfm_shapefit.scene.structure import Structure
from sfm_shapefit.tracks.filter import keypoint_errors_px


def rigid_strip(images: Images, chosen: BoolArray) -> IntArray:
    """Return pairs (k, 2) of images that make the frames of those chosen (i,) rigid, one image of each."""
    rows = np.flatnonzero(chosen)
    rows = rows[np.unique(images.frame_of[rows], return_index=True)[1]]
    return np.concatenate([np.column_stack([rows[step:], rows[:-step]]) for step in (1, 2)])


def tie_images(
    view: View,
    fits: PairFits,
    structure: Structure,
    fixed: BoolArray | None,
    tied_pairs: IntArray | None,
    threads: int = 1,
) -> tuple[IntArray, tuple[UntiedGroup, ...]]:
    """Return what each image (i,) is tied to, by number, and the groups that hardly anything ties to it.

    Frames move as one; images (i,) that are `fixed` are one, and so are those of each of `tied_pairs` (k, 2).
    Where too few points are known for that, what pairs and points hold is one, and no group is named but what
    hangs on one pair or image.
    """
    points, images = structure.points, structure.images
    frames = images.frame_of

    def images_of(inside: BoolArray) -> tuple[str, ...]:
        return images.names_of(np.flatnonzero(inside[frames] & images.is_posed))

    fitting = keypoint_errors_px(structure, threads=threads) <= FITTING_PX
    rays = Rays(points.points_seen(), frames.astype(np.int32)[points.images], fitting).of_three()
    pairs = links_of_pairs(*(frames[side] for side in fits.sides))
    known = [] if fixed is None else [frames[rigid_strip(images, fixed)]]
    if tied_pairs is not None:
        tied = frames[tied_pairs]
        known.append(tied[tied[:, 0] != tied[:, 1]])
    together = np.concatenate([np.zeros((0, 2), dtype=np.int64), *known])
    group = rigid_groups(len(images.frames.ids), rays, together, threads)
    lost = lost_points(view, structure, fitting, group[frames])
    rays = rays._replace(fits=rays.fits & ~lost[rays.points])
    tied, groups = find_groups(group, rays, pairs, images_of)
    posed, of = distinct(frames[images.is_posed]), tied[frames]
    if 2 * np.bincount(tied[posed]).max(initial=0) < len(posed):
        held = fits.held(images)
        if 2 * held.sum() < images.is_posed.sum():
            held = fits.held(images, points.taken(fitting))
        of, groups = np.where(held, 0, 1 + frames), ()
    named = frozenset(name for one in groups for name in one.images)
    holding = links_of_pairs(frames[fits.directions.pairs[fits.may_hold]], frames[fits.sides[1]])
    hanging = find_hanging(len(group), rays, holding, together, images_of)
    return of, (*groups, *(one for one in hanging if named.isdisjoint(one.images)))


def lost_points(view: View, structure: Structure, fits: BoolArray, group: IntArray) -> BoolArray:
    """Return which points (x,) only pairs carry between groups of images (i,) whose matches mostly miss.

    Some matches of a pair that repeated structure has made may fit where it puts a group; others, of points
    that either side knows, do not: they see two that do not coincide.
    """
    points, images = structure.points, structure.images
    across = images.is_posed[view.pairs].all(axis=1) & (group[view.pairs[:, 0]] != group[view.pairs[:, 1]])
    lost, carried = np.zeros((2, points.num_points), dtype=np.bool_)
    if not (across.any() and structure.has_keypoints_of(view)):
        return lost
    begins = offsets_of(view.num_keypoints)
    point_of, fitting = np.full(begins[-1], -1, dtype=np.int32), np.zeros(begins[-1], dtype=np.bool_)
    seen = begins[points.images] + points.keypoints
    point_of[seen], fitting[seen] = points.points_seen(), fits
    for batch in view.links(chosen=across):
        pair = batch.list_of_rows()
        seen_by, keypoints = batch.pairs[pair], begins[batch.pairs[pair]] + batch.keypoints
        ends = point_of[keypoints]
        same = (ends[:, 0] == ends[:, 1]) & fitting[keypoints].all(axis=1)
        apart = (ends >= 0).all(axis=1) & (ends[:, 0] != ends[:, 1])
        rows = np.flatnonzero(apart)
        for end in (0, 1):  # the point of either end, where the other has its keypoint
            one = Points(
                xyz=points.xyz[ends[rows, end]],
                offsets=np.arange(len(rows) + 1),
                images=seen_by[rows, 1 - end],
                keypoints=batch.keypoints[rows, 1 - end],
                ids=rows,
            )
            rows = rows[keypoint_errors_px(replace(structure, points=one)) <= FITTING_PX]
        apart[rows] = False
        num_fit, num_missing = (np.bincount(pair[x], minlength=len(batch.pairs)) for x in (same, apart))
        sound = (num_fit >= OUTNUMBERED * num_missing)[pair]
        lost[ends[same & ~sound, 0]] = True
        carried[ends[same & sound, 0]] = True
    return lost & ~carried
