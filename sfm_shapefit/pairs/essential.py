"""Relative rotations of the image pairs of a database, estimated from their inlier matches.

COLMAP leaves `cam2_from_cam1` out by default, and databases of other tools hold inlier matches and nothing
else. So the relative pose of a pair is estimated anew:

    a few robust trials of pycolmap's essential matrix, on at most 60 matches, taken evenly from the list
    Gauss-Newton on the Sampson error of all of them, see `rotations.two_view_poses`

Few trials suffice, because the inlier matches agree on a pose already; whether it is the true one is for the
averaging to find. Compared with COLMAP's two-view estimator, more pairs come within 5 degrees of the truth,
at a tenth of the time: `scripts/results/notes.md#relative-rotations-of-pairs`.
The estimator takes pixels. What is at hand are rays, of any camera model: they are given as pixels of an
ideal camera that sees all around, one pixel per radian. A pair without parallax has a rotation too: for
averaging, cameras that only turn are as good as others.
"""

from collections.abc import Sequence
from dataclasses import fields
from functools import partial
from typing import NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.executors import in_threads
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.pairs.two_view_poses import refine_two_view_poses
from sfm_shapefit.scene.matches import RayMatches

_TRIAL_MATCHES = 60  # matches per trial; the essential matrix is a start, all matches refine it
_LEAST_TRIALS = 10  # trials of a pair; matches in agreement need no more
_MOST_TRIALS = 50  # trials of a pair; bounds the time where no pose fits
_MANY_PAIRS, _MANY_PAIRS_OF_AN_IMAGE = 20_000, 50
"""Pairs of a database, and pairs of an image on average, above either of which each has fewer trials.

Averaging can do without the one right pair of 30 to 60 that is missed then:
scripts/results/notes.md#relative-rotations-of-pairs. Below, pycolmap's own confidence and multiplier (0.9999
and 3) try nearly every pair 50 times.
"""
_FEWER_TRIALS = {"confidence": 0.99, "dyn_num_trials_multiplier": 1.0}
_INLIER_PX = 2.0  # pixels, in trials; chosen on scripts/results/notes.md#relative-rotations-of-pairs
_ROUGH_WIDTH = 2.0  # standard deviations of an image's rotation; by as much rough ones make rays miss
_PAIRS_PER_SLICE = 64  # pairs; Python can be interrupted between slices, every 50 ms


class LikelyPoses(NamedTuple):
    """Relative poses that k pairs may have, to be tried before any other."""

    rotations: FloatArray
    """(k, 3, 3) cam_j_from_cam_i."""
    translations: FloatArray
    """(k, 3) unit vectors in axes of camera j; NaN for pairs of which nothing is known."""
    least_weights: FloatArray
    """(k,) mean robust weights; a pose near the likely one that reaches it needs no trial."""


def have_many_pairs(num_images: int, num_pairs: int) -> bool:
    """Return whether images have so many pairs that averaging can do without some of the right ones."""
    return num_pairs > min(_MANY_PAIRS, 0.5 * _MANY_PAIRS_OF_AN_IMAGE * num_images)


def estimate_relative_rotations(
    batch: RayMatches,
    threads: int = 1,
    *,
    are_many: bool = False,
    likely: LikelyPoses | None = None,
) -> RelativeRotations:
    """Return the relative rotation of every pair that has one, in the order of pairs.

    Pairs are left out on whose matches no trial finds a pose: fewer than five different ones.

    Args:
        batch: rays in camera axes, that is, of a model whose rotations are the identity.
        threads: number of threads to share the pairs among; the answer does not depend on it.
        are_many: whether images have so many pairs that each is tried less often; see `have_many_pairs`.
        likely: poses of the batch's pairs. Where the matches fit near one, that is the answer; the trials,
            nine tenths of the time, are for the others.
    """
    parts, places, others = [], [], np.arange(len(batch.pairs))
    if likely is not None:
        tried = np.flatnonzero(np.isfinite(likely.translations).all(axis=1))
        start = likely.rotations[tried], likely.translations[tried]
        near = refine_two_view_poses(batch.rays_of(tried), *start, threads)
        fits = near.weight_shares >= likely.least_weights[tried]
        parts, places, others = [near.subset(fits)], [tried[fits]], np.delete(others, tried[fits])
    slices = [others[k : k + _PAIRS_PER_SLICE] for k in range(0, len(others), _PAIRS_PER_SLICE)]
    for part, has_pose in in_threads(threads, partial(_estimate_slice, batch, are_many), slices):
        places.append(slices[len(parts) - (likely is not None)][has_pose])
        parts.append(part)
    return concatenate_rotations(parts).subset(np.argsort(np.concatenate([*places, others[:0]])))


def refine_rough_rotations(
    batch: RayMatches,
    threads: int,
    *,
    rotations: FloatArray,
    sigma_rad: float,
) -> RelativeRotations:
    """Return the relative rotation of every pair that fits its matches best, near a rough one.

    Args:
        batch, threads: as of `estimate_relative_rotations`.
        rotations: (n, 3, 3) of all images, cam_from_world.
        sigma_rad: standard deviation per axis of the rotation of each image.
    """
    i, j = batch.pairs.T
    rotations = rotations[j] @ rotations[i].transpose(0, 2, 1)
    turns = batch.spread(rotations)
    normals = np.cross(np.einsum("mab,mb->ma", turns, batch.rays_i), batch.rays_j)
    products = np.append(normals[:, :, None] * normals[:, None, :], np.zeros((1, 3, 3)), axis=0)
    sums = np.add.reduceat(products, batch.offsets[:-1], axis=0)
    translations = np.linalg.eigh(sums)[1][:, :, 0]  # rays meet in planes with it
    off_rad = _ROUGH_WIDTH * sigma_rad
    return refine_two_view_poses(batch, rotations, translations, threads, off_rad)


def concatenate_rotations(parts: Sequence[RelativeRotations]) -> RelativeRotations:
    """Return the pairs of all parts, in order; there may be no parts."""
    nothing = RelativeRotations(
        pairs=np.zeros((0, 2), dtype=np.int64),
        rotations=np.zeros((0, 3, 3)),
        information=np.zeros((0, 3, 3)),
        num_matches=np.zeros(0, dtype=np.int64),
        weight_shares=np.zeros(0),
        translations=np.zeros((0, 3)),
    )
    names = [field.name for field in fields(RelativeRotations)]
    columns = {name: np.concatenate([getattr(part, name) for part in (nothing, *parts)]) for name in names}
    return RelativeRotations(**columns)


def _estimate_slice(
    batch: RayMatches, are_many: bool, pairs: IntArray
) -> tuple[RelativeRotations, BoolArray]:
    """Return the relative rotations of some pairs by trials, and which of them got one."""
    matches = batch.rays_of(pairs)
    has_pose, rotations, translations = _start_by_trials(matches, are_many)
    return refine_two_view_poses(matches, rotations, translations).subset(has_pose), has_pose


def _start_by_trials(matches: RayMatches, are_many: bool) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Return which pairs got a pose, (k,), their rotations (k, 3, 3) and unit translations (k, 3)."""
    k, tried = len(matches.pairs), matches.thinned(_TRIAL_MATCHES)
    rotations, translations = np.full((k, 3, 3), np.nan), np.full((k, 3), np.nan)
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=1, height=1, params=[2.0 * np.pi, np.pi])
    pixels = [np.asarray(camera.img_from_cam(rays)) for rays in (tried.rays_i, tried.rays_j)]
    options = pycolmap.RANSACOptions()
    options.min_num_trials, options.max_num_trials, options.random_seed = _LEAST_TRIALS, _MOST_TRIALS, 0
    if are_many:
        options.mergedict(_FEWER_TRIALS)
    for p in range(k):
        options.max_error = _INLIER_PX * float(matches.pixel_angles[p])
        first, second = (side[tried.slice_of(p)] for side in pixels)
        estimate = pycolmap.estimate_essential_matrix(first, second, camera, camera, options)
        if estimate is None:
            continue
        pose = estimate["cam2_from_cam1"]
        rotations[p], translations[p] = pose.rotation.matrix(), pose.translation
    translations = normalized(translations)
    has_pose = np.isfinite(rotations).all(axis=(1, 2)) & np.isfinite(translations).all(axis=1)
    rotations[~has_pose], translations[~has_pose] = np.eye(3), [1.0, 0.0, 0.0]
    return has_pose, rotations, translations
