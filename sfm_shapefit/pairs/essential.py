"""Relative rotations of the image pairs of a database, estimated from their inlier matches, or as stored.

COLMAP leaves `cam2_from_cam1` out by default, and databases of other tools hold inlier matches and nothing
else. So the relative pose of a pair is estimated anew:

    a few robust trials of pycolmap's essential matrix, on at most 60 matches, taken evenly from the list
    Gauss-Newton on the Sampson error of all of them, see `rotations.two_view_poses`

Few trials suffice, because the inlier matches agree on a pose already; whether it is the true one, the
averaging tells. Pairs within 5 degrees of the truth, 25 % and 50 % quantile of the error in degrees, and
milliseconds of CPU per pair, beside COLMAP's two-view estimator (essential matrix against homography):

                  two-view estimator         estimated here             of pairs
    castle-P30    229   .16   .81  14.6      232   .09   .39   1.0        378
    lego100       633   .63  5.6    3.7      729   .39  2.4     .8       1313

The estimator takes pixels. What is at hand are rays, of any camera model: they are given as pixels of an
ideal camera that sees all around, one pixel per radian. A pair without parallax has a rotation too: for
averaging, cameras that only turn are as good as others.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import fields
from functools import partial
from typing import Literal, NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.files.colmap.database import relative_poses
from sfm_shapefit.files.colmap.model import PosedModel
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.pairs.two_view_poses import refine_two_view_poses
from sfm_shapefit.scene.matches import RayMatches, View

RelativeSource = Literal["matches", "stored"]

_TRIAL_MATCHES = 60
_LEAST_TRIALS = 10
_MOST_TRIALS = 50
# Of databases with more pairs than these: the confidence of the trials, and what multiplies their number.
# Others have the defaults of pycolmap (0.9999 and 3), which try nearly every pair 50 times. So many pairs
# have images of many pairs each, and can do without the one right pair of 30 to 60 that is then missed
# (lego100: 715 pairs within 5 degrees instead of 727; liberty-calibrated 449 instead of 464; a facade of
# 2,500 images, a fifth of the matches wrong: 280 of 280, both, in 0.56 ms a pair instead of 1.29).
MANY_PAIRS = 20_000
_FEWER_TRIALS = {"confidence": 0.99, "dyn_num_trials_multiplier": 1.0}
# Mean robust weight of its matches from which a pose that was likely is taken without a trial.
_LIKELY_SHARE = 0.6
# Of the trials. At 4 px, 36 pairs of lego100 that are right at 2 px are not; 1 px is as good as 2.
_INLIER_PX = 2.0
# Between two slices Python can be interrupted: about 50 ms.
_PAIRS_PER_SLICE = 64
_STORED_NOISE_PX = 20.0


class LikelyPoses(NamedTuple):
    """Relative poses that k pairs may have, to be tried before any other."""

    rotations: FloatArray
    """(k, 3, 3) cam_j_from_cam_i."""
    translations: FloatArray
    """(k, 3) unit vectors in axes of camera j; NaN for pairs of which nothing is known."""


def estimate_relative_rotations(
    batch: RayMatches,
    threads: int = 1,
    advance: Callable[[int], None] | None = None,
    *,
    num_pairs: int = 0,
    likely: LikelyPoses | None = None,
) -> RelativeRotations:
    """Return the relative rotation of every pair that has one, in the order of pairs.

    Left out are pairs on whose matches no trial finds a pose: fewer than five different ones.

    Args:
        batch: rays in camera axes, that is, of a model whose rotations are the identity.
        threads: number of threads to share the pairs among; the answer does not depend on it.
        advance: called with the number of pairs that are done, each time some are.
        num_pairs: all that there are, of which these are a part: of many, each is tried less often.
        likely: poses of the batch's pairs. Where most matches fit near one, that is the answer; the trials,
            nine tenths of the time, are for the others.
    """
    firsts = range(0, len(batch.pairs), _PAIRS_PER_SLICE)
    with ExitStack() as stack:
        # Where memory is short, Python waits for ever for a thread that could not begin.
        share_out = map if threads <= 1 else stack.enter_context(ThreadPoolExecutor(threads)).map
        parts = []
        for part in share_out(partial(_estimate_slice, batch, num_pairs, likely), firsts):
            parts.append(part)
            if advance is not None:
                advance(min(len(parts) * _PAIRS_PER_SLICE, len(batch.pairs)))
    return concatenate(parts)


def stored_relative_rotations(view: View[PosedModel], min_matches: int = 1) -> RelativeRotations:
    """Return the relative rotations that a database stores; pairs without one are left out.

    Nothing says how well they are known. So their information is taken as isotropic, n / (20 px)^2, with
    the angle of a pixel at the smaller focal length, between what estimates have along their least and their
    middle axis; W is 1.

    Args:
        view: of images whose focal lengths count.
        min_matches: pairs with fewer inlier matches are left out.

    Raises:
        InputError: naming the pair whose pose is damaged.
    """
    poses = relative_poses(view)
    noise = _STORED_NOISE_PX / view.images.focal_lengths_px[poses.pairs].min(axis=1)
    stored = RelativeRotations(
        pairs=poses.pairs,
        rotations=poses.rotations,
        information=(poses.num_inliers / noise**2)[:, None, None] * np.eye(3),
        num_matches=poses.num_inliers,
        weight_shares=np.ones(len(poses.pairs)),
    )
    return stored.subset(poses.num_inliers >= min_matches)


def concatenate(parts: Sequence[RelativeRotations]) -> RelativeRotations:
    """Return the pairs of all parts, in order; there may be no parts."""
    nothing = RelativeRotations(
        pairs=np.zeros((0, 2), dtype=np.int64),
        rotations=np.zeros((0, 3, 3)),
        information=np.zeros((0, 3, 3)),
        num_matches=np.zeros(0, dtype=np.int64),
        weight_shares=np.zeros(0),
    )
    names = [field.name for field in fields(RelativeRotations)]
    columns = {name: np.concatenate([getattr(part, name) for part in (nothing, *parts)]) for name in names}
    return RelativeRotations(**columns)


def _estimate_slice(
    batch: RayMatches, num_pairs: int, likely: LikelyPoses | None, first: int
) -> RelativeRotations:
    """Return the relative rotations of the pairs from `first` on, as many as make a slice."""
    pairs = np.arange(first, min(first + _PAIRS_PER_SLICE, len(batch.pairs)))
    found, places = [], []
    if likely is not None:
        known = pairs[np.isfinite(likely.translations[pairs]).all(axis=1)]
        near = _refine(batch.rays_of(known), likely.rotations[known], likely.translations[known])
        fits = near.weight_shares >= _LIKELY_SHARE
        found, places = [near.subset(fits)], [known[fits]]
        pairs = np.setdiff1d(pairs, known[fits])
    matches = batch.rays_of(pairs)
    has_pose, rotations, translations = _start_by_trials(matches, num_pairs)
    found.append(_refine(matches, rotations, translations).subset(has_pose))
    places.append(pairs[has_pose])
    return concatenate(found).subset(np.argsort(np.concatenate(places)))


def _refine(matches: RayMatches, rotations: FloatArray, translations: FloatArray) -> RelativeRotations:
    """Return the relative rotations of pairs that fit all their matches best, near those given."""
    poses = refine_two_view_poses(matches, rotations, translations)
    return RelativeRotations(
        pairs=matches.pairs,
        rotations=poses.rotations,
        information=poses.information,
        num_matches=np.diff(matches.offsets),
        weight_shares=poses.weight_shares,
    )


def _start_by_trials(matches: RayMatches, num_pairs: int) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Return which pairs, of so many in all, got a pose, (k,), their rotations (k, 3, 3) and unit
    translations (k, 3).
    """
    k, counts = len(matches.pairs), np.diff(matches.offsets)
    rotations, translations = np.full((k, 3, 3), np.nan), np.full((k, 3), np.nan)
    tried = np.minimum(counts, _TRIAL_MATCHES)
    ends = np.append(0, np.cumsum(tried))
    position = np.arange(ends[-1]) - np.repeat(ends[:-1], tried)
    rows = np.repeat(matches.offsets[:-1], tried) + position * np.repeat(counts, tried) // np.repeat(
        tried, tried
    )
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=1, height=1, params=[2.0 * np.pi, np.pi])
    pixels = [camera.img_from_cam(rays[rows]) for rays in (matches.rays_i, matches.rays_j)]
    options = pycolmap.RANSACOptions()
    options.min_num_trials, options.max_num_trials, options.random_seed = _LEAST_TRIALS, _MOST_TRIALS, 0
    if num_pairs > MANY_PAIRS:
        options.mergedict(_FEWER_TRIALS)
    for p in range(k):
        options.max_error = _INLIER_PX * float(matches.pixel_angles[p])
        first, second = (side[ends[p] : ends[p + 1]] for side in pixels)
        estimate = pycolmap.estimate_essential_matrix(first, second, camera, camera, options)
        if estimate is None:
            continue
        pose = estimate["cam2_from_cam1"]
        rotations[p], translations[p] = pose.rotation.matrix(), pose.translation
    translations = normalized(translations)
    found = np.isfinite(rotations).all(axis=(1, 2)) & np.isfinite(translations).all(axis=1)
    rotations[~found], translations[~found] = np.eye(3), [1.0, 0.0, 0.0]
    return found, rotations, translations
