"""Focal lengths that COLMAP found pair by pair, from 4.2 on, where one of the two lenses is a guess.

Where the other lens is calibrated, or both images share the guessed one, COLMAP verifies a pair by solving
for pose and focal length together, and keeps the lens that it found in `camera1` or `camera2` of the pair:

    camera  id u32, model i32, width u64, height u64, prior_focal_length u8, count u64, params f64 each

A pair may be far off, but right ones agree: what counts is the value at which most matches are.

Source: https://github.com/colmap/colmap/pull/4521, https://github.com/colmap/colmap/pull/4561.
"""

import struct
from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.files.colmap.database_cameras import read_cameras
from sfm_shapefit.files.colmap.database_pairs import MAX_NUM_IMAGES
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.scene.matches import PairNames, indices_of_pairs

_HEAD = struct.Struct("<IiQQBQ")
_WIDTH = 0.03  # scatter of logs of focal lengths; that of right pairs of castle-P30 and lego100
_NEAR = 3.0  # such widths; pairs within agree
# Pairs that agree, their share of the matches and of the pairs; with fewer, those of liberty, most of which
# are of wrong matches, agree on focal lengths that are off by a factor of two.
_FEWEST, _LEAST_SHARE, _LEAST_OF_PAIRS = 3, 0.5, 0.4
_MOST_PAIRS = 50_000  # pairs of most matches; 65 bytes each
_MOST_OF_CAMERA = 500  # pairs of a camera that take part; the time grows with their square


class PairFocal(NamedTuple):
    """What the pairs of a camera agree on."""

    factor: float
    """Focal length over that of the camera in the database."""
    num_pairs: int
    """Pairs that agree."""
    is_one_sided: bool
    """Whether the other lenses of most of these are calibrated; else they are the same guess."""


def read_pair_focals(
    database: DatabaseFile, asked: Collection[int], left_out: PairNames = frozenset()
) -> dict[int, PairFocal]:
    """Return what the pairs of a database say of the cameras asked, by their ids there.

    Pairs that are left out, by the names of their images, say nothing.

    Raises:
        InputError: if the database cannot be read.
    """
    columns = ("pair_id", "rows", "camera1", "camera2")
    where = f"WHERE coalesce(camera1, camera2) IS NOT NULL ORDER BY rows DESC, pair_id LIMIT {_MOST_PAIRS}"
    table = "two_view_geometries"
    rows = database.rows(table, {columns: f"SELECT {', '.join(columns)} FROM {table} {where}"})
    cameras, ids = read_cameras(database).usable, dict(database.query("SELECT name, image_id FROM images"))
    ends = indices_of_pairs(ids, left_out).tolist()
    unwanted = {MAX_NUM_IMAGES * min(pair) + max(pair) for pair in ends}
    by_camera: dict[int, list[tuple[float, float, float]]] = {}
    for pair_id, count, *blobs in rows:
        is_one_sided = None in blobs
        for blob in blobs if pair_id not in unwanted else ():
            camera_id, focal = _focal(blob)
            if camera_id in cameras and camera_id in asked and isinstance(count, int) and focal > 0.0:
                of_camera = by_camera.setdefault(camera_id, [])
                factor = focal / cameras[camera_id].params[0]
                of_camera.append((np.log(factor), float(count), float(is_one_sided)))
    agreed = {i: _agreed(np.array(of_camera[:_MOST_OF_CAMERA])) for i, of_camera in sorted(by_camera.items())}
    return {i: one for i, one in agreed.items() if one is not None}


def _focal(blob: object) -> tuple[int, float]:
    """Return the id of a lens and its focal length; NaN if it is none."""
    if not isinstance(blob, bytes) or len(blob) <= _HEAD.size or len(blob) != _HEAD.size + 8 * blob[25]:
        return -1, np.nan
    return _HEAD.unpack_from(blob)[0], struct.unpack_from("<d", blob, _HEAD.size)[0]


def _agreed(pairs: FloatArray) -> PairFocal | None:
    """Return what pairs (k, 3), log of the factor, matches and side, agree on; None if on nothing."""
    logs, matches, one_sided = pairs.T
    kernel = np.exp(-0.5 * ((logs[:, None] - logs) / _WIDTH) ** 2)
    peak = logs[np.argmax(kernel @ matches)]
    near = np.abs(logs - peak) <= _NEAR * _WIDTH
    is_most = matches[near].sum() > _LEAST_SHARE * matches.sum() and near.mean() >= _LEAST_OF_PAIRS
    if near.sum() < _FEWEST or not is_most:
        return None
    order = np.argsort(logs[near], kind="stable")
    weights = np.cumsum(matches[near][order])
    middle = logs[near][order][np.searchsorted(weights, 0.5 * weights[-1])]
    return PairFocal(float(np.exp(middle)), int(near.sum()), bool(one_sided[near].mean() > 0.5))
