"""The tables of a COLMAP database that say which images have matches, checked row by row.

Images of the database and of a model are matched by name, since their ids may differ. A pair of
database images (a, b), a < b, has pair_id = 2147483647 a + b. Until COLMAP 3.1 verified matches stand in a
table inlier_matches, with the same columns but for the matrices and poses.

Source: https://colmap.github.io/database.html, `colmap/scene/database_sqlite.cc`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.wording import counted
from sfm_shapefit.files.colmap.damage import Damage
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile, is_between
from sfm_shapefit.scene.same_images import same_images

MAX_NUM_IMAGES = 2147483647
"""COLMAP's kMaxNumImages: pair_id = MAX_NUM_IMAGES * smaller id + larger id."""

NO_ID = 2**32 - 1
"""Id of nothing; COLMAP's ids are 32-bit, and this one is none."""

_UNVERIFIED = {0: "UNDEFINED", 1: "DEGENERATE", 7: "WATERMARK"}
"""Values of COLMAP's TwoViewGeometryConfiguration; the matches of such pairs are not verified."""
_VERIFIED = (2, 3, 4, 5, 6, 8, 9)  # all others; a later COLMAP's are unknown, and may mean anything

_GEOMETRIES, _INLIER_MATCHES = "two_view_geometries", "inlier_matches"  # tables; the second is the older
_REQUIRED_COLUMNS = {
    "images": ("image_id", "name"),
    "keypoints": ("image_id", "rows", "cols", "data"),
    _GEOMETRIES: ("pair_id", "rows", "cols", "data"),
}


class PairRows(NamedTuple):
    """The pairs of some images that have verified inlier matches, sorted by (i, j)."""

    pairs: IntArray
    """(k, 2) images (i, j), i < j, by their place among the names; all else is (k,)."""
    rowids: IntArray
    """Rows of the table of geometries."""
    swapped: BoolArray
    """Whether the database has image j first."""
    num_inliers: IntArray


def pair_table(file: DatabaseFile) -> str:
    """Return the table of verified matches: that of an old COLMAP only where the newer one has no row."""
    old = file.columns(_INLIER_MATCHES)
    if not old or (file.columns(_GEOMETRIES) and file.query(f"SELECT 1 FROM {_GEOMETRIES} LIMIT 1")):
        return _GEOMETRIES
    return _INLIER_MATCHES


def check_schema(file: DatabaseFile) -> None:
    """Refuse a database without the tables and columns that are read, or that computes what they hold.

    A view, a virtual table and a generated column run code of whoever made the database when they are read.
    """
    for table in (*_REQUIRED_COLUMNS, _INLIER_MATCHES):
        file.refuse_computed(table)
    for table in ("images", "cameras"):
        file.refuse_mistyped(table)
    geometries = pair_table(file)
    for name, required in _REQUIRED_COLUMNS.items():
        table = geometries if name == _GEOMETRIES else name
        columns = file.columns(table)
        if missing := [name for name in required if name not in columns]:
            what = f"no column {missing[0]} in its table {table}" if columns else f"no table {table}"
            raise InputError(f"{file.path} is not a COLMAP database: it has {what}")


def refuse_no_features(file: DatabaseFile) -> None:
    """Refuse a database of which no feature was extracted."""
    check_schema(file)
    if _has_rows(file, "keypoints"):
        return
    (num_images,) = file.query("SELECT count(*) FROM images")[0]
    raise InputError(
        f"{file.path}: no features were extracted of its {counted(num_images, 'image')}; run colmap "
        "feature_extractor, then a matcher such as colmap exhaustive_matcher"
    )


def explain_no_pairs(file: DatabaseFile) -> str:
    """Return which step of COLMAP a database lacks before it has verified matches; empty if it has some."""
    table, missing = pair_table(file), "match the images and verify them geometrically first"
    configs = file.query(f"SELECT {_config(file, table)}, count(*) FROM {table} WHERE rows > 0 GROUP BY 1")
    if any(config not in _UNVERIFIED for config, _ in configs):
        return ""
    if configs:
        named = ", ".join(f"{counted(count, 'pair')} {_UNVERIFIED[config]}" for config, count in configs)
        hint = " (with --TwoViewGeometry.detect_watermark 0)" if 7 in dict(configs) else ""
        return f"{file.path} has no verified matches, but {named}; {missing}{hint}"
    if "rows" in file.columns("matches") and _has_rows(file, "matches"):
        return f"{file.path} has matches but no two-view geometries; {missing} (colmap geometric_verifier)"
    return f"{file.path} has features but no matches; {missing} (colmap exhaustive_matcher does both)"


def _has_rows(file: DatabaseFile, table: str) -> bool:
    return bool(file.query(f"SELECT 1 FROM {table} WHERE typeof(rows) != 'integer' OR rows != 0 LIMIT 1"))


def _config(file: DatabaseFile, table: str) -> str:
    """Return what to select as the configuration of a pair; all are verified where the table has none."""
    return "config" if "config" in file.columns(table) else str(_VERIFIED[0])


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
            raise InputError(f"{path}: the image {name} appears twice; remove one of them")
        index_of_id[image_id] = index
        if index >= 0:
            matched.add(index)
        elif example is None:
            example = name
    if not index_of_id:
        raise InputError(f"{path} has no images; run COLMAP's feature extraction and matching first")
    if len(matched) < 2:
        unmatched = next(name for index, name in enumerate(names) if index not in matched)
        elsewhere = f", and the database's {example} is not in the model" if example is not None else ""
        raise InputError(
            f"{path} has {len(matched)} of the model's {len(names)} images: the model's {unmatched} is "
            f"not in the database{elsewhere}; {ambiguity or 'give the database this model was made from'}"
        )
    if ambiguity:
        file.notes.append(f"{path}: {ambiguity}")
    return index_of_id


def read_pairs(file: DatabaseFile, index_of_id: dict[int, int], damage: Damage) -> PairRows:
    """Read which pairs of the images that have an index have verified inlier matches.

    Rows that cannot be used are left aside.
    """
    table = pair_table(file)
    config = _config(file, table)
    are_integers = " AND ".join(f"typeof({value}) = 'integer'" for value in ("pair_id", "rows", config))
    is_whole = f"{are_integers} AND cols = 2 AND typeof(data) = 'blob' AND length(data) = 8 * rows"
    filled = f"FROM {table} WHERE (typeof(rows) != 'integer' OR rows != 0) AND ({is_whole})"
    broken = file.query(f"SELECT pair_id, {are_integers} {filled} IS NOT 1 ORDER BY rowid")
    rows = file.query(f"SELECT rowid, pair_id, {config}, rows {filled} ORDER BY rowid")
    rowids, pair_ids, configs, num_inliers = np.array(rows, dtype=np.int64).reshape(-1, 4).T
    ids = np.stack(np.divmod(pair_ids, MAX_NUM_IMAGES), axis=1)
    ends, is_there = _indices_of(ids, index_of_id)
    is_new = np.zeros(len(rows), dtype=np.bool_)
    is_new[np.unique(pair_ids, return_index=True)[1]] = True
    is_known = np.isin(configs, (*_UNVERIFIED, *_VERIFIED))
    wrong = np.flatnonzero(~(is_there & is_known & is_new))
    first = ""
    if broken:
        reason = "has matches of wrong length" if broken[0][1] else "has no number where one belongs"
        first = f"{_called(file, broken[0][0])} {reason}"
    elif len(wrong):
        row = int(wrong[0])
        reason = f"has the unknown configuration {configs[row]}" if is_there[row] else "is of no two images"
        reason = reason if is_new[row] else "appears twice"
        first = f"{_called(file, int(pair_ids[row]))} {reason}"
    damage.leave_aside(len(broken) + len(wrong), len(broken) + len(rows), "pairs", first)
    swapped = ends[:, 0] > ends[:, 1]
    ends = np.sort(ends, axis=1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    is_used = is_there & is_new & (ends >= 0).all(axis=1) & np.isin(configs, _VERIFIED)
    order = order[is_used[order]]
    return PairRows(ends[order], rowids[order], swapped[order], num_inliers[order])


def _indices_of(ids: IntArray, index_of_id: dict[int, int]) -> tuple[IntArray, BoolArray]:
    """Return the indices (k, 2) of images by their ids, -1 where they have none, and which pairs exist."""
    known = np.array(sorted(index_of_id), dtype=np.int64)
    position = np.minimum(np.searchsorted(known, ids), len(known) - 1)
    is_there = (known[position] == ids).all(axis=1) & (ids[:, 0] < ids[:, 1])
    indices = np.array([index_of_id[i] for i in known.tolist()], dtype=np.int64)
    return indices[position], is_there


def _called(file: DatabaseFile, pair_id: object) -> str:
    """Return what a pair is called in messages: by the names of its images, or else by its id."""
    names = []
    if isinstance(pair_id, int) and pair_id >= 0:
        ids = divmod(pair_id, MAX_NUM_IMAGES)
        names = [row[0] for i in ids for row in file.query("SELECT name FROM images WHERE image_id = ?", i)]
    return f"the pair {names[0]} and {names[1]}" if len(names) == 2 else f"the pair with id {pair_id!r}"
