"""The tables of a COLMAP database that say which images have matches, checked row by row.

Images of the database and of a model are matched by name, since their ids may differ. A pair of
database images (a, b), a < b, has pair_id = 2147483647 a + b.

Source: https://colmap.github.io/database.html, `colmap/scene/database_sqlite.cc`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile, is_between
from sfm_shapefit.scene.same_images import same_images

MAX_NUM_IMAGES = 2147483647
"""COLMAP's kMaxNumImages: pair_id = MAX_NUM_IMAGES * smaller id + larger id."""

NO_ID = 2**32 - 1
"""Id of nothing; COLMAP's ids are 32-bit, and this one is none."""

# COLMAP's TwoViewGeometryConfiguration; what these list is not verified: undefined, degenerate, watermark.
_CONFIGS_WITHOUT_MATCHES = (0, 1, 7)

_REQUIRED_COLUMNS = {
    "images": ("image_id", "name"),
    "keypoints": ("image_id", "rows", "cols", "data"),
    "two_view_geometries": ("pair_id", "rows", "cols", "data", "config"),
}


class PairRows(NamedTuple):
    """The pairs of some images that have verified inlier matches, sorted by (i, j)."""

    pairs: IntArray
    """(k, 2) images (i, j), i < j, by their place among the names; all else is (k,)."""
    rowids: IntArray
    """Rows of two_view_geometries."""
    swapped: BoolArray
    """Whether the database has image j first."""
    num_inliers: IntArray


def check_schema(file: DatabaseFile) -> None:
    """Refuse a database without the tables and columns that are read, or that computes what they hold.

    A view, a virtual table and a generated column run code of whoever made the database when they are read.
    """
    for table, required in _REQUIRED_COLUMNS.items():
        file.refuse_computed(table)
        columns = file.columns(table)
        if missing := [name for name in required if name not in columns]:
            what = f"no column {missing[0]} in its table {table}" if columns else f"no table {table}"
            raise InputError(f"{file.path} is not a COLMAP database: it has {what}")


def match_names(file: DatabaseFile, names: Sequence[str]) -> dict[int, int]:
    """Return for each image id of the database the place of the image's name in `names`, or -1."""
    path, index_of_id = file.path, dict[int, int]()
    example, matched = None, set()
    rows = file.query("SELECT image_id, name FROM images ORDER BY image_id")
    places, ambiguity = same_images([str(name) for _, name in rows], names)
    for index, (image_id, name) in zip(places.tolist(), rows, strict=True):
        if not (is_between(image_id, 0, MAX_NUM_IMAGES) and isinstance(name, str)):
            raise InputError(
                f"{path}: the image with id {image_id!r} has no valid id and name; it is damaged"
            )
        if index in matched or image_id in index_of_id:
            raise InputError(f"{path}: the image {name} stands twice; remove one of them")
        index_of_id[image_id] = index
        if index >= 0:
            matched.add(index)
        elif example is None:
            example = name
    if not index_of_id:
        raise InputError(f"{path} has no images; run COLMAP's feature extraction and matching first")
    if len(matched) < 2:
        unmatched = next(name for index, name in enumerate(names) if index not in matched)
        there = f", and the database's {example} is not in the model" if example is not None else ""
        raise InputError(
            f"{path} has {len(matched)} of the model's {len(names)} images: the model's {unmatched} is "
            f"not in the database{there}; {ambiguity or 'give the database this model was made from'}"
        )
    if ambiguity:
        file.notes.append(f"{path}: {ambiguity}")
    return index_of_id


def read_pairs(file: DatabaseFile, index_of_id: dict[int, int]) -> PairRows:
    """Read which pairs of the images that have an index have verified inlier matches."""
    damaged = file.query(
        "SELECT pair_id FROM two_view_geometries WHERE typeof(pair_id) != 'integer' "
        "OR typeof(rows) != 'integer' OR typeof(config) != 'integer' OR pair_id < 0 OR rows < 0 LIMIT 1"
    )
    if damaged:
        raise InputError(f"{file.path}: the two-view geometry of pair {damaged[0][0]!r} is damaged")
    rows = file.query("SELECT rowid, pair_id, config, rows FROM two_view_geometries WHERE rows > 0")
    rowids, pair_ids, configs, num_inliers = np.array(rows, dtype=np.int64).reshape(-1, 4).T
    ends = _indices_of_pairs(file.path, pair_ids, index_of_id)
    known = np.logical_and(ends[:, 0] >= 0, ends[:, 1] >= 0)
    swapped = ends[:, 0] > ends[:, 1]
    ends = np.sort(ends, axis=1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    order = order[known[order]]
    pairs = ends[order]
    repeated = pair_ids[order[:-1]][(pairs[1:] == pairs[:-1]).all(axis=1)]
    if len(repeated):
        raise InputError(f"{file.path}: the two-view geometry of pair {repeated[0]} stands twice")
    order = order[~np.isin(configs[order], _CONFIGS_WITHOUT_MATCHES)]
    return PairRows(ends[order], rowids[order], swapped[order], num_inliers[order])


def _indices_of_pairs(path: Path, pair_ids: IntArray, index_of_id: dict[int, int]) -> IntArray:
    """Decode pair ids into indices (k, 2), first image first; -1: the image has none."""
    ids = np.stack(np.divmod(pair_ids, MAX_NUM_IMAGES), axis=1)
    known = np.array(sorted(index_of_id), dtype=np.int64)
    position = np.minimum(np.searchsorted(known, ids), len(known) - 1)
    bad = ids[(known[position] != ids).any(axis=1) | (ids[:, 0] >= ids[:, 1])]
    if len(bad):
        a, b = bad[0]
        raise InputError(f"{path}: a two-view geometry joins the images with ids {a} and {b}; it is damaged")
    indices = np.array([index_of_id[i] for i in known.tolist()], dtype=np.int64)
    return indices[position]
