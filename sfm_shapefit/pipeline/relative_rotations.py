"""`relative_rotations`: those of all pairs of a database's images, by threads or by workers of a cluster."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray, rank_within
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.executors import nobody
from sfm_shapefit.pairs.direction_options import LEAST_MATCHES, DirectionOptions
from sfm_shapefit.pairs.essential import (
    LikelyPoses,
    concatenate_rotations,
    estimate_relative_rotations,
    have_many_pairs,
)
from sfm_shapefit.pairs.estimate import estimate_directions
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.pipeline.execution import measure_with_workers
from sfm_shapefit.rotations.average import average_relative_rotations
from sfm_shapefit.scene.matches import RayMatches, View

if TYPE_CHECKING:
    pass

# Pairs of each image that are tried for by themselves where there are very many: all lie near their average.
_FIRST_PAIRS = 5
_NEAR = DirectionOptions(inlier_threshold_px=8.0, num_hypotheses=50)
"""What a baseline must show by rotations that are tenths of a degree off."""
_LIKELY = 0.5  # mean robust weight; no other pose can have more of the matches
_MATCHES_PER_TASK = 100_000  # matches; about a second of work, be they of many pairs or of few


def measure_rotations(
    view: View, min_matches: int = LEAST_MATCHES, clock: Clock | None = None
) -> RelativeRotations:
    """Return relative rotations estimated from matches; pairs are indices into the view's images.

    The images are in axes of their cameras, see `Images.apart`. Without a clock, all cores work.

    Raises:
        InputError: if the database cannot be read, or a row of it is damaged.
        WorkerError: if a worker does not see the database, or a task failed again and again.
    """
    clock = clock or Clock()
    are_many = have_many_pairs(view.images.num_images, view.num_pairs)
    estimate = partial(estimate_relative_rotations, are_many=are_many)
    if are_many:
        some = estimate_here(view, estimate, clock, min_matches, without=_all_but_some(view))
        averaged = average_relative_rotations(view.images.num_images, some, clock.threads)
        known = np.where(averaged.registered[:, None, None], averaged.rotations, np.nan)
        estimate = partial(estimate_near, are_many=are_many, rotations=known)
    if clock.cluster is None:
        return estimate_here(view, estimate, clock, min_matches)
    parts = measure_with_workers(view, estimate, clock, min_matches, _MATCHES_PER_TASK)
    return concatenate_rotations(parts)


def estimate_near(
    batch: RayMatches, threads: int = 1, *, are_many: bool, rotations: FloatArray
) -> RelativeRotations:
    """Return the relative rotations of pairs, near those of rotations (n, 3, 3) where the matches fit there.

    Trials are for the others, nine tenths of whose time they take, and for images whose rotation is NaN.
    """
    i, j = batch.pairs.T
    turns = np.nan_to_num(rotations[j] @ rotations[i].transpose(0, 2, 1))
    rays_i = np.empty_like(batch.rays_i)
    for own, turn in zip(batch.slices(), turns.transpose(0, 2, 1), strict=True):
        np.matmul(batch.rays_i[own], turn, out=rays_i[own])
    in_axes_of_j = replace(batch, rays_i=rays_i)
    baselines = estimate_directions(in_axes_of_j, _NEAR, threads).directions
    likely = LikelyPoses(turns, baselines, np.full(len(batch.pairs), _LIKELY))
    return estimate_relative_rotations(batch, threads, are_many=are_many, likely=likely)


def _all_but_some(view: View) -> IntArray:
    """Return the pairs (m, 2) that are not among the first of one of their images, by matches, then drawn."""
    counts = np.repeat(view.matches.num_matches[view.rows], 2)
    drawn = np.repeat(np.random.default_rng(0).permutation(view.num_pairs), 2)
    ranks = rank_within(view.pairs.ravel(), -counts.astype(np.int64), drawn)
    return np.delete(view.pairs, np.flatnonzero(ranks < _FIRST_PAIRS) // 2, axis=0)


def estimate_here(
    view: View,
    estimate: Callable[..., RelativeRotations],
    clock: Clock,
    min_matches: int = LEAST_MATCHES,
    *,
    without: IntArray | None = None,
) -> RelativeRotations:
    """Return the relative rotations of a view's pairs, but for some of them, by threads of this process.

    `estimate` is called with a batch and the number of threads.
    """
    batches = view.batches(min_matches, without, clock.advance if without is None else nobody)
    own = partial(estimate, threads=clock.threads)
    return concatenate_rotations(list(view.measured(batches, own, clock.threads)))
