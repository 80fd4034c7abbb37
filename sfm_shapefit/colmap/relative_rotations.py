"""Relative rotations of the image pairs of a database, estimated from their inlier matches, or as stored.

COLMAP leaves `cam2_from_cam1` out by default, and databases of other tools hold inlier matches and nothing
else. So the relative pose of a pair is estimated from its inlier matches and the calibrated rays, by
COLMAP's own estimator (essential matrix and homography in competition, refined). A pair without parallax
has a rotation too: for averaging, cameras that only turn are as good as others.

Estimating anew is worth its 10 ms a pair even where poses are stored. The estimator calls a pair
uncalibrated if a fundamental matrix explains its matches better than an essential one; where the focal
lengths are known, that is the mark of a false pair. Pairs within 5 degrees of the truth, of all pairs, and
25 % quantile of the error:

                  stored               estimated, calibrated only
    castle-P30    230 of 378, 0.20     193 of 210, 0.08
    castle-P19     86 of 147, 0.27      72 of  78, 0.11
    lego100       650 of 1312, 0.63    606 of 755, 0.33
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.colmap.database import open_database
from sfm_shapefit.colmap.model import PosedModel
from sfm_shapefit.colmap.quiet import quiet_stderr
from sfm_shapefit.directions.matches import MatchBatch

RelativeSource = Literal["matches", "stored"]

_CONFIG = pycolmap.TwoViewGeometryConfiguration
_SOUND_CONFIGS = (_CONFIG.CALIBRATED, _CONFIG.PLANAR, _CONFIG.PANORAMIC, _CONFIG.PLANAR_OR_PANORAMIC)


class RelativeRotations(NamedTuple):
    """The relative rotations of k pairs of images, in the order of pairs."""

    pairs: IntArray
    """(k, 2) images (i, j), i < j, as indices into `PosedModel.image_ids`."""
    rotations: FloatArray
    """(k, 3, 3) camera j from camera i."""
    num_matches: IntArray
    """(k,) inlier matches."""
    sound: BoolArray
    """(k,) False where known focal lengths contradict the matches."""

    def subset(self, rows: IntArray | BoolArray) -> "RelativeRotations":
        """Return some of the pairs."""
        return RelativeRotations(
            self.pairs[rows], self.rotations[rows], self.num_matches[rows], self.sound[rows]
        )


def relative_rotations(
    path: Path,
    model: PosedModel,
    min_matches: int,
    source: RelativeSource = "matches",
    threads: int = 1,
    advance: Callable[[int, int], None] | None = None,
) -> RelativeRotations:
    """Return the relative rotation of every pair with enough matches that has one.

    Args:
        path: the database; it is not changed.
        model: all its images, with the identity as their rotation (see `unposed`).
        min_matches: pairs with fewer inlier matches are left out.
        source: estimated from the matches, or as stored; then pairs without a stored pose are left out.
        threads: of the estimates; the answer does not depend on it.
        advance: called with the pairs that are done and their number.

    Raises:
        InputError: if the database cannot be read, or a row of it is damaged.
    """
    with open_database(path, model) as database:
        if source == "stored":
            poses = database.relative_poses()
            sound = np.ones(len(poses.pairs), dtype=np.bool_)
            stored = RelativeRotations(poses.pairs, poses.rotations, poses.num_inliers, sound)
            return stored.subset(poses.num_inliers >= min_matches)
        with ThreadPoolExecutor(threads) as pool, quiet_stderr():
            rows, before = [], 0
            for batch in database.iter_matches(min_matches):
                pixels = {image: database.keypoints(image) for image in np.unique(batch.pairs).tolist()}
                estimate = partial(_estimate, model, pixels, batch)
                for k, row in enumerate(pool.map(estimate, range(len(batch.pairs)))):
                    if advance is not None:
                        advance(before + k + 1, database.num_pairs)
                    if row is not None and row[2] >= min_matches:
                        rows.append(row)
                before += len(batch.pairs)
    return RelativeRotations(
        pairs=np.array([row[0] for row in rows], dtype=np.int64).reshape(-1, 2),
        rotations=np.array([row[1] for row in rows], dtype=np.float64).reshape(-1, 3, 3),
        num_matches=np.array([row[2] for row in rows], dtype=np.int64),
        sound=np.array([row[3] for row in rows], dtype=np.bool_),
    )


def _estimate(
    model: PosedModel, pixels: dict[int, FloatArray], batch: MatchBatch, k: int
) -> tuple[tuple[int, int], FloatArray, int, bool] | None:
    """Return pair k, its rotation, number of matches and soundness; None if the pair has no rotation."""
    i, j = batch.pairs[k].tolist()
    matches = batch.keypoints[batch.offsets[k] : batch.offsets[k + 1]]
    first, second = model.camera(i), model.camera(j)
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose = True
    options.ransac.random_seed = 0
    each_with_itself = np.repeat(np.arange(len(matches), dtype=np.uint32)[:, None], 2, axis=1)
    geometry = pycolmap.estimate_calibrated_two_view_geometry(
        first, pixels[i][matches[:, 0]], second, pixels[j][matches[:, 1]], each_with_itself, options
    )
    is_uncalibrated = geometry.config == _CONFIG.UNCALIBRATED
    is_guess = not (first.has_prior_focal_length and second.has_prior_focal_length)
    sound = geometry.config in _SOUND_CONFIGS or (is_uncalibrated and is_guess)
    pose = geometry.cam2_from_cam1
    if pose is None or not (sound or is_uncalibrated):
        return None
    rotation = pose.rotation.matrix()
    if not np.isfinite(rotation).all():
        return None
    return (i, j), rotation, len(geometry.inlier_matches), sound
